"""Generator: two-level, smooth and recorded waveforms."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Card,
    Circuit,
    CircuitError,
    Deck,
    Edges,
    Engine,
    EngineError,
    Excitation,
    ExcitationError,
    Mode,
    Multiplier,
    PotTurn,
    RecordedExcitation,
    Resistor,
    SuspensionComputer,
    VoltageSource,
    acquired,
    load_patch,
    piecewise_linear,
)
from analogrig_emulator.engine.system import Drive
from tests.emulator.plays import AMPLIFIERS, LSB_V, NgSpice, Volts

RATE_HZ = 20e3


def edges_of(excitation: Excitation, samples: int) -> Edges:
    return excitation.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)


def instants(edges: Edges) -> list[float]:
    """In samples."""
    return [float(tick) / TICKS_PER_SAMPLE for tick in edges.ticks]


def test_a_square_wave_rises_at_once_and_then_switches_every_half_period() -> None:
    edges = edges_of(Excitation(frequency_hz=200.0, low_v=1.0, high_v=9.0), 210)
    assert instants(edges) == [0, 50, 100, 150, 200]
    assert edges.levels_v.tolist() == [9, 1, 9, 1, 9]


@pytest.mark.parametrize(("phase", "first"), [(0.3, [0, 20, 70]), (0.5, [0, 50, 100]), (0.9, [0, 10, 60])])
def test_phase_is_how_far_into_the_period_it_starts(phase: float, first: list[float]) -> None:
    edges = edges_of(Excitation(frequency_hz=200.0, phase=phase), 105)
    assert instants(edges)[:3] == first
    assert edges.levels_v[0] == (10.0 if phase < 0.5 else 0.0)


def test_a_pulse_is_high_for_its_duty() -> None:
    edges = edges_of(Excitation(shape="pulse", frequency_hz=200.0, duty=0.1), 210)
    assert instants(edges) == [0, 10, 100, 110, 200]
    assert edges.levels_v.tolist() == [10, 0, 10, 0, 10]


def test_on_the_cards_clock_an_edge_waits_for_the_next_sample() -> None:
    # A half period of 20000 / 600 = 33.33 samples.
    assert instants(edges_of(Excitation(frequency_hz=300.0), 201)) == [0, 34, 67, 100, 134, 167, 200]


def test_a_free_generator_drifts_by_its_ppm() -> None:
    excitation = Excitation(clock="free", frequency_hz=200.0, phase=0.137, drift_ppm=20.0)
    edges = edges_of(excitation, 1_000_000)
    half_period = Fraction(50) / (1 + Fraction(20, 1_000_000))
    for k in (1, 2, 777, 20_000):
        exact = (k * half_period - Fraction(137, 1000) * 2 * half_period) * TICKS_PER_SAMPLE
        assert abs(int(edges.ticks[k]) - exact) <= 1
    # 20 ppm of a million samples is 20 samples: one half period more would need 50.
    assert edges.ticks.size == 20_001


def test_a_slow_clock_drifts_the_other_way() -> None:
    fast, slow = (edges_of(Excitation(clock="free", drift_ppm=ppm), 10_000).ticks[199] for ppm in (50.0, -50.0))
    assert slow - fast == pytest.approx(2 * 50e-6 * 9950 * TICKS_PER_SAMPLE, rel=1e-4)


@pytest.mark.parametrize("length", range(2, 17))
def test_a_pseudo_random_sequence_has_maximal_length(length: int) -> None:
    period = 2**length - 1
    edges = edges_of(Excitation(shape="prbs", frequency_hz=RATE_HZ / 2, register_length=length), 4 * period)
    levels = levels_at(edges, 2 * period, 2.0) > 5.0
    assert np.array_equal(levels[:period], levels[period:])
    assert levels[:period].sum() == 2 ** (length - 1)
    weights = 1 << np.arange(length)
    windows = {int(levels[i : i + length] @ weights) for i in range(period)}
    assert windows == set(range(1, 2**length))


def levels_at(edges: Edges, count: int, every: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Levels at instants 0, every, 2 every ... samples."""
    ticks = (np.arange(count) * every * TICKS_PER_SAMPLE).astype(np.int64)
    return edges.levels_v[np.searchsorted(edges.ticks, ticks, side="right") - 1]


def test_the_seed_shifts_the_sequence() -> None:
    plain, shifted = (
        levels_at(edges_of(Excitation(shape="prbs", frequency_hz=1e3, seed=seed), 2000), 100, 20.0) for seed in (0, 7)
    )
    assert np.array_equal(plain[7:], shifted[:-7])
    assert not np.array_equal(plain, shifted)


@pytest.mark.parametrize(
    "excitation",
    [
        Excitation(frequency_hz=300.0, phase=0.123),
        Excitation(shape="pulse", duty=0.003, frequency_hz=777.0),
        Excitation(shape="pulse", duty=0.997, frequency_hz=777.0),
        Excitation(shape="prbs", frequency_hz=9.9e3, phase=0.5),
        Excitation(clock="free", drift_ppm=-35.0, frequency_hz=1234.5, phase=0.999),
        Excitation(shape="prbs", clock="free", frequency_hz=3333.0, drift_ppm=500.0),
    ],
)
def test_cutting_the_range_changes_no_edge(excitation: Excitation) -> None:
    whole = edges_of(excitation, 500)
    rng = np.random.default_rng(4)
    cuts = [0, *sorted(rng.integers(1, 500 * TICKS_PER_SAMPLE, 2000).tolist()), 500 * TICKS_PER_SAMPLE]
    parts = [excitation.edges(start, stop, RATE_HZ) for start, stop in itertools.pairwise(cuts)]
    assert np.array_equal(np.concatenate([part.ticks for part in parts]), whole.ticks)
    assert np.array_equal(np.concatenate([part.levels_v for part in parts]), whole.levels_v)
    assert whole.ticks[0] == 0
    assert (np.diff(whole.ticks) > 0).all()
    assert (np.diff(whole.levels_v) != 0).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("shape", "triangle"),
        ("clock", "gps"),
        ("low_v", math.nan),
        ("high_v", -1.0),
        ("frequency_hz", 0.0),
        ("frequency_hz", math.inf),
        ("phase", 1.0),
        ("phase", -0.1),
        ("duty", 0.2),
        ("drift_ppm", 3.0),
        ("drift_ppm", math.nan),
        ("register_length", 21),
        ("seed", 0.5),
    ],
)
def test_a_field_out_of_range_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(ExcitationError, match=f"excitation: {field}"):
        Excitation(**{field: value})  # type: ignore[arg-type]


def test_a_frequency_that_the_card_cannot_follow_is_refused() -> None:
    with pytest.raises(ExcitationError, match="frequency_hz 10001.0 exceeds half the sample rate"):
        Excitation(frequency_hz=10001.0).edges(0, 1, RATE_HZ)


def test_a_period_of_more_ticks_than_can_be_counted_is_refused() -> None:
    with pytest.raises(ExcitationError, match=r"frequency_hz 0.1 is too low .* more than 2\^53 ticks"):
        Excitation(frequency_hz=0.1).edges(0, 1, 1e15)


# ---- smooth shapes of the generator: their level, circuits that they drive, and ngspice's own sine


RC_S = 2e-3

SINE = Excitation("sine", -5.0, 5.0, 317.0)
SWEEP = Excitation("sweep", -5.0, 5.0, 50.0, 0.25, end_hz=2000.0, sweep_s=0.02)
MULTISINE = Excitation("multisine", -5.0, 5.0, 100.0, harmonics=tuple(range(1, 17)))
RECORDED = Excitation("recorded", samples_v=tuple((5.0 * np.sin(np.arange(300) ** 2 / 500)).tolist()))
SMOOTH = pytest.mark.parametrize("excitation", [SINE, SWEEP, MULTISINE, RECORDED], ids=lambda each: each.shape)


def drive_of(excitation: Excitation, samples: int) -> Drive:
    return excitation.drive(0, samples * TICKS_PER_SAMPLE, RATE_HZ)


def through_rc(excitation: Excitation, samples: int = 400) -> NDArray[np.float64]:
    circuit = Circuit([VoltageSource("IN", "in"), Resistor("R", "in", "out", 2e4), Capacitor("C", "out", "0", 1e-7)])
    engine = Engine(piecewise_linear(circuit), ["out"], RATE_HZ, drives={"IN": drive_of(excitation, samples)})
    return engine.run(samples, {})[:, 0]


def by_scipy(level_v: Callable[[float], float]) -> NDArray[np.float64]:
    found = solve_ivp(
        lambda t, v: (level_v(t) - v) / RC_S,
        (0.0, 0.02),
        [0.0],
        t_eval=np.arange(400) / RATE_HZ,
        rtol=1e-10,
        atol=1e-12,
        max_step=2e-5,
    )
    return np.asarray(found.y[0])


def test_a_sine_is_numpys() -> None:
    at = np.linspace(0.0, 999.0, 5000)
    tone = Excitation("sine", -4.0, 2.0, 317.0, 0.3)
    expected = -1.0 + 3.0 * np.sin(2 * math.pi * (317.0 * at / RATE_HZ + 0.3))
    assert np.abs(tone.smooth_v(at, RATE_HZ) - expected).max() < 1e-10
    assert np.abs(drive_of(tone, 1000).volts(at) - expected).max() < 1e-7


def test_between_samples_a_sine_at_a_tenth_of_the_rate_is_exact_to_1e_5() -> None:
    at = np.linspace(0.0, 199.0, 3001)
    driven = drive_of(Excitation("sine", -1.0, 1.0, 2e3), 200).volts(at)
    assert np.abs(driven - np.sin(2 * math.pi * 0.1 * at)).max() < 1e-5


@pytest.mark.parametrize("hz", [20.0, 200.0, 2000.0])
def test_a_sine_through_an_rc_is_its_closed_form(hz: float) -> None:
    """A / (1 + w^2) (sin wt' - w cos wt' + w exp(-t')), t' = t / RC and w = omega RC."""
    volts = through_rc(replace(SINE, frequency_hz=hz))
    t, w = np.arange(400) / RATE_HZ / RC_S, 2 * math.pi * hz * RC_S
    expected = 5.0 / (1 + w * w) * (np.sin(w * t) - w * np.cos(w * t) + w * np.exp(-t))
    assert np.abs(volts - expected).max() < 0.001 * LSB_V


def test_a_sweep_through_an_rc_is_scipys_solution() -> None:
    def level_v(t: float) -> float:
        return 5.0 * math.sin(2 * math.pi * (50.0 * t + 0.5 * 1950.0 / 0.02 * t * t + 0.25))

    assert np.abs(through_rc(SWEEP) - by_scipy(level_v)).max() < 0.001 * LSB_V


def test_a_sweep_goes_back_and_forth_with_the_frequencies_of_its_law() -> None:
    """Turns over whole sweeps are those of the mean frequency; the level is the same forth and back about its ends."""
    sweep = Excitation("sweep", -1.0, 1.0, 100.0, end_hz=1000.0, sweep_s=0.01)
    at = np.arange(0.0, 200.0, 0.25)
    back = sweep.smooth_v(400.0 - at, RATE_HZ)
    assert np.abs(sweep.smooth_v(at, RATE_HZ) + back).max() < 1e-9  # 11 turns in 20 ms: odd about its middle
    assert np.abs(sweep.smooth_v(at + 4000.0, RATE_HZ) - sweep.smooth_v(at, RATE_HZ)).max() < 1e-9


def test_a_multisine_has_its_lines_alone_and_a_low_peak_within_its_levels() -> None:
    volts = MULTISINE.smooth_v(np.arange(200.0), RATE_HZ)
    lines = np.abs(np.fft.rfft(volts)) / 100
    assert lines[1:17] == pytest.approx(lines[1])
    assert np.abs(np.delete(lines, range(1, 17))).max() < 1e-12
    dense = MULTISINE.smooth_v(np.arange(0.0, 200.0, 0.01), RATE_HZ)
    assert 4.95 < np.abs(dense).max() <= 5.0
    assert np.abs(dense).max() / dense.std() < 2.0


def test_a_recorded_excitation_passes_through_its_samples_and_holds_the_last() -> None:
    at = np.arange(400.0)
    assert RECORDED.samples_v is not None
    expected = np.pad(RECORDED.samples_v, (0, 100), mode="edge")
    assert np.abs(RECORDED.smooth_v(at, RATE_HZ) - expected).max() < 1e-9
    assert RECORDED.range_v == (min(RECORDED.samples_v), max(RECORDED.samples_v))


def test_a_clock_of_its_own_runs_fast_by_its_drift() -> None:
    drifting = replace(SINE, clock="free", drift_ppm=1000.0)
    faster = replace(SINE, frequency_hz=317.0 * 1.001)
    at = np.arange(2000.0)
    assert np.abs(drifting.smooth_v(at, RATE_HZ) - faster.smooth_v(at, RATE_HZ)).max() < 1e-9


@pytest.mark.parametrize("shape", ["sine", "multisine"])
def test_a_suspension_agrees_with_ngspice_at_every_amplifier(ngspice: NgSpice, shape: str) -> None:
    """Against ngspice's own sine, and through the pieces of the exported deck."""
    computer = SuspensionComputer("front")
    excitation = {"sine": replace(SINE, low_v=-8.0, high_v=8.0), "multisine": MULTISINE}[shape]
    deck = Deck(computer.circuit, samples=30, drives={"F": drive_of(excitation, 30)})
    text = deck.text(AMPLIFIERS)
    if shape == "sine":
        text, found = re.subn(r"V_F in 0 PWL\([^)]*\)", "V_F in 0 SIN(0 8 317)", text)
        assert found == 1
    assert np.abs(deck.volts(AMPLIFIERS) - ngspice(text, AMPLIFIERS, 30)).max() < 0.05 * LSB_V


@SMOOTH
def test_a_machine_plays_it_in_blocks_and_while_a_pot_turns(excitation: Excitation) -> None:
    turn = PotTurn(40, {"K": 18000.0}, 2)
    played = [
        np.concatenate(list(SuspensionComputer("front").play(excitation, 120, [turn], block_samples)))
        for block_samples in (120, 7)
    ]
    assert np.array_equal(played[0], played[1])
    assert np.abs(played[0][:, 0] - excitation.smooth_v(np.arange(120.0), RATE_HZ)).max() < 1e-9


@SMOOTH
def test_a_skewed_channel_is_taken_at_its_own_instant(excitation: Excitation) -> None:
    """With five probes a sample, the force taken 20 us late is the level two fifths of a sample later."""
    card = Card(skew_s=(20e-6, 0.0, 0.0, 0.0))
    machine = SuspensionComputer("front", sample_rate_hz=5 * RATE_HZ)
    (volts,) = acquired(machine, card, excitation, 100, rng=np.random.default_rng(1))
    straight = np.concatenate(list(SuspensionComputer("front").play(excitation, 100)))
    expected = drive_of(excitation, 100).volts(np.arange(100.0) + 0.4)
    assert np.abs(volts[:, 0] - expected).max() < 2e-4
    assert np.abs(volts[:, 1:] - straight[:, 1:]).max() < 0.05 * LSB_V


@pytest.mark.parametrize(
    ("excitation", "message"),
    [
        (Excitation("sine", frequency_hz=6e3), "frequency_hz 6000.0 exceeds a quarter of the sample rate"),
        (replace(SWEEP, end_hz=6e3), "end_hz 6000.0 exceeds a quarter of the sample rate"),
        (replace(MULTISINE, harmonics=(1, 51)), "frequency_hz 100.0 times harmonic 51 exceeds a quarter"),
    ],
)
def test_a_frequency_above_a_quarter_of_the_rate_is_refused(excitation: Excitation, message: str) -> None:
    with pytest.raises(ExcitationError, match=message):
        list(SuspensionComputer("front").play(excitation, 10))
    with pytest.raises(ExcitationError, match="has no edges"):
        excitation.edges(0, 1, RATE_HZ)


# ---- recorded excitation: the signal between its samples, circuits that it drives, and programs with multipliers


PROGRAMS = Path(__file__).parents[2] / "fixtures" / "programs"
RECORDED_RATE_HZ = 1e3


def rc_circuit() -> Circuit:
    return Circuit([VoltageSource("IN", "in"), Resistor("R", "in", "out", 2e4), Capacitor("C", "out", "0", 1e-7)])


def sine(samples: int, frequency: float, volts: float = 5.0) -> Volts:
    """Sine of a frequency in cycles per sample, which begins and ends at rest."""
    k = np.arange(samples)
    return np.asarray(volts * np.sin(2 * np.pi * frequency * k) * np.hanning(samples))


@pytest.mark.parametrize("frequency", [0.01, 0.1, 0.3])
def test_a_drive_passes_through_the_samples_and_between_them_through_the_sine(frequency: float) -> None:
    def signal(at: Volts) -> Volts:
        return np.asarray(5.0 * np.sin(2 * np.pi * frequency * at) * np.exp(-(((at - 200) / 40) ** 2)))

    drive = Drive.band_limited(signal(np.arange(400.0)))
    at = np.linspace(0.0, 399.0, 4001)
    found = np.array([drive.at(int(k * TICKS_PER_SAMPLE)) for k in at])
    # The polynomial of degree 4 leaves 0.1 % of a sine of a third of the sample rate.
    assert np.abs(found - signal(at)).max() < {0.01: 1e-6, 0.1: 2e-5, 0.3: 5e-3}[frequency]


def test_a_drive_of_an_rc_circuit_has_the_response_of_the_differential_equation() -> None:
    samples = sine(300, 0.05)
    drive = Drive.band_limited(samples)
    engine = Engine(piecewise_linear(rc_circuit()), ["in", "out"], RECORDED_RATE_HZ, drives={"IN": drive})
    volts = engine.run(300)
    assert np.abs(volts[:, 0] - samples).max() < 1e-12
    out, expected = 0.0, []
    for row in drive.terms:  # the exact response to each polynomial
        expected.append(out)
        out = _rc_response(row, out)
    assert np.abs(volts[:, 1] - expected).max() < 1e-9


def _rc_response(terms: Volts, start: float) -> float:
    """Output one sample period later: y' = (u - y) / RC with u a polynomial, by its particular solution."""
    rate = RC_S * RECORDED_RATE_HZ
    particular = np.zeros(len(terms))
    for k in reversed(range(len(terms))):
        particular[k] = terms[k] - (rate * (k + 1) * particular[k + 1] if k + 1 < len(terms) else 0.0)
    return float(particular.sum() + (start - particular[0]) * np.exp(-1.0 / rate))


def test_a_constant_drive_equals_an_edge_and_cuts_change_no_bit() -> None:
    system = piecewise_linear(rc_circuit())
    edge = Engine(system, ["out"], RECORDED_RATE_HZ).run(40, {"IN": Edges(np.zeros(1, np.int64), np.array([3.0]))})
    held = Drive.band_limited(np.full(7, 3.0))
    whole = Engine(system, ["out"], RECORDED_RATE_HZ, drives={"IN": held}).run(40)
    engine = Engine(system, ["out"], RECORDED_RATE_HZ, drives={"IN": held})
    parts = np.concatenate([engine.run(n) for n in (1, 0, 13, 26)])
    assert np.abs(whole - edge).max() < 1e-9
    assert (parts == whole).all()


def test_a_duffing_oscillator_follows_a_recorded_input_as_its_equations_do() -> None:
    program = load_patch(PROGRAMS / "duffing.toml")
    rate_hz, samples = 4e3, 120
    u_v = 4.0 + sine(samples, 0.03, 3.0)
    u_v[:20] *= np.linspace(0.0, 1.0, 20) ** 2
    computer = SuspensionComputer(program, opamp="ideal", sample_rate_hz=rate_hz)
    volts = np.concatenate(list(computer.play(RecordedExcitation(u_v), samples)))
    excitation = Drive.band_limited(u_v)
    values, scales = program.equations.values, program.scales
    period_s = program.equations.speed / rate_hz

    def slopes(t: float, state: Volts) -> list[float]:
        x, v = state
        force = excitation.at(min(int(t / period_s * TICKS_PER_SAMPLE), (samples - 1) * TICKS_PER_SAMPLE))
        force *= scales.full("force") / 10.0
        spring = values["k"] * x + values["k3"] * x**3
        return [v, (force - values["c"] * v - spring) / values["m"]]

    at = np.arange(samples) * period_s
    solved = solve_ivp(slopes, (0.0, at[-1]), [0.0, 0.0], "DOP853", at, rtol=1e-9, atol=1e-12, max_step=period_s)
    expected = solved.y[0] * 10.0 / scales.full("x")
    assert np.abs(expected).max() > 2.0  # the spring hardens
    assert np.abs(volts[:, program.channels.index("x")] - expected).max() < 0.05 * LSB_V


def test_a_linear_program_and_real_amplifiers_follow_a_recorded_square_wave_between_its_edges() -> None:
    computer = SuspensionComputer("front")
    steps = np.repeat([0.0, 5.0, 0.0], 200)
    volts = np.concatenate(list(computer.play(RecordedExcitation(steps), 600, block_samples=77)))
    assert volts.shape == (600, 4)
    assert abs(volts[399, 0] - 5.0) < 1e-9
    assert computer.machine.mode is Mode.OPERATE
    assert computer.machine.read()["in"] == pytest.approx(0.0, abs=1e-9)
    replayed = np.concatenate(list(computer.play(RecordedExcitation(steps), 600)))
    assert (replayed == volts).all()


@pytest.mark.parametrize(
    ("samples", "complaint"),
    [
        (np.zeros((3, 2)), "shape"),
        (np.zeros(0), "shape"),
        (np.array([0.0, np.nan]), "not finite"),
        (np.array([0.0, 2e3]), "beyond"),
    ],
)
def test_wrong_samples_are_refused(samples: Volts, complaint: str) -> None:
    with pytest.raises(ExcitationError, match=complaint):
        RecordedExcitation(samples)


def test_wrong_drives_are_refused() -> None:
    system = piecewise_linear(rc_circuit())
    with pytest.raises(CircuitError, match="no input is called 'OUT'; there are IN"):
        Engine(system, ["out"], RECORDED_RATE_HZ, drives={"OUT": Drive.band_limited(np.zeros(3))})
    for terms in (np.zeros((3, 4)), np.zeros((0, 5)), np.full((3, 5), np.inf)):
        with pytest.raises(EngineError, match="finite coefficients"):
            Engine(system, ["out"], RECORDED_RATE_HZ, drives={"IN": Drive(terms)})
    with pytest.raises(EngineError, match="a drive begins after it"):
        Engine(system, ["out"], RECORDED_RATE_HZ, drives={"IN": Drive(np.zeros((3, 5)), first=3)})
    engine = Engine(system, ["out"], RECORDED_RATE_HZ, drives={"IN": Drive.band_limited(np.zeros(3))})
    with pytest.raises(EngineError, match="no input is called 'IN'"):
        engine.run(3, {"IN": Edges(np.zeros(1, np.int64), np.ones(1))})


def test_a_held_recording_is_the_square_wave_that_it_samples() -> None:
    computer = SuspensionComputer(load_patch(PROGRAMS / "duffing.toml"))
    square = Excitation(low_v=1.0, high_v=5.0, frequency_hz=500.0)
    held = RecordedExcitation(square_levels(square, computer.sample_rate_hz), is_held=True)
    one, other = (np.concatenate(list(computer.play(each, 400))) for each in (square, held))
    assert np.abs(one - other).max() < 1e-6


def square_levels(square: Excitation, rate_hz: float) -> Volts:
    """Level of a square wave from each of 400 samples on."""
    edges = square.edges(0, 400 * TICKS_PER_SAMPLE, rate_hz)
    samples = np.arange(400, dtype=np.int64) * TICKS_PER_SAMPLE
    return np.asarray(edges.levels_v[np.searchsorted(edges.ticks, samples, "right") - 1])


def test_more_multipliers_and_drives_than_the_engine_takes_are_counted() -> None:
    chain = [Multiplier(f"M{i}", "in", "in", f"m{i}") for i in range(16)]
    system = piecewise_linear(Circuit([VoltageSource("IN", "in"), *chain]))
    with pytest.raises(EngineError, match="16 multipliers and 1 inputs that move all the time; .* at most 16 together"):
        Engine(system, ["m0"], RECORDED_RATE_HZ, drives={"IN": Drive.band_limited(np.zeros(3))})
