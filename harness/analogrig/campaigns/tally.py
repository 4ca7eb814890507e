"""Tally of a campaign: the parts received so far, in any order, the trials that count, and the results of them."""

from __future__ import annotations

import functools
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from analogrig.campaigns.aggregates import Aggregate, Distribution, Histogram, Summary
from analogrig.campaigns.plan import Cell, Part, Plan
from analogrig.campaigns.store import Store
from analogrig.campaigns.trials import Trials
from analogrig.identity import Identity
from analogrig.judging.statistics import Decision


class Tally:
    """Aggregates of the trials that count: in each cell, those without a gap up to the cell's end."""

    def __init__(self, plan: Plan, store: Store | None = None) -> None:
        """Count all trials that a store holds; without a store there are none.

        :raises RecordingError: the store is damaged.
        """
        self.cells = [Aggregate(most) for most in plan.most_alarms]
        self.distribution = Distribution(plan.spec.draw)
        self.trials = 0
        self._plan, self._store = plan, store
        self._decided = [False] * plan.size
        self._early: list[dict[int, int]] = [{} for _ in range(plan.size)]
        """Numbers of trials by place of the first one, for parts behind a gap."""
        for part, trials in () if store is None else store.parts():
            self.add(part, trials)

    def add(self, part: Part, trials: Trials) -> None:
        """Add a part that the store has, and count all that is now without a gap."""
        early, cell = self._early[part.cell], self.cells[part.cell]
        if part.first != cell.trials:
            early[part.first] = part.trials
            return
        self._count(part, trials)
        while self._store is not None and early.pop(cell.trials, None) is not None:
            number = part.cell * self._plan.spec.trials + cell.trials
            ((following, trials),) = self._store.parts(range(number, number + 1))
            self._count(following, trials)

    def _count(self, part: Part, trials: Trials) -> None:
        cell, stop, chunk = self.cells[part.cell], self._plan.spec.stop, self._plan.spec.chunk
        step = len(trials) if stop is None else chunk - part.first % chunk
        start = 0
        while start < len(trials) and not self._decided[part.cell]:
            portion = trials[start : start + step]
            cell.add(portion, self._plan.spec.first_seed + part.first + start)
            self.distribution.add(portion)
            self.trials += len(portion)
            start, step = start + len(portion), chunk
            if stop is not None and cell.trials % chunk == 0:
                known = cell.sequence(stop.quantity, stop.confidence)
                self._decided[part.cell] = known.decision(stop.rate) is not Decision.OPEN

    def has_ended(self, cell: int) -> bool:
        """True if all trials of a cell are there that count."""
        return self._decided[cell] or self.cells[cell].trials == self._plan.spec.trials

    def total(self) -> Counter[str]:
        """Total counts over all cells (``Aggregate.counts``)."""
        return sum((each.counts for each in self.cells), Counter())

    def gaps(self, cell: int) -> deque[tuple[int, int]]:
        """First and end of the ranges of trials of a cell that are still to be played."""
        found: deque[tuple[int, int]] = deque()
        at = self.cells[cell].trials
        for first, count in sorted([*self._early[cell].items(), (self._plan.spec.trials, 0)]):
            if first > at:
                found.append((at, first))
            at = first + count
        return found


@dataclass(frozen=True)
class Results:
    """Summary of each cell in the order of ``Plan.cells``, and the distributions over all, without dates."""

    plan: Plan
    aggregates: Sequence[Aggregate]
    distribution: Distribution
    played_by: tuple[Identity, ...] = ()
    """Commands that have played a part; nothing else depends on them."""

    @classmethod
    def load(cls, store: Store | Path) -> Self:
        """Results of a store whose campaign has ended, folded part by part.

        :raises RecordingError: absent, not the results of a campaign, not ended, or damaged.
        """
        if isinstance(store, Path):
            with Store.read(store) as opened:
                return cls.load(opened)
        store.check_whole()
        tally = Tally(store.plan, store)
        if not all(map(tally.has_ended, range(store.plan.size))):
            raise store.damage("trials are missing")
        return cls(store.plan, tally.cells, tally.distribution, store.commands())

    @functools.cached_property
    def cells(self) -> list[tuple[Cell, Summary]]:
        """Cells, each with the summary of its trials."""
        return [
            (cell, Summary.of(each, self.plan.estimates))
            for cell, each in zip(self.plan.cells(), self.aggregates, strict=True)
        ]

    @functools.cached_property
    def total(self) -> Summary:
        return Summary.of(Aggregate.merged(self.aggregates), self.plan.estimates)

    @functools.cached_property
    def latencies(self) -> Histogram:
        """Detection delays of all cells."""
        return Aggregate.merged(self.aggregates).latency_n

    @property
    def outcome(self) -> str:
        """``failed`` if a trial failed; ``inconclusive`` if one was not valid; else ``passed``."""
        return "failed" if self.total.failed else "inconclusive" if self.total.inconclusive else "passed"
