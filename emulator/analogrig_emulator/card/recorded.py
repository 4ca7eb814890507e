"""Recorded excitation: a signal that was sampled at the card's rate, played back between the samples as well."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine.system import Drive
from analogrig_emulator.errors import ExcitationError

MOST_V = 1e3


@dataclass(frozen=True, eq=False)
class RecordedExcitation:
    """Generator that plays samples_v, (n,) in V, one at each sample instant; the last one holds.

    Between samples the signal is band-limited to half the sample rate, as that before the recorder's filter was.
    Raises ExcitationError.
    """

    samples_v: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.samples_v.ndim != 1 or not self.samples_v.size:
            raise ExcitationError(f"excitation: recorded samples of shape {self.samples_v.shape}, not (n,) from 1 on")
        if not (np.abs(self.samples_v) <= MOST_V).all():
            raise ExcitationError(f"excitation: a recorded sample is not finite, or beyond +-{MOST_V:g} V")

    @functools.cached_property
    def drive(self) -> Drive:
        """Signal as the engine takes it."""
        return Drive.band_limited(np.asarray(self.samples_v, np.float64))
