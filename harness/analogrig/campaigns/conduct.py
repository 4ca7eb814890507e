"""A campaign: many trials, played by whoever is there, to one file of results.

The results are a function of the plan alone: neither the number of workers, nor the order in which they are done, nor
how often the campaign was interrupted changes a byte of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from analogrig.campaigns.journal import Journal
from analogrig.campaigns.plan import Chunk, Plan, device_as_planned
from analogrig.campaigns.results import Results
from analogrig.campaigns.rows import RATES, Row, counts
from analogrig.campaigns.trial import close_devices, play_chunk
from analogrig.campaigns.workers import Workers
from analogrig.devices.dut import connect
from analogrig.errors import DeviceError, LinkError
from analogrig.judging.statistics import Decision


@dataclass
class Tally:
    """What has come, in any order, and what of it counts: of each cell the rounds without a gap, up to its end."""

    plan: Plan
    cells: int
    came: dict[Chunk, list[Row]] = field(default_factory=dict)
    counted: list[list[Row]] = field(init=False)
    rounds: list[int] = field(init=False)
    ended: list[bool] = field(init=False)
    trials: int = 0
    counts: list[dict[str, int]] = field(init=False)

    def __post_init__(self) -> None:
        self.counted = [[] for _ in range(self.cells)]
        self.rounds = [0] * self.cells
        self.ended = [False] * self.cells
        self.counts = [counts([]) for _ in range(self.cells)]

    def add(self, chunk: Chunk, rows: list[Row]) -> None:
        """Count it, and what it completes."""
        self.came[chunk] = rows
        cell = chunk.cell
        while not self.ended[cell]:
            following = self.came.get(Chunk((self.rounds[cell], cell)))
            if following is None:
                return
            self._count(cell, following)

    def _count(self, cell: int, rows: list[Row]) -> None:
        self.counted[cell] += rows
        self.rounds[cell] += 1
        self.trials += len(rows)
        for name, count in counts(rows).items():
            self.counts[cell][name] += count
        stop = self.plan.spec.stop
        if stop is not None:
            known = RATES[stop.quantity].known(self.counts[cell], stop.confidence, stop.rate)
            self.ended[cell] = known.decision(stop.rate) is not Decision.OPEN

    def total(self) -> dict[str, int]:
        """The counts of all cells together."""
        return {name: sum(each[name] for each in self.counts) for name in counts([])}


Progress = Callable[[Tally], None]


def conduct(plan: Plan, workers: Workers, out: Path, progress: Progress | None = None) -> Results:
    """Play the plan to ``out``. Interrupted by whatever, it goes on where it was when it is asked for again.

    :raises ConfigurationError: ``out`` or its journal hold something else, or a device refuses its configuration.
    :raises RecordingError: ``out`` cannot be written.
    :raises WorkerError: the workers cannot be had or kept.
    """
    if out.exists():
        return Results.load(out).of_plan(plan, out)
    tally = Tally(plan, len(plan.cells()))
    with Journal(journal_of(out), plan) as journal:
        if out.exists():  # another one has ended meanwhile
            journal.remove()
            return Results.load(out).of_plan(plan, out)
        for chunk, rows in journal.rows.items():
            tally.add(chunk, rows)
        work: Any = functools.partial(play_chunk, plan.as_json())
        try:
            for chunk, rows in workers.play(work, _open_chunks(plan, tally)):
                journal.add(chunk, rows)
                tally.add(chunk, rows)
                if progress is not None:
                    progress(tally)
        finally:
            close_devices()
        results = Results(plan, tuple(tuple(rows) for rows in tally.counted))
        results.save(out)
        journal.remove()
    return results


def unreachable(plan: Plan) -> dict[str, str]:
    """Why devices cannot be had from here, by their names. Those within a process are not tried: a library may end it.

    :raises ConfigurationError: a device refuses its configuration.
    """
    found = {}
    for device in map(device_as_planned, plan.devices):
        try:
            if not device.is_in_process:
                connect(device).close()
        except (LinkError, DeviceError) as error:
            found[device.name] = str(error)
    return found


def journal_of(out: Path) -> Path:
    """Where a campaign that has not ended keeps what it has got."""
    return out.with_name(f"{out.name}.journal")


def _open_chunks(plan: Plan, tally: Tally) -> Iterator[Chunk]:
    """What is still to be played, at the time it is asked."""
    for chunk in plan.chunks():
        if chunk not in tally.came and not tally.ended[chunk.cell]:
            yield chunk
