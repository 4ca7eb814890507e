"""Answers sample by sample, collected into blocks."""

from __future__ import annotations

import numpy as np

from analogrig.answers import (
    EVENTS,
    Answers,
    RaisedAlarm,
    ReportedDiagnosis,
    ReportedMisfit,
)

__all__ = ["AnswerRows"]
"""Names for packages beside the core."""


class AnswerRows:
    """Answers not yet taken, in lists: numpy takes as long for one number as for a hundred."""

    def __init__(self, width: int) -> None:
        self.width = width
        """Number of elements of theta, plus one for the innovation."""
        self.values: list[float] = []
        self.statistics: list[float] = []
        self.flags: list[int] = []
        self.alarms: list[RaisedAlarm] = []
        self.diagnoses: list[ReportedDiagnosis] = []
        self.misfits: list[ReportedMisfit] = []
        self._last_taken = (width * [0.0], 0.0)

    def repeat(self, flags: int, statistic: float | None = None) -> None:
        """Enter a sample without a report: the estimate of the sample before, and no innovation."""
        row = self.values[-self.width :] or self._last_taken[0]
        self.values += [*row[:-1], 0.0]
        self.finish(flags, self.statistic if statistic is None else statistic)

    @property
    def statistic(self) -> float:
        """Statistic of the latest sample."""
        return (self.statistics or self._last_taken[1:])[-1]

    def finish(self, flags: int, statistic: float) -> None:
        self.flags.append(flags)
        self.statistics.append(statistic)

    def take(self, n: int, before: int) -> Answers:
        """Remove and return the first n samples, and all that was reported before the index ``before``."""
        cut = n * self.width
        values = np.array(self.values[:cut], dtype=np.float32).reshape(n, self.width)
        events = {name: [each for each in getattr(self, name) if each.index < before] for name in EVENTS}
        out = Answers(
            theta=values[:, :-1],
            innovation=values[:, -1],
            statistic=np.array(self.statistics[:n], dtype=np.float32),
            flags=np.array(self.flags[:n], dtype=np.uint8),
            **events,
        )
        if n:
            self._last_taken = (self.values[cut - self.width : cut], self.statistics[n - 1])
        del self.values[:cut], self.statistics[:n], self.flags[:n], self.alarms[: len(out.alarms)]
        del self.diagnoses[: len(out.diagnoses)], self.misfits[: len(out.misfits)]
        return out
