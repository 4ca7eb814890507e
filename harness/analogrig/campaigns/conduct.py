"""Campaign execution: many trials, played by the available workers, to one store.

The aggregated results are a function of the plan alone. The number of workers, the order of their work, the division
into tasks, and interruptions do not change a byte of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from analogrig.campaigns.plan import Plan, device_files, device_of
from analogrig.campaigns.plays import PlayedTask, close_devices, play_task
from analogrig.campaigns.results import Results, load_ended, tally_of
from analogrig.campaigns.store import NotAStoreError, Store
from analogrig.campaigns.tally import Tally, Task, Tasks
from analogrig.campaigns.trials import COLUMNS, Trials
from analogrig.campaigns.workers import CampaignWorkers
from analogrig.errors import ConfigurationError, DeviceError, LinkError
from analogrig.identity import Identity


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
            return load_ended(store)
        if command is not None:
            store.add_command(command)
        tally = tally_of(store, plan)
        try:
            for trials in _play(plan, workers, store, tally):
                if progress is not None and trials:
                    progress(tally)
        finally:
            close_devices()
        results = Results.of(plan, tally, store.commands())
        counted = [each.trials for each in tally.cells]
        store.finish(plan, counted, [{**cell.values, **asdict(summary)} for cell, summary in results.cells])
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
            results = load_ended(store)
    except NotAStoreError as error:
        raise ConfigurationError(f"{error}: choose another --out, or remove it") from error
    plan.check_same(results.plan.as_plain(), f"{out}: holds another campaign")
    return results


def _play(plan: Plan, workers: CampaignWorkers, store: Store, tally: Tally) -> Iterator[int]:
    """Play what is left; yield the number of trials of each task that has been stored and counted."""
    workers.supply(device_files(plan.devices))
    tasks, axes = Tasks(plan, tally, workers.slots), len(plan.spec.draw)
    work: Callable[[Task], PlayedTask] = functools.partial(play_task, plan.as_json())
    for _, played in workers.play(work, iter(tasks)):
        store.add(plan, played.parts)
        count = 0
        for part, columns in played.parts:
            named: Any = dict(zip(COLUMNS, columns, strict=True))
            tally.add(part, Trials.decode(part.trials, named, axes))
            count += part.trials
        tasks.note(count, played.seconds)
        yield count


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
