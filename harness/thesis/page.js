"use strict";
(() => {
  const [HEIGHT_PX, PRINT_HEIGHT_PX] = [190, 136]; // two figures of two plots to a printed page
  const [LEFT_PX, RIGHT_PX] = [78, 16];
  const FONT = "12px system-ui, sans-serif";
  const PRINT_WIDTH_PX = 700; // an A4 page between its margins
  const DENSE_PX = 10; // other alarms that are nearer to each other than this ...
  const DENSE_ALPHA = 0.25; // ... fade, at most to this

  const data = JSON.parse(document.getElementById("data").textContent);
  const showEvery = document.getElementById("every");
  let plots = [];

  async function decoded() {
    const bytes = Uint8Array.from(atob(data.deflated), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const buffer = await new Response(stream).arrayBuffer();
    let at = 0;
    return data.lengths.map((n) => {
      const raw = new Float32Array(buffer, at, n);
      at += 4 * n;
      return Array.from(raw, (v) => (Number.isFinite(v) ? v : null));
    });
  }

  function padded(low, high) {
    const margin = Math.max(0.08 * (high - low), 0.01 * Math.abs(high), 1e-9);
    return [low - margin, high + margin];
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

  function position(u, at) {
    return Math.round(u.valToPos(at, "x", true)) + 0.5;
  }

  function verticals(u, marked, { colour, width, dash, alpha }) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = colour;
    ctx.globalAlpha = alpha;
    ctx.lineWidth = width * px;
    ctx.setLineDash(dash.map((d) => d * px));
    ctx.beginPath();
    for (const mark of marked) {
      ctx.moveTo(position(u, mark.at), bbox.top);
      ctx.lineTo(position(u, mark.at), bbox.top + bbox.height);
    }
    ctx.stroke();
    ctx.restore();
  }

  function flags(u, marked, colour) {
    const { ctx, bbox } = u;
    const [size, bottom] = [4 * devicePixelRatio, bbox.top + bbox.height];
    ctx.save();
    ctx.fillStyle = colour;
    for (const mark of marked) {
      ctx.beginPath();
      ctx.moveTo(position(u, mark.at), bottom - 2 * size);
      ctx.lineTo(position(u, mark.at) + size, bottom);
      ctx.lineTo(position(u, mark.at) - size, bottom);
      ctx.fill();
    }
    ctx.restore();
  }

  function labels(u, marked, colour) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    ctx.save();
    ctx.font = FONT.replace(/^\d+/, (size) => String(size * px));
    ctx.fillStyle = colour;
    ctx.textAlign = "center";
    ctx.textBaseline = "bottom";
    let free = -Infinity;
    for (const mark of marked) {
      const x = position(u, mark.at);
      const half = ctx.measureText(mark.label).width / 2;
      if (x - half < free) continue; // it would cover its neighbour; zooming in makes room
      ctx.fillText(mark.label, x, bbox.top - 2 * px);
      free = x + half + 6 * px;
    }
    ctx.restore();
  }

  // Lines lie under the signals, flags and labels above them.
  function marks(u, figure, ink) {
    const { min, max } = u.scales.x;
    const seen = (kind) => figure.marks.filter((mark) => mark.kind === kind && mark.at >= min && mark.at <= max);
    const [changes, noticed, wrong] = ["change", "alarm", "false"].map(seen);
    const room_px = u.bbox.width / devicePixelRatio / Math.max(1, wrong.length);
    const alpha = Math.min(1, Math.max(DENSE_ALPHA, room_px / DENSE_PX)); // many of them must not hide the signals
    return {
      lines() {
        verticals(u, wrong, { colour: ink("false"), width: 1.5, dash: [2, 3], alpha });
        verticals(u, changes, { colour: ink("ink"), width: 1.25, dash: [], alpha: 1 });
        verticals(u, noticed, { colour: ink("alarm"), width: 1.75, dash: [6, 4], alpha: 1 });
      },
      flags() {
        flags(u, wrong, ink("false"));
        flags(u, noticed, ink("alarm"));
        labels(u, changes, ink("ink"));
      },
    };
  }

  function series(curve, ink) {
    const value = (u, v) => (v === null || v === undefined ? "–" : v.toPrecision(5));
    return {
      label: curve.label,
      stroke: ink(curve.ink),
      width: curve.ink === "truth" && curve.style !== "dash" ? 3.5 : 1.5,
      dash: curve.style === "dash" ? [8, 5] : undefined,
      paths: curve.style === "step" ? uPlot.paths.stepped({ align: 1 }) : undefined,
      points: { show: false },
      value,
    };
  }

  function axis(label, side, ink) {
    return {
      side,
      label,
      scale: side === 2 ? "x" : "y",
      size: side === 2 ? 26 : LEFT_PX - 20,
      labelSize: 20,
      labelGap: 0,
      font: FONT,
      labelFont: FONT,
      stroke: ink("muted"),
      grid: { stroke: ink("line"), width: 1 },
      ticks: { stroke: ink("line"), width: 1, size: 5 },
    };
  }

  function isPrinting() {
    return document.documentElement.classList.contains("printing");
  }

  function options(figure, panel, width, ink) {
    const wide = (u, values) => values.map((v) => (v === null ? "" : String(v)));
    return {
      width,
      height: isPrinting() ? PRINT_HEIGHT_PX : HEIGHT_PX,
      padding: [20, RIGHT_PX, 0, 0],
      cursor: { y: false, sync: { key: figure.number, scales: ["x", null] }, drag: { x: true, y: false, dist: 4 } },
      scales: { x: { time: false, distr: panel.log ? 3 : 1 }, y: { range: range(panel.shown) } },
      axes: [{ ...axis(panel.x_label, 2, ink), ...(panel.log ? { values: wide } : {}) }, axis(panel.y_label, 3, ink)],
      series: [{ label: panel.x_label }, ...panel.curves.map((curve) => series(curve, ink))],
      hooks: {
        drawAxes: [(u) => marks(u, figure, ink).lines()],
        draw: [(u) => marks(u, figure, ink).flags()],
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
    const values = panel.curves.map((curve) => columns[curve.column]);
    const x = panel.x === null ? Array.from(values[0], (_, k) => k) : columns[panel.x];
    const plot = new uPlot(options(figure, panel, width, ink), [x, ...values], holder);
    const canvas = plot.root.querySelector("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Fig. ${figure.number}, ${panel.title}`);
    return plot;
  }

  function draw(columns) {
    const style = getComputedStyle(document.documentElement);
    const ink = (name) => style.getPropertyValue(`--${name}`).trim();
    plots.forEach((plot) => plot.destroy());
    plots = data.figures.flatMap((figure, i) => {
      const place = document.querySelector(`[data-figure="${i}"]`);
      place.replaceChildren();
      const width = isPrinting() ? PRINT_WIDTH_PX : place.clientWidth;
      return figure.panels.map((panel) => drawn(figure, panel, columns, place, width, ink));
    });
  }

  function redrawn(columns) {
    const again = () => draw(columns);
    const printing = (on) => () => {
      document.documentElement.classList.toggle("printing", on);
      again();
    };
    addEventListener("beforeprint", printing(true));
    addEventListener("afterprint", printing(false));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
    showEvery.addEventListener("change", () => plots.forEach((plot) => plot.setScale("x", plot.scales.x)));
    const place = document.querySelector("[data-figure]");
    new ResizeObserver(() => {
      const width = place.clientWidth;
      if (!width || isPrinting() || plots[0].width === width) return;
      for (const plot of plots) plot.setSize({ width, height: HEIGHT_PX });
    }).observe(place);
  }

  function trouble(text) {
    const place = document.getElementById("trouble");
    place.textContent = text;
    place.hidden = false;
  }

  async function main() {
    if (typeof DecompressionStream === "undefined") return trouble("This browser is too old for the plots: it has no DecompressionStream.");
    const columns = await decoded();
    draw(columns);
    redrawn(columns);
    document.documentElement.dataset.drawn = String(plots.length);
  }

  main().catch((error) => {
    trouble(`The plots could not be drawn: ${error.message}`);
    throw error;
  });
})();
