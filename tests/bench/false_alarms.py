"""Counts of false alarms, and a bound of their rate that holds for alarms in bursts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.99

CLUSTER_N = 500
"""Alarms at most so many samples apart are one cluster."""


@dataclass(frozen=True)
class FalseAlarms:
    """False alarms of some runs."""

    exposure_n: int
    """Armed samples."""
    by_run: tuple[int, ...]
    """Alarms of each run."""
    clusters: tuple[int, ...]
    """Alarms of each cluster."""

    @classmethod
    def joined(cls, parts: Iterable[FalseAlarms]) -> FalseAlarms:
        """False alarms of all the runs together."""
        every = list(parts)
        return cls(
            sum(part.exposure_n for part in every),
            tuple(count for part in every for count in part.by_run),
            tuple(size for part in every for size in part.clusters),
        )

    @property
    def alarms(self) -> int:
        return sum(self.by_run)

    def upper_rate(self, confidence: float = CONFIDENCE) -> float:
        """Upper confidence bound of the rate per sample that holds for alarms in bursts.

        Gamma quantile of a Poisson count, with the count and the mean in units of the dispersion (McCullagh and
        Nelder, Generalized Linear Models, 6.2.3). The dispersion is the larger one of that of the clusters, as of a
        compound Poisson process, and that between the runs.
        """
        from scipy.special import gammaincinv

        dispersion = max(1.0, self._dispersion_of_clusters(), self._dispersion_of_runs())
        return float(dispersion * gammaincinv(self.alarms / dispersion + 1.0, confidence) / self.exposure_n)

    def _dispersion_of_clusters(self) -> float:
        """Variance over mean of the number of alarms if clusters come independently."""
        sizes = np.array(self.clusters, dtype=float)
        return float(np.sum(sizes**2) / np.sum(sizes)) if len(sizes) else 1.0

    def _dispersion_of_runs(self) -> float:
        """Variance over mean of the number of alarms in a run."""
        counts = np.array(self.by_run, dtype=float)
        return float(counts.var(ddof=1) / counts.mean()) if counts.any() and len(counts) > 1 else 1.0


def count_false_alarms(alarms: Sequence[Sequence[int]], exposures_n: Sequence[int]) -> FalseAlarms:
    """Counts of runs with alarms at these samples."""
    clusters: list[int] = []
    for run in alarms:
        gaps = np.diff(np.asarray(run, dtype=np.int64), prepend=-10 * CLUSTER_N)
        starts = np.flatnonzero(gaps > CLUSTER_N)
        clusters += np.diff(np.append(starts, len(run))).tolist()
    return FalseAlarms(sum(exposures_n), tuple(len(run) for run in alarms), tuple(clusters))
