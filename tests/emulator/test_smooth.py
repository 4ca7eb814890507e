"""Sine, sweep and multisine: the generator's level, circuits that it drives, and ngspice's own sine."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    Deck,
    Engine,
    ExcitationError,
    Resistor,
    SmoothExcitation,
    SuspensionComputer,
    Tone,
    VoltageSource,
    piecewise_linear,
)

from .conftest import NgSpice

LSB_V = 10.0 / 4096
RC_S = 2e-3
AMPLIFIERS = ("u1", "u2", "u3", "u4", "u5")


def through_rc(excitation: SmoothExcitation) -> np.ndarray:
    circuit = Circuit([VoltageSource("IN", "in"), Resistor("R", "in", "out", 2e4), Capacitor("C", "out", "0", 1e-7)])
    engine = Engine(piecewise_linear(circuit), ["out"], excitation.sample_rate_hz, drives={"IN": excitation.drive})
    return engine.run(excitation.samples, {})[:, 0]


def test_a_sine_is_numpys() -> None:
    at = np.linspace(0.0, 999.0, 5000)
    tone = SmoothExcitation(1000, (Tone(3.0, 317.0, 0.3),), offset_v=-1.0)
    expected = -1.0 + 3.0 * np.sin(2 * math.pi * (317.0 * at / 20e3 + 0.3))
    assert np.abs(tone.volts(at) - expected).max() < 1e-10
    assert np.abs([tone.drive.at(int(k * TICKS_PER_SAMPLE)) for k in at] - expected).max() < 1e-7


def test_between_samples_a_sine_at_a_tenth_of_the_rate_is_exact_to_1e_5() -> None:
    tone, at = SmoothExcitation(200, (Tone(1.0, 2e3),)), np.linspace(0.0, 199.0, 3001)
    driven = np.array([tone.drive.at(int(k * TICKS_PER_SAMPLE)) for k in at])
    assert np.abs(driven - np.sin(2 * math.pi * 0.1 * at)).max() < 1e-5


@pytest.mark.parametrize("hz", [20.0, 200.0, 2000.0])
def test_a_sine_through_an_rc_is_its_closed_form(hz: float) -> None:
    """A / (1 + w^2) (sin wt' - w cos wt' + w exp(-t')), t' = t / RC and w = omega RC."""
    volts = through_rc(SmoothExcitation(400, (Tone(5.0, hz),)))
    t, w = np.arange(400) / 20e3 / RC_S, 2 * math.pi * hz * RC_S
    expected = 5.0 / (1 + w * w) * (np.sin(w * t) - w * np.cos(w * t) + w * np.exp(-t))
    assert np.abs(volts - expected).max() < 0.001 * LSB_V


def test_a_sweep_through_an_rc_is_scipys_solution() -> None:
    sweep = SmoothExcitation(400, (Tone(5.0, 50.0, 0.25, end_hz=2000.0),))

    def slope(t: float, v: np.ndarray) -> np.ndarray:
        turns = 50.0 * t + 0.5 * 1950.0 / 0.02 * t * t + 0.25
        return np.asarray((5.0 * math.sin(2 * math.pi * turns) - v) / RC_S)

    found = solve_ivp(slope, (0.0, 0.02), [0.0], t_eval=np.arange(400) / 20e3, rtol=1e-10, atol=1e-12, max_step=2e-5)
    assert np.abs(through_rc(sweep) - found.y[0]).max() < 0.001 * LSB_V


def test_a_multisine_has_its_lines_alone_and_a_low_peak() -> None:
    frequencies_hz = [100.0 * k for k in range(1, 17)]
    signal = SmoothExcitation.multisine(400, 0.5, frequencies_hz)
    volts = signal.volts(np.arange(200.0))
    lines = np.abs(np.fft.rfft(volts)) / 100
    assert lines[1:17] == pytest.approx(0.5)
    assert np.abs(np.delete(lines, range(1, 17))).max() < 1e-12
    assert np.abs(volts).max() / volts.std() < 2.0


def test_a_suspension_driven_by_a_sine_agrees_with_ngspice_at_every_amplifier(ngspice: NgSpice) -> None:
    computer = SuspensionComputer("front")
    text = Deck(computer.circuit, samples=200).text(AMPLIFIERS)
    text, found = re.subn(r"V_F in 0 PWL\([^)]*\)", "V_F in 0 SIN(0 8 317)", text)
    assert found == 1
    engine = Engine(
        piecewise_linear(computer.circuit), AMPLIFIERS, drives={"F": SmoothExcitation(200, (Tone(8.0, 317.0),)).drive}
    )
    assert np.abs(engine.run(200, {}) - ngspice(text, AMPLIFIERS, 200)).max() < 0.05 * LSB_V


def test_a_machine_plays_it_in_blocks() -> None:
    sweep = SmoothExcitation(120, (Tone(4.0, 20.0, end_hz=900.0),), offset_v=4.0)
    played = [
        np.concatenate(list(SuspensionComputer("front").play(sweep, 120, (), block_samples)))
        for block_samples in (120, 7)
    ]
    assert np.array_equal(played[0], played[1])
    assert np.abs(played[0][:, 0] - sweep.volts(np.arange(120.0))).max() < 1e-9


@pytest.mark.parametrize(
    ("tone", "message"),
    [
        (Tone(1.0, 6e3), "frequency 6000.0 must be"),
        (Tone(1.0, 10.0, end_hz=-1.0), "frequency -1.0 must be"),
        (Tone(1.0, math.nan), "frequency nan must be"),
        (Tone(math.inf, 10.0), "the largest level inf must be"),
        (Tone(1.0, 10.0, math.inf), "phase inf must be"),
    ],
)
def test_a_tone_that_cannot_be_is_refused(tone: Tone, message: str) -> None:
    with pytest.raises(ExcitationError, match=message):
        SmoothExcitation(10, (tone,))
