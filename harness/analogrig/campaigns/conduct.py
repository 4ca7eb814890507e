"""Campaign execution: many trials, played by the available workers, to one results file.

The results are a function of the plan alone. The number of workers, the order of their work, and interruptions do not
change a byte.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from analogrig.campaigns.journal import Journal
from analogrig.campaigns.plan import Chunk, Plan, device_of
from analogrig.campaigns.plays import close_devices, play_chunk
from analogrig.campaigns.results import Results
from analogrig.campaigns.rows import RATES, Row, counts
from analogrig.campaigns.workers import Workers
from analogrig.errors import DeviceError, LinkError
from analogrig.judging.statistics import Decision


class Tally:
    """Chunks received so far, in any order, and the rows that count.

    In each cell, consecutive rounds without a gap count, up to the cell's end.
    """

    def __init__(self, plan: Plan) -> None:
        self.came: dict[Chunk, list[Row]] = {}
        self.counted: list[list[Row]] = [[] for _ in range(plan.size)]
        self.ended = [False] * plan.size
        self.trials = 0
        self._stop = plan.spec.stop
        self._rounds = [0] * plan.size
        self._counts = [counts([]) for _ in range(plan.size)]

    def add(self, chunk: Chunk, rows: list[Row]) -> None:
        """Add the rows of a chunk, and count every round that is now without a gap."""
        self.came[chunk] = rows
        cell = chunk.cell
        while not self.ended[cell]:
            following = self.came.get(Chunk(self._rounds[cell], cell))
            if following is None:
                return
            self._count(cell, following)

    def _count(self, cell: int, rows: list[Row]) -> None:
        self.counted[cell] += rows
        self._rounds[cell] += 1
        self.trials += len(rows)
        for name, count in counts(rows).items():
            self._counts[cell][name] += count
        if (stop := self._stop) is not None:
            known = RATES[stop.quantity].sequence(self._counts[cell], stop.confidence)
            self.ended[cell] = known.decision(stop.rate) is not Decision.OPEN

    def total(self) -> dict[str, int]:
        """Total counts over all cells."""
        return {name: sum(each[name] for each in self._counts) for name in counts([])}


def conduct(plan: Plan, workers: Workers, out: Path, progress: Callable[[Tally], None] | None = None) -> Results:
    """Play the plan to ``out``. After any interruption, another call resumes it.

    :raises ConfigurationError: ``out`` or its journal hold something else, or a device refuses its configuration.
    :raises RecordingError: ``out`` cannot be written.
    :raises WorkerError: the workers cannot be reached, or keep dying over a chunk.
    """
    if out.exists():
        return Results.load(out).of_plan(plan, out)
    tally = Tally(plan)
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
    """Reasons why devices cannot be reached from this machine, by device name.

    In-process devices are not tried: loading a library may crash this process.

    :raises ConfigurationError: a device refuses its configuration.
    """
    found = {}
    for device in map(device_of, plan.devices):
        try:
            if "in-process" not in device.capabilities:
                device.connect().close()
        except (LinkError, DeviceError) as error:
            found[device.name] = str(error)
    return found


def journal_of(out: Path) -> Path:
    """Path of the journal in which an unfinished campaign keeps its rows."""
    return out.with_name(f"{out.name}.journal")


def _open_chunks(plan: Plan, tally: Tally) -> Iterator[Chunk]:
    """Yield the chunks still to be played; evaluated at each step."""
    for chunk in plan.chunks():
        if chunk not in tally.came and not tally.ended[chunk.cell]:
            yield chunk
