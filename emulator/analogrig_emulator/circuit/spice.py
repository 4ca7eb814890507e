"""A circuit as a SPICE deck that ngspice runs unchanged.

    ngspice -b -r out.raw deck.cir

Op-amps and pots are instances of the subcircuits of LIBRARY, with their datasheet numbers as parameters; an op-amp
follows the same law there as in the engine. The deck starts from the initial conditions (uic). A pot that is turned has
a fourth node, whose voltage is its dial. Sources and dials step within STEP_S: sources up to the instant, since a
sample follows the edges of its instant, and dials from it on. A dummy PULSE source puts ngspice's time points on the
sample instants, where it would otherwise interpolate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import Circuit, Element
from analogrig_emulator.circuit.elements import (
    Capacitor,
    CurrentSource,
    DiodeLimiter,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
)
from analogrig_emulator.circuit.nodal import Nodal
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.circuit.opamp import CLAMP_RATE, OpAmpModel
from analogrig_emulator.circuit.pot import END_FRACTION, PotTurn
from analogrig_emulator.engine.engine import Engine
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Drive, Edges, Law
from analogrig_emulator.exceptions import CircuitError

STEP_S = 1e-12
"""Rise time of every step in a deck, far below anything the circuits resolve."""

_WRAP = 8

_LONGEST_STEP_S = 1e-5
"""Longest time step of a linear circuit: ngspice's tolerances shorten it where the solution bends."""

_STEPS_PER_TIME_CONSTANT = 100
"""Time steps within the shortest time constant of a circuit with limits, products or functions.

These pass on errors that a linear circuit lets die. ngspice tolerates an error in every step, whatever it grows to.
"""

_LEAST_INTEGRATOR_FARAD = 0.5e-9
"""Smallest capacitor of an integrator. Smaller ones are strays, which follow the rest of the circuit."""

LIMITLESS = 1e99
"""Infinity in a deck."""

_PRODUCT = """\
V = ((v(x) + {vx}) * ({x1} + {x3} * (v(x) + {vx}) * (v(x) + {vx})))
+ * ((v(y) + {vy}) * ({y1} + {y3} * (v(y) + {vy}) * (v(y) + {vy}))) + {vz}"""
"""Product of a multiplier. x1, x3 and y1, y3: linear and cubic coefficients of both factors."""

LIBRARY: Mapping[str, str] = MappingProxyType(
    {
        # The capacitance only scales the currents to sizes that ngspice's tolerances suit (mA at full slew). An output
        # without resistance gets 0.1 mOhm, 1 uV at 10 mA.
        "opamp": f"""\
.subckt opamp plus minus out avol=2e5 gbw=3e6 slew=13e6 swing_low=-13.5 swing_high=13.5 rout=100 vos=0
Cstate state 0 1e-10
Bstate 0 state I = 1e-10 * (max(-{{slew}}, min({{slew}},
+ {2 * math.pi!r} * {{gbw}} * (v(plus, minus) + {{vos}} - v(state) / {{avol}})))
+ - {CLAMP_RATE!r} * (max(0, v(state) - {{swing_high}}) + min(0, v(state) - {{swing_low}})))
Einner inner 0 state 0 1
Rout inner out {{max(rout, 1e-4)}}
.ends""",
        # Node inner is what is behind Rout: the state within out_low and out_high.
        "limited_opamp": f"""\
.subckt limited_opamp plus minus out avol=1e99 gbw=1e6 slew=1e99 swing_low=-1e99 swing_high=1e99 rout=0 vos=0
+ common=0 drop=1e99 out_low=-1e99 out_high=1e99
Cstate state 0 1e-10
Bstate 0 state I = 1e-10 * (max(-{{slew}}, min({{slew}},
+ {2 * math.pi!r} * {{gbw}} * (v(plus, minus) + {{common}} * (v(plus) + v(minus)) + {{vos}} - v(state) / {{avol}})))
+ - {CLAMP_RATE!r} * (max(0, v(state) - {{swing_high}}) + min(0, v(state) - {{swing_low}}))
+ - {CLAMP_RATE!r} * (max(0, v(inner, out) - {{drop}}) + min(0, v(inner, out) + {{drop}})))
Binner inner 0 V = max({{out_low}}, min({{out_high}}, v(state)))
Rout inner out {{max(rout, 1e-4)}}
.ends""",
        "opamp_without_pole": """\
.subckt opamp_without_pole plus minus out avol=1e99 rout=0 vos=0 common=0
Binner inner 0 V = {min(avol, 1e9)} * (v(plus, minus) + {common} * (v(plus) + v(minus)) + {vos})
Rout inner out {max(rout, 1e-4)}
.ends""",
        "pot": f"""\
.subckt pot top wiper bottom track=10k dial=0.5
Rupper top wiper {{max(1 - dial, {END_FRACTION!r}) * track}}
Rlower wiper bottom {{max(dial, {END_FRACTION!r}) * track}}
.ends""",
        "turned_pot": f"""\
.subckt turned_pot top wiper bottom dial track=10k
Bupper top wiper I = v(top, wiper) / (max(1 - v(dial), {END_FRACTION!r}) * {{track}})
Blower wiper bottom I = v(wiper, bottom) / (max(v(dial), {END_FRACTION!r}) * {{track}})
.ends""",
        "diode_limiter": """\
.subckt diode_limiter a b threshold=0 on=1 off=1g
Roff a b {off}
Bon a b I = (1 / {on} - 1 / {off}) * max(0, v(a, b) - {threshold})
.ends""",
        # Node inner is the product, state follows it.
        "multiplier": f"""\
.subckt multiplier x y out x1=0.1 x3=0 y1=1 y3=0 vx=0 vy=0 vz=0 rate=6e6 slew=1e99 swing_low=-1e99 swing_high=1e99
+ rout=0
Bproduct inner 0 {_PRODUCT}
Cstate state 0 1e-10
Bstate 0 state I = 1e-10 * (max(-{{slew}}, min({{slew}}, {{rate}} * (v(inner) - v(state))))
+ - {CLAMP_RATE!r} * (max(0, v(state) - {{swing_high}}) + min(0, v(state) - {{swing_low}})))
Eout behind 0 state 0 1
Rout behind out {{max(rout, 1e-4)}}
.ends""",
        "multiplier_without_pole": f"""\
.subckt multiplier_without_pole x y out x1=0.1 x3=0 y1=1 y3=0 vx=0 vy=0 vz=0
Bproduct out 0 {_PRODUCT}
.ends""",
        "divider": """\
.subckt divider x y out scale=10
Bquotient out 0 V = {scale} * v(x) / v(y)
.ends""",
        "root": """\
.subckt root x y out scale=10 sign=1
Broot out 0 V = {sign} * sqrt(max(0, {scale} * v(x)))
.ends""",
        "switch": """\
.subckt switch a b on=1 off=1g closed=1
Rab a b {closed * on + (1 - closed) * off}
.ends""",
        "time_points": """\
.subckt time_points node period=5e-5
Vnode node 0 PULSE(0 1 0 1n 1n {period / 2} {period})
.ends""",
    }
)
"""Subcircuits by name."""


@dataclass(frozen=True)
class Accuracy:
    """ngspice's tolerances; max_step_s is its longest time step (None: longest_step_s() of the circuit).

    method: ngspice's integration, trap or gear.

    After a limit is reached, trap may alternate about the solution, and shrink its step without end; gear does not.

    With the defaults its error is below 0.01 LSB of a 12-bit card on the suspension, and below 0.05 LSB on programs
    that are not linear.
    """

    reltol: float = 1e-7
    vntol_v: float = 1e-9
    abstol_a: float = 1e-12
    trtol: float = 0.1
    max_step_s: float | None = None
    method: Literal["trap", "gear"] = "trap"


def longest_step_s(circuit: Circuit) -> float:
    """Longest time step of ngspice that keeps its error below 0.05 LSB of 12 bits."""
    if not any(isinstance(each, DiodeLimiter | Multiplier | Function) for each in circuit.elements):
        return _LONGEST_STEP_S
    siemens = {amplifier.minus: 0.0 for amplifier in circuit.of(OpAmp)}
    for resistor in circuit.of(Resistor):
        for junction in siemens.keys() & set(resistor.nodes):
            siemens[junction] += 1.0 / resistor.ohm
    rates_hz = [
        siemens[junction] / capacitor.farad
        for capacitor in circuit.of(Capacitor)
        for junction in siemens.keys() & set(capacitor.nodes)
        if capacitor.farad >= _LEAST_INTEGRATOR_FARAD
    ]
    return 1.0 / max(1.0 / _LONGEST_STEP_S, _STEPS_PER_TIME_CONSTANT * max(rates_hz, default=0.0))


@dataclass(frozen=True, eq=False)
class Deck:
    """A circuit, its excitation and its pot changes: the engine plays it, ngspice runs its text.

    samples: number of samples at ``sample_rate_hz``; edges: levels by input, from tick 0 on, 0 V without any; drives:
    inputs that move all the time instead, for ngspice in straight pieces of a 32nd of a sample period; turns: changes
    of dials, without ramps; initial_v: V at sample 0 by state (capacitor, op-amp with a pole), else 0 V.
    """

    circuit: Circuit
    samples: int = 0
    sample_rate_hz: float = 20e3
    edges: Mapping[str, Edges] = field(default_factory=dict)
    turns: Sequence[PotTurn] = ()
    initial_v: Mapping[str, float] = field(default_factory=dict)
    title: str = "analogue computer"
    drives: Mapping[str, Drive] = field(default_factory=dict)

    def text(self, nodes: Sequence[str] | None = None, accuracy: Accuracy | None = None) -> str:
        """Deck that ngspice runs, without .tran when there are no samples.

        nodes: names of the voltages to save, all when None.
        Raises CircuitError for an unknown input, pot, state or node, for a name that SPICE does not allow, and for a
        ramp.
        """
        writer = _DeckWriter(self)
        writer.check(nodes)
        return "\n".join(writer.lines(accuracy or Accuracy(), nodes)) + "\n"

    def volts(self, nodes: Sequence[str] | None = None) -> NDArray[np.float64]:
        """Solution of the engine: (samples, nodes) in V, for every node of the circuit when none are named.

        Raises CircuitError, PotError, EngineError.
        """
        nodal = Nodal(self.circuit)
        dials: dict[str, float] = {}
        system = nodal.at(dials)
        outputs = self.circuit.nodes if nodes is None else nodes
        engine = Engine(system, outputs, self.sample_rate_hz, drives=self.drives)
        engine.state = np.array([self.initial_v.get(state, 0.0) for state in system.states])
        stretches = []
        for change in [*sorted(self.turns, key=lambda change: change.sample), PotTurn(self.samples - 1, {})]:
            samples = change.sample + 1 - engine.recorded
            if samples > 0:
                window = engine.window(samples)
                stretches.append(engine.run(samples, {name: e.within(*window) for name, e in self.edges.items()}))
            dials |= change.values
            engine.set_system(nodal.at(dials))
        return np.concatenate(stretches)


def to_spice(
    circuit: Circuit, *, nodes: Sequence[str] | None = None, accuracy: Accuracy | None = None, **played: Any
) -> str:
    """Text of Deck(circuit, **played)."""
    return Deck(circuit, **played).text(nodes, accuracy)


class _DeckWriter:
    def __init__(self, deck: Deck) -> None:
        self._deck = deck
        self._circuit = deck.circuit
        self._period_s = 1.0 / deck.sample_rate_hz
        self._taken = {name.lower() for name in self._circuit.nodes}
        self._taken |= {_card(_LETTERS[type(element)], element.name).lower() for element in self._circuit.elements}
        self._used: dict[str, None] = {}

    def check(self, nodes: Sequence[str] | None) -> None:
        circuit = self._circuit
        _known("input", {**self._deck.edges, **self._deck.drives}, [source.name for source in circuit.inputs])
        for change in self._deck.turns:
            circuit.with_dials(change.values)
            if change.ramp_n:
                raise CircuitError(f"pots {', '.join(change.values)}: a deck turns pots at once; ramp_n must be 0")
        amps = [amp.name for amp in circuit.of(OpAmp) if amp.model.has_state]
        amps += [multiplier.name for multiplier in circuit.of(Multiplier) if multiplier.model.has_state]
        _known("state", self._deck.initial_v, [*(capacitor.name for capacitor in circuit.of(Capacitor)), *amps])
        _known("node", nodes or (), circuit.nodes)
        for node in circuit.nodes:
            if node.lower() == "gnd":
                raise CircuitError(f"node {node}: SPICE takes this name for ground; call it otherwise")

    def lines(self, accuracy: Accuracy, nodes: Sequence[str] | None) -> Iterator[str]:
        elements = [line for element in self._circuit.elements for line in self._element(element)]
        clock = self._instance("time_points", self._free("Xclock"), (self._free("clock"),), period=self._period_s)
        yield f"* {' '.join(self._deck.title.split())}".encode("ascii", "replace").decode()
        for name in self._used:
            yield LIBRARY[name]
        yield from elements
        yield "* time points on the samples"
        yield clock
        for amp in (*self._circuit.of(OpAmp), *self._circuit.of(Multiplier)):
            if amp.name in self._deck.initial_v:
                yield f".ic v({_card('X', amp.name)}.state)={_number(self._deck.initial_v[amp.name])}"
        yield ".save " + " ".join(f"v({node})" for node in (self._circuit.nodes if nodes is None else nodes))
        yield f".options reltol={accuracy.reltol:g} vntol={accuracy.vntol_v:g} abstol={accuracy.abstol_a:g}"
        yield f".options trtol={accuracy.trtol:g} method={accuracy.method}"
        if self._deck.samples > 0:
            stop_s = (self._deck.samples - 1) * self._period_s
            max_step_s = accuracy.max_step_s or longest_step_s(self._circuit)
            yield f".tran {_number(self._period_s)} {_number(stop_s)} 0 {_number(max_step_s)} uic"
        yield ".end"

    def _element(self, element: Element) -> Iterator[str]:
        card = _card(_LETTERS[type(element)], element.name)
        match element:
            case Resistor(a=a, b=b, ohm=ohm):
                yield f"{card} {a} {b} {_number(ohm)}"
            case Capacitor(name=name, a=a, b=b, farad=farad):
                initial = f" IC={_number(self._deck.initial_v[name])}" if name in self._deck.initial_v else ""
                yield f"{card} {a} {b} {_number(farad)}{initial}"
            case VoltageSource() | CurrentSource():
                yield from self._source(card, element)
            case Pot(name=name) if turns := [turn for turn in self._deck.turns if name in turn.values]:
                yield from self._turned_pot(card, element, turns)
            case Function():
                yield from _straight_pieces(card, element)
            case _:
                subcircuit, values = _instance_of(element)
                yield self._instance(subcircuit, card, element.nodes, **values)

    def _source(self, card: str, source: VoltageSource | CurrentSource) -> Iterator[str]:
        head, level = f"{card} {source.plus} {source.minus}", source.constant
        if source.name in self._deck.drives:
            at = np.arange((self._deck.samples - 1) * _PIECES_PER_SAMPLE + 1) / _PIECES_PER_SAMPLE
            levels_v = self._deck.drives[source.name].volts(at)
            yield from _straight(
                head, [f"{_number(k * self._period_s)} {_number(v)}" for k, v in zip(at, levels_v, strict=True)]
            )
        elif level is None:
            times_s, levels_v = _levels(self._deck.edges.get(source.name, Edges.none()), self._period_s)
            yield from _stepped(head, times_s - STEP_S, levels_v)
        else:
            yield f"{head} DC {_number(level)}"

    def _turned_pot(self, card: str, pot: Pot, turns: Sequence[PotTurn]) -> Iterator[str]:
        dial = self._free(f"dial_{pot.name}")
        times_s = np.array([0.0] + [turn.sample * self._period_s for turn in turns])
        dials = np.array([pot.dial] + [turn.values[pot.name] for turn in turns])
        yield from _stepped(f"{self._free(f'V_{dial}')} {dial} 0", times_s, dials)
        yield self._instance("turned_pot", card, (*pot.nodes, dial), track=pot.track_ohm)

    def _instance(self, subcircuit: str, card: str, nodes: Sequence[str], **values: float) -> str:
        self._used[subcircuit] = None
        return " ".join([card, *nodes, subcircuit, *(f"{name}={_number(value)}" for name, value in values.items())])

    def _free(self, name: str) -> str:
        """Name with as many underscores appended as make it unique in the deck."""
        while name.lower() in self._taken:
            name += "_"
        self._taken.add(name.lower())
        return name


_PIECES_PER_SAMPLE = 32

_LETTERS: Mapping[type, str] = {
    Resistor: "R",
    Capacitor: "C",
    VoltageSource: "V",
    CurrentSource: "I",
    Pot: "X",
    OpAmp: "X",
    DiodeLimiter: "X",
    Switch: "X",
    Multiplier: "X",
    Function: "B",
}


def _card(letter: str, name: str) -> str:
    """Name of an element's card: its own if it begins with SPICE's letter, else with letter and _ before it.

    A name like R_1 gets the prefix too, so that removing prefixes restores names.
    """
    begins = name[:1].upper() == letter and name[1:2] != "_"
    return name if begins else f"{letter}_{name}"


def _known(what: str, names: Iterable[str], there: Sequence[str]) -> None:
    for name in names:
        if name not in there:
            raise CircuitError(f"no {what} is called {name!r}; there are {', '.join(there) or 'none'}")


def _levels(edges: Edges, period_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Instants in s and levels from 0 s on, without levels shorter than a step."""
    times_s = edges.ticks.astype(np.float64) * (period_s / TICKS_PER_SAMPLE)
    lasting = np.append(times_s[1:] > times_s[:-1] + STEP_S, True)[: times_s.size]
    times_s, levels_v = times_s[lasting], edges.levels_v[lasting]
    if times_s.size and times_s[0] <= 0:
        return times_s, levels_v
    return np.append(0.0, times_s), np.append(0.0, levels_v)


def _stepped(head: str, times_s: NDArray[np.float64], values: NDArray[np.float64]) -> Iterator[str]:
    """A PWL source that holds each value from its instant (the first from 0 s) to the next."""
    points = [f"0 {_number(values[0])}"]
    for time_s, before, after in zip(times_s[1:], values[:-1], values[1:], strict=True):
        points += [f"{_number(time_s)} {_number(before)}", f"{_number(time_s + STEP_S)} {_number(after)}"]
    yield from _straight(head, points)


def _straight(head: str, points: Sequence[str]) -> Iterator[str]:
    """A PWL source through points, each an instant and a level."""
    yield f"{head} PWL("
    for i in range(0, len(points), _WRAP):
        yield "+ " + " ".join(points[i : i + _WRAP])
    yield "+ )"


def _number(value: float) -> str:
    return repr(float(value))


def _straight_pieces(card: str, function: Function) -> Iterator[str]:
    """Behavioural source of a function: its middle line, and the excess beyond each bend."""
    slope, volts = function.line
    x = f"v({function.x})"
    yield f"{card} {function.out} 0 V = {_number(slope)} * {x} + {_number(volts)}"
    for kink in function.kinks:
        below, _, above = kink.slopes
        if math.isfinite(kink.lower):
            yield f"+ + {_number(below)} * min(0, {x} - {_number(kink.lower)})"
        if math.isfinite(kink.upper):
            yield f"+ + {_number(above)} * max(0, {x} - {_number(kink.upper)})"


def _instance_of(element: OpAmp | Pot | DiodeLimiter | Switch | Multiplier) -> tuple[str, dict[str, float]]:
    """Return the subcircuit of an element and its parameters; its nodes are the element's, in their order."""
    match element:
        case OpAmp():
            return _opamp_instance(element.model)
        case Pot():
            return "pot", {"track": element.track_ohm, "dial": element.dial}
        case DiodeLimiter():
            return "diode_limiter", {
                "threshold": element.threshold_v,
                "on": element.on_ohm,
                "off": element.off_ohm,
            }
        case Multiplier():
            return _multiplier_instance(element)
        case Switch():
            return "switch", {"on": element.on_ohm, "off": element.off_ohm, "closed": float(element.closed)}


def _opamp_instance(model: OpAmpModel) -> tuple[str, dict[str, float]]:
    rejection = {"common": 0.5 / model.cmrr} if math.isfinite(model.cmrr) else {}
    if not model.has_state:
        return "opamp_without_pole", _finite(avol=model.avol, rout=model.rout_ohm, vos=model.vos_v) | rejection
    low, high = model.bounds_v
    law = _finite(
        avol=model.avol,
        gbw=model.gbw_hz,
        slew=model.slew_v_per_s,
        swing_low=low,
        swing_high=high,
        rout=model.rout_ohm,
        vos=model.vos_v,
    )
    limits = {"drop": model.rout_ohm * model.current_limit_a} if model.limits_current else {}
    if model.recovers:
        limits |= dict(zip(("out_low", "out_high"), model.swing_v, strict=True))
    if not (rejection or limits):
        return "opamp", law
    return "limited_opamp", law | rejection | _finite(**limits)


def _multiplier_instance(element: Multiplier) -> tuple[str, dict[str, float]]:
    model, product = element.model, element.product
    if element.law is Law.QUOTIENT:
        return "divider", {"scale": element.scale_v}
    if element.law is Law.ROOT:
        return "root", {"scale": element.scale_v, "sign": element.sign}
    for side, factor in (("x", product.x), ("y", product.y)):
        if unsaid := [power for power, number in enumerate(factor) if number and power not in (1, 3)]:
            raise CircuitError(
                f"multiplier {element.name}: the deck has no power {unsaid[0]} of its {side} input, only 1 and 3"
            )
    _, x1, _, x3 = (*product.x, 0.0, 0.0)[:4]
    _, y1, _, y3 = (*product.y, 0.0, 0.0)[:4]
    law = {"x1": x1, "x3": x3, "y1": y1, "y3": y3}
    law |= {"vx": model.x_offset_v, "vy": model.y_offset_v, "vz": model.z_offset_v}
    if not model.has_state:
        return "multiplier_without_pole", law
    low, high = model.swing_v
    limits = {"slew": model.slew_v_per_s, "swing_low": low, "swing_high": high, "rout": model.rout_ohm}
    return "multiplier", _finite(**law, rate=model.gain_rate, **limits)


def _finite(**values: float) -> dict[str, float]:
    return {name: v if math.isfinite(v) else math.copysign(LIMITLESS, v) for name, v in values.items()}
