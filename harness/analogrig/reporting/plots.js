"use strict";
// Common parts of the pages with plots: decoding of the data, marks, print and dark scheme, error messages.
const plotting = (() => {
  const FONT = "12px system-ui, sans-serif";
  const PRINT_WIDTH_PX = 700; // an A4 page between its margins
  const DENSE_PX = 10; // smallest distance of false alarms that do not fade
  const DENSE_ALPHA = 0.2; // opacity of the most faded alarms
  const ZOOM = 1.25; // factor of one step of the wheel or one key
  const MOVE = 0.25; // share of the visible width by which a key moves the plots

  // Columns with their raw values, and with their values in the unit of the plot; null for a non-finite one.
  async function decoded(columns, deflated) {
    const bytes = Uint8Array.from(atob(deflated), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const buffer = await new Response(stream).arrayBuffer();
    const types = { uint8: Uint8Array, uint16: Uint16Array, float32: Float32Array };
    let at = 0;
    return columns.map((column) => {
      const size = types[column.type].BYTES_PER_ELEMENT * column.points;
      const raw = new types[column.type](buffer.slice(at, at + size)); // a copy is aligned
      at += size;
      const values = Array.from(raw, (v) => (Number.isFinite(v) ? column.offset + column.scale * v : null));
      return { ...column, raw, values };
    });
  }

  function padded(low, high) {
    const margin = Math.max(0.1 * (high - low), 0.01 * Math.abs(high), 1e-12);
    return [low - margin, high + margin];
  }

  // Marks; `at` is the position on the x axis.

  function position(u, at) {
    return Math.round(u.valToPos(at, "x", true)) + 0.5;
  }

  function verticals(u, marks, { colour, width, dash = [], alpha = 1 }) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = colour;
    ctx.globalAlpha = alpha;
    ctx.lineWidth = width * px;
    ctx.setLineDash(dash.map((d) => d * px));
    ctx.beginPath();
    for (const { at } of marks) {
      ctx.moveTo(position(u, at), bbox.top);
      ctx.lineTo(position(u, at), bbox.top + bbox.height);
    }
    ctx.stroke();
    ctx.restore();
  }

  function flags(u, marks, colour) {
    const { ctx, bbox } = u;
    const [size, bottom] = [5 * devicePixelRatio, bbox.top + bbox.height];
    ctx.save();
    ctx.fillStyle = colour;
    for (const { at } of marks) {
      ctx.beginPath();
      ctx.moveTo(position(u, at), bottom - 2 * size);
      ctx.lineTo(position(u, at) + size, bottom);
      ctx.lineTo(position(u, at) - size, bottom);
      ctx.fill();
    }
    ctx.restore();
  }

  // Prepare the context for text; the caller restores it.
  function lettered({ ctx }, colour, align, baseline) {
    ctx.save();
    ctx.font = FONT.replace(/^\d+/, (size) => String(size * devicePixelRatio));
    ctx.fillStyle = colour;
    ctx.textAlign = align;
    ctx.textBaseline = baseline;
  }

  function labels(u, marks, colour) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    lettered(u, colour, "center", "bottom");
    let free = -Infinity;
    for (const mark of marks) {
      const x = position(u, mark.at);
      const half = ctx.measureText(mark.label).width / 2;
      if (x - half < free) continue; // the label would cover its neighbour; zooming in makes room
      ctx.fillText(mark.label, x, bbox.top - 2 * px);
      free = x + half + 6 * px;
    }
    ctx.restore();
  }

  // Visible changes of the plant and alarms. Lines are below the signals, flags and labels above.
  function alarms(u, { changes, noticed, wrong }, ink) {
    const { min, max } = u.scales.x;
    const [moved, right, other] = [changes, noticed, wrong].map((all) => all.filter(({ at }) => at >= min && at <= max));
    const room_px = u.bbox.width / devicePixelRatio / Math.max(1, other.length);
    const alpha = Math.min(1, Math.max(DENSE_ALPHA, room_px / DENSE_PX)); // many alarms must not hide the signals
    return {
      lines() {
        verticals(u, moved, { colour: ink("ink"), width: 1.25 });
        verticals(u, other, { colour: ink("false"), width: 2, dash: [2, 3], alpha });
        verticals(u, right, { colour: ink("alarm"), width: 1.75, dash: [6, 4] });
      },
      flags() {
        flags(u, other, ink("false"));
        flags(u, right, ink("alarm"));
        labels(u, moved, ink("ink"));
      },
    };
  }

  // Curves, axes and layout

  function curve(label, stroke, { unit, ...more }) {
    const value = (u, v) => (v === null || v === undefined ? "–" : `${v.toPrecision(5)}${unit ? " " + unit : ""}`);
    return { label, stroke, width: 1.5, points: { show: false }, value, ...more };
  }

  // Labels of ticks with enough digits for their distance; uPlot's own have three decimals at most.
  function tickLabels(u, splits, _axis, _space, step) {
    const high = Math.max(...splits.map(Math.abs));
    const place = Math.floor(Math.log10(step) + 1e-9); // of the first digit that differs
    const whole = splits.map((v) => (Math.abs(v) < step / 2 ? 0 : v));
    if (high > 1e-3 && high <= 1e7) {
      const format = new Intl.NumberFormat("en", { maximumFractionDigits: Math.min(9, Math.max(0, 1 - place)) });
      return whole.map((v) => format.format(v));
    }
    const digits = Math.min(9, Math.max(0, Math.floor(Math.log10(high)) - place + 1));
    return whole.map((v) => (v === 0 ? "0" : v.toExponential(digits).replace(/\.?0*e/, "e")));
  }

  function axis(scale, label, side, ink, more) {
    const line = { stroke: ink("line"), width: 1 };
    return {
      scale,
      side,
      label,
      labelGap: 0,
      values: tickLabels,
      font: FONT,
      labelFont: FONT,
      stroke: ink("muted"),
      grid: line,
      ticks: { ...line, size: 5 },
      ...more,
    };
  }

  function inks() {
    const style = getComputedStyle(document.documentElement);
    return (name) => style.getPropertyValue(`--${name}`).trim();
  }

  function isPrinting() {
    return document.documentElement.classList.contains("printing");
  }

  // Zooming and moving. All plots with the same key follow.

  function show(u, min, max) {
    for (const plot of uPlot.sync(u.cursor.sync.key).plots) plot.setScale("x", { min, max });
  }

  function ends(u) {
    return [u.data[0][0], u.data[0][u.data[0].length - 1]];
  }

  // Move by a distance on the x axis, but not beyond the ends of the data.
  function move(u, distance) {
    const { min, max } = u.scales.x;
    const [first, last] = ends(u);
    const by = Math.max(first - min, Math.min(last - max, distance));
    show(u, min + by, max + by);
  }

  // Magnify the visible width by a factor; `at` keeps its place.
  function zoom(u, factor, at = (u.scales.x.min + u.scales.x.max) / 2) {
    const { min, max } = u.scales.x;
    const [first, last] = ends(u);
    show(u, Math.max(first, at + (min - at) / factor), Math.min(last, at + (max - at) / factor));
  }

  function width(u) {
    return u.scales.x.max - u.scales.x.min;
  }

  // The wheel with Ctrl zooms around the pointer; across, or with Shift, it moves the plots.
  function wheeled(u, event) {
    const across = event.shiftKey && !event.deltaX ? event.deltaY : event.deltaX;
    if (event.ctrlKey) zoom(u, event.deltaY < 0 ? ZOOM : 1 / ZOOM, u.posToVal(event.offsetX, "x"));
    else if (Math.abs(across) > Math.abs(event.deltaY) || event.shiftKey) move(u, (across * width(u)) / u.over.clientWidth);
    else return; // the page scrolls
    event.preventDefault();
  }

  const KEYS = {
    ArrowLeft: (u) => move(u, -MOVE * width(u)),
    ArrowRight: (u) => move(u, MOVE * width(u)),
    "+": (u) => zoom(u, ZOOM),
    "-": (u) => zoom(u, 1 / ZOOM),
    Home: (u) => move(u, -Infinity),
    End: (u) => move(u, Infinity),
    0: (u) => show(u, ...ends(u)),
  };

  function typed(u, event) {
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in KEYS)) return;
    KEYS[event.key](u);
    event.preventDefault();
  }

  // Dragging with Shift moves the plots; without, uPlot selects a range to zoom to.
  function pressed(u, target, select) {
    return (event) => {
      if (!event.shiftKey) return select(event);
      let from = event.clientX;
      const drag = (next) => {
        move(u, ((from - next.clientX) * width(u)) / u.over.clientWidth);
        from = next.clientX;
      };
      addEventListener("mousemove", drag);
      addEventListener("mouseup", () => removeEventListener("mousemove", drag), { once: true });
      event.preventDefault();
      return undefined;
    };
  }

  // Style of a curve's line in the legend.
  function styleOf(u, i) {
    const [long, gap] = u.series[i].dash ?? [];
    return !long ? "solid" : long > gap ? "dashed" : "dotted";
  }

  // The pointer reads out all plots with the same key. Dragging zooms all of them. `under` and `over` draw more below
  // and above the signals.
  function options({ key, right_px, scales, axes, series, marks, under = [], over = [] }, width, height, ink) {
    return {
      width,
      height,
      padding: [20, right_px, 0, 0],
      cursor: { y: false, sync: { key, scales: ["x", null] }, drag: { x: true, y: false, dist: 4 }, bind: { mousedown: pressed } },
      legend: { markers: { dash: styleOf } },
      scales,
      axes,
      series,
      hooks: {
        drawAxes: [...under, (u) => alarms(u, marks, ink).lines()],
        draw: [...over, (u) => alarms(u, marks, ink).flags()],
      },
    };
  }

  function plotted(plot, heights, ink) {
    const frame = document.createElement(plot.frame[0]);
    const caption = document.createElement(plot.frame[1]);
    frame.className = "plot";
    caption.textContent = plot.caption;
    frame.append(caption);
    plot.place.append(frame);
    const width = isPrinting() ? PRINT_WIDTH_PX : plot.place.clientWidth;
    const drawn = new uPlot(options(plot, width, heights[isPrinting() ? 1 : 0], ink), plot.data, frame);
    drawn.over.addEventListener("wheel", (event) => wheeled(drawn, event), { passive: false });
    frame.addEventListener("keydown", (event) => typed(drawn, event));
    frame.tabIndex = 0;
    const canvas = drawn.root.querySelector("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", plot.name);
    return drawn;
  }

  // Draw what `describe` returns, again for print and for another colour scheme, and fit it to its container.
  // Return a function that returns the plots.
  function drawn(describe, heights) {
    let plots = [];
    function draw() {
      const ink = inks();
      const kept = plots.map(({ scales }) => ({ min: scales.x.min, max: scales.x.max }));
      plots.forEach((plot) => plot.destroy());
      const described = describe(ink);
      for (const { place } of described) place.replaceChildren();
      plots = described.map((plot) => plotted(plot, heights, ink));
      kept.forEach((range, i) => plots[i].setScale("x", range));
      return described[0].place;
    }
    const printing = (on) => () => {
      document.documentElement.classList.toggle("printing", on);
      draw();
    };
    const place = draw();
    addEventListener("beforeprint", printing(true));
    addEventListener("afterprint", printing(false));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    new ResizeObserver(() => {
      const width = place.clientWidth;
      if (!width || isPrinting() || plots[0].width === width) return;
      for (const plot of plots) plot.setSize({ width, height: heights[0] });
    }).observe(place);
    return () => plots;
  }

  function trouble(text) {
    const place = document.getElementById("trouble");
    place.textContent = text;
    place.hidden = false;
  }

  // `show` draws the decoded columns and returns the number of plots.
  async function begin(columns, deflated, show) {
    if (typeof DecompressionStream === "undefined") {
      return trouble("This browser is too old for the plots: it has no DecompressionStream.");
    }
    try {
      document.documentElement.dataset.drawn = String(show(await decoded(columns, deflated)));
    } catch (error) {
      trouble(`The plots could not be drawn: ${error.message}`);
      throw error;
    }
  }

  return { axis, begin, curve, drawn, inks, lettered, padded, position, trouble, verticals };
})();
