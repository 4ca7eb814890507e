"use strict";
// The live bench: draws frames and states of the server, and sends what the hand does.
(() => {
  const COLOURS = ["first", "second", "third", "truth", "missing", "false", "ink"];
  const BASES_S = [0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2];
  const DIVISIONS = 5; // above and below the middle
  const STEPS = [1, 2, 5, 10]; // of scales, in each decade
  const SPECTRUM = { per: 20, middle: -60 }; // dB
  const WIDTH = 1; // of curves: wider ones take three times as long to draw without a graphics processor
  const KEPT = 12; // frames of the persistence
  const RETRY_MS = 500;
  const HAND_MS = 40; // time between two messages of a hand that turns a pot
  const RAMP_N = 16; // samples of its ramps: each takes the emulator as long as fifty of a pot that stands still
  const BEHIND_MS = 3000; // time for which the page warns that the bench has fallen behind real time
  const SILENT_S = 3; // without an answer, of which the page tells
  const NOTICE_MS = 15000; // time for which a message stays at the bottom: the list keeps it
  const PATCH_WIDTH = 560;
  const SVG = "http://www.w3.org/2000/svg";
  const $ = (id) => document.getElementById(id);
  const ink = plotting.inks();

  let socket = null;
  let bench = null;
  let state = null;
  let frame = null;
  let waiting = null; // range of the source while the trigger has not come
  let frames = 0; // that were drawn
  let isDue = false; // true until the last frame is drawn
  let measures = null; // that were not shown yet
  let shown = [];
  let current = "";
  const scales = new Map(); // of each signal in each choice of units: volts per division, and volts at the middle
  let plot = null; // axes and grid, drawn when they change; the curves are drawn above it
  let plotKey = "";
  let size = { width: 800, height: 420 }; // of the screen: asking the page for it would lay it out anew
  let known = {}; // last measures of each signal
  let behind = { samples: 0, until: 0, factor: 1 };
  let kept = [];
  let arm = 0;
  let level = 0; // of the trigger, in volts or in the device's own numbers
  let number = 0;
  const views = new Set(); // numbers of views that are not answered
  let isOfView = false; // true if the error in sight is that of a view
  let notice = { number: 0, until: 0 };
  let closed = ""; // recording whose commands the hand has put away
  const knobs = new Map();
  const voltages = new Map(); // texts of the patch by amplifier
  const settings = document.querySelectorAll("#generator [data-key]");
  const OPERATED =
    ".bar button, .bar select, #generator button, #generator [data-key], #modes button, #fault-section button, " +
    "#fault-section select, #clear-lamps";
  let operated = document.querySelectorAll(OPERATED); // what only the page that drives can operate
  const FIXED = "#restart, #generator button, #generator [data-key], #modes button"; // within a recording

  // ---- messages

  function connect() {
    const token = new URLSearchParams(location.search).get("token") ?? "";
    socket = new WebSocket(`ws://${location.host}/live?token=${encodeURIComponent(token)}`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => (typeof data === "string" ? receive(JSON.parse(data)) : receiveFrame(data));
    socket.onclose = () => {
      document.documentElement.removeAttribute("data-connected");
      leave();
      put($("failure"), "");
      complain("The bench does not answer. Trying again; if it was started anew, open the address that it prints.");
      setTimeout(connect, RETRY_MS);
    };
  }

  function send(name, table = {}) {
    if (name !== "view") complain("");
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ do: name, id: ++number, ...table }));
    return number;
  }

  function receive(message) {
    if (message.bench) {
      views.clear();
      bench = message.bench;
      behind = { samples: Infinity, until: 0, factor: 0 };
      complain("");
      build();
      look();
      document.documentElement.setAttribute("data-connected", "");
    } else if (message.state) {
      state = message.state;
      show();
    } else {
      for (const knob of knobs.values()) knob.answered(message.re);
      const isView = views.delete(message.re);
      if (message.error) complain(named(message.error), isView);
      else if (isView && isOfView) complain("");
      if (message.error && state) show();
    }
  }

  function complain(text, ofView = false) {
    put($("trouble"), text);
    isOfView = ofView;
  }

  // An error with the names of this page instead of those of the commands.
  function named(error) {
    let text = error.replace(/^(excitation|generate): /, "Generator: ");
    for (const each of settings) text = text.replaceAll(each.dataset.key, each.parentElement.firstChild.data.trim());
    return text;
  }

  // ---- numbers

  function put(element, text) {
    if (element.textContent !== String(text)) element.textContent = text;
  }

  function short(value, digits = 4) {
    if (value === null || value === undefined || !Number.isFinite(value)) return "–";
    if (Math.abs(value) >= 1e6) return value.toExponential(digits - 1);
    return String(Number(value.toPrecision(digits)));
  }

  function withPrefix(value, unit) {
    if (value === null || value === undefined || !Number.isFinite(value)) return "–";
    const [prefix, factor] = Math.abs(value) >= 1 ? ["", 1] : Math.abs(value) >= 1e-3 ? ["m", 1e3] : ["µ", 1e6];
    return Math.abs(value) >= 1e3 ? `${short(value / 1e3)} k${unit}` : `${short(value * factor)} ${prefix}${unit}`;
  }

  function signal(id) {
    return bench.signals.find((each) => each.id === id) ?? { id, label: id, unit: "", per_volt: 1, group: "device" };
  }

  function unitOf(id) {
    const { unit, group } = signal(id);
    if (group === "device") return "";
    return $("units").value === "problem" && unit ? unit : "V";
  }

  function factorOf(id) {
    const { unit, per_volt: perVolt, group } = signal(id);
    return group !== "device" && $("units").value === "problem" && unit ? perVolt : 1;
  }

  function reading(id, value) {
    const unit = unitOf(id);
    return `${rounded(id, value)}${unit && value !== null ? ` ${unit}` : ""}`;
  }

  // Text of a value with the decimals that its signal resolves.
  function rounded(id, value) {
    if (value === null) return "–";
    const decimals = Math.max(0, Math.ceil(-Math.log10(signal(id).resolution * factorOf(id))));
    if (decimals > 6) return short(value * factorOf(id));
    return Number((value * factorOf(id)).toFixed(decimals)).toFixed(decimals); // twice: no minus before zero
  }

  function scaleOf(id) {
    const key = `${$("units").value} ${id}`;
    if (!scales.has(key)) scales.set(key, { per: signal(id).group !== "device" && unitOf(id) === "V" ? 2 : 0, middle: 0 });
    return scales.get(key);
  }

  function colourOf(id) {
    return COLOURS[shown.indexOf(id) % COLOURS.length];
  }

  // ---- the page, built once for each bench

  function option(select, value, text) {
    const made = new Option(text, value);
    select.append(made);
    return made;
  }

  function build() {
    $("what").textContent = `${bench.program} on ${bench.rig}, device ${bench.dut}`;
    shown = shown.filter((id) => bench.signals.some((each) => each.id === id));
    if (!shown.length) shown = bench.signals.slice(0, 2).map(({ id }) => id);
    if (!shown.includes(current)) [current] = shown;
    const base = $("base").value;
    $("base").replaceChildren();
    for (const seconds of BASES_S) option($("base"), seconds, `${withPrefix(seconds / 10, "s")}/div`);
    $("base").value = base || "0.02";
    const source = $("source").value;
    $("source").replaceChildren();
    for (const { id, label } of bench.signals) option($("source"), id, label);
    const stays = bench.signals.some(({ id }) => id === source);
    $("source").value = stays ? source : shown[0];
    if (!stays) level = bench.level;
    buildKnobs();
    buildModes();
    buildFaults();
    buildPatch();
    buildSignals();
    operated = document.querySelectorAll(OPERATED);
  }

  function buildKnobs() {
    knobs.clear();
    $("knobs").replaceChildren();
    for (const knob of bench.knobs) {
      const made = new Knob(knob);
      knobs.set(knob.name, made);
      $("knobs").append(made.element);
    }
  }

  function buildModes() {
    $("machine").hidden = !bench.modes.length;
    $("step").hidden = !bench.stepped;
    $("tempo").disabled = !bench.stepped;
    $("modes").replaceChildren();
    for (const mode of bench.modes) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = mode.toLowerCase();
      button.dataset.mode = mode;
      button.onclick = () => send("operate", { mode });
      $("modes").append(button);
    }
  }

  function buildFaults() {
    const names = Object.entries(bench.faults);
    $("fault-section").hidden = !names.length && !Object.keys(bench.line_faults).length;
    $("faults").replaceChildren();
    for (const [fault, label] of names) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = label;
      button.dataset.fault = fault;
      button.onclick = () => send("inject", { fault, on: button.getAttribute("aria-pressed") !== "true" });
      $("faults").append(button);
    }
    const kinds = Object.entries(bench.line_faults);
    $("line-section").hidden = !kinds.length;
    $("line-fault").replaceChildren();
    for (const [kind, label] of kinds) option($("line-fault"), kind, `${kind}: ${label}`);
  }

  function cell(row, text, kind = "") {
    const made = row.insertCell();
    made.textContent = text;
    made.className = kind;
    return made;
  }

  function buildSignals() {
    const body = $("signals").tBodies[0];
    body.replaceChildren();
    for (const id of shown) {
      const { label } = signal(id);
      const row = body.insertRow();
      row.dataset.signal = id;
      const head = document.createElement("th");
      head.scope = "row";
      const swatch = document.createElement("span");
      swatch.className = "swatch";
      swatch.style.borderTopColor = `var(--${colourOf(id)})`;
      const name = document.createElement("button");
      name.type = "button";
      name.textContent = label;
      name.title = "axis and cursors show this signal";
      name.onclick = () => {
        current = id;
        buildSignals();
        redraw();
      };
      const remove = document.createElement("button");
      remove.type = "button";
      remove.textContent = "×";
      remove.setAttribute("aria-label", `remove ${label}`);
      remove.onclick = () => toggle(id);
      head.append(swatch, name, " ", remove);
      row.append(head);
      row.setAttribute("aria-current", String(id === current));
      cell(row, unitOf(id));
      cell(row, "").append(field(id, "per", `${label}: per division`));
      cell(row, "").append(field(id, "middle", `${label}: at the middle`));
      for (let i = 0; i < 6; i++) cell(row, "–", "number");
    }
    $("add").replaceChildren();
    option($("add"), "", "choose");
    for (const { id, label } of bench.signals) if (!shown.includes(id)) option($("add"), id, label);
    document.querySelectorAll("#patch g[role=button]").forEach((each) => {
      each.setAttribute("aria-pressed", String(shown.includes(each.dataset.probe)));
    });
  }

  function field(id, key, label) {
    const input = document.createElement("input");
    input.type = "number";
    input.step = "any";
    input.className = "short";
    input.setAttribute("aria-label", label);
    input.value = short(scaleOf(id)[key] * factorOf(id), 5);
    input.onchange = () => {
      const value = Number(input.value) / factorOf(id);
      if (Number.isFinite(value) && (key === "middle" || value > 0)) scaleOf(id)[key] = value;
      input.value = short(scaleOf(id)[key] * factorOf(id), 5);
      redraw();
    };
    return input;
  }

  function toggle(id) {
    if (shown.includes(id)) {
      if (shown.length === 1) return;
      shown = shown.filter((each) => each !== id);
    } else {
      shown = [...shown, id].slice(-bench.limits.signals);
    }
    if (!shown.includes(current)) [current] = shown;
    buildSignals();
    look();
  }

  // ---- pots

  class Knob {
    constructor(knob) {
      this.knob = knob;
      this.value = knob.low;
      this.held = false;
      this.awaited = 0; // number of the last turn, until it is answered: earlier states hold older values
      const { name, unit, pots } = knob;
      this.element = document.createElement("div");
      this.element.className = "knob";
      this.slider = document.createElement("div");
      this.slider.setAttribute("role", "slider");
      this.slider.tabIndex = 0;
      this.slider.dataset.parameter = name;
      const attributes = { label: `parameter ${name}`, valuemin: knob.low, valuemax: knob.high, orientation: "vertical" };
      for (const [name, value] of Object.entries(attributes)) this.slider.setAttribute(`aria-${name}`, value);
      this.slider.innerHTML = `<svg viewBox="-50 -50 100 100" aria-hidden="true"><path class="track"/><path class="value"/><circle class="cap" r="30"/><line class="hand" x1="0" y1="-14" x2="0" y2="-27"/></svg>`;
      this.slider.querySelector(".track").setAttribute("d", arc(1));
      const title = document.createElement("label");
      this.input = document.createElement("input");
      this.input.type = "number";
      this.input.step = "any";
      title.append(`${name}${unit ? `, ${unit}` : ""}`, this.input);
      const limits = document.createElement("small");
      const shownBy = pots.join(", ");
      limits.textContent = `${short(knob.low, 3)} to ${short(knob.high, 3)}${shownBy === name ? "" : `, pot ${shownBy}`}`;
      this.element.append(this.slider, title, limits);
      this.slider.onkeydown = (event) => this.key(event);
      this.slider.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
      this.slider.onpointerdown = (event) => this.grasp(event);
      this.input.onchange = () => {
        const value = Number(this.input.value);
        if (this.input.value !== "" && Number.isFinite(value)) this.turn(value);
        else this.input.value = short(this.value, 6);
        if (value < knob.low || value > knob.high) {
          complain(`${name}: limited to ${short(knob.low)} … ${short(knob.high)} ${unit}`.trimEnd());
        }
      };
    }

    get fraction() {
      return Math.log(this.value / this.knob.low) / Math.log(this.knob.high / this.knob.low);
    }

    show(value) {
      if (value === this.shown) return;
      this.value = this.shown = value;
      const { unit, name } = this.knob;
      this.slider.setAttribute("aria-valuenow", String(value));
      this.slider.setAttribute("aria-valuetext", `${name} ${short(value, 5)} ${unit}`.trimEnd());
      this.slider.querySelector(".value").setAttribute("d", arc(this.fraction));
      this.slider.querySelector(".hand").setAttribute("transform", `rotate(${-135 + 270 * this.fraction})`);
      if (document.activeElement !== this.input) this.input.value = short(value, 6);
    }

    turn(value, ramp = 0) {
      const { low, high, name } = this.knob;
      const within = Math.min(Math.max(value, low), high);
      this.input.blur();
      this.show(within);
      this.awaited = send("turn", { name, value: within, ramp_n: ramp });
    }

    answered(turn) {
      if (turn === this.awaited) this.awaited = 0;
    }

    disable(on) {
      this.input.disabled = on;
      this.slider.setAttribute("aria-disabled", String(on));
    }

    get isDisabled() {
      return this.slider.getAttribute("aria-disabled") === "true";
    }

    key(event) {
      if (this.isDisabled) return;
      const steps = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1, PageUp: 10, PageDown: -10 };
      const ends = { Home: this.knob.low, End: this.knob.high };
      if (event.key in steps) this.turn(this.value * 1.01 ** (steps[event.key] * (event.shiftKey ? 0.1 : 1)));
      else if (event.key in ends) this.turn(ends[event.key]);
      else return;
      event.preventDefault();
    }

    wheel(event) {
      if (this.isDisabled) return;
      event.preventDefault();
      this.turn(this.value * 1.01 ** (event.deltaY < 0 ? 1 : -1));
    }

    // A ramp lasts until the next message of the hand, unless the emulator would fall behind.
    grasp(event) {
      if (this.isDisabled) return;
      this.held = true;
      this.slider.setPointerCapture(event.pointerId);
      let [y, fraction, sent] = [event.clientY, this.fraction, 0];
      const { low, high } = this.knob;
      const move = (moved, last = false) => {
        fraction = Math.min(1, Math.max(0, fraction + (y - moved.clientY) / (moved.shiftKey ? 2000 : 250)));
        y = moved.clientY;
        const value = low * (high / low) ** fraction;
        this.show(value);
        if (last || performance.now() - sent >= HAND_MS) {
          sent = performance.now();
          const ramp = bench.stepped && state ? Math.round((bench.rate / state.factor) * (HAND_MS / 1000)) : 0;
          this.turn(value, Math.min(ramp, RAMP_N));
        }
      };
      this.slider.onpointermove = (moved) => moved.clientY !== y && move(moved);
      this.slider.onpointerup = this.slider.onpointercancel = (moved) => {
        this.slider.onpointermove = null;
        if (sent) move(moved, true);
        this.held = false;
      };
    }
  }

  function arc(fraction) {
    const at = (part) => {
      const angle = ((-225 + 270 * part) * Math.PI) / 180;
      return `${(42 * Math.cos(angle)).toFixed(2)} ${(42 * Math.sin(angle)).toFixed(2)}`;
    };
    return `M${at(0)}A42 42 0 ${fraction > 2 / 3 ? 1 : 0} 1 ${at(Math.max(fraction, 0.002))}`;
  }

  // ---- the patch

  function svg(parent, name, attributes, text = "") {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.textContent = text;
    parent.append(made);
    return made;
  }

  function buildPatch() {
    $("patch-section").hidden = !bench.patch.length;
    const drawing = $("patch");
    drawing.replaceChildren();
    voltages.clear();
    let y = 12;
    for (const row of bench.patch) {
      const height = 30 * Math.max(1, row.inputs.length);
      const label = `${row.name}, ${row.kind}${row.quantity ? `, ${row.quantity}` : ""}`;
      const group = svg(drawing, "g", { role: "button", tabindex: 0, "data-probe": row.name, "aria-label": `probe ${label}` });
      svg(group, "rect", { x: 0, y: y - 6, width: PATCH_WIDTH, height: height + 12, fill: "transparent" });
      row.inputs.forEach((input, i) => {
        const middle = y + 30 * i + 15;
        svg(group, "text", { x: 8, y: middle + 4 }, input.node);
        svg(group, "path", { class: "wire", d: `M60 ${middle}H240` });
        if (input.pot) {
          svg(group, "circle", { class: "body", cx: 110, cy: middle, r: 12 });
          svg(group, "text", { x: 110, y: middle + 4, "text-anchor": "middle" }, input.pot);
        }
        svg(group, "text", { x: 150, y: middle - 4, class: "small" }, withPrefix(input.ohm, "Ω"));
      });
      svg(group, "path", { class: "body", d: `M240 ${y}L310 ${y + height / 2}L240 ${y + height}Z` });
      if (row.farad) svg(group, "rect", { class: "body", x: 234, y, width: 6, height });
      svg(group, "path", { class: "wire", d: `M310 ${y + height / 2}H340` });
      svg(group, "text", { x: 248, y: y + height / 2 + 4, class: "small" }, row.name);
      svg(group, "text", { x: 348, y: y + height / 2 + 4 }, `${row.node}${row.quantity ? `: ${row.quantity}` : ""}`);
      voltages.set(row.name, svg(group, "text", { x: PATCH_WIDTH - 8, y: y + height / 2 + 4, "text-anchor": "end" }, "–"));
      group.onclick = () => toggle(row.name);
      group.onkeydown = (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        toggle(row.name);
      };
      y += height + 18;
    }
    drawing.setAttribute("viewBox", `0 0 ${PATCH_WIDTH} ${y}`);
  }

  // ---- the state

  function leave() {
    put($("role"), "The bench is not connected.");
    $("drive").hidden = true;
    document.documentElement.dataset.role = "watches";
    for (const each of operated) each.disabled = true;
    for (const knob of knobs.values()) knob.disable(true);
  }

  function show() {
    if (!bench) return;
    const drives = state.drives;
    const off = state.generator.on ? "" : " The generator is off: switch it on.";
    const watches = state.driven ? "This page watches: another one drives." : "Nobody drives the bench.";
    put($("role"), drives ? `This page drives the bench.${off}` : watches);
    showBehind();
    $("drive").hidden = state.driven;
    document.documentElement.dataset.role = drives ? "drives" : "watches";
    for (const each of operated) each.disabled = !drives;
    if (!bench.stepped) $("tempo").disabled = true;
    for (const each of document.querySelectorAll(FIXED)) {
      each.disabled ||= state.recording;
      each.title = state.recording ? "end the recording first: it is one scenario" : "";
    }
    pressed($("play"), state.playing, state.playing ? "Pause" : "Run");
    pressed($("record"), state.recording, state.recording ? "End the recording" : "Record");
    pressed($("generator-on"), state.generator.on, state.generator.on ? "Switch off" : "Switch on");
    if (document.activeElement !== $("tempo")) $("tempo").value = String(state.factor);
    put($("clock"), `take ${state.take}, ${withPrefix(state.samples / state.rate, "s")}, ${samples(state.samples)}`);
    for (const [name, knob] of knobs) {
      knob.disable(!drives);
      if (!knob.held && !knob.awaited && state.values[name] !== undefined) knob.show(state.values[name]);
    }
    for (const each of settings) {
      const value = state.generator[each.dataset.key];
      if (document.activeElement !== each) each.value = typeof value === "number" ? short(value, 6) : value;
      if (each.dataset.key === "duty") {
        each.disabled ||= state.generator.shape !== "pulse";
        each.title ||= each.disabled ? "only pulses have a duty" : "";
      }
    }
    for (const each of $("modes").children) each.setAttribute("aria-pressed", String(each.dataset.mode === state.mode));
    for (const each of $("faults").children) {
      const on = state.faults.includes(each.dataset.fault);
      pressed(each, on, bench.faults[each.dataset.fault]);
    }
    put($("line-faults"), state.line_faults.length ? `in force: ${state.line_faults.join(", ")}` : "");
    put($("lamps"), state.lamps.length ? state.lamps.join(", ") : "none");
    $("lamps").classList.toggle("lit", state.lamps.length > 0);
    for (const [name, volts] of Object.entries(state.volts)) {
      if (voltages.has(name)) put(voltages.get(name), `${volts.toFixed(2)} V`);
    }
    showDevice();
    put($("failure"), failure());
    showNotices();
    showSaved();
  }

  // Failure of the device in one line, with its cure.
  function failure() {
    const { failure: reason, line_faults: faults, silent_s: silent } = state;
    if (silent >= SILENT_S) return `The device has not answered for ${silent.toFixed(0)} s. If it hangs, end the bench in its terminal.`;
    if (!reason) return "";
    return `Stopped: ${reason}. ${faults.length ? "Mend the line, then press Run." : "Press Run to try again."}`;
  }

  function showBehind() {
    const { overruns, factor, rates, rate, playing } = state;
    const now = performance.now();
    const fellBehind = overruns > behind.samples && factor === behind.factor; // the rate of another pace tells nothing
    behind = { samples: overruns, until: fellBehind ? now + BEHIND_MS : behind.until, factor };
    $("behind").hidden = !playing || now > behind.until;
    const part = Math.min(100, Math.round((100 * rates.samples_hz * factor) / rate));
    put($("behind"), `behind: ${part} % of ${factor === 1 ? "real time" : "the chosen pace"}`);
  }

  function showNotices() {
    const notices = [...state.notices].reverse();
    const [number, text] = notices[0] ?? [0, ""];
    if (number !== notice.number) {
      notice = { number, until: performance.now() + NOTICE_MS };
      setTimeout(showNotices, NOTICE_MS + 1);
    }
    put($("notice"), performance.now() > notice.until ? "" : text);
    const again = state.saved.flatMap(({ commands }) => commands.map((command) => `to play it again: ${command}`));
    list($("notices"), [...notices.map(([, text]) => text), ...again]);
  }

  // Commands that play the last recording again.
  function showSaved() {
    const last = state.saved.at(-1);
    $("saved").hidden = !last || state.recording || last.run === closed;
    if (!last || last.run === $("saved").dataset.run) return;
    $("saved").dataset.run = last.run;
    for (const [i, id] of ["replay", "rerun"].entries()) {
      put($(id), last.commands[i]);
      put($(`copy-${id}`), "Copy");
    }
  }

  async function copy(id) {
    getSelection().selectAllChildren($(id)); // all that an address without a clipboard allows
    await navigator.clipboard?.writeText($(id).textContent);
    put($(`copy-${id}`), navigator.clipboard ? "Copied" : "Selected");
  }

  function pressed(button, on, text) {
    button.setAttribute("aria-pressed", String(on));
    put(button, text);
  }

  function list(parent, texts) {
    const wanted = texts.length ? texts : ["none"];
    if (wanted.join("\n") === parent.dataset.texts) return;
    parent.dataset.texts = wanted.join("\n");
    parent.replaceChildren(...wanted.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  }

  function showDevice() {
    const alarms = [...state.alarms].reverse();
    const [last] = alarms;
    const isPast = !last || last.take !== state.take;
    const past = `no alarm in this take${last ? ` (last one: take ${last.take}, sample ${last.sample})` : ""}`;
    put($("alarm"), isPast ? past : `alarm at sample ${last.sample}: ${cause(last)}`);
    $("alarm").classList.toggle("past", isPast);
    rows($("alarms"), alarms, (row, alarm) => {
      cell(row, alarm.take);
      cell(row, alarm.sample, "number");
      const text = alarm.what || (alarm.again && `${alarm.again} again`) || alarm.fault || "none: false alarm";
      cell(row, text, alarm.what || alarm.again || alarm.fault ? "text" : "text bad");
      cell(row, alarm.latency_n ?? "–", "number");
      cell(row, alarm.bound_n ?? "–", "number");
    });
    $("estimates").hidden = !state.estimates.length;
    rows($("estimates"), state.estimates, (row, { name, estimate, truth }) => {
      const head = document.createElement("th");
      head.scope = "row";
      head.textContent = name;
      row.append(head);
      cell(row, short(estimate, 5), "number");
      cell(row, short(truth, 5), "number");
      const error = truth && estimate !== null ? 100 * (estimate / truth - 1) : null;
      cell(row, error === null ? "–" : `${error.toFixed(2)} %`, "number");
    });
    const ceiling = bench.ceiling;
    put($("statistic"), ceiling === null ? short(state.statistic) : `${short(state.statistic)} of ${short(ceiling)}`);
    const part = ceiling ? Math.min(1, Math.max(0, state.statistic / ceiling)) : 0;
    $("meter").style.width = `${100 * part}%`;
    $("meter").classList.toggle("high", part >= 1);
    put($("diagnosis"), bench.diagnoses ? state.diagnosis || "none" : "not reported");
    put($("misfit"), bench.misfits ? state.misfit || "none" : "not reported");
    put($("speed"), short(state.rates.samples_hz, 5));
    put($("frames"), state.rates.frames_hz ? short(state.rates.frames_hz) : "–");
    put($("load"), state.rates.line_load ? `${(100 * state.rates.line_load).toFixed(1)} %` : "–");
    put($("overruns"), state.overruns);
    put($("missing"), state.missing);
    put($("felt"), state.felt_ms === null ? "–" : `${state.felt_ms} ms`);
    put($("link-counters"), state.link_counters.join(", ") || "none");
    put($("counters"), state.counters.join(", ") || "none");
  }

  function cause({ what, again, fault, latency_n: latency, bound_n: bound }) {
    if (what) return `${what} changed ${samples(latency)} before${bound === null ? "" : `, best possible ${bound}`}`;
    if (again) return `the change of ${again} again`;
    return fault ? `${fault}, no false alarm` : "false alarm, no change explains it";
  }

  function samples(count) {
    return `${count} sample${count === 1 ? "" : "s"}`;
  }

  function rows(table, items, fill) {
    const key = JSON.stringify(items);
    if (table.dataset.key === key) return;
    table.dataset.key = key;
    table.tBodies[0].replaceChildren();
    for (const item of items) fill(table.tBodies[0].insertRow(), item);
  }

  // ---- the screen

  function look() {
    if (!bench) return;
    const { limits } = bench;
    const within = (value, [low, high]) => Math.round(Math.min(high, Math.max(low, value)));
    const count = within(Number($("base").value) * bench.rate, limits.samples);
    const trigger = {
      source: $("source").value,
      slope: $("slope").value,
      level,
      mode: $("mode").value,
      position: Number($("position").value),
    };
    const columns = within(size.width, limits.columns);
    const kind = $("kind").value;
    kept = [];
    $("arm").hidden = $("mode").value !== "single";
    if (document.activeElement !== $("level")) $("level").value = short(level * factorOf($("source").value), 6);
    $("level-unit").textContent = unitOf($("source").value);
    $("autoscale").disabled = kind === "fft";
    $("screen").hidden = kind === "xy";
    $("xy").hidden = kind !== "xy";
    $("cursor-panel").hidden = !$("cursors").checked || kind === "xy";
    $("screen").setAttribute("aria-label", kind === "fft" ? "Spectrum of the signals" : "Signals over time");
    views.add(send("view", { signals: shown, samples: count, columns, kind, trigger, arm }));
    redraw();
  }

  function receiveFrame(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    waiting = header.waiting ?? null;
    if (!isDue) requestAnimationFrame(redraw);
    isDue = true;
    if (waiting) return;
    const values = {};
    header.signals.forEach((id, i) => {
      values[id] = new Float32Array(buffer, 4 + length + 4 * i * header.points, header.points);
    });
    frame = { ...header, values };
    measures = header.measures ?? measures;
    if ($("persist").checked) kept = [...kept.slice(1 - KEPT), frame];
  }

  function redraw() {
    isDue = false;
    put($("triggered"), triggering());
    if (!frame || !frame.signals.every((id) => shown.includes(id))) return;
    const fresh = frame.kind === "fft" ? [] : frame.signals.filter((id) => !scaleOf(id).per);
    fresh.forEach(fit);
    if (fresh.length) buildSignals();
    if (frame.kind === "xy") drawXy();
    else drawPlot();
    if (measures) showMeasures();
    if (!$("cursor-panel").hidden) showCursors();
    frames += 1;
    document.documentElement.dataset.frames = frames;
    if (frames === 1) document.documentElement.setAttribute("data-drawn", "");
  }

  function triggering() {
    const isSingle = $("mode").value === "single";
    if ($("kind").value === "fft") return "";
    if (waiting) return `${isSingle ? "armed" : "waiting for a trigger"}${beside(...waiting)}`;
    if (!frame) return "";
    if (frame.rolls) return "newest samples, the last one at the right";
    if (frame.trigger !== null) return isSingle ? "stopped after a single shot" : "triggered";
    const { min, max } = known[$("source").value] ?? {};
    return `no trigger${beside(min, max)}`;
  }

  // Note on a level that the source does not reach.
  function beside(least, most) {
    const side = level > most ? "above" : level <= least ? "below" : "";
    return side ? `: the level is ${side} all values of ${signal($("source").value).label}` : "";
  }

  function fit(id) {
    let [low, high] = [Infinity, -Infinity];
    for (const value of frame.values[id]) {
      if (Number.isFinite(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    if (low > high) return;
    const factor = factorOf(id);
    const least = (Math.max(high - low, 0.02 * Math.abs(high), 1e-9) / 8) * factor;
    const decade = 10 ** Math.floor(Math.log10(least));
    const per = (STEPS.find((step) => step * decade >= least) * decade) / factor;
    Object.assign(scaleOf(id), { per, middle: Math.round((low + high) / 2 / per) * per });
  }

  // Position of the first point on the x axis, distance of two points, and both ends of the axis.
  function across(of) {
    if (of.kind === "fft") {
      const pitch = of.per * of.step;
      return { start: 0, pitch, ends: [0, (of.points - 1) * pitch] };
    }
    const before = of.trigger === null ? of.points * of.per : of.trigger - of.first; // 0 ms is the trigger, or now
    const ms = 1000 / of.rate;
    const low = -Math.floor(before); // the axis stays where it is from frame to frame
    return { start: -before * ms, pitch: of.per * ms, ends: [low * ms, (low + of.points * of.per) * ms] };
  }

  function heightScale(of, id) {
    return of.kind === "fft" ? SPECTRUM : scaleOf(id);
  }

  function drawPlot() {
    const { per, middle } = heightScale(frame, current);
    const { width, height } = size;
    const key = [frame.kind, frame.trigger === null, width, height, current, colourOf(current), per, middle, $("units").value, dark(), devicePixelRatio].join(";");
    const { ends } = across(frame);
    if (key !== plotKey) {
      plotKey = key;
      layOut(ends);
    } else if (ends.some((end, i) => end !== plot.data[0][i])) {
      plot.setData([ends, [null, null]]);
    } else {
      drawCurves(plot);
    }
  }

  function layOut(ends) {
    plot?.destroy();
    $("axes").replaceChildren();
    const isSpectrum = frame.kind === "fft";
    const unit = unitOf(current) ? `, ${unitOf(current)}` : "";
    const title = isSpectrum ? "dB of 1 V rms" : `selected: ${signal(current).label}${unit}`;
    const { per, middle } = heightScale(frame, current);
    const factor = isSpectrum ? 1 : factorOf(current);
    const ticks = (_, splits) => splits.map((at) => short((at * per + middle) * factor, 5));
    const vertical = Array.from({ length: 2 * DIVISIONS + 1 }, (_, i) => i - DIVISIONS);
    plot = new uPlot(
      {
        ...size,
        cursor: { show: false },
        legend: { show: false },
        scales: { x: { time: false }, y: { range: [-DIVISIONS, DIVISIONS] } },
        series: [{}, {}],
        axes: [
          plotting.axis("x", isSpectrum ? "frequency, Hz" : `time${frame.trigger === null ? " until now" : ""}, ms`, 2, ink, { size: 28, labelSize: 18 }),
          plotting.axis("y", title, 3, ink, { size: 70, splits: () => vertical, values: ticks }),
        ],
        hooks: { draw: [drawCurves] }, // it lays the axes out later
      },
      [ends, [null, null]],
      $("axes"),
    );
  }

  function drawCurves({ bbox: { left, top, width, height }, data: [ends] }) {
    const canvas = $("curves");
    const px = devicePixelRatio;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    Object.assign(canvas.style, { left: `${left / px}px`, top: `${top / px}px`, width: `${width / px}px`, height: `${height / px}px` });
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    context.lineWidth = WIDTH * px;
    context.globalAlpha = 0.25;
    for (const old of kept.slice(0, -1)) {
      if (old.kind === frame.kind) for (const id of old.signals) if (shown.includes(id)) drawCurve(context, ends, old, id);
    }
    context.globalAlpha = 1;
    for (const id of frame.signals) drawCurve(context, ends, frame, id);
    drawMarks(context, ends);
  }

  function drawCurve(context, [low, high], of, id) {
    const { width, height } = context.canvas;
    const { start, pitch } = across(of);
    const { per, middle } = heightScale(of, id);
    const unit = height / (2 * DIVISIONS) / per;
    const values = of.values[id];
    let x = ((start - low) * width) / (high - low);
    const step = (pitch * width) / (high - low);
    context.strokeStyle = ink(colourOf(id));
    context.beginPath();
    for (let i = 0; i < values.length; i++) {
      const y = height / 2 - (values[i] - middle) * unit;
      context.lineTo(x, Math.round(Math.min(2 * height, Math.max(-height, y))) + 0.5); // one that is no number is left out
      x += step;
    }
    context.stroke();
  }

  function drawMarks(context, [low, high]) {
    const { width, height } = context.canvas;
    const line = (colour, dash, from, to) => {
      context.strokeStyle = ink(colour);
      context.setLineDash(dash.map((each) => each * devicePixelRatio));
      context.beginPath();
      context.moveTo(...from);
      context.lineTo(...to);
      context.stroke();
    };
    if (frame.kind === "yt") frame.signals.forEach((id) => drawZero(context, id));
    const source = $("source").value;
    if (frame.kind === "yt" && frame.trigger !== null) {
      const x = Math.round((-low * width) / (high - low)) + 0.5;
      line("muted", [2, 4], [x, 0], [x, height]);
    }
    if (frame.kind === "yt" && shown.includes(source)) {
      const { per, middle } = scaleOf(source);
      const y = Math.round(height / 2 - ((level - middle) * height) / (2 * DIVISIONS) / per) + 0.5;
      line(colourOf(source), [2, 4], [0, y], [width, y]);
    }
    if ($("cursors").checked) {
      for (const [id, dash] of [["cursor-a", [6, 3]], ["cursor-b", [2, 3]]]) {
        const x = Math.round(Number($(id).value) * width) + 0.5;
        line("ink", dash, [x, 0], [x, height]);
      }
    }
    context.setLineDash([]);
  }

  // Mark at the height of zero, or at the edge beyond which it lies.
  function drawZero(context, id) {
    const { per, middle } = scaleOf(id);
    const { height } = context.canvas;
    const size = 5 * devicePixelRatio;
    const wanted = height / 2 + (middle * height) / (2 * DIVISIONS) / per;
    const y = Math.min(height - size, Math.max(size, wanted));
    const points = { false: [[0, y - size], [2 * size, y], [0, y + size]], true: [[0, y], [2 * size, y], [size, wanted < y ? y - size : y + size]] };
    context.fillStyle = ink(colourOf(id));
    context.beginPath();
    for (const point of points[String(wanted !== y)]) context.lineTo(...point);
    context.fill();
  }

  function dark() {
    return matchMedia("(prefers-color-scheme: dark)").matches;
  }

  function showCursors() {
    if (!(current in frame.values)) return; // it was added after this frame
    const places = ["cursor-a", "cursor-b"].map((id) => Math.round(Number($(id).value) * (frame.points - 1)));
    const [a, b] = places.map((i) => frame.values[current][i]);
    const apart = (places[1] - places[0]) * across(frame).pitch;
    if (frame.kind === "fft") {
      $("cursor-text").textContent = `A ${short(a)} dB, B ${short(b)} dB; B − A: ${withPrefix(apart, "Hz")}, ${short(b - a)} dB`;
      return;
    }
    const pace = apart ? `, 1/Δt ${withPrefix(Math.abs(1000 / apart), "Hz")}` : "";
    $("cursor-text").textContent =
      `${signal(current).label}: A ${reading(current, a)}, B ${reading(current, b)}; ` +
      `B − A: ${withPrefix(apart / 1000, "s")}${pace}, ${reading(current, b - a)}`;
  }

  function drawXy() {
    const canvas = $("xy");
    const px = devicePixelRatio;
    [canvas.width, canvas.height] = [canvas.clientWidth * px, canvas.clientHeight * px];
    const context = canvas.getContext("2d");
    const [x, y] = [frame.signals[0], frame.signals[1] ?? frame.signals[0]];
    const margin = 46 * px; // of the numbers
    const size = Math.min(canvas.width, canvas.height) - 2 * margin;
    const place = (value, length, sign) => length / 2 + (sign * value * size) / (2 * DIVISIONS);
    const number = (at, id) => short((at * scaleOf(id).per + scaleOf(id).middle) * factorOf(id), 5);
    const title = (id) => `${signal(id).label}${unitOf(id) ? `, ${unitOf(id)}` : ""}`;
    const [left, bottom] = [place(-DIVISIONS, canvas.width, 1), place(-DIVISIONS, canvas.height, -1)];
    context.strokeStyle = ink("line");
    context.fillStyle = ink("muted");
    context.font = `${12 * px}px system-ui, sans-serif`;
    for (let i = -DIVISIONS; i <= DIVISIONS; i++) {
      context.strokeRect(place(i, canvas.width, 1), bottom - size, 0, size);
      context.strokeRect(left, place(i, canvas.height, -1), size, 0);
      context.textAlign = "center";
      if (i % 2) context.fillText(number(i, x), place(i, canvas.width, 1), bottom + 16 * px);
      context.textAlign = "right";
      context.fillText(number(i, y), left - 6 * px, place(i, canvas.height, -1) + 4 * px);
    }
    context.textAlign = "center";
    context.fillText(title(x), canvas.width / 2, bottom + 34 * px);
    context.fillText(title(y), left, bottom - size - 14 * px);
    for (const each of kept.length ? kept.filter(({ kind }) => kind === "xy") : [frame]) {
      const [h, v] = [x, y].map((id) => [...each.values[id]].map((value) => (value - scaleOf(id).middle) / scaleOf(id).per));
      context.globalAlpha = each === frame ? 1 : 0.25;
      context.strokeStyle = ink("first");
      context.lineWidth = 1.5 * px;
      context.beginPath();
      h.forEach((value, i) => context.lineTo(place(value, canvas.width, 1), place(v[i], canvas.height, -1)));
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  function showMeasures() {
    for (const row of $("signals").tBodies[0].rows) {
      const id = row.dataset.signal;
      const found = measures[id];
      if (!found) continue;
      const texts = ["min", "max", "mean", "rms"].map((key) => rounded(id, found[key]));
      texts.push(withPrefix(found.frequency, "Hz"), found.overshoot === null ? "–" : `${(100 * found.overshoot).toFixed(1)} %`);
      texts.forEach((text, i) => put(row.cells[4 + i], text));
    }
    known = measures;
    measures = null;
  }

  // ---- the hand

  function listen() {
    $("play").onclick = () => send("play", { on: !state.playing });
    $("step").onclick = () => send("step", { samples: 1 });
    $("drive").onclick = () => send("drive");
    $("restart").onclick = () => send("restart");
    $("tempo").onchange = () => send("tempo", { factor: Number($("tempo").value) });
    $("record").onclick = () => send("record", { on: !state.recording });
    $("generator-on").onclick = () => send("generate", { on: !state.generator.on });
    $("clear-lamps").onclick = () => send("clear lamps");
    $("spoil").onclick = () => send("spoil", { kind: $("line-fault").value, direction: $("line-direction").value });
    $("mend").onclick = () => send("mend");
    $("copy-replay").onclick = () => copy("replay");
    $("copy-rerun").onclick = () => copy("rerun");
    $("close-saved").onclick = () => {
      closed = $("saved").dataset.run;
      $("saved").hidden = true;
    };
    for (const each of settings) {
      each.onchange = () => {
        const value = each.type === "number" ? Number(each.value) : each.value;
        each.blur();
        send("generate", { [each.dataset.key]: value });
      };
    }
    for (const id of ["kind", "base", "source", "slope", "position", "cursors"]) $(id).onchange = look;
    $("level").onchange = () => {
      const value = Number($("level").value) / factorOf($("source").value);
      if ($("level").value !== "" && Number.isFinite(value)) level = value;
      $("level").blur();
      look();
    };
    $("mode").onchange = $("arm").onclick = () => {
      arm += 1;
      look();
    };
    $("units").onchange = () => {
      if (bench) buildSignals();
      look();
    };
    $("add").onchange = () => $("add").value && toggle($("add").value);
    $("persist").onchange = () => {
      kept = [];
    };
    $("cursor-a").oninput = $("cursor-b").oninput = redraw;
    $("autoscale").onclick = () => {
      if (!frame || frame.kind === "fft") return;
      for (const id of frame.signals) fit(id);
      buildSignals();
      redraw();
    };
    new ResizeObserver(([{ contentRect: { width, height } }]) => {
      if (width) size = { width, height };
      look();
    }).observe($("screen"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  }

  listen();
  leave();
  connect();
})();
