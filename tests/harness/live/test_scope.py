"""Measurements of the oscilloscope, on signals whose values are known."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig_live.scope import measures

RATE_HZ, LSB = 20_000.0, 0.005
SQUARE = np.where(np.arange(400) % 100 < 50, 1.0, 0.0)
"""Square wave of 200 Hz."""


def step_response(damping: float, periods: int = 4, half_n: int = 50) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Response of an oscillator to a square wave whose half periods are twelve of its time constants."""
    times, out, state = np.linspace(0.0, 14.0, half_n, endpoint=False), [], 0.0
    fast = np.sqrt(complex(damping**2 - 1.0))
    poles = -damping + fast, -damping - fast
    course = (1.0 - (poles[0] * np.exp(poles[1] * times) - poles[1] * np.exp(poles[0] * times)) / (2.0 * fast)).real
    for target in (1.0, 0.0) * periods:
        out.append(state + (target - state) * course)
        state = target
    return np.concatenate(out)


@pytest.mark.parametrize("damping", [0.6, 0.9, 1.05])
@pytest.mark.parametrize("shift", [0, 13, 57])
def test_overshoot_is_that_of_the_step_response(damping: float, shift: int) -> None:
    expected = np.exp(-np.pi * damping / np.sqrt(1.0 - damping**2)) if damping < 1.0 else 0.0
    noise = LSB * 0.3 * np.random.default_rng(1995).standard_normal(340)
    values = 6.0 * step_response(damping)[shift : shift + 340] + noise
    assert measures(values, RATE_HZ, LSB)["overshoot"] == pytest.approx(expected, abs=0.004)


@pytest.mark.parametrize("values", [step_response(3.0), np.sin(np.arange(400) / 16.0)], ids=["overdamped", "sine"])
def test_signal_that_does_not_settle_has_no_overshoot(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> None:
    assert measures(values, RATE_HZ)["overshoot"] is None


def test_noise_has_neither_frequency_nor_overshoot() -> None:
    rng = np.random.default_rng(1995)
    few_lsb = LSB * np.round(0.8 * rng.standard_normal(400))
    for values in (few_lsb, LSB * SQUARE, rng.standard_normal(400)):
        found = measures(values, RATE_HZ, LSB)
        assert (found["frequency"], found["overshoot"]) == (None, None)


def test_square_wave_has_its_frequency_and_pulses_without_a_period_have_none() -> None:
    assert measures(SQUARE, RATE_HZ, LSB)["frequency"] == 200.0
    pulses = np.isin(np.arange(400) // 10, (3, 5, 18, 31)).astype(float)
    assert measures(pulses, RATE_HZ, LSB)["frequency"] is None
