"use strict";
(() => {
  const HEIGHTS_PX = [190, 136]; // on paper two figures of two plots to a page
  const [LEFT_PX, RIGHT_PX] = [78, 16];
  const { axis, begin, curve, drawn, padded } = plotting;

  const data = JSON.parse(document.getElementById("data").textContent);
  const showEvery = document.getElementById("every");

  function range(shown) {
    return (u, low, high) => {
      if (low === null || high === null) return shown ?? [0, 1];
      const [from, to] = padded(low, high);
      if (!shown || showEvery.checked) return [from, to];
      const inside = [Math.max(from, shown[0]), Math.min(to, shown[1])];
      return inside[0] < inside[1] ? inside : shown;
    };
  }

  const TRUTH_DASHES = { "first-truth": undefined, "second-truth": [14, 4], "third-truth": [4, 4] };

  function series({ label, ink: colour = "first", style }, ink) {
    return curve(label, ink(colour), {
      width: colour.endsWith("truth") && style !== "dash" ? 3.5 : 1.5,
      dash: style === "dash" ? [8, 5] : TRUTH_DASHES[colour],
      paths: style === "step" ? uPlot.paths.stepped({ align: 1 }) : undefined,
    });
  }

  function described({ number, marks, panels }, columns, ink) {
    const [changes, noticed, wrong] = ["change", "alarm", "false"].map((kind) => marks.filter((mark) => mark.kind === kind));
    const wide = (u, values) => values.map((v) => (v === null ? "" : String(v)));
    return panels.map(({ title, y_label, x_label, shown, x, curves }) => {
      const values = curves.map((each) => columns[each.column].values);
      return {
        place: document.querySelector(`[data-figure="${number}"]`),
        frame: ["div", "p"],
        caption: title,
        name: `Fig. ${number}, ${title}`,
        key: number,
        right_px: RIGHT_PX,
        data: [x === null ? Array.from(values[0], (_, k) => k) : columns[x].values, ...values],
        scales: { x: { time: false, distr: x_label ? 3 : 1 }, y: { range: range(shown) } },
        axes: [
          axis("x", x_label ?? "sample", 2, ink, { size: 26, labelSize: 20, ...(x_label ? { values: wide } : {}) }),
          axis("y", y_label, 3, ink, { size: LEFT_PX - 20, labelSize: 20 }),
        ],
        series: [{ label: x_label ?? "sample" }, ...curves.map((each) => series(each, ink))],
        marks: { changes, noticed, wrong },
      };
    });
  }

  // Filter by chapter and verdict. With a verdict, only the claims that have it are shown.
  function filtered() {
    const [chapter, verdict] = ["chapter", "verdict"].map((id) => document.getElementById(id));
    const claims = [...document.querySelectorAll(".claim")];
    const chapters = [...document.querySelectorAll("main > section")];
    const isClaims = (part) => part.classList.contains("claim") || part.id.startsWith("claims-") || part.tagName === "H2";
    function apply() {
      for (const each of claims) each.hidden = Boolean(verdict.value) && each.dataset.verdict !== verdict.value;
      for (const each of chapters) {
        const claimed = each.querySelector(".claim:not([hidden])");
        const isWanted = !chapter.value || each.dataset.chapter === chapter.value;
        each.hidden = !isWanted || (Boolean(verdict.value) && !claimed);
        for (const part of each.children) if (!part.classList.contains("claim")) part.hidden = Boolean(verdict.value) && !isClaims(part);
      }
      const shown = claims.filter((each) => !each.hidden && !each.closest("section").hidden);
      document.getElementById("count").textContent = `${shown.length} of ${claims.length} claims`;
    }
    // A link to a part that is hidden shows all parts.
    function follow() {
      const goal = document.getElementById(decodeURIComponent(location.hash.slice(1)));
      if (!goal?.closest("[hidden]")) return;
      [chapter.value, verdict.value] = ["", ""];
      apply();
      goal.scrollIntoView();
    }
    for (const each of [chapter, verdict]) each.addEventListener("change", apply);
    addEventListener("hashchange", follow);
    apply();
  }

  filtered();
  begin(data.columns, data.deflated, (columns) => {
    const plots = drawn((ink) => data.figures.flatMap((figure) => described(figure, columns, ink)), HEIGHTS_PX);
    showEvery.addEventListener("change", () => plots().forEach((plot) => plot.setScale("x", plot.scales.x)));
    return plots().length;
  });
})();
