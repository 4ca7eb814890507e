"""Results of a campaign: the summary of each cell and the distributions over all, without dates."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from analogrig.campaigns.plan import Cell, Part, Plan
from analogrig.campaigns.store import Store
from analogrig.campaigns.summary import Aggregate, Distribution, Histogram, Summary
from analogrig.campaigns.tally import Tally
from analogrig.campaigns.trials import Trials
from analogrig.identity import Identity


@dataclass(frozen=True)
class Results:
    """Aggregates of every cell, in the order of ``Plan.cells``."""

    plan: Plan
    aggregates: Sequence[Aggregate]
    distribution: Distribution
    played_by: tuple[Identity, ...] = ()
    """Commands that have played a part; nothing else depends on them."""

    @classmethod
    def of(cls, plan: Plan, tally: Tally, played_by: tuple[Identity, ...] = ()) -> Results:
        return cls(plan, tally.cells, tally.distribution, played_by)

    @classmethod
    def load(cls, path: Path) -> Results:
        """Results of a store whose campaign has ended, folded part by part.

        :raises RecordingError: absent, not the results of a campaign, or not ended.
        """
        with Store.read(path) as store:
            return load_ended(store)

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


def load_ended(store: Store) -> Results:
    """Results of an open store.

    :raises RecordingError: the campaign has not ended, or the store is damaged.
    """
    plan = store.plan()
    store.check_whole(plan)
    tally = tally_of(store, plan)
    if not all(map(tally.has_ended, range(plan.size))):
        raise store.damage("trials are missing")
    return Results.of(plan, tally, store.commands())


def tally_of(store: Store, plan: Plan) -> Tally:
    """Tally of all that a store holds.

    :raises RecordingError: the store is damaged.
    """

    def read(part: Part) -> Trials:
        first = part.cell * plan.spec.trials + part.first
        ((_, trials),) = store.parts(plan, range(first, first + 1))
        return trials

    tally = Tally(plan, read)
    for part, trials in store.parts(plan):
        tally.add(part, trials)
    return tally
