"""Reference of the watch of the fit: when it states a cause, and the line of a hum in the innovations of a block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SUM_N, SETTLING_N, BLOCK_N = 24, 336, 768
"""Samples of a sum, those before the first block, and those of a block. One sum more is for the evaluation."""

_EVALUATION_N = 19
"""Samples after a block until it is evaluated."""

LINES_N, LEAST_LINE = 16, 1
"""Lines of the spectrum of a block; the first is the mean."""

LINE = 22.0
"""Power of a line over its mean at which it is hum."""

CLIP = 3.0
"""Limit of an innovation, in standard deviations of the noise."""


@dataclass(frozen=True)
class Hum:
    """Line of a periodic disturbance."""

    frequency: float
    """Cycles per sample."""
    strength: float
    """Statistic over its limit."""


def block_of(block: int) -> slice:
    """Samples of a block, counted from 0."""
    first = SETTLING_N + block * (BLOCK_N + SUM_N)
    return slice(first, first + BLOCK_N)


def stated_n(block: int) -> int:
    """Sample after which a block is evaluated."""
    return SETTLING_N + block * (BLOCK_N + SUM_N) + BLOCK_N + _EVALUATION_N


def hum_in_block(innovation: NDArray[np.float64], used: NDArray[np.bool_], noise_variance: float, block: int) -> Hum:
    """Hum in a block, counted from 0, of a run without alarms and doubts, whose noise variance is configured."""
    at, limit = block_of(block), CLIP * noise_variance**0.5
    limited, count = np.clip(innovation[at], -limit, limit) * used[at], int(used[at].sum())
    power: list[float] = np.square(np.abs(np.fft.rfft(limited.reshape(-1, SUM_N).sum(axis=1)))).tolist()
    peak = max(range(LEAST_LINE, LINES_N), key=power.__getitem__)
    beside = {line: power[line] for line in (peak - 1, peak + 1) if LEAST_LINE <= line < LINES_N}
    neighbour = max(beside, key=beside.__getitem__)
    ratio = (beside[neighbour] / power[peak]) ** 0.5
    energy = max(float(np.square(limited).sum()), noise_variance * count)
    return Hum(
        (peak + (neighbour - peak) * ratio / (1.0 + ratio)) / BLOCK_N, (power[peak] + beside[neighbour]) / energy / LINE
    )
