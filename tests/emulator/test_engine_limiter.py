"""Diode limiters and switches: kinks that feed one another, against circuits solved by hand and against ngspice."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    CircuitError,
    DiodeLimiter,
    Edges,
    Engine,
    EngineError,
    OpAmp,
    OpAmpModel,
    Resistor,
    Switch,
    VoltageSource,
    piecewise_linear,
    preset,
    to_spice,
)
from analogrig_emulator.circuit.nodal import Nodal
from tests.emulator.plays import LSB_V, NgSpice, steps

SOURCE = VoltageSource("V1", "in")


def back_to_back(name: str, a: str, b: str, threshold_v: float, on_ohm: float = 50.0) -> list[DiodeLimiter]:
    return [
        DiodeLimiter(f"{name}p", a, b, threshold_v, on_ohm, 1e8),
        DiodeLimiter(f"{name}n", b, a, threshold_v, on_ohm, 1e8),
    ]


def staircase(levels_v: Sequence[float]) -> dict[str, Edges]:
    return steps(*enumerate(levels_v))


def test_a_resistive_limiter_follows_its_law() -> None:
    """1 k into a limiter of 2 V, 1 k on, 9 k off: v = 0.9 u up to u = 2.222 V, then 2 v = u + 2 (8/9)."""
    circuit = Circuit([SOURCE, Resistor("R1", "in", "o", 1e3), DiodeLimiter("D1", "o", "0", 2.0, 1e3, 9e3)])
    levels_v = np.linspace(-10.0, 10.0, 41)
    volts = Engine(piecewise_linear(circuit), ["o"]).run(41, staircase(levels_v.tolist()))[:, 0]
    expected = np.where(levels_v < 2.0 / 0.9, 0.9 * levels_v, (levels_v + 2.0 * 8.0 / 9.0) / 2.0)
    np.testing.assert_allclose(volts, expected, rtol=1e-13)


def test_a_bridge_of_four_limiters_rectifies() -> None:
    """All four are coupled; solved by trying the 16 combinations with plain linear algebra."""
    ends = [("in", "p"), ("0", "p"), ("m", "in"), ("m", "0")]
    limiters = [DiodeLimiter(f"D{i}", a, b, 0.6, 20.0, 1e6) for i, (a, b) in enumerate(ends)]
    circuit = Circuit([SOURCE, *limiters, Resistor("RL", "p", "m", 1e3), Resistor("RG", "m", "0", 1e7)])
    levels_v = [-8.0, -1.0, -0.3, 0.0, 0.4, 1.3, 9.0]
    volts = Engine(piecewise_linear(circuit), ["p", "m"]).run(len(levels_v), staircase(levels_v))
    np.testing.assert_allclose(volts, [bridge(level) for level in levels_v], rtol=0, atol=1e-9)


def bridge(u: float) -> NDArray[np.float64]:
    """v(p), v(m) of the bridge above."""
    for on in itertools.product((False, True), repeat=4):
        matrix = np.array([[1e-3, -1e-3], [-1e-3, 1e-3 + 1e-7]])
        right = np.zeros(2)
        # (row, sign of that node's voltage in v(a) - v(b), the fixed other end)
        for (row, sign, fixed), conducts in zip(((0, -1, u), (0, -1, 0.0), (1, 1, u), (1, 1, 0.0)), on, strict=True):
            siemens = 1 / 20 if conducts else 1e-6
            offset = 0.6 * (1 / 20 - 1e-6) if conducts else 0.0
            # Current a -> b: siemens (v(a) - v(b)) - offset, leaving node row when sign is +1.
            matrix[row, row] += siemens
            right[row] += siemens * fixed + sign * offset
        v = np.linalg.solve(matrix, right)
        beyond = [u - v[0], -v[0], v[1] - u, v[1]]
        if all((x > 0.6) == conducts for x, conducts in zip(beyond, on, strict=True)):
            return v
    raise AssertionError("no combination is consistent")


def limited_inverter(amp: str | OpAmpModel = "tl07x") -> Circuit:
    """Gain -2, its output limited by 4 V limiters across the feedback, then a low-pass and a limiter on a capacitor."""
    model = preset(amp) if isinstance(amp, str) else amp
    return Circuit(
        [
            SOURCE,
            *(Resistor("R1", "in", "s", 10e3), Resistor("R2", "s", "o", 20e3), OpAmp("U1", "0", "s", "o", model)),
            *back_to_back("DF", "s", "o", 4.0),
            *(Resistor("R3", "o", "m", 5e3), Resistor("R4", "m", "c", 5e3), Capacitor("C1", "c", "0", 10e-9)),
            *back_to_back("DM", "m", "0", 2.5, 200.0),
            *(DiodeLimiter("DC", "c", "0", 1.5, 300.0, 1e7), OpAmp("U2", "c", "p", "p", model)),
        ]
    )


@pytest.mark.parametrize("amp", ["tl07x", "741"])
def test_limiters_agree_with_ngspice_at_every_output_and_sample(ngspice: NgSpice, amp: str) -> None:
    edges = steps((0.0, 1.0), (3.3, 9.0), (9.71, -7.0), (15.2, 2.6), (22.5, -10.0), (30.25, 10.0), (36.6, 0.0))
    circuit, nodes = limited_inverter(amp), ("o", "m", "c", "p")
    reference = ngspice(to_spice(circuit, samples=60, edges=edges), nodes, 60)
    engine = Engine(piecewise_linear(circuit), nodes)
    volts = engine.run(60, edges)
    assert np.abs(volts - reference).max() < 0.05 * LSB_V
    assert engine.counts.events > 20


def test_an_ideal_amplifier_limits_at_the_threshold() -> None:
    """1 mA into 20 k beside 4 V, 50 ohm: v/20k + v/1e8 * 2 + (1/50 - 1/1e8)(v - 4) = 1 mA."""
    circuit = limited_inverter(OpAmpModel())
    volts = Engine(piecewise_linear(circuit), ["o"]).run(3, steps((0.0, -10.0), (1.0, 10.0), (2.0, 1.0)))[:, 0]
    v = (1e-3 + (1 / 50 - 1e-8) * 4.0) / (1 / 20e3 + 1 / 50 + 1e-8)
    np.testing.assert_allclose(volts[:2], [v, -v], rtol=1e-9)
    assert volts[2] == pytest.approx(-1e-4 / (1 / 20e3 + 2e-8), rel=1e-12)


def test_limiters_with_positive_feedback_have_no_unique_solution_and_are_refused() -> None:
    """An amplifier of gain +3 drives the limiter's own node: beyond the threshold its conductance looks negative."""
    latch = (
        *(
            Resistor("R1", "in", "a", 10e3),
            Resistor("R2", "a", "o", 10e3),
            DiodeLimiter("D1", "a", "g", 1.0, 10.0, 1e9),
        ),
        *(Resistor("R3", "g", "0", 1e3), OpAmp("U1", "g", "n", "o", OpAmpModel())),
        *(Resistor("R4", "o", "n", 40e3), Resistor("R5", "n", "0", 1e3)),
    )
    with pytest.raises(EngineError, match="no unique solution"):
        Engine(piecewise_linear(Circuit([SOURCE, *latch])), ["o"])


def test_a_switch_is_its_resistance_and_is_thrown_like_a_pot() -> None:
    circuit = Circuit([SOURCE, Resistor("R1", "in", "o", 1e3), Switch("S1", "o", "0", 1e3, 3e3, closed=False)])
    nodal = Nodal(circuit)
    engine = Engine(nodal.at({}), ["o"])
    before = engine.run(2, steps((0.0, 8.0)))
    engine.set_system(nodal.at({}, {"S1": True}))
    assert [*before[:, 0], *engine.run(1)[:, 0]] == pytest.approx([6.0, 6.0, 4.0], rel=1e-14)
    closed = piecewise_linear(circuit.with_switches({"S1": True}))
    assert np.array_equal(closed.lmn, nodal.at({}, {"S1": True}).lmn)
    assert "X_S1 o 0 switch on=1000.0 off=3000.0 closed=1.0" in to_spice(circuit.with_switches({"S1": True}), samples=2)


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (DiodeLimiter("D1", "in", "0", float("nan"), 1.0, 2.0), "threshold_v must be finite"),
        (DiodeLimiter("D1", "in", "0", 1.0, 3.0, 2.0), "on_ohm 3.0 exceeds off_ohm 2.0"),
        (DiodeLimiter("D1", "in", "0", 1.0, 0.0, 2.0), "on_ohm must be positive"),
        (Switch("S1", "in", "in", 1.0, 2.0, closed=True), "both ends are on node in"),
        (Switch("S1", "in", "0", 1.0, float("inf"), closed=True), "off_ohm must be positive and finite"),
    ],
)
def test_bad_values_are_refused_naming_element_and_field(element: DiodeLimiter | Switch, message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        Circuit([SOURCE, element])


nodes_of_a_mesh = st.sampled_from(("in", "a", "b", "c", "d", "0"))
limiters_of_a_mesh = st.lists(
    st.tuples(
        nodes_of_a_mesh, nodes_of_a_mesh, st.sampled_from((-1.0, 0.0, 0.6, 0.6, 3.0)), st.floats(0.0, 4.0)
    ).filter(lambda drawn: drawn[0] != drawn[1]),
    min_size=1,
    max_size=8,
)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(limiters_of_a_mesh, st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=12))
def test_the_currents_of_any_mesh_of_limiters_balance(
    drawn: list[tuple[str, str, float, float]], levels_v: list[float]
) -> None:
    """Kirchhoff's law with the law of each element is the definition; a passive mesh has one solution."""
    limiters = [DiodeLimiter(f"D{i}", a, b, v, 10.0**decade, 1e6) for i, (a, b, v, decade) in enumerate(drawn)]
    ring = [("in", "a"), ("a", "b"), ("b", "c"), ("c", "d"), ("d", "0")]
    resistors = [Resistor(f"R{i}", a, b, 1e3 * (1 + i)) for i, (a, b) in enumerate(ring)]
    engine = Engine(piecewise_linear(Circuit([SOURCE, *resistors, *limiters])), ["in", "a", "b", "c", "d"])
    for volts in engine.run(len(levels_v), staircase(levels_v)):
        v = dict(zip(("in", "a", "b", "c", "d"), volts.tolist(), strict=True)) | {"0": 0.0}
        into = dict.fromkeys(v, 0.0)
        elements: list[Resistor | DiodeLimiter] = [*resistors, *limiters]
        for element in elements:
            amperes = current(element, v[element.a] - v[element.b])
            into[element.a] -= amperes
            into[element.b] += amperes
        assert max(abs(into[node]) for node in "abcd") < 2e-10  # of up to 20 A: 1e-11 of them


def current(element: Resistor | DiodeLimiter, v: float) -> float:
    """From a to b, in A."""
    if isinstance(element, Resistor):
        return v / element.ohm
    conducting = max(0.0, v - element.threshold_v)
    return v / element.off_ohm + (1.0 / element.on_ohm - 1.0 / element.off_ohm) * conducting


def test_an_unknown_switch_is_refused() -> None:
    with pytest.raises(CircuitError, match="no switch is called 'S2'; there are none"):
        Circuit([SOURCE, Resistor("R1", "in", "0", 1.0)]).with_switches({"S2": True})


@pytest.mark.parametrize(
    ("refused", "why"),
    [
        (lambda: latching(closed=True), "no unique solution"),
        (lambda: latching(closed=False, farad=1e-40), "too stiff"),
    ],
)
def test_a_refused_circuit_is_refused_again_and_not_played(refused: Callable[[], Circuit], why: str) -> None:
    engine = Engine(piecewise_linear(latching(closed=False)), ["o"])
    engine.run(3, steps((0.0, 1.0)))
    for _ in range(2):
        with pytest.raises(EngineError, match=why):
            engine.set_system(piecewise_linear(refused()))
    with pytest.raises(EngineError, match="the last one was refused"):
        engine.run(1)
    engine.set_system(piecewise_linear(latching(closed=False)))
    assert engine.run(3).shape == (3, 1)


def schmitt(amp: str) -> Circuit:
    """A limiter with hysteresis: x is about +-3 V, and switches where the input n passes a third of it."""
    return Circuit(
        [
            *(SOURCE, Resistor("R0", "in", "n", 1e3), Capacitor("C0", "n", "0", 1e-9)),
            *(OpAmp("U1", "p", "n", "o", preset(amp)), Resistor("R1", "o", "x", 2e3)),
            *back_to_back("D", "x", "0", 3.0, 20.0),
            *(Resistor("R2", "x", "p", 20e3), Resistor("R3", "p", "0", 10e3)),
        ]
    )


COURSE = ((-2.0, 1), (0.5, 1), (0.9, 1), (1.6, -1), (0.5, -1), (-0.9, -1), (-1.7, 1), (0.9, 1), (2.0, -1), (0.0, -1))
"""Levels of the input, each for four samples, and the sign of x after each: thresholds are +-1.03 V."""


def course() -> dict[str, Edges]:
    return steps(*((4.0 * i + 0.3 * (i % 3), level) for i, (level, _) in enumerate(COURSE)))


@pytest.mark.parametrize("amp", ["tl07x", "741"])
def test_a_limiter_with_hysteresis_remembers_the_threshold_that_was_passed_last(amp: str) -> None:
    engine = Engine(piecewise_linear(schmitt(amp)), ["x"])
    volts = engine.run(4 * len(COURSE), course())[3::4, 0]
    np.testing.assert_allclose(volts, [3.1 * sign for _, sign in COURSE], atol=0.05)
    assert engine.counts.events >= 4 * 2  # four switchings, each of which lets one limiter go and takes the other


def test_a_limiter_with_hysteresis_agrees_with_ngspice(ngspice: NgSpice) -> None:
    circuit, nodes, samples = schmitt("tl07x"), ("x", "p", "o"), 4 * len(COURSE)
    reference = ngspice(to_spice(circuit, samples=samples, edges=course()), nodes, samples)
    volts = Engine(piecewise_linear(circuit), nodes).run(samples, course())
    assert np.abs(volts - reference).max() < 0.05 * LSB_V


def latching(*, closed: bool, farad: float = 1e-9) -> Circuit:
    """A follower with a limiter from output to input, which a switch puts in: beyond its threshold it latches."""
    return Circuit(
        [
            *(SOURCE, Resistor("R1", "in", "p", 1e4), Resistor("R2", "o", "n", 1e4), Resistor("R3", "n", "0", 1e4)),
            *(OpAmp("U1", "p", "n", "o", OpAmpModel()), Switch("S1", "o", "x", 1.0, 1e12, closed)),
            *(
                DiodeLimiter("D1", "x", "p", 0.5, 100.0, 1e9),
                Resistor("R4", "in", "c", 1e3),
                Capacitor("C1", "c", "0", farad),
            ),
        ]
    )


@pytest.mark.parametrize("pulse_ticks", [1, 3, 100])
def test_a_pulse_that_ends_before_the_first_look_takes_the_limiter_nowhere(pulse_ticks: int) -> None:
    """10 k into 10 nF, settled just below a limiter of 1.5 V: the first look after the edge is beyond the bound."""
    low_v, high_v, samples = 1.5 - 1e-3, 10.0, 60
    limiter = DiodeLimiter("D1", "c", "0", 1.5, 50.0, 1e9)
    circuit = Circuit([SOURCE, Resistor("R1", "in", "c", 10e3), Capacitor("C1", "c", "0", 10e-9), limiter])
    pulse = (50.0, 50.0 + pulse_ticks / TICKS_PER_SAMPLE)
    engine = Engine(piecewise_linear(circuit), ["c"])
    volts = engine.run(samples, steps((0.0, low_v), (pulse[0], high_v), (pulse[1], low_v)))[:, 0]
    unmoved = Engine(piecewise_linear(circuit), ["c"]).run(samples, steps((0.0, low_v)))[:, 0]
    assert engine.counts.events == 0
    np.testing.assert_allclose(volts, unmoved, rtol=0, atol=2e-4)
