"""Smooth shapes of the generator: their level, circuits that they drive, and ngspice's own sine."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Card,
    Circuit,
    Deck,
    Engine,
    Excitation,
    ExcitationError,
    PotTurn,
    Resistor,
    SuspensionComputer,
    VoltageSource,
    acquired,
    piecewise_linear,
)
from analogrig_emulator.engine.system import Drive

from .conftest import NgSpice

LSB_V = 10.0 / 4096
RATE_HZ = 20e3
RC_S = 2e-3
AMPLIFIERS = ("u1", "u2", "u3", "u4", "u5")

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
