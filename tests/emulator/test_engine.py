"""The engine against scipy and against solutions by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from numpy.typing import NDArray

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    Edges,
    Engine,
    EngineError,
    OpAmp,
    OpAmpModel,
    PiecewiseLinear,
    Resistor,
    VoltageSource,
    piecewise_linear,
)
from analogrig_emulator.circuit.opamp import CLAMP_RATE

Volts = NDArray[np.float64]
Slope = Callable[[float, Volts, float], tuple[float, ...]]

SOURCE = VoltageSource("V1", "in")
RATE = 2 * math.pi * 1e6
"""2 pi GBW of the op-amps in this file."""
SLEW = 0.5e6
OPAMP = OpAmpModel(gbw_hz=1e6, slew_v_per_s=SLEW, swing_v=(-13.5, 13.5))


def steps(*changes: tuple[float, float]) -> dict[str, Edges]:
    """Edges of V1 at (instant in samples, level)."""
    instants, levels_v = np.array(changes).T
    return {"V1": Edges(np.rint(instants * TICKS_PER_SAMPLE).astype(np.int64), levels_v)}


def rc_ladder(sections: int) -> Circuit:
    rng = np.random.default_rng(sections)
    nodes = ["in", *(f"n{i}" for i in range(sections))]
    resistors = [Resistor(f"R{i}", nodes[i], nodes[i + 1], 10 ** rng.uniform(2, 5)) for i in range(sections)]
    capacitors = [Capacitor(f"C{i}", nodes[i + 1], "0", 10 ** rng.uniform(-11, -8)) for i in range(sections)]
    return Circuit([SOURCE, *resistors, *capacitors])


def follower(model: OpAmpModel = OPAMP) -> PiecewiseLinear:
    return piecewise_linear(Circuit([SOURCE, OpAmp("U1", "in", "out", "out", model)]))


def integrator() -> PiecewiseLinear:
    """10 k and 1 nF: 10 us."""
    elements = (Resistor("R1", "in", "n", 10e3), Capacitor("C1", "n", "out", 1e-9), OpAmp("U1", "0", "n", "out", OPAMP))
    return piecewise_linear(Circuit([SOURCE, *elements]))


@pytest.mark.parametrize("sections", [1, 3, 7, 16, 32])
def test_a_linear_circuit_follows_the_matrix_exponential(sections: int) -> None:
    system = piecewise_linear(rc_ladder(sections))
    engine = Engine(system, system.nodes)
    # Instants that are whole ticks, so that the reference need not round them.
    engine.run(5, steps((0.0, 10.0), (1.3125, -4.0), (1.75, 2.0), (4.0, 7.0)))
    generator = np.vstack([system.abc, np.zeros((2, sections + 2))])
    z = np.zeros(sections + 2)
    for level, duration in ((10.0, 1.3125), (-4.0, 0.4375), (2.0, 2.25)):
        z[-2:] = level, 1.0
        z = scipy.linalg.expm(generator * duration * 50e-6) @ z
    np.testing.assert_allclose(engine.state, z[:sections], rtol=1e-10, atol=1e-12)


def test_samples_show_the_edge_that_falls_on_their_instant() -> None:
    engine = Engine(piecewise_linear(Circuit([SOURCE, Resistor("R1", "in", "0", 1e3)])), ["in"])
    volts = engine.run(5, steps((0.0, 1.0), (2.0, 5.0), (3.5, 7.0)))
    assert volts[:, 0].tolist() == [1.0, 1.0, 5.0, 5.0, 7.0]


def test_slewing_ends_when_the_law_says_so() -> None:
    """A follower, solved by hand: a ramp at the slew rate until a (u - v) = SR, then an exponential."""
    engine = Engine(follower(), ["out"], sample_rate_hz=1e6)
    volts = engine.run(60, steps((0.0, 10.0)))[:, 0]
    t = np.arange(60) * 1e-6
    ends_s = (10.0 - SLEW / RATE) / SLEW
    expected = np.where(t < ends_s, SLEW * t, 10.0 - SLEW / RATE * np.exp(-RATE * np.maximum(t - ends_s, 0.0)))
    np.testing.assert_allclose(volts, expected, rtol=0, atol=1e-8)
    assert engine.counts.events == 1


def test_an_overdriven_output_stands_slew_over_clamp_rate_beyond_its_swing() -> None:
    load = [Resistor("RL", "out", "0", 1e3), Resistor("RF", "out", "in", 1e9)]  # the source does not mind the feedback
    system = piecewise_linear(Circuit([SOURCE, OpAmp("U1", "in", "0", "out", OPAMP), *load]))
    engine = Engine(system, ["out"])
    volts = engine.run(3, steps((0.0, 1.0), (1.0, -1.0)))[:, 0]
    # The second sample: 50 us at 0.5 V/us reach the upper clamp; the third, from there down to the lower one, does not.
    assert volts[1] == pytest.approx(13.5 + SLEW / CLAMP_RATE, abs=1e-9)
    assert volts[2] == pytest.approx(13.5 - 25.0, abs=2e-3)


def brute_force(slope: Slope, x0: Volts, stretches: list[tuple[float, float]], instants_s: Volts) -> Volts:
    """(instants, states): an implicit integrator at tight tolerance, restarted at every (start in s, level).

    The last stretch ends just after the last instant.
    """
    stops_s = [start_s for start_s, _ in stretches[1:]] + [float(instants_s[-1]) + 1e-9]
    rows, x = [], x0
    for (start_s, level), stop_s in zip(stretches, stops_s, strict=True):
        wanted = instants_s[(instants_s >= start_s) & (instants_s < stop_s)]
        times_s = np.append(wanted, stop_s)
        done = scipy.integrate.solve_ivp(
            slope, (start_s, stop_s), x, "Radau", times_s, args=(level,), rtol=1e-10, atol=1e-12, max_step=2e-7
        )
        rows.append(done.y.T[:-1])
        x = done.y[:, -1]
    return np.concatenate(rows)


def law(demand: float, v: float) -> float:
    beyond = max(v - 13.5, 0.0) + min(v + 13.5, 0.0)
    return min(max(demand, -SLEW), SLEW) - CLAMP_RATE * beyond


def test_an_integrator_driven_into_its_clamp_and_back_agrees_with_brute_force() -> None:
    def slope(_: float, x: Volts, level: float) -> tuple[float, float]:
        capacitor_v, v = x
        n = capacitor_v + v
        return (level - n) / (10e3 * 1e-9), law(-RATE * n, v)

    engine = Engine(integrator(), ["out"])
    volts = engine.run(8, steps((0.0, 5.0), (2.37, -5.0), (4.0, 0.0)))[:, 0]
    expected = brute_force(slope, np.zeros(2), [(0.0, 5.0), (118.5e-6, -5.0), (200e-6, 0.0)], np.arange(8.0) * 50e-6)
    assert expected[:, 1].min() < -13.5
    # Radau itself is good to some 1e-6 V across the kinks; 1e-5 V is 4/1000 LSB of a 12-bit card on 10 V.
    np.testing.assert_allclose(volts, expected[:, 1], atol=1e-5)


def test_slewing_that_starts_after_the_edge_is_seen() -> None:
    """A low-pass of 2 us before the follower: right after the edge nothing slews yet."""

    def slope(_: float, x: Volts, level: float) -> tuple[float, float]:
        capacitor_v, v = x
        return (level - capacitor_v) / 2e-6, law(RATE * (capacitor_v - v), v)

    elements = (Resistor("R1", "in", "p", 1e3), Capacitor("C1", "p", "0", 2e-9), OpAmp("U1", "p", "out", "out", OPAMP))
    engine = Engine(piecewise_linear(Circuit([SOURCE, *elements])), ["out"], sample_rate_hz=1e5)
    volts = engine.run(5, steps((0.0, 8.0)))[:, 0]
    expected = brute_force(slope, np.zeros(2), [(0.0, 8.0)], np.arange(5.0) * 10e-6)
    np.testing.assert_allclose(volts, expected[:, 1], atol=1e-5)
    assert engine.counts.events == 2


def test_slewing_that_starts_late_and_ends_before_the_next_sample_is_seen() -> None:
    """The same at 20 kHz: quiet at both ends of the first interval; a slow low-pass keeps what was between."""

    def slope(_: float, x: Volts, level: float) -> tuple[float, float, float]:
        fast_v, slow_v, v = x
        return (level - fast_v) / 2e-6, (v - slow_v) / 100e-6, law(RATE * (fast_v - v), v)

    elements = (
        *(Resistor("R1", "in", "p", 1e3), Capacitor("C1", "p", "0", 2e-9), OpAmp("U1", "p", "out", "out", OPAMP)),
        *(Resistor("R2", "out", "slow", 1e3), Capacitor("C2", "slow", "0", 100e-9)),
    )
    engine = Engine(piecewise_linear(Circuit([SOURCE, *elements])), ["slow"])
    volts = engine.run(6, steps((3.0, 4.0)))[:, 0]
    expected = brute_force(slope, np.zeros(3), [(0.0, 4.0)], np.arange(3.0) * 50e-6)
    np.testing.assert_allclose(volts[3:], expected[:, 1], atol=1e-5)
    assert engine.counts.events == 2


def test_slewing_for_a_moment_between_two_steps_is_seen() -> None:
    """A low-pass as slow as the follower: the slope asked for, u a (a t) exp(-a t), peaks at u a / e when a t = 1.

    That is at 159 ns, while steps end 98 and 195 ns after the edge; there it is 0.906 and 0.978 of the peak.
    """
    farad = 1 / (RATE * 1e3)
    elements = (Resistor("R1", "in", "p", 1e3), Capacitor("C1", "p", "0", farad), OpAmp("U1", "p", "o", "o", OPAMP))
    for excess, events in ((0.99, 0), (1.01, 2)):
        engine = Engine(piecewise_linear(Circuit([SOURCE, *elements])), ["o"])
        engine.run(2, steps((0.0, excess * math.e * SLEW / RATE)))
        assert engine.counts.events == events


@pytest.mark.parametrize(("amplitude_v", "peak"), [(13.8, 0.5), (13.6, 0.25)])
def test_a_peak_that_touches_the_clamp_between_two_samples_is_seen(amplitude_v: float, peak: float) -> None:
    """An undamped loop of two integrators and an inverter swings at 2 kHz; a follower clips its peaks.

    At 10 samples a period no sample is beyond 13.5 V; the peaks come that part of an interval after a sample.
    """
    omega = 2 * math.pi * 2e3
    phase = -omega * 50e-6 * peak
    ohm = 1 / (omega * 1e-9)
    ideal, clamped = OpAmpModel(), OpAmpModel(gbw_hz=1e6, swing_v=(-13.5, 13.5))
    elements = (
        *(Resistor("R1", "c", "n1", ohm), Capacitor("C1", "n1", "a", 1e-9), OpAmp("U1", "0", "n1", "a", ideal)),
        *(Resistor("R2", "a", "n2", ohm), Capacitor("C2", "n2", "b", 1e-9), OpAmp("U2", "0", "n2", "b", ideal)),
        *(Resistor("R3", "b", "n3", 1e4), Resistor("R4", "n3", "c", 1e4), OpAmp("U3", "0", "n3", "c", ideal)),
        OpAmp("U4", "a", "out", "out", clamped),
        *(Resistor("R5", "out", "slow", 1e3), Capacitor("C3", "slow", "0", 100e-9)),
    )

    def slope(t: float, x: Volts, _: float) -> tuple[float, float]:
        v, slow_v = x
        a = amplitude_v * math.cos(omega * t + phase)
        clamp = CLAMP_RATE * (max(v - 13.5, 0.0) + min(v + 13.5, 0.0))
        return RATE * (a - v) - clamp, (v - slow_v) / 100e-6

    a, b = amplitude_v * math.cos(phase), amplitude_v * math.sin(phase)
    engine = Engine(piecewise_linear(Circuit(elements)), ["a", "slow"])
    # da/dt = -omega c = omega b, so b = -sin; a capacitor's voltage is that of its virtual ground less the output's.
    engine.state = np.array([-a, b, 0.0, a])
    volts = engine.run(13)
    np.testing.assert_allclose(volts[:, 0], amplitude_v * np.cos(omega * np.arange(13) * 50e-6 + phase), atol=1e-9)
    assert np.abs(volts[:, 0]).max() < 13.45
    expected = brute_force(slope, np.array([a, 0.0]), [(0.0, 0.0)], np.arange(13.0) * 50e-6)
    np.testing.assert_allclose(volts[:, 1], expected[:, 1], atol=1e-5)


@pytest.mark.parametrize("block", [1, 2, 7, 64])
def test_cutting_a_run_into_blocks_changes_no_bit(block: int) -> None:
    rng = np.random.default_rng(3)
    instants = np.sort(rng.uniform(0, 63, 40))
    edges = steps((0.0, 5.0), *zip(instants, rng.uniform(-8, 8, 40), strict=True))["V1"]
    whole = Engine(integrator(), ["out", "n"]).run(64, {"V1": edges})
    engine = Engine(integrator(), ["out", "n"])
    parts = []
    while engine.recorded < 64:
        count = min(block, 64 - engine.recorded)
        start, stop = engine.window(count)
        now = (edges.ticks >= start) & (edges.ticks < stop)
        parts.append(engine.run(count, {"V1": Edges(edges.ticks[now], edges.levels_v[now])}))
    assert np.array_equal(np.concatenate(parts), whole)


def test_setting_an_equal_circuit_or_an_equal_level_changes_no_bit() -> None:
    plain, touched = Engine(integrator(), ["out"]), Engine(integrator(), ["out"])
    plain.run(3, steps((0.0, 1.0)))
    touched.run(3, steps((0.0, 1.0)))
    touched.set_system(integrator())
    assert np.array_equal(touched.run(20, steps((7.3, 1.0))), plain.run(20))
    # An engine of an earlier test, kept for this one, may have its modes already.
    assert replace(touched.counts, modes_built=0) == replace(plain.counts, modes_built=0)


def test_an_edge_at_the_instant_of_the_last_sample_comes_after_it() -> None:
    engine = Engine(follower(), ["out"])
    assert engine.run(2, steps((0.0, 1.0)))[-1, 0] == pytest.approx(1.0)
    assert engine.run(1, steps((1.0, 3.0)))[0, 0] == pytest.approx(3.0)
    with pytest.raises(EngineError, match="before the last sample recorded"):
        engine.run(1, steps((1.5, 2.0)))


def test_a_new_circuit_takes_over_the_voltages() -> None:
    def low_pass(ohm: float) -> PiecewiseLinear:
        return piecewise_linear(Circuit([SOURCE, Resistor("R1", "in", "out", ohm), Capacitor("C1", "out", "0", 1e-9)]))

    engine = Engine(low_pass(50e3), ["out"])
    engine.run(2, steps((0.0, 1.0)))
    engine.set_system(low_pass(100e3))
    # 50 us at 50 us, then 50 us at 100 us.
    assert engine.run(1)[0, 0] == pytest.approx(1.0 - math.exp(-1.5), rel=1e-12)


def test_a_state_that_is_set_is_where_the_circuit_goes_on() -> None:
    engine = Engine(follower(), ["out"], sample_rate_hz=1e6)
    engine.run(1)
    engine.state = np.array([1.0])
    # 1 V above 0 V, the follower slews for 1 us.
    assert engine.run(1)[0, 0] == pytest.approx(0.5, abs=1e-12)
    with pytest.raises(EngineError, match="shape"):
        engine.state = np.zeros(2)


def test_a_circuit_with_other_states_is_refused() -> None:
    with pytest.raises(EngineError, match="not \\(\\('U1',\\), \\('V1',\\)\\)"):
        Engine(follower(), ["out"]).set_system(integrator())


def test_too_many_events_end_the_run_and_do_not_hang_it() -> None:
    engine = Engine(follower(), ["out"], events_per_sample=0)
    with pytest.raises(EngineError, match="after 1 samples: more events within one sample"):
        engine.run(5, steps((0.0, 10.0)))


def positive_feedback(model: OpAmpModel) -> Engine:
    return Engine(piecewise_linear(Circuit([SOURCE, OpAmp("U1", "out", "in", "out", model)])), ["out"])


def test_an_unstable_circuit_is_reported_and_does_not_hang() -> None:
    with pytest.raises(EngineError, match="no longer finite"):
        positive_feedback(OpAmpModel(gbw_hz=1e6)).run(100, steps((0.0, 1.0)))


def test_an_unstable_circuit_that_slews_goes_no_faster_than_its_slew_rate() -> None:
    volts = positive_feedback(OpAmpModel(gbw_hz=1e6, slew_v_per_s=SLEW)).run(100, steps((0.0, 1.0)))
    assert volts[-1, 0] == pytest.approx(-SLEW * 99 * 50e-6, rel=1e-3)


def test_a_circuit_too_stiff_for_any_step_is_refused() -> None:
    with pytest.raises(EngineError, match="too stiff"):
        Engine(piecewise_linear(Circuit([SOURCE, OpAmp("U1", "in", "out", "out", OpAmpModel(gbw_hz=1e30))])), ["out"])


@pytest.mark.parametrize("edges", [steps((2.0, 1.0), (1.0, 2.0)), steps((9.5, 1.0)), steps((-1.0, 1.0))])
def test_edges_out_of_order_or_of_the_run_are_refused(edges: dict[str, Edges]) -> None:
    with pytest.raises(EngineError, match="edges"):
        Engine(follower(), ["out"]).run(5, edges)


def test_an_edge_of_an_unknown_input_or_no_number_is_refused() -> None:
    engine = Engine(follower(), ["out"])
    with pytest.raises(EngineError, match="no input is called 'V2'; there are V1"):
        engine.run(5, {"V2": Edges.none()})
    with pytest.raises(EngineError, match="finite levels"):
        engine.run(5, steps((0.0, math.nan)))


def test_two_inputs_may_change_at_the_same_instant() -> None:
    circuit = Circuit(
        [VoltageSource("A", "a"), VoltageSource("B", "b"), Resistor("R1", "a", "o", 1e3), Resistor("R2", "b", "o", 1e3)]
    )
    one = Edges(np.array([0, TICKS_PER_SAMPLE]), np.array([2.0, 4.0]))
    other = Edges(np.array([TICKS_PER_SAMPLE, 2 * TICKS_PER_SAMPLE]), np.array([6.0, 0.0]))
    assert Engine(piecewise_linear(circuit), ["o"]).run(3, {"B": other, "A": one})[:, 0].tolist() == [1.0, 5.0, 2.0]


def test_what_cannot_be_recorded_is_refused_with_the_number() -> None:
    with pytest.raises(EngineError, match="300 nodes are to be recorded; the engine takes at most 256"):
        Engine(follower(), ["out"] * 300)
    with pytest.raises(EngineError, match="sample_rate_hz must be positive and finite, got inf"):
        Engine(follower(), ["out"], sample_rate_hz=float("inf"))
    with pytest.raises(EngineError, match="cannot record -3 samples"):
        Engine(follower(), ["out"]).run(-3)
