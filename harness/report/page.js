"use strict";
(() => {
  const HEIGHT_PX = 210;
  const LEFT_PX = 84;
  const RIGHT_PX = 80;
  const FONT = "12px system-ui, sans-serif";
  const PRINT_WIDTH_PX = 700; // an A4 page between its margins
  const ROBUST_TAIL = 0.15; // of the estimates in view, on either side, may lie outside the plot ...
  const ROBUST_SPREAD = 0.6; // ... and nothing farther than this from the truth widens it
  const CEILINGS_SHOWN = 2;
  const DENSE_PX = 10; // false alarms that are nearer to each other than this ...
  const DENSE_ALPHA = 0.2; // ... fade, at most to this

  const run = JSON.parse(document.getElementById("run").textContent);
  const last = run.samples - 1;
  const showEvery = document.getElementById("every");
  const view = { min: 0, max: last };
  let plots = [];

  async function decoded() {
    const bytes = Uint8Array.from(atob(run.deflated), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const buffer = await new Response(stream).arrayBuffer();
    const types = { uint8: Uint8Array, uint16: Uint16Array, float32: Float32Array };
    const signals = {};
    let at = 0;
    for (const column of run.columns) {
      const size = types[column.type].BYTES_PER_ELEMENT * run.samples;
      const raw = new types[column.type](buffer.slice(at, at + size)); // a copy is aligned
      at += size;
      const values = Array.from(raw, (v) => (Number.isFinite(v) ? column.offset + column.scale * v : null));
      signals[column.name] = { raw, values, unit: column.unit };
    }
    return signals;
  }

  function truth(name) {
    if (!run.segments.length) return null;
    const values = new Array(run.samples).fill(null);
    for (const segment of run.segments) values.fill(segment[name], segment.start, segment.end);
    return values;
  }

  function missingStretches(missing) {
    const stretches = [];
    for (let k = 0; k < missing.length; k++) {
      if (!missing[k]) continue;
      const first = k;
      while (k + 1 < missing.length && missing[k + 1]) k++;
      stretches.push([first, k]);
    }
    return stretches;
  }

  // Ranges of the vertical scales

  function inView(values) {
    const first = Math.max(0, Math.ceil(view.min));
    return values.slice(first, Math.min(last, Math.floor(view.max)) + 1).filter((v) => v !== null);
  }

  function padded(low, high) {
    const margin = Math.max(0.1 * (high - low), 0.01 * Math.abs(high), 1e-12);
    return [low - margin, high + margin];
  }

  function extent(values) {
    return values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]);
  }

  function plainRange(u, low, high) {
    return low === null || high === null ? [0, 1] : padded(low, high);
  }

  // Before it has converged, and after every change, an estimate may be anything: such values must not squash the plot.
  function estimateRange(estimates, truths) {
    return (u, low, high) => {
      if (showEvery.checked) return plainRange(u, low, high);
      const sorted = Float64Array.from(inView(estimates)).sort();
      const [lowest, highest] = extent(inView(truths || []));
      if (!sorted.length) return Number.isFinite(lowest) ? padded(lowest, highest) : [0, 1];
      const tail = Math.floor(ROBUST_TAIL * sorted.length);
      const [from, to] = [sorted[tail], sorted[sorted.length - 1 - tail]];
      if (!Number.isFinite(lowest)) return padded(from, to);
      return padded(
        Math.min(lowest, Math.max(from, lowest * (1 - ROBUST_SPREAD))),
        Math.max(highest, Math.min(to, highest * (1 + ROBUST_SPREAD))),
      );
    };
  }

  function statisticRange(u, low, high) {
    if (low === null || run.ceiling === null) return plainRange(u, low, high);
    const top = Math.max(high, 1.15 * run.ceiling);
    return [Math.min(0, low), showEvery.checked ? top : Math.min(top, CEILINGS_SHOWN * run.ceiling)];
  }

  // Marks

  // Lines lie under the signals, flags and labels above them.
  function marks(u, ink) {
    const px = devicePixelRatio;
    const seen = (mark) => mark.sample >= view.min && mark.sample <= view.max;
    const noticed = run.alarms.filter((alarm) => seen(alarm) && !alarm.false);
    const wrong = run.alarms.filter((alarm) => seen(alarm) && alarm.false);
    const room_px = u.bbox.width / px / Math.max(1, wrong.length);
    const alpha = Math.min(1, Math.max(DENSE_ALPHA, room_px / DENSE_PX)); // many of them must not hide the signals
    return {
      lines() {
        verticals(u, run.overloads.filter(seen), { colour: ink("truth"), width: 2, dash: [1, 3], alpha: 1 });
        verticals(u, run.tweaks.filter(seen), { colour: ink("ink"), width: 1.25, dash: [], alpha: 1 });
        verticals(u, wrong, { colour: ink("false"), width: 2.25, dash: [2, 3], alpha });
        verticals(u, noticed, { colour: ink("alarm"), width: 1.75, dash: [6, 4], alpha: 1 });
      },
      flags() {
        flags(u, wrong, ink("false"));
        flags(u, noticed, ink("alarm"));
        labels(u, run.tweaks.filter(seen), ink);
        lamps(u, run.overloads.filter(seen), ink);
      },
    };
  }

  function position(u, sample) {
    return Math.round(u.valToPos(sample, "x", true)) + 0.5;
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
    for (const { sample } of marked) {
      ctx.moveTo(position(u, sample), bbox.top);
      ctx.lineTo(position(u, sample), bbox.top + bbox.height);
    }
    ctx.stroke();
    ctx.restore();
  }

  function flags(u, marked, colour) {
    const { ctx, bbox } = u;
    const [size, bottom] = [5 * devicePixelRatio, bbox.top + bbox.height];
    ctx.save();
    ctx.fillStyle = colour;
    for (const { sample } of marked) {
      ctx.beginPath();
      ctx.moveTo(position(u, sample), bottom - 2 * size);
      ctx.lineTo(position(u, sample) + size, bottom);
      ctx.lineTo(position(u, sample) - size, bottom);
      ctx.fill();
    }
    ctx.restore();
  }

  function labels(u, tweaks, ink) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    lettered(u, ink("ink"), "center", "bottom");
    let free = -Infinity;
    for (const tweak of tweaks) {
      const x = position(u, tweak.sample);
      const half = ctx.measureText(tweak.label).width / 2;
      if (x - half < free) continue; // it would cover its neighbour; zooming in makes room
      ctx.fillText(tweak.label, x, bbox.top - 2 * px);
      free = x + half + 6 * px;
    }
    ctx.restore();
  }

  // A lit lamp and the name of its amplifier, inside the plot: those of one sample below one another.
  function lamps(u, overloads, ink) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    lettered(u, ink("truth"), "left", "middle");
    overloads.forEach((lamp, k) => {
      const above = overloads.slice(0, k).filter((other) => other.sample === lamp.sample).length;
      const [x, y] = [position(u, lamp.sample), bbox.top + (8 + 14 * above) * px];
      ctx.beginPath();
      ctx.arc(x, y, 4 * px, 0, 2 * Math.PI);
      ctx.fill();
      ctx.fillText(lamp.label, x + 7 * px, y);
    });
    ctx.restore();
  }

  function lettered({ ctx }, colour, align, baseline) {
    ctx.save();
    ctx.font = FONT.replace(/^\d+/, (size) => String(size * devicePixelRatio));
    ctx.fillStyle = colour;
    ctx.textAlign = align;
    ctx.textBaseline = baseline;
  }

  function missingBand(u, stretches, ink) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    ctx.save();
    ctx.fillStyle = ink("missing");
    for (const [first, final] of stretches) {
      if (final < view.min || first > view.max) continue;
      const from = Math.max(bbox.left, u.valToPos(first - 0.5, "x", true));
      const to = Math.min(bbox.left + bbox.width, u.valToPos(final + 0.5, "x", true));
      ctx.fillRect(from, bbox.top + bbox.height - 6 * px, Math.max(to - from, px), 6 * px);
    }
    ctx.restore();
  }

  // Plots

  function line(label, ink, colour, unit, more) {
    const value = (u, v) => (v === null || v === undefined ? "–" : `${v.toPrecision(5)}${unit ? " " + unit : ""}`);
    return { label, stroke: ink(colour), width: 1.5, points: { show: false }, value, ...more };
  }

  // Circles around the values at which the channel's bit of `clipped` is set.
  function circled(clipped, channel, ink, colour) {
    const indices = [];
    clipped.forEach((bits, k) => bits & (1 << channel) && indices.push(k));
    return {
      show: indices.length > 0,
      filter: () => indices.filter((k) => k >= view.min && k <= view.max),
      size: 7,
      width: 1.25,
      stroke: ink(colour),
      fill: "transparent",
    };
  }

  function axis(scale, label, side, ink, colour = "muted") {
    return {
      scale,
      side,
      label,
      size: (side === 3 ? LEFT_PX : RIGHT_PX) - 22,
      labelSize: 22,
      labelGap: 0,
      font: FONT,
      labelFont: FONT,
      stroke: ink(colour),
      grid: { show: side === 3, stroke: ink("line"), width: 1 },
      ticks: { stroke: ink("line"), width: 1, size: 5 },
    };
  }

  function sampleAxis(ink) {
    return { ...axis("x", "sample", 2, ink), size: 26, labelSize: 18, grid: { stroke: ink("line"), width: 1 } };
  }

  function pair(signals, ink, caption, left, right) {
    const [a, b] = [left, right].map((name) => signals[name]);
    const words = (name) => name.replace("_", " ");
    const points = (name, colour) => circled(signals.clipped.raw, run.columns.findIndex((c) => c.name === name), ink, colour);
    return {
      caption,
      data: [a.values, b.values],
      series: [
        line(words(left), ink, "first", a.unit, { scale: "left", points: points(left, "first") }),
        line(words(right), ink, "second", b.unit, { scale: "right", points: points(right, "second") }),
      ],
      scales: { left: { range: plainRange }, right: { range: plainRange } },
      axes: [
        axis("left", `${words(left)} [${a.unit}]`, 3, ink, "first"),
        axis("right", `${words(right)} [${b.unit}]`, 1, ink, "second"),
      ],
    };
  }

  function estimate(signals, ink, name, caption, unit) {
    const known = truth(name);
    const estimates = signals[name].values;
    const drawn = line("estimate", ink, "first", unit, { scale: "left" });
    const steps = uPlot.paths.stepped({ align: 1 });
    return {
      caption,
      data: known ? [known, estimates] : [estimates],
      series: known ? [line("truth", ink, "truth", unit, { scale: "left", width: 4, paths: steps }), drawn] : [drawn],
      scales: { left: { range: estimateRange(estimates, known) } },
      axes: [axis("left", `${name} [${unit}]`, 3, ink)],
    };
  }

  function statistic(signals, ink) {
    const values = signals.statistic.values;
    const ceiling = run.ceiling === null ? [] : [line("ceiling", ink, "truth", "", { scale: "left", width: 2, dash: [10, 6] })];
    return {
      caption: "Trigger: its statistic, and the ceiling above which it raises an alarm",
      data: ceiling.length ? [values, new Array(run.samples).fill(run.ceiling)] : [values],
      series: [line("statistic", ink, "first", "", { scale: "left" }), ...ceiling],
      scales: { left: { range: statisticRange } },
      axes: [axis("left", "statistic", 3, ink)],
    };
  }

  function options(plot, width, ink, stretches) {
    const rightAxis = plot.axes.length > 1;
    return {
      width,
      height: HEIGHT_PX,
      padding: [20, rightAxis ? 0 : RIGHT_PX, 0, 0],
      cursor: { y: false, sync: { key: "run", scales: ["x", null] }, drag: { x: true, y: false, dist: 4 } },
      scales: {
        x: {
          time: false,
          range: (u, min, max) => {
            view.min = Math.max(0, min ?? 0);
            view.max = Math.min(last, max ?? last);
            return [view.min, view.max];
          },
        },
        ...plot.scales,
      },
      axes: [sampleAxis(ink), ...plot.axes],
      series: [{ label: "sample" }, ...plot.series],
      hooks: {
        drawAxes: [(u) => marks(u, ink).lines()],
        draw: [(u) => missingBand(u, stretches, ink), (u) => marks(u, ink).flags()],
      },
    };
  }

  function show(first, final) {
    for (const plot of plots) plot.setScale("x", { min: Math.max(0, first), max: Math.min(last, final) });
  }

  function draw(signals) {
    const style = getComputedStyle(document.documentElement);
    const ink = (name) => style.getPropertyValue(`--${name}`).trim();
    const place = document.getElementById("plots");
    const width = document.documentElement.classList.contains("printing") ? PRINT_WIDTH_PX : place.clientWidth;
    const stretches = missingStretches(signals.missing.raw);
    const samples = Array.from({ length: run.samples }, (_, k) => k);
    const kept = { ...view };
    plots.forEach((plot) => plot.destroy());
    place.replaceChildren();
    plots = [
      pair(signals, ink, "Force on the suspension and its displacement", "force", "displacement"),
      ...(signals.velocity && signals.net_force
        ? [pair(signals, ink, "Velocity and net force", "velocity", "net_force")] : []),
      estimate(signals, ink, "M", "Mass: estimate and truth", "kg"),
      estimate(signals, ink, "B", "Damping: estimate and truth", "N s/m"),
      estimate(signals, ink, "K", "Stiffness: estimate and truth", "N/m"),
      statistic(signals, ink),
    ].map((plot) => {
      const figure = document.createElement("figure");
      const caption = document.createElement("figcaption");
      caption.textContent = plot.caption;
      figure.append(caption);
      place.append(figure);
      const drawn = new uPlot(options(plot, width, ink, stretches), [samples, ...plot.data], figure);
      const canvas = drawn.root.querySelector("canvas");
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `${plot.caption}, samples 0 to ${last}`);
      return drawn;
    });
    show(kept.min, kept.max);
  }

  function redrawn(signals) {
    const again = () => draw(signals);
    const printing = (on) => () => {
      document.documentElement.classList.toggle("printing", on);
      again();
    };
    addEventListener("beforeprint", printing(true));
    addEventListener("afterprint", printing(false));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
    const place = document.getElementById("plots");
    new ResizeObserver(() => {
      const width = place.clientWidth;
      if (document.documentElement.classList.contains("printing") || plots[0].width === width) return;
      for (const plot of plots) plot.setSize({ width, height: HEIGHT_PX });
    }).observe(place);
  }

  function controlled() {
    document.getElementById("whole").addEventListener("click", () => show(0, last));
    showEvery.addEventListener("change", () => show(view.min, view.max));
    for (const button of document.querySelectorAll("button[data-first]")) {
      const first = Number(button.dataset.first);
      const final = button.dataset.last === undefined ? first + 80 : Number(button.dataset.last);
      const lead = button.dataset.last === undefined ? 40 : 0;
      button.addEventListener("click", () => {
        show(first - lead, final);
        document.getElementById("signals").scrollIntoView();
      });
    }
  }

  function trouble(text) {
    const place = document.getElementById("trouble");
    place.textContent = text;
    place.hidden = false;
  }

  async function main() {
    if (!run.samples) return trouble("The run ended before its first sample: there is nothing to plot.");
    if (typeof DecompressionStream === "undefined") return trouble("This browser is too old for the plots: it has no DecompressionStream.");
    const signals = await decoded();
    draw(signals);
    redrawn(signals);
    controlled();
    document.documentElement.dataset.drawn = String(plots.length);
  }

  main().catch((error) => {
    trouble(`The plots could not be drawn: ${error.message}`);
    throw error;
  });
})();
