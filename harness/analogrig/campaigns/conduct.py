"""Campaign execution: many trials, played by the available workers, to one store.

The aggregated results are a function of the plan alone. The number of workers, the order of their work, the division
into tasks, and interruptions do not change a byte of them.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

from analogrig.campaigns.plan import Part, Plan, device_files, device_of
from analogrig.campaigns.plays import PlayedTask, close_devices, play_task
from analogrig.campaigns.store import NotAStoreError, Store
from analogrig.campaigns.tally import Results, Tally
from analogrig.campaigns.trials import MOST_TRIALS, decode
from analogrig.campaigns.workers import CampaignWorkers
from analogrig.errors import ConfigurationError, DeviceError, LinkError
from analogrig.identity import Identity

Task = tuple[Part, ...]

FIRST_N = 10
"""Number of trials of the first tasks, before the duration of a trial is known."""

TASK_S, SHORTEST_S = 5.0, 0.2
"""Duration of a task in seconds, and of the last ones, which are made shorter so that all workers end together."""


def conduct(
    plan: Plan,
    workers: CampaignWorkers,
    out: Path,
    progress: Callable[[Tally], None] | None = None,
    command: Identity | None = None,
) -> Results:
    """Play the plan to the store ``out``. After any interruption, another call resumes it.

    :param command: identity of this command, which is kept in the store if anything is left to play.
    :raises ConfigurationError: ``out`` holds something else, or a device refuses its configuration.
    :raises RecordingError: ``out`` cannot be written.
    :raises WorkerError: the workers cannot be reached, or keep dying over a task.
    """
    if (ended := ended_results(plan, out)) is not None:
        return ended
    with Store.write(out, plan) as store:
        if store.is_ended:  # by another process meanwhile
            return Results.load(store)
        if command is not None:
            store.add_command(command)
        workers.supply(device_files(plan.devices))
        tally = Tally(plan, store)
        tasks = Tasks(plan, tally, workers.slots)
        work: Callable[[Task], PlayedTask] = functools.partial(play_task, plan.as_json())
        try:
            for _, played in workers.play(work, iter(tasks)):
                store.add(played.parts)
                for part, columns in played.parts:
                    tally.add(part, decode(part.trials, columns, len(plan.spec.draw)))
                tasks.note(sum(part.trials for part, _ in played.parts), played.seconds)
                if progress is not None:
                    progress(tally)
        finally:
            close_devices()
        results = Results(plan, tally.cells, tally.distribution, store.commands())
        counted = [each.trials for each in tally.cells]
        store.finish(counted, [{**cell.values, **asdict(summary)} for cell, summary in results.cells])
    return results


def ended_results(plan: Plan, out: Path) -> Results | None:
    """Results of the plan if its campaign has ended; None if there is something left to play.

    :raises ConfigurationError: ``out`` holds something else.
    :raises RecordingError: it cannot be read, or is damaged.
    """
    if not out.exists():
        return None
    try:
        with Store.read(out) as store:
            if not store.is_ended:
                return None
            results = Results.load(store)
    except NotAStoreError as error:
        raise ConfigurationError(f"{error}: choose another --out, or remove it") from error
    plan.check_same(results.plan, f"{out}: holds another campaign")
    return results


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
        wanted, parts, count = FIRST_N, [], 0
        if self._trial_s is not None:
            share = max(self._open / (2 * self._slots), SHORTEST_S / self._trial_s)
            wanted = max(1, int(min(TASK_S / self._trial_s, share, MOST_TRIALS)))
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
