"""Sine, sweep and multisine: generator whose level moves all the time."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.recorded import MOST_V, DrivenExcitation
from analogrig_emulator.engine.system import Drive
from analogrig_emulator.errors import ExcitationError

_MOST_TURNS_PER_SAMPLE = 0.25
_TERMS = 12
"""Terms of the series of a sine; within a quarter turn they leave 1e-20."""


@dataclass(frozen=True)
class Tone:
    """Sine of amplitude_v that begins at frequency_hz and at phase, in turns, and moves evenly to end_hz if given."""

    amplitude_v: float
    frequency_hz: float
    phase: float = 0.0
    end_hz: float | None = None

    def turns(self, time_s: NDArray[np.float64], length_s: float) -> NDArray[np.float64]:
        """Turns at instants of a play of length_s."""
        end_hz = self.frequency_hz if self.end_hz is None else self.end_hz
        steady = self.frequency_hz * time_s + self.phase
        return np.asarray(steady + (0.5 * (end_hz - self.frequency_hz) / length_s) * time_s * time_s)


@dataclass(frozen=True)
class SmoothExcitation(DrivenExcitation):
    """Generator that plays offset_v and the sum of tones for `samples` samples; the last level holds.

    One tone is a sine, one with end_hz a sweep, several are a multisine. At a tenth of the sample rate a sine is exact
    to 1e-5 of its amplitude. Raises ExcitationError naming the field.
    """

    samples: int
    tones: tuple[Tone, ...]
    offset_v: float = 0.0
    sample_rate_hz: float = 20e3

    def __post_init__(self) -> None:
        _require("samples", self.samples, self.samples >= 1, "must be at least 1")
        _require("sample_rate_hz", self.sample_rate_hz, 0 < self.sample_rate_hz < math.inf, "must be positive")
        most_hz = _MOST_TURNS_PER_SAMPLE * self.sample_rate_hz
        for tone in self.tones:
            for hz in (tone.frequency_hz, tone.frequency_hz if tone.end_hz is None else tone.end_hz):
                _require("frequency", hz, 0 <= hz <= most_hz, f"must be 0 to a quarter of the rate, {most_hz:g} Hz")
            _require("phase", tone.phase, math.isfinite(tone.phase), "must be finite")
        most_v = abs(self.offset_v) + sum(abs(tone.amplitude_v) for tone in self.tones)
        _require("the largest level", most_v, most_v <= MOST_V, f"must be at most {MOST_V:g} V")

    @classmethod
    def multisine(
        cls, samples: int, amplitude_v: float, frequencies_hz: Sequence[float], **fields: float
    ) -> SmoothExcitation:
        """Tones of one amplitude with Schroeder's phases, which keep the peak of harmonics low."""
        count = max(len(frequencies_hz), 1)
        tones = (Tone(amplitude_v, hz, -k * (k + 1) / (2 * count)) for k, hz in enumerate(frequencies_hz))
        return cls(samples, tuple(tones), **fields)

    def volts(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Level at instants in samples, none beyond the last sample."""
        time_s, length_s = at / self.sample_rate_hz, self.samples / self.sample_rate_hz
        volts = np.full(at.shape, self.offset_v)
        for tone in self.tones:
            volts += tone.amplitude_v * _sine(tone.turns(time_s, length_s))
        return volts

    @functools.cached_property
    def drive(self) -> Drive:
        """Signal as the engine takes it."""
        return Drive.through(lambda at: self.volts(np.minimum(at, self.samples - 1.0)), self.samples)


def _sine(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sine by its series: numpy's has other bits on other processors."""
    turns = turns - np.rint(turns)
    folded = np.where(np.abs(turns) > 0.25, np.copysign(0.5, turns) - turns, turns)
    angle = 2.0 * math.pi * folded
    square, sine = angle * angle, np.zeros_like(angle)
    for k in range(_TERMS, 0, -1):
        sine = 1.0 - square / ((2 * k) * (2 * k + 1)) * (sine if k < _TERMS else 1.0)
    return np.asarray(angle * sine)


def _require(field: str, value: float, holds: object, what: str) -> None:
    if not holds:
        raise ExcitationError(f"excitation: {field} {value!r} {what}")
