"""Tally of a campaign: the parts received so far, in any order, and the trials that count."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

from analogrig.campaigns.plan import Part, Plan
from analogrig.campaigns.summary import COUNTED, Aggregate, Distribution
from analogrig.campaigns.trials import MOST_TRIALS, Trials
from analogrig.judging.statistics import Decision

Task = tuple[Part, ...]

FIRST_N = 10
"""Number of trials of the first tasks, before the duration of a trial is known."""

TASK_S, SHORTEST_S = 5.0, 0.2
"""Duration of a task in seconds, and of the last ones, which are made shorter so that all workers end together."""


class Tally:
    """Aggregates of the trials that count: in each cell, those without a gap up to the cell's end."""

    def __init__(self, plan: Plan, read: Callable[[Part], Trials]) -> None:
        """Start with no trials.

        :param read: returns the trials of a part that came before those in front of it.
        """
        self.cells = [Aggregate(most) for most in plan.most_alarms]
        self.distribution = Distribution(plan.spec.draw)
        self.trials = 0
        self._plan, self._read = plan, read
        self._decided = [False] * plan.size
        self._early: list[dict[int, int]] = [{} for _ in range(plan.size)]
        """Numbers of trials by place of the first one, for parts behind a gap."""

    def add(self, part: Part, trials: Trials) -> None:
        """Add a part, and count all that is now without a gap."""
        early, cell = self._early[part.cell], self.cells[part.cell]
        if self._decided[part.cell]:
            return
        if part.first != cell.trials:
            early[part.first] = part.trials
            return
        self._count(part, trials)
        while not self._decided[part.cell] and (count := early.pop(cell.trials, None)) is not None:
            following = Part(part.cell, cell.trials, count)
            self._count(following, self._read(following))

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

    def total(self) -> dict[str, int]:
        """Total counts over all cells."""
        return {name: sum(each.counted[name] for each in self.cells) for name in COUNTED}

    def gaps(self, cell: int) -> deque[tuple[int, int]]:
        """First and end of the ranges of trials of a cell that are still to be played."""
        found: deque[tuple[int, int]] = deque()
        at = self.cells[cell].trials
        for first, count in sorted(self._early[cell].items()):
            if first > at:
                found.append((at, first))
            at = first + count
        if at < self._plan.spec.trials:
            found.append((at, self._plan.spec.trials))
        return found


class Tasks:
    """Tasks of about TASK_S each, whatever a trial takes.

    Cells that ``[stop]`` may end progress together; others are played one after the other.
    """

    def __init__(self, plan: Plan, tally: Tally, slots: int) -> None:
        self._tally, self._slots, self._stops = tally, slots, plan.spec.stop is not None
        self._chunk = plan.spec.chunk if self._stops else MOST_TRIALS
        """Least number of trials of a cell in a task: large parts are stored better, small ones end a cell earlier."""
        self._cells = deque(
            (cell, gaps) for cell in range(plan.size) if not tally.has_ended(cell) and (gaps := tally.gaps(cell))
        )
        self._open = sum(end - first for _, gaps in self._cells for first, end in gaps)
        self._trial_s: float | None = None

    def note(self, trials: int, seconds: float) -> None:
        """Take note of the duration of a task."""
        self._trial_s = max(seconds / trials, 1e-6)

    def __iter__(self) -> Iterator[Task]:
        """Yield tasks; the trials still to be played are evaluated at each step."""
        while task := self._next():
            yield task

    def _next(self) -> Task:
        wanted, parts, count = self._wanted(), [], 0
        while self._cells and count < wanted:
            cell, gaps = self._cells.popleft()
            if self._tally.has_ended(cell):
                continue
            first, end = gaps.popleft()
            share = max(self._chunk, wanted // (len(self._cells) + 1))
            part = Part(cell, first, min(end - first, share, wanted - count, MOST_TRIALS))
            parts.append(part)
            count += part.trials
            if first + part.trials < end:
                gaps.appendleft((first + part.trials, end))
            if gaps and self._stops:
                self._cells.append((cell, gaps))
            elif gaps:
                self._cells.appendleft((cell, gaps))
        self._open -= count
        return tuple(parts)

    def _wanted(self) -> int:
        """Number of trials of the next task."""
        if self._trial_s is None:
            return FIRST_N
        share = max(self._open / (2 * self._slots), SHORTEST_S / self._trial_s)
        return max(1, int(min(TASK_S / self._trial_s, share, MOST_TRIALS)))
