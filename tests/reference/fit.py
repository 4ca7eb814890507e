"""Reference of the watch of the fit, as far as its messages need: the line of a hum in the innovations of one block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SUM_N, SETTLING_N, BLOCK_N = 24, 336, 768
"""Samples of a sum, those before the first block, and those of a block. One sum more is for the evaluation."""

STATED_N = 2 * BLOCK_N + SETTLING_N + SUM_N + 19
"""Sample after which the second of two blocks with a misfit is evaluated."""

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


def hum_in_second_block(innovation: NDArray[np.float64], noise_variance: float) -> Hum:
    """Hum in the second block of a run without gaps, alarms and doubts, whose noise variance is configured."""
    first = SETTLING_N + BLOCK_N + SUM_N
    limit = CLIP * noise_variance**0.5
    limited = np.clip(innovation[first : first + BLOCK_N], -limit, limit)
    power: list[float] = np.square(np.abs(np.fft.rfft(limited.reshape(-1, SUM_N).sum(axis=1)))).tolist()
    peak = max(range(LEAST_LINE, LINES_N), key=power.__getitem__)
    beside = {line: power[line] for line in (peak - 1, peak + 1) if LEAST_LINE <= line < LINES_N}
    neighbour = max(beside, key=beside.__getitem__)
    ratio = (beside[neighbour] / power[peak]) ** 0.5
    energy = max(float(np.square(limited).mean()), noise_variance) * BLOCK_N
    return Hum(
        (peak + (neighbour - peak) * ratio / (1.0 + ratio)) / BLOCK_N, (power[peak] + beside[neighbour]) / energy / LINE
    )
