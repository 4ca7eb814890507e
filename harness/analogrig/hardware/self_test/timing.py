"""A square wave by its samples: its levels, its edges, and what each edge says about its instant.

An edge between two samples says no more than that: it came between them. Yet edges that come at ever other parts of a
sample leave little room together, if it is known how they follow one another: then each gives an interval for what is
unknown, and the truth is in all of them (set-membership estimation: Milanese and Vicino, Automatica 27, 1991, 997).

An instrument that averages over a part of each sample period shows some edges on the way between the levels; how far on
the way is linear in the instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import SelfTestError

SETTLED_PART = 0.01
"""A sample that is off its level by more than this part of the swing, and by the noise, is on the way."""

_NOISES = 6.0
_MOST_ON_THE_WAY = 3
"""Samples of one edge that may be on the way."""
_AVERAGES_FROM = 8
"""So many edges seen on the way, and the instrument averages; fewer are chance, such as jitter at the very edge."""


@dataclass(frozen=True, eq=False)
class Levels:
    """The two levels of a square wave, and which samples are at which."""

    low: float
    high: float
    """Codes: medians."""
    state: NDArray[np.int8]
    """(n,): 0 at the lower level, 1 at the upper one, -1 on the way."""

    @classmethod
    def of(cls, codes: NDArray[np.uint16]) -> Levels:
        """:raises SelfTestError: there are no two levels."""
        values = codes.astype(np.float64)
        upper = values > 0.5 * (values.min() + values.max())
        if not upper.any():
            raise SelfTestError("the force does not change")
        low, high = float(np.median(values[~upper])), float(np.median(values[upper]))
        off = np.abs(values - np.where(upper, high, low))
        noise = max(1.4826 * float(np.median(off)), 0.5)
        settled = off <= max(SETTLED_PART * (high - low), _NOISES * noise)
        return cls(low, high, np.where(settled, upper, -1).astype(np.int8))


@dataclass(frozen=True, eq=False)
class SeenEdges:
    """The edges of a square wave as its samples show them, rising and falling in turn: (edges,)."""

    before: NDArray[np.int64]
    """The last sample at the old level."""
    after: NDArray[np.int64]
    """The first one at the new level."""
    rising: NDArray[np.bool_]

    @classmethod
    def of(cls, state: NDArray[np.int8], half_period_n: float) -> SeenEdges:
        """
        :param half_period_n: about so many samples lie between two edges.
        :raises SelfTestError: it is no unbroken square wave.
        """
        settled = np.flatnonzero(state >= 0)
        turns = np.flatnonzero(np.diff(state[settled]))
        before, after = settled[turns], settled[turns + 1]
        marks = np.concatenate(([0], 0.5 * (before + after), [len(state)]))
        lengths = np.diff(marks) / half_period_n
        lengths[[0, -1]] = np.where(lengths[[0, -1]] < 1.5, 1.0, lengths[[0, -1]])
        if (broken := np.flatnonzero(np.rint(lengths) != 1)).size:
            raise SelfTestError(f"the square wave of the force is broken after sample {int(marks[broken[0]])}")
        if (longest := int((after - before).max())) > _MOST_ON_THE_WAY + 1:
            raise SelfTestError(f"the force takes {longest} samples from level to level: it is no square wave")
        return cls(before, after, state[after] == 1)

    @property
    def turn(self) -> NDArray[np.float64]:
        """Number of the period of each edge, 0 in the middle of the record: (edges,)."""
        first = 0 if self.rising[0] else 1
        return np.asarray((np.arange(len(self.rising)) + first) // 2 - len(self.rising) // 4, dtype=np.float64)

    def line(self) -> EdgeTimes:
        """That on which their middles lie best; it is off by part of a sample."""
        design = np.stack([self.turn, self.rising, ~self.rising], axis=1).astype(np.float64)
        middles = 0.5 * (self.before + self.after)
        period, rising, falling = np.linalg.lstsq(design, middles, rcond=None)[0]
        return EdgeTimes(float(period), float(rising), float(falling))

    def on_the_way(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The samples between the levels, and the edge of each."""
        counts = self.after - self.before - 1
        edge = np.repeat(np.arange(len(counts)), counts)
        place = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
        return self.before[edge] + 1 + place, edge


@dataclass(frozen=True)
class EdgeTimes:
    """When the edges of a square wave come, in samples: one instant near the middle of the record, and the period."""

    period_n: float
    rising_n: float
    falling_n: float

    def instants(self, edges: SeenEdges) -> NDArray[np.float64]:
        """Of these edges: (edges,)."""
        return np.asarray(edges.turn * self.period_n + np.where(edges.rising, self.rising_n, self.falling_n))


def averaged_n(edges: SeenEdges) -> float:
    """Over so much of a sample period the instrument averages, 0 for one that does not: it sees that part of all edges
    on the way."""
    seen = len(edges.on_the_way()[0])
    return seen / len(edges.rising) / (1.0 - 2.0 * SETTLED_PART) if seen >= _AVERAGES_FROM else 0.0


def lateness(
    codes: NDArray[np.uint16], levels: Levels, edges: SeenEdges, line: EdgeTimes, room_n: float
) -> tuple[float, float]:
    """By how many samples the edges of these codes are later than the line says, and its standard error.

    :param room_n: by so much the line may be off at the ends of the record.
    """
    samples, edge = edges.on_the_way()
    instants, averaged = line.instants(edges), averaged_n(edges)
    if averaged:
        upper = (codes[samples] - levels.low) / (levels.high - levels.low)
        new = np.where(edges.rising[edge], upper, 1.0 - upper)
        late = samples - averaged * (new - 0.5) - instants[edge]
        return float(late.mean()), float(np.hypot(late.std() / np.sqrt(len(late)), room_n))
    least, most = float((edges.before - instants).max()), float((edges.after - instants).min())
    return 0.5 * (least + most), float((abs(most - least) + 2.0 * room_n) / np.sqrt(12.0))
