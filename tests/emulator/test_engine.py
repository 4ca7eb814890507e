"""The engine against scipy and against solutions by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from analogrig_emulator import (
    CARDS,
    OP_AMP_GRADES,
    TICKS_PER_SAMPLE,
    Capacitor,
    Card,
    Circuit,
    Edges,
    Engine,
    EngineError,
    Excitation,
    NoisySuspension,
    OpAmp,
    OpAmpModel,
    PiecewiseLinear,
    PotTurn,
    Resistor,
    SuspensionComputer,
    VoltageSource,
    acquired,
    ahead_ticks,
    piecewise_linear,
)
from analogrig_emulator.circuit.opamp import CLAMP_RATE
from tests.emulator.plays import LSB_V, Volts, steps

Slope = Callable[[float, Volts, float], tuple[float, ...]]

SOURCE = VoltageSource("V1", "in")
RATE = 2 * math.pi * 1e6
"""2 pi GBW of the op-amps in this file."""
SLEW = 0.5e6
OPAMP = OpAmpModel(gbw_hz=1e6, slew_v_per_s=SLEW, swing_v=(-13.5, 13.5))


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


def positive_feedback(model: OpAmpModel) -> Engine:
    return Engine(piecewise_linear(Circuit([SOURCE, OpAmp("U1", "out", "in", "out", model)])), ["out"])


STIFF = OpAmpModel(gbw_hz=1e30)
REFUSED: Mapping[str, tuple[Callable[[], object], str]] = {
    "other states": (lambda: Engine(follower(), ["out"]).set_system(integrator()), r"not \(\('U1',\), \('V1',\)\)"),
    "too many events": (
        lambda: Engine(follower(), ["out"], events_per_sample=0).run(5, steps((0.0, 10.0))),
        "after 1 samples: more events within one sample",
    ),
    "unstable": (lambda: positive_feedback(OpAmpModel(gbw_hz=1e6)).run(100, steps((0.0, 1.0))), "no longer finite"),
    "too stiff": (lambda: Engine(follower(STIFF), ["out"]), "too stiff"),
    "edges out of order": (lambda: Engine(follower(), ["out"]).run(5, steps((2.0, 1.0), (1.0, 2.0))), "edges"),
    "edges after the run": (lambda: Engine(follower(), ["out"]).run(5, steps((9.5, 1.0))), "edges"),
    "edges before the run": (lambda: Engine(follower(), ["out"]).run(5, steps((-1.0, 1.0))), "edges"),
    "no such input": (
        lambda: Engine(follower(), ["out"]).run(5, {"V2": Edges.none()}),
        "no input is called 'V2'; there are V1",
    ),
    "no level": (lambda: Engine(follower(), ["out"]).run(5, steps((0.0, math.nan))), "finite levels"),
    "too many nodes": (
        lambda: Engine(follower(), ["out"] * 300),
        "300 nodes are to be recorded; the engine takes at most 256",
    ),
    "no rate": (
        lambda: Engine(follower(), ["out"], sample_rate_hz=math.inf),
        "sample_rate_hz must be positive and finite, got inf",
    ),
    "fewer than no samples": (lambda: Engine(follower(), ["out"]).run(-3), "cannot record -3 samples"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_engine_can_play_is_refused_and_does_not_hang(name: str) -> None:
    play, message = REFUSED[name]
    with pytest.raises(EngineError, match=message):
        play()


def test_an_unstable_circuit_that_slews_goes_no_faster_than_its_slew_rate() -> None:
    volts = positive_feedback(OpAmpModel(gbw_hz=1e6, slew_v_per_s=SLEW)).run(100, steps((0.0, 1.0)))
    assert volts[-1, 0] == pytest.approx(-SLEW * 99 * 50e-6, rel=1e-3)


def test_two_inputs_may_change_at_the_same_instant() -> None:
    circuit = Circuit(
        [VoltageSource("A", "a"), VoltageSource("B", "b"), Resistor("R1", "a", "o", 1e3), Resistor("R2", "b", "o", 1e3)]
    )
    one = Edges(np.array([0, TICKS_PER_SAMPLE]), np.array([2.0, 4.0]))
    other = Edges(np.array([TICKS_PER_SAMPLE, 2 * TICKS_PER_SAMPLE]), np.array([6.0, 0.0]))
    assert Engine(piecewise_linear(circuit), ["o"]).run(3, {"B": other, "A": one})[:, 0].tolist() == [1.0, 5.0, 2.0]


# ---- stopping between two samples, and the watch over amplifiers at their limits


def low_pass(ohm: float) -> PiecewiseLinear:
    return piecewise_linear(Circuit([SOURCE, Resistor("R1", "in", "out", ohm), Capacitor("C1", "out", "0", 1e-9)]))


def follower_engine_watch() -> Engine:
    model = OpAmpModel(gbw_hz=1e6, slew_v_per_s=SLEW)
    return Engine(piecewise_linear(Circuit([SOURCE, OpAmp("U1", "in", "out", "out", model)])), ["out"])


def test_a_circuit_changed_between_two_samples_follows_both_exponentials() -> None:
    engine = Engine(low_pass(100e3), ["out"])
    engine.run(1, steps((0.0, 10.0)))
    engine.advance(TICKS_PER_SAMPLE // 4)
    engine.set_system(low_pass(20e3))
    volts = engine.run(2)[:, 0]
    expected = 10.0 * (1 - math.exp(-12.5e-6 / 100e-6) * np.exp(-np.array([37.5e-6, 87.5e-6]) / 20e-6))
    np.testing.assert_allclose(volts, expected, rtol=1e-12)


def test_edges_on_the_way_are_taken_and_the_window_begins_after_them() -> None:
    engine = Engine(low_pass(1.0), ["in"])
    engine.run(1, steps((0.0, 1.0)))
    engine.advance(TICKS_PER_SAMPLE // 2, steps((0.25, 2.0)))
    assert engine.window(2) == (TICKS_PER_SAMPLE // 2 + 1, 2 * TICKS_PER_SAMPLE + 1)
    assert engine.run(2, steps((1.5, 3.0)))[:, 0].tolist() == [2.0, 3.0]


@pytest.mark.parametrize("tick", [-1, 2 * TICKS_PER_SAMPLE - 1, 3 * TICKS_PER_SAMPLE])
def test_an_instant_past_or_not_before_the_next_sample_is_refused(tick: int) -> None:
    engine = Engine(low_pass(1e3), ["in"])
    engine.run(3)
    with pytest.raises(EngineError, match="after 3 samples"):
        engine.advance(tick)


def test_the_watch_tells_when_patience_ended() -> None:
    engine = follower_engine_watch()
    engine.watch(TICKS_PER_SAMPLE // 4)
    engine.run(3, steps((1.5, 10.0)))
    assert engine.overdue_ticks.tolist() == [pytest.approx(1.75 * TICKS_PER_SAMPLE, abs=1)]


def test_patience_counts_unbroken_stretches_only() -> None:
    engine = follower_engine_watch()
    engine.watch(TICKS_PER_SAMPLE // 2)
    engine.run(6, steps((0.0, 10.0), (1.0, 0.0), (2.0, 10.0)))
    assert engine.overdue_ticks.tolist() == [-1]


def test_a_kink_that_is_outside_still_is_told_of_too() -> None:
    engine = follower_engine_watch()
    engine.watch(TICKS_PER_SAMPLE // 4)
    engine.run(1, steps((0.0, 10.0)))
    engine.advance(TICKS_PER_SAMPLE * 3 // 10)
    assert engine.overdue_ticks.tolist() == [TICKS_PER_SAMPLE // 4]
    engine.watch(TICKS_PER_SAMPLE // 20)
    assert engine.overdue_ticks.tolist() == [-1]
    engine.run(1)
    assert engine.overdue_ticks.tolist() == [TICKS_PER_SAMPLE * 3 // 10 + TICKS_PER_SAMPLE // 20]


# ---- voltages a little after each sample: of the engine, of the machine, and of the card that needs them


RATE_HZ, NODES = 20e3, ("in", "u5", "u2", "u1")
FINER = 64
AHEAD_TICKS = TICKS_PER_SAMPLE // FINER
SQUARE, FREE = Excitation(), Excitation(clock="free", phase=0.137, drift_ppm=20.0)
PRBS = Excitation(shape="prbs", frequency_hz=10e3)
CHANGES = (PotTurn(60, {"K": 18000.0}), PotTurn(99, {"M": 30.0}, 20))


def engine(rate_hz: float = RATE_HZ, ahead: int = 0) -> Engine:
    return Engine(piecewise_linear(SuspensionComputer("front").circuit), NODES, rate_hz, ahead_ticks=ahead)


@pytest.mark.parametrize("excitation", [SQUARE, FREE, PRBS])
def test_looking_ahead_is_running_on_and_changes_no_sample(excitation: Excitation) -> None:
    """With a finer grid the samples of the engine itself lie at the later instants."""
    samples = 300
    edges = excitation.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)
    looking, counts = engine(ahead=AHEAD_TICKS), (1, 70, samples - 71)
    volts = np.concatenate([looking.run(n, {"F": edges.within(*looking.window(n))}) for n in counts])
    start, stop = 0, (samples - 1) * TICKS_PER_SAMPLE + 1
    assert np.array_equal(volts, engine(ahead=AHEAD_TICKS).run(samples, {"F": edges.within(start, stop)}))
    assert np.array_equal(volts[:, :4], engine().run(samples, {"F": edges.within(start, stop)}))
    finer = Edges(edges.ticks * FINER, edges.levels_v).within(start, stop * FINER)
    later = engine(RATE_HZ * FINER).run((samples - 1) * FINER + 2, {"F": finer})[1::FINER]
    after_sample = edges.ticks % TICKS_PER_SAMPLE
    assert not ((after_sample > 0) & (after_sample <= AHEAD_TICKS)).any()
    np.testing.assert_allclose(volts[:, 4:], later, rtol=0, atol=1e-7)


def test_a_play_that_looks_ahead_has_the_same_samples_through_changes_and_ramps() -> None:
    plain = np.concatenate(list(SuspensionComputer("front").play(FREE, 200, CHANGES)))
    for block in (33, 200):
        blocks = SuspensionComputer("front").play(FREE, 200, CHANGES, block, AHEAD_TICKS)
        volts = np.concatenate(list(blocks))
        assert np.array_equal(volts[:, :4], plain)
        assert 0.0 < np.abs(volts[:, 4:] - plain).max() < 10.0


def test_a_delayed_sample_is_that_of_a_machine_sampled_faster() -> None:
    """50 ns is a thousandth of the sample period, and the op-amps slew meanwhile."""
    samples, faster = 60, 1000
    card = Card(aperture_delay_s=50e-9)
    blocks = acquired(SuspensionComputer("front"), card, SQUARE, samples, rng=np.random.default_rng(1))
    edges = SQUARE.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)
    computer = SuspensionComputer("front")
    fast = Engine(piecewise_linear(computer.circuit), computer.program.channel_nodes, RATE_HZ * faster)
    every = fast.run((samples - 1) * faster + 2, {"F": Edges(edges.ticks * faster, edges.levels_v)})
    expected = every[1::faster] * computer.program.channel_signs
    np.testing.assert_allclose(np.concatenate(list(blocks)), expected, rtol=0, atol=0.001 * LSB_V)


def test_an_early_sample_lies_on_the_line_from_the_one_before() -> None:
    """Half of the samples without a delay are early. The force has its edges at sample instants."""
    card = Card(aperture_jitter_s=5e-9)
    blocks = acquired(SuspensionComputer("front"), card, SQUARE, 400, rng=np.random.default_rng(1), block_samples=64)
    force = np.concatenate(list(blocks))[:, 0]
    level = np.concatenate(list(SuspensionComputer("front").play(SQUARE, 400)))[:, 0]
    off = np.flatnonzero(np.abs(force - level) > 1e-9)
    assert set(off) <= {k for k in range(1, 400) if level[k] != level[k - 1]}
    assert 0 < len(off) < 16
    assert np.abs(force - level).max() < 10.0 * 25e-9 * RATE_HZ


def test_noise_of_the_circuit_is_the_same_in_both_voltages_of_a_row() -> None:
    def rows(*, noisy: bool) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        computer = SuspensionComputer("front")
        rng = np.random.default_rng(1)
        machine = NoisySuspension(computer, rng, op_amps=OP_AMP_GRADES["tl07x"]) if noisy else computer
        return np.concatenate(list(machine.play(SQUARE, 100, (), 32, AHEAD_TICKS)))

    noise_v = rows(noisy=True) - rows(noisy=False)
    assert np.abs(noise_v[:, :4]).max() > 0.0
    np.testing.assert_allclose(noise_v[:, :4], noise_v[:, 4:], rtol=0, atol=1e-14)


def test_only_a_card_with_aperture_errors_looks_ahead() -> None:
    assert ahead_ticks(Card()) == ahead_ticks(CARDS["skewed"]) == 0
    assert ahead_ticks(CARDS["dt2821"]) / TICKS_PER_SAMPLE / RATE_HZ == pytest.approx(50e-9, rel=1e-3)
    assert ahead_ticks(Card(aperture_jitter_s=1e-6, skew_s=(0.0, 1e-6, 0.0, 0.0))) == TICKS_PER_SAMPLE
