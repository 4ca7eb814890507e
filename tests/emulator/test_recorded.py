"""Recorded excitation: the signal between its samples, circuits that it drives, and programs with multipliers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    CircuitError,
    Edges,
    Engine,
    EngineError,
    Excitation,
    ExcitationError,
    Mode,
    Multiplier,
    RecordedExcitation,
    Resistor,
    SuspensionComputer,
    VoltageSource,
    load_patch,
    piecewise_linear,
)
from analogrig_emulator.engine.system import Drive

PROGRAMS = Path(__file__).parents[2] / "fixtures" / "programs"
LSB_V = 10.0 / 4096
RATE_HZ = 1e3
RC_S = 2e-3

Volts = NDArray[np.float64]


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
    engine = Engine(piecewise_linear(rc_circuit()), ["in", "out"], RATE_HZ, drives={"IN": drive})
    volts = engine.run(300)
    assert np.abs(volts[:, 0] - samples).max() < 1e-12
    out, expected = 0.0, []
    for row in drive.terms:  # the exact response to each polynomial
        expected.append(out)
        out = _rc_response(row, out)
    assert np.abs(volts[:, 1] - expected).max() < 1e-9


def _rc_response(terms: Volts, start: float) -> float:
    """Output one sample period later: y' = (u - y) / RC with u a polynomial, by its particular solution."""
    rate = RC_S * RATE_HZ
    particular = np.zeros(len(terms))
    for k in reversed(range(len(terms))):
        particular[k] = terms[k] - (rate * (k + 1) * particular[k + 1] if k + 1 < len(terms) else 0.0)
    return float(particular.sum() + (start - particular[0]) * np.exp(-1.0 / rate))


def test_a_constant_drive_equals_an_edge_and_cuts_change_no_bit() -> None:
    system = piecewise_linear(rc_circuit())
    edge = Engine(system, ["out"], RATE_HZ).run(40, {"IN": Edges(np.zeros(1, np.int64), np.array([3.0]))})
    held = Drive.band_limited(np.full(7, 3.0))
    whole = Engine(system, ["out"], RATE_HZ, drives={"IN": held}).run(40)
    engine = Engine(system, ["out"], RATE_HZ, drives={"IN": held})
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
        Engine(system, ["out"], RATE_HZ, drives={"OUT": Drive.band_limited(np.zeros(3))})
    for terms in (np.zeros((3, 4)), np.zeros((0, 5)), np.full((3, 5), np.inf)):
        with pytest.raises(EngineError, match="finite coefficients"):
            Engine(system, ["out"], RATE_HZ, drives={"IN": Drive(terms)})
    with pytest.raises(EngineError, match="a drive begins after it"):
        Engine(system, ["out"], RATE_HZ, drives={"IN": Drive(np.zeros((3, 5)), first=3)})
    engine = Engine(system, ["out"], RATE_HZ, drives={"IN": Drive.band_limited(np.zeros(3))})
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
        Engine(system, ["m0"], RATE_HZ, drives={"IN": Drive.band_limited(np.zeros(3))})
