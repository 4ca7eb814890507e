"""A circuit as a SPICE deck that ngspice runs unchanged.

    ngspice -b -r out.raw deck.cir

Op-amps follow the same law as in the engine. The deck starts from zero state (uic). A pot that is turned becomes two
behavioural resistors steered by a voltage that steps; sources and pots step within STEP_S, from the instant on. A dummy
PULSE source puts ngspice's time points on the sample instants, where it would otherwise interpolate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .circuit import (
    GROUND,
    Capacitor,
    Circuit,
    DiodeLimiter,
    Element,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
)
from .errors import CircuitError
from .excitation import TICKS_PER_SAMPLE, Edges
from .opamp import CLAMP_RATE, OpAmpModel
from .pot import legs_ohm

__all__ = ["STEP_S", "Accuracy", "to_spice"]

STEP_S = 1e-11
"""Rise time of every step in a deck, far below anything the circuits resolve."""

_STATE_FARAD = 1e-10
"""Capacitance that holds an op-amp's state in the deck; it only scales the currents to sizes that ngspice's tolerances
suit (mA at full slew)."""

_NULLOR_GAIN = 1e9

_WRAP = 8


@dataclass(frozen=True)
class Accuracy:
    """ngspice's tolerances; max_step_s is its longest time step.

    With the defaults its error on the suspension is below 0.01 LSB of a 12-bit card.
    """

    reltol: float = 1e-7
    vntol_v: float = 1e-9
    abstol_a: float = 1e-12
    trtol: float = 0.1
    max_step_s: float = 1e-5


def to_spice(
    circuit: Circuit,
    *,
    samples: int,
    sample_rate_hz: float = 20e3,
    edges: Mapping[str, Edges] | None = None,
    turns: Sequence[tuple[int, Mapping[str, float]]] = (),
    nodes: Sequence[str] | None = None,
    accuracy: Accuracy | None = None,
    title: str = "analogue computer",
) -> str:
    """The deck of a circuit played for that many samples from zero state.

    edges: by input, from tick 0 on (an input without any stays at 0 V). turns: (sample, dials by pot), effective right
    after that sample.
    nodes: which voltages are saved, all when None. Raises CircuitError for an input, pot or node that is not there.
    """
    accuracy = accuracy or Accuracy()
    period_s = 1.0 / sample_rate_hz
    edges = edges or {}
    _check(circuit, edges, turns, nodes)
    lines = [f"* {title}"]
    for element in circuit.elements:
        lines += _element(element, edges, turns, period_s)
    lines += [
        "* time points on the samples",
        f"Vtimepoints timepoints 0 PULSE(0 1 0 1n 1n {_number(0.5 * period_s)} {_number(period_s)})",
        ".save " + " ".join(f"v({node})" for node in (circuit.nodes if nodes is None else nodes)),
        f".options reltol={accuracy.reltol:g} vntol={accuracy.vntol_v:g} abstol={accuracy.abstol_a:g}",
        f".options trtol={accuracy.trtol:g}",
        f".tran {_number(period_s)} {_number((samples - 1) * period_s)} 0 {_number(accuracy.max_step_s)} uic",
        ".end",
    ]
    return "\n".join(lines) + "\n"


def _check(
    circuit: Circuit,
    edges: Mapping[str, Edges],
    turns: Sequence[tuple[int, Mapping[str, float]]],
    nodes: Sequence[str] | None,
) -> None:
    inputs = {source.name for source in circuit.of(VoltageSource) if source.dc_v is None}
    for name in edges:
        if name not in inputs:
            raise CircuitError(f"no input is called {name!r}; there are {', '.join(sorted(inputs)) or 'none'}")
    for _, dials in turns:
        circuit.with_dials(dials)
    for node in nodes or ():
        if node not in circuit.nodes:
            raise CircuitError(f"no node is called {node!r}; there are {', '.join(circuit.nodes)}")


def _element(
    element: Element, edges: Mapping[str, Edges], turns: Sequence[tuple[int, Mapping[str, float]]], period_s: float
) -> Iterator[str]:
    name = element.name
    match element:
        case Resistor(a=a, b=b, ohm=ohm):
            yield f"R_{name} {a} {b} {_number(ohm)}"
        case Capacitor(a=a, b=b, farad=farad):
            yield f"C_{name} {a} {b} {_number(farad)}"
        case VoltageSource(plus=plus, minus=minus, dc_v=None):
            yield from _stepped(f"V_{name} {plus} {minus}", *_levels(edges.get(name, Edges.none()), period_s))
        case VoltageSource(plus=plus, minus=minus, dc_v=volts):
            yield f"V_{name} {plus} {minus} DC {_number(volts or 0.0)}"
        case Pot():
            yield from _pot(element, [(sample, dials[name]) for sample, dials in turns if name in dials], period_s)
        case OpAmp():
            yield from _opamp(element)
        case DiodeLimiter(a=a, b=b, threshold_v=threshold_v, off_ohm=off_ohm):
            beyond = f"max(0, {_difference(a, b)} - ({_number(threshold_v)}))"
            yield f"R_{name}_off {a} {b} {_number(off_ohm)}"
            yield f"B_{name} {a} {b} I = {_number(element.excess_siemens)} * {beyond}"
        case Switch(a=a, b=b, closed=closed):
            yield f"R_{name} {a} {b} {_number(element.ohm(closed=closed))}"


def _pot(pot: Pot, turns: list[tuple[int, float]], period_s: float) -> Iterator[str]:
    if not turns:
        upper_ohm, lower_ohm = legs_ohm(pot.dial, pot.track_ohm)
        yield f"R_{pot.name}_upper {pot.top} {pot.wiper} {_number(upper_ohm)}"
        yield f"R_{pot.name}_lower {pot.wiper} {pot.bottom} {_number(lower_ohm)}"
        return
    upper_s, lower_s = f"upper_{pot.name}", f"lower_{pot.name}"
    times_s = np.array([0.0] + [sample * period_s for sample, _ in turns])
    legs = np.array([legs_ohm(dial, pot.track_ohm) for dial in [pot.dial] + [dial for _, dial in turns]])
    # Voltages that stand for the legs' conductances in mS.
    yield from _stepped(f"V_{pot.name}_upper {upper_s} 0", times_s, 1e3 / legs[:, 0])
    yield from _stepped(f"V_{pot.name}_lower {lower_s} 0", times_s, 1e3 / legs[:, 1])
    yield f"B_{pot.name}_upper {pot.top} {pot.wiper} I = 1e-3 * v({upper_s}) * {_difference(pot.top, pot.wiper)}"
    yield f"B_{pot.name}_lower {pot.wiper} {pot.bottom} I = 1e-3 * v({lower_s}) * {_difference(pot.wiper, pot.bottom)}"


def _opamp(amp: OpAmp) -> Iterator[str]:
    model, inner, driven = amp.model, f"{amp.name}_v", amp.out if amp.model.rout_ohm == 0 else f"{amp.name}_r"
    difference = f"({_difference(amp.plus, amp.minus)} + {_number(model.vos_v)})"
    if model.has_state:
        yield f"C_{amp.name} {inner} 0 {_number(_STATE_FARAD)}"
        yield f"B_{amp.name} 0 {inner} I = {_number(_STATE_FARAD)} * ({_slope(model, difference, f'v({inner})')})"
        yield f"E_{amp.name} {driven} 0 {inner} 0 1"
    else:
        yield f"B_{amp.name} {driven} 0 V = {_number(min(model.avol, _NULLOR_GAIN))} * {difference}"
    if model.rout_ohm > 0:
        yield f"R_{amp.name}_out {driven} {amp.out} {_number(model.rout_ohm)}"


def _slope(model: OpAmpModel, difference: str, state: str) -> str:
    """The law of opamp.py as an expression."""
    slope = f"{_number(model.gain_rate)} * {difference} - {_number(model.leak_rate)} * {state}"
    if model.slews:
        slew = _number(model.slew_v_per_s)
        slope = f"max(-{slew}, min({slew}, {slope}))"
    low, high = model.swing_v
    if np.isfinite(high):
        slope += f" - {_number(CLAMP_RATE)} * max(0, {state} - {_number(high)})"
    if np.isfinite(low):
        slope += f" - {_number(CLAMP_RATE)} * min(0, {state} - ({_number(low)}))"
    return slope


def _levels(edges: Edges, period_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Instants in s and levels, beginning at 0 s."""
    times_s = edges.ticks.astype(np.float64) * (period_s / TICKS_PER_SAMPLE)
    if times_s.size and times_s[0] <= 0:
        return times_s, edges.levels_v
    return np.append(0.0, times_s), np.append(0.0, edges.levels_v)


def _stepped(head: str, times_s: NDArray[np.float64], values: NDArray[np.float64]) -> Iterator[str]:
    """A PWL source that holds each value from its instant (the first from 0 s) to the next."""
    points = [f"0 {_number(values[0])}"]
    for time_s, before, after in zip(times_s[1:], values[:-1], values[1:], strict=True):
        points += [f"{_number(time_s)} {_number(before)}", f"{_number(time_s + STEP_S)} {_number(after)}"]
    yield f"{head} PWL("
    for i in range(0, len(points), _WRAP):
        yield "+ " + " ".join(points[i : i + _WRAP])
    yield "+ )"


def _difference(a: str, b: str) -> str:
    if b == GROUND:
        return f"v({a})"
    return f"(v({a}) - v({b}))" if a != GROUND else f"(-v({b}))"


def _number(value: float) -> str:
    return repr(float(value))
