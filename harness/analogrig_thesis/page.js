"use strict";
(() => {
  const [HEIGHT_PX, PRINT_HEIGHT_PX] = [190, 136]; // two figures of two plots to a printed page
  const [LEFT_PX, RIGHT_PX] = [78, 16];
  const { alarms, axis, begin, cursor, curve, inks, isPrinting, padded, plotted, redrawn, widthOf } = plotting;

  const data = JSON.parse(document.getElementById("data").textContent);
  const showEvery = document.getElementById("every");
  let plots = [];

  function decoded(buffer) {
    let at = 0;
    return data.lengths.map((n) => {
      const raw = new Float32Array(buffer, at, n);
      at += 4 * n;
      return Array.from(raw, (v) => (Number.isFinite(v) ? v : null));
    });
  }

  function range(shown) {
    return (u, low, high) => {
      if (low === null || high === null) return shown ?? [0, 1];
      const [from, to] = padded(low, high);
      if (!shown || showEvery.checked) return [from, to];
      const inside = [Math.max(from, shown[0]), Math.min(to, shown[1])];
      return inside[0] < inside[1] ? inside : shown;
    };
  }

  function marks(figure) {
    const [changes, noticed, wrong] = ["change", "alarm", "false"].map((kind) => figure.marks.filter((mark) => mark.kind === kind));
    return { changes, noticed, wrong };
  }

  function series(each, ink) {
    return curve(each.label, ink(each.ink), {
      width: each.ink === "truth" && each.style !== "dash" ? 3.5 : 1.5,
      dash: each.style === "dash" ? [8, 5] : undefined,
      paths: each.style === "step" ? uPlot.paths.stepped({ align: 1 }) : undefined,
    });
  }

  function options(figure, panel, width, ink) {
    const wide = (u, values) => values.map((v) => (v === null ? "" : String(v)));
    const shown = marks(figure);
    return {
      width,
      height: isPrinting() ? PRINT_HEIGHT_PX : HEIGHT_PX,
      padding: [20, RIGHT_PX, 0, 0],
      cursor: cursor(figure.number),
      scales: { x: { time: false, distr: panel.log_x ? 3 : 1 }, y: { range: range(panel.shown) } },
      axes: [
        axis("x", panel.x_label, 2, ink, { size: 26, labelSize: 20, ...(panel.log_x ? { values: wide } : {}) }),
        axis("y", panel.y_label, 3, ink, { size: LEFT_PX - 20, labelSize: 20 }),
      ],
      series: [{ label: panel.x_label }, ...panel.curves.map((each) => series(each, ink))],
      hooks: {
        drawAxes: [(u) => alarms(u, shown, ink).lines()],
        draw: [(u) => alarms(u, shown, ink).flags()],
      },
    };
  }

  function drawn(figure, panel, columns, place, width, ink) {
    const holder = document.createElement("div");
    const title = document.createElement("h4");
    title.textContent = panel.title;
    holder.className = "plot";
    holder.append(title);
    place.append(holder);
    const values = panel.curves.map((each) => columns[each.column]);
    const x = panel.x === null ? Array.from(values[0], (_, k) => k) : columns[panel.x];
    return plotted(options(figure, panel, width, ink), [x, ...values], holder, `Fig. ${figure.number}, ${panel.title}`);
  }

  function draw(columns) {
    const ink = inks();
    plots.forEach((plot) => plot.destroy());
    plots = data.figures.flatMap((figure, i) => {
      const place = document.querySelector(`[data-figure="${i}"]`);
      place.replaceChildren();
      return figure.panels.map((panel) => drawn(figure, panel, columns, place, widthOf(place), ink));
    });
  }

  begin(data.deflated, (buffer) => {
    const columns = decoded(buffer);
    draw(columns);
    redrawn(() => draw(columns), document.querySelector("[data-figure]"), () => plots, HEIGHT_PX);
    showEvery.addEventListener("change", () => plots.forEach((plot) => plot.setScale("x", plot.scales.x)));
    return plots.length;
  });
})();
