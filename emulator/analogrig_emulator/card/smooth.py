"""Waveforms of the generator whose level moves all the time: sine, sweep and multisine, each within -1 to 1."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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
