"""Samples of one run as a device may meet them, and the information on a change in them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2
from analogrig_emulator import CHANNELS, Card

Array = NDArray[np.float64]

PARAMETERS = "MBK"

HALF_PERIOD_N = 50
LOW_V, HIGH_V = 0.1, 9.9
"""Shipped excitation: 200 Hz at 20,000 samples/s."""

FORCE, DISPLACEMENT = (CHANNELS.index(name) for name in ("force", "displacement"))

CARD = Card(ranges_v=((-1.0, 11.0), (-1.0, 9.0), (-10.0, 10.0), (-12.5, 12.5)), noise_lsb=(1.0,) * 4)
"""Card of the shipped rig ``emulator``."""


class Change(NamedTuple):
    """Change of one parameter; the next sample is the first one affected."""

    parameter: str
    """Name of its pot: ``M``, ``B`` or ``K``."""
    factor: float
    sample: int


@dataclass(frozen=True, eq=False)
class Played:
    """Samples of one run; all arrays are (n,)."""

    u: Array
    """Force in codes."""
    y: Array
    """Displacement in codes."""
    valid: NDArray[np.bool_]
    information: Array
    """I of ``analogrig.judging.information`` up to each sample, between the plants with and without the change; 0
    without one."""

    def until(self, end: int) -> Played:
        """Samples before this one."""
        return Played(self.u[:end], self.y[:end], self.valid[:end], self.information[:end])


def accumulate(seen_lsb: Array, variance_lsb2: float, correlation: float = 0.0) -> Array:
    """Information up to each sample of a difference (n,) in first-order autoregressive noise and quantisation.

    A Kalman filter of the noise whitens the difference.
    """
    whitened = np.empty(len(seen_lsb))
    predicted, spread = 0.0, variance_lsb2
    for k, seen in enumerate(seen_lsb.tolist()):
        error, variance = seen - predicted, spread + QUANTISATION_VARIANCE_LSB2
        whitened[k] = error / math.sqrt(variance)
        gain = spread / variance
        predicted = correlation * (predicted + gain * error)
        spread = correlation**2 * (1.0 - gain) * spread + (1.0 - correlation**2) * variance_lsb2
    return np.asarray(np.cumsum(whitened**2) / 2.0)
