"""Recorded excitation: a signal that was sampled at the card's rate, played back between the samples as well."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.smooth import MOST_V
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Drive, Edges
from analogrig_emulator.errors import ExcitationError


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
