"use strict";
(() => {
  const HEIGHT_PX = 246;
  const LEFT_PX = 84;
  const RIGHT_PX = 80;
  const ROBUST_TAIL = 0.15; // share of the visible estimates on either side that may lie outside the plot
  const ROBUST_SPREAD = 0.6; // relative distance from the truth beyond which an estimate does not widen the plot
  const INNOVATIONS_SHOWN = 0.99; // share of the visible innovations that determines their range
  const CEILINGS_SHOWN = 2;
  const BUCKET_PX = 3;
  const { begin, curve, drawn, lettered, padded, position, trouble, verticals } = plotting;

  const run = JSON.parse(document.getElementById("run").textContent);
  const last = run.samples - 1;
  const showEvery = document.getElementById("every");
  const view = { min: 0, max: last };
  const places = placed();
  let plots = () => [];

  // Sample of each point. A bucket of several samples has two points: the minimum and the maximum.
  function placed() {
    const places = [];
    for (const [start, end, size] of run.pieces) {
      for (let first = start; first < end; first += size) {
        places.push(first);
        if (size > 1) places.push(first + (Math.min(size, end - first) >> 1));
      }
    }
    return places;
  }

  // First point at or after a sample.
  function pointAt(sample) {
    let [low, high] = [0, places.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (places[middle] < sample) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  function truth(name) {
    if (!run.segments.length) return null;
    const values = new Array(run.points).fill(null);
    for (const segment of run.segments) values.fill(segment[name], pointAt(segment.start), pointAt(segment.end));
    return values;
  }

  // Ranges of the vertical scales

  function inView(values) {
    const [first, end] = [pointAt(view.min), pointAt(Math.floor(view.max) + 1)];
    const seen = first < end ? values.slice(first, end) : values.slice(Math.max(0, first - 1), first + 1); // or the nearest neighbours
    return seen.filter((v) => v !== null);
  }

  function extent(values) {
    return values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]);
  }

  function plainRange(u, low, high) {
    return low === null || high === null ? [0, 1] : padded(low, high);
  }

  // Transients before convergence and after a change can be arbitrarily large. They must not squash the plot.
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

  // Symmetrical. The innovations before convergence and after a change must not squash the others.
  function innovationRange(u, low, high) {
    const sorted = Float64Array.from(inView(u.data[1]), Math.abs).sort();
    if (!sorted.length) return [-1, 1];
    const shown = sorted[Math.floor((showEvery.checked ? 1 : INNOVATIONS_SHOWN) * (sorted.length - 1))];
    return padded(-shown, shown);
  }

  function statisticRange(u, low, high) {
    if (low === null || run.ceiling === null) return plainRange(u, low, high);
    const top = Math.max(high, 1.15 * run.ceiling);
    return [Math.min(0, low), showEvery.checked ? top : Math.min(top, CEILINGS_SHOWN * run.ceiling)];
  }

  // Marks

  const marked = (all) => all.map((mark) => ({ ...mark, at: mark.sample }));
  const lit = marked(run.overloads);
  const noticed = marked(run.alarms.filter((alarm) => !alarm.false));
  const wrong = marked(run.alarms.filter((alarm) => alarm.false));
  const marks = { changes: marked(run.changes), noticed, wrong };

  // Lit lamps with the names of their amplifiers, inside the plot. Those of one sample are stacked.
  function lamps(u, ink) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    lettered(u, ink("truth"), "left", "middle");
    const seen = lit.filter(({ at }) => at >= view.min && at <= view.max);
    seen.forEach((lamp, k) => {
      const above = seen.slice(0, k).filter((other) => other.at === lamp.at).length;
      const [x, y] = [position(u, lamp.at), bbox.top + (8 + 14 * above) * px];
      ctx.beginPath();
      ctx.arc(x, y, 4 * px, 0, 2 * Math.PI);
      ctx.fill();
      ctx.fillText(lamp.label, x + 7 * px, y);
    });
    ctx.restore();
  }

  function missingBand(u, missing, ink) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    ctx.save();
    ctx.fillStyle = ink("missing");
    for (let k = pointAt(view.min); k < places.length && places[k] <= view.max; k++) {
      if (!missing[k]) continue;
      const from = Math.max(bbox.left, Math.floor(u.valToPos(places[k] - 0.5, "x", true))); // whole pixels leave no seams
      const to = Math.min(bbox.left + bbox.width, Math.ceil(u.valToPos((places[k + 1] ?? last + 1) - 0.5, "x", true)));
      ctx.fillRect(from, bbox.top + bbox.height - 6 * px, Math.max(to - from, px), 6 * px);
    }
    ctx.restore();
  }

  // Shade and label the stretches in which two points represent many samples and could be taken for a signal.
  function buckets(u, ink) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    for (const [start, end, size] of run.pieces) {
      if (size === 1 || (size * bbox.width) / (view.max - view.min) <= BUCKET_PX * px) continue;
      const from = Math.max(bbox.left, u.valToPos(start, "x", true));
      const width = Math.min(bbox.left + bbox.width, u.valToPos(end, "x", true)) - from;
      if (width <= 0) continue;
      ctx.save();
      ctx.fillStyle = ink("line");
      ctx.globalAlpha = 0.35;
      ctx.fillRect(from, bbox.top, width, bbox.height);
      ctx.restore();
      lettered(u, ink("muted"), "left", "bottom");
      const words = `minimum and maximum of every ${size} samples`;
      if (ctx.measureText(words).width < width) ctx.fillText(words, from, bbox.top - 2 * px);
      ctx.restore();
    }
  }

  // Plots

  function bitOf(name) {
    return 1 << run.columns.findIndex((c) => c.name === name);
  }

  // Values of a channel; null where an imported column has none: a clipped one would lie at an end of the range.
  function seen(signals, name) {
    const { raw, values, last } = signals[name];
    const isGap = (k) => signals.clipped.raw[k] & bitOf(name) && raw[k] !== 0 && raw[k] !== last;
    return last === undefined ? values : values.map((v, k) => (isGap(k) ? null : v));
  }

  // Circles around the values at which the channel's bit of `clipped` is set.
  function circled(clipped, name, values, ink, colour) {
    const indices = [];
    clipped.forEach((bits, k) => bits & bitOf(name) && values[k] !== null && indices.push(k));
    return {
      show: indices.length > 0,
      filter: () => indices.filter((k) => places[k] >= view.min && places[k] <= view.max),
      size: 7,
      width: 1.25,
      stroke: ink(colour),
      fill: "transparent",
    };
  }

  function axis(scale, label, side, ink, colour = "muted") {
    const size = (side === 3 ? LEFT_PX : RIGHT_PX) - 22;
    const grid = { show: side === 3, stroke: ink("line"), width: 1 };
    return plotting.axis(scale, label, side, ink, { size, labelSize: 22, stroke: ink(colour), grid });
  }

  // Plot of some curves, each with its values `of` every point.
  function plotOf(ink, caption, curves, range, axes) {
    return {
      caption,
      data: curves.map(({ of }) => of),
      series: curves.map(({ label, colour, ...more }) => curve(label, ink(colour), { scale: "left", ...more })),
      scales: { left: { range }, right: { range } },
      axes,
    };
  }

  // A generator holds its level between edges.
  const stepped = uPlot.paths.stepped({ align: 1 });

  // Plot of one channel, or of two.
  function pair(signals, ink, left, right) {
    const words = (name) => name.replaceAll("_", " ");
    const label = (name) => `${words(name)} [${signals[name].unit}]`;
    const curveOf = (name, scale, colour) => {
      const of = seen(signals, name);
      const points = circled(signals.clipped.raw, name, of, ink, colour);
      const paths = name === run.channels[0] ? stepped : undefined;
      return { of, label: words(name), colour, unit: signals[name].unit, scale, points, paths };
    };
    const curves = [curveOf(left, "left", "first")], axes = [axis("left", label(left), 3, ink, "first")];
    if (right === undefined) return plotOf(ink, words(left), curves, plainRange, axes);
    curves.push(curveOf(right, "right", "second"));
    axes.push(axis("right", label(right), 1, ink, "second"));
    return plotOf(ink, `${words(left)} and ${words(right)}`, curves, plainRange, axes);
  }

  function estimate(signals, ink, name, unit) {
    const known = truth(name);
    const found = { of: signals[name].values, label: "estimate", colour: "first", unit };
    const curves = known ? [{ of: known, label: "truth", colour: "truth", unit, width: 4, paths: stepped }, found] : [found];
    return plotOf(ink, `${name}: estimate and truth`, curves, estimateRange(found.of, known), [axis("left", `${name} [${unit}]`, 3, ink)]);
  }

  function gainUnit(signals) {
    const [input, output] = run.channels;
    return `${signals[output].unit}/${signals[input].unit}`;
  }

  function innovation(signals, ink) {
    const caption = "Innovation: the measured output less the predicted one";
    const curves = [{ of: signals.innovation.values, label: "innovation", colour: "first", unit: "codes" }];
    return plotOf(ink, caption, curves, innovationRange, [axis("left", "innovation [codes]", 3, ink)]);
  }

  function statistic(signals, ink) {
    const caption = "Trigger: its statistic, and the ceiling above which it raises an alarm";
    const curves = [{ of: signals.statistic.values, label: "statistic", colour: "first" }];
    if (run.ceiling !== null) {
      const ceiling = new Array(run.points).fill(run.ceiling);
      curves.push({ of: ceiling, label: "ceiling", colour: "truth", width: 2, dash: [10, 6] });
    }
    return plotOf(ink, caption, curves, statisticRange, [axis("left", "statistic", 3, ink)]);
  }

  const samples = {
    time: false,
    range: (u, min, max) => {
      view.min = Math.max(0, min ?? 0);
      view.max = Math.min(last, max ?? last);
      return [view.min, view.max];
    },
  };

  const seconds = { time: false, from: "x", range: (u, min, max) => [min * run.period_s, max * run.period_s] };

  function described(signals, ink) {
    return [
      pair(signals, ink, ...run.channels.slice(0, 2)),
      ...(run.channels.length > 2 ? [pair(signals, ink, ...run.channels.slice(2, 4))] : []),
      ...run.estimates.map(({ name, unit }) => estimate(signals, ink, name, unit)),
      ...(signals.resonance ? [ // of an unknown plant
        estimate(signals, ink, "resonance", "Hz"),
        estimate(signals, ink, "damping", "1"),
        estimate(signals, ink, "gain", gainUnit(signals)),
      ] : []),
      ...(signals.innovation ? [innovation(signals, ink)] : []),
      ...(signals.statistic ? [statistic(signals, ink)] : []),
    ].map((plot) => ({
      ...plot,
      place: document.getElementById("plots"),
      frame: ["figure", "figcaption"],
      name: `${plot.caption}, samples 0 to ${last}`,
      key: "run",
      right_px: plot.axes.length > 1 ? 0 : RIGHT_PX,
      data: [places, ...plot.data],
      scales: { x: samples, seconds, ...plot.scales },
      axes: [
        plotting.axis("x", "sample", 2, ink, { size: 26, labelSize: 18 }),
        plotting.axis("seconds", "problem time [s]", 2, ink, { size: 26, labelSize: 18, grid: { show: false } }),
        ...plot.axes,
      ],
      series: [{ label: "sample" }, ...plot.series],
      marks,
      under: [
        (u) => buckets(u, ink),
        (u) => verticals(u, lit, { colour: ink("truth"), width: 2, dash: [1, 3] }),
      ],
      over: [(u) => missingBand(u, signals.missing.raw, ink), (u) => lamps(u, ink)],
    }));
  }

  function show(first, final) {
    for (const plot of plots()) plot.setScale("x", { min: Math.max(0, first), max: Math.min(last, final) });
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

  function shown(columns) {
    const signals = Object.fromEntries(columns.map((column) => [column.name, column]));
    plots = drawn((ink) => described(signals, ink), [HEIGHT_PX, HEIGHT_PX]);
    show(0, last);
    controlled();
    return plots().length;
  }

  const columns = run.columns.map((column) => ({ ...column, points: run.points }));
  if (run.samples) begin(columns, run.deflated, shown);
  else trouble("The run ended before its first sample: there is nothing to plot.");
})();
