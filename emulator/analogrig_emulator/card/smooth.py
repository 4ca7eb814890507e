"""Waveforms whose level moves all the time: sine, sweep and multisine, each within -1 to 1; recorded signals."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Drive, Edges
from analogrig_emulator.exceptions import ExcitationError

Matrix = NDArray[np.float64]

MOST_V = 1e3
MOST_HARMONIC = 1000

_TERMS = 12
"""Terms of the series of a sine; within a quarter turn they leave 1e-20."""

_POINTS_PER_TURN = 64
"""Points of the highest harmonic at which the peak of a multisine is looked for."""


def sine(turns: Matrix) -> Matrix:
    """Sine by its series: numpy's has other bits on other processors."""
    turns = turns - np.rint(turns)
    folded = np.where(np.abs(turns) > 0.25, np.copysign(0.5, turns) - turns, turns)
    angle = 2.0 * math.pi * folded
    square, series = angle * angle, np.ones_like(angle)
    for k in range(_TERMS - 1, 0, -1):
        series = 1.0 - square / ((2 * k) * (2 * k + 1)) * series
    return np.asarray(angle * series)


def sweep_turns(time_s: Matrix, start_hz: float, end_hz: float, sweep_s: float) -> Matrix:
    """Turns of a frequency that moves evenly from start_hz to end_hz in sweep_s, and back in as much, over and over."""
    returns = np.floor(time_s / (2.0 * sweep_s))
    whole = (start_hz + end_hz) * sweep_s
    here_s = time_s - 2.0 * sweep_s * returns
    is_back = here_s > sweep_s
    from_start_s = np.where(is_back, 2.0 * sweep_s - here_s, here_s)
    turns = (start_hz + (0.5 * (end_hz - start_hz) / sweep_s) * from_start_s) * from_start_s
    return np.asarray(returns * whole + np.where(is_back, whole - turns, turns))


def multisine(turns: Matrix, harmonics: Sequence[int]) -> Matrix:
    """Sum of harmonics of one amplitude, with Schroeder's phases, which keep its peak low; its peak is 1.

    turns: of the fundamental.
    """
    return _summed(turns, harmonics) / _peak(tuple(harmonics))


def _summed(turns: Matrix, harmonics: Sequence[int]) -> Matrix:
    total = np.zeros_like(turns)
    for k, harmonic in enumerate(harmonics):
        total += sine(harmonic * turns - k * (k + 1) / (2 * len(harmonics)))
    return total


@functools.lru_cache(maxsize=16)
def _peak(harmonics: tuple[int, ...]) -> float:
    """Bound on the sum: between two points a sum of sines exceeds them by at most 1 / cos(pi / points per turn)."""
    points = np.arange(_POINTS_PER_TURN * max(harmonics)) / (_POINTS_PER_TURN * max(harmonics))
    return float(np.abs(_summed(points, harmonics)).max()) / math.cos(math.pi / _POINTS_PER_TURN)


@dataclass(frozen=True, eq=False)
class RecordedExcitation:
    """Generator that plays samples_v, (n,) in V, one at each sample instant; the last one holds.

    Between samples the signal is band-limited to half the sample rate, as that before the recorder's filter was; with
    is_held it keeps the level of each sample until the next, as that of a converter does.
    Raises ExcitationError.
    """

    samples_v: NDArray[np.float64]
    is_held: bool = False

    def __post_init__(self) -> None:
        if self.samples_v.ndim != 1 or not self.samples_v.size:
            raise ExcitationError(f"excitation: recorded samples of shape {self.samples_v.shape}, not (n,) from 1 on")
        if not (np.abs(self.samples_v) <= MOST_V).all():
            raise ExcitationError(f"excitation: a recorded sample is not finite, or beyond +-{MOST_V:g} V")

    @property
    def is_smooth(self) -> bool:
        """True if the level moves all the time: drive() gives it, and there are no edges."""
        return not self.is_held

    @functools.cached_property
    def signal(self) -> Drive:
        """Signal from sample 0 on."""
        return Drive.band_limited(np.asarray(self.samples_v, np.float64))

    def drive(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Drive:  # noqa: ARG002 - all at once
        """Signal as the engine takes it, for the ticks start_tick <= t < stop_tick at least."""
        return self.signal

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Edges:  # noqa: ARG002 - one per sample
        """Edges of a held signal at ticks start_tick <= t < stop_tick."""
        ticks = TICKS_PER_SAMPLE * np.arange(self.samples_v.size, dtype=np.int64)
        return Edges(ticks, np.asarray(self.samples_v, np.float64)).within(start_tick, stop_tick)
