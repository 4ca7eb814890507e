"""Work of a worker: plays, each on the bench of its rig and device, which stay open for the next one."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import operator
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from analogrig.bench import Bench, raise_if_interrupted
from analogrig.campaigns import builds
from analogrig.campaigns.plan import Case, Cell, Part, Plan, device_of, open_table
from analogrig.campaigns.together import DirectBench, can_be_direct, direct_bench, judge_all
from analogrig.campaigns.trials import Trial, columns_of, encode
from analogrig.devices.device import Device
from analogrig.errors import AnalogrigError, ConfigurationError, DeviceError, LinkError, RigError
from analogrig.judging.exposure import exposure, exposures, until_latched
from analogrig.judging.verdict import invalid_reasons
from analogrig.rigs.rig import Rig
from analogrig.run import Run

MOST_KEPT = 64
"""Largest number of rigs, and of devices, that are open at once."""

BATCH_SAMPLES = 1 << 16
"""Samples of trials that are judged together; they fit in the cache."""

Kept = TypeVar("Kept")


class _Cache(Generic[Kept]):
    """The most recently opened rigs or devices, by plain values that describe them: a worker gets cells in turn."""

    def __init__(self, opened: Callable[..., AbstractContextManager[Kept]]) -> None:
        self._opened = opened
        self._kept: dict[str, tuple[Kept, ExitStack]] = {}
        self._last: tuple[tuple[Any, ...], Kept] | None = None
        """Object of the last ``get``: trials of a cell share their tables, which take long to write."""

    def get(self, *described: Any) -> Kept:
        """Return the open object of this description; open it first if necessary."""
        if self._last is not None and all(map(operator.is_, self._last[0], described)):
            return self._last[1]
        key = json.dumps(described, sort_keys=True)
        if key not in self._kept:
            while len(self._kept) >= MOST_KEPT:
                self._close(next(iter(self._kept)))
            with ExitStack() as stack:
                self._kept[key] = stack.enter_context(self._opened(*described)), stack.pop_all()
        self._last = described, self._kept[key][0]
        return self._last[1]

    def drop(self, *described: Any) -> None:
        """Close the object of this description, so that the next play reopens it."""
        self._close(json.dumps(described, sort_keys=True))

    def close(self) -> None:
        while self._kept:
            self._close(next(iter(self._kept)))

    def _close(self, key: str) -> None:
        self._last = None
        if key in self._kept:
            with contextlib.suppress(AnalogrigError):
                self._kept.pop(key)[1].close()


class _Benches(threading.local):
    """Open rigs, devices and direct benches of one thread."""

    def __init__(self) -> None:
        self._rigs: _Cache[Rig] = _Cache(open_table)
        self._devices: _Cache[Device] = _Cache(lambda table: device_of(table).connect())
        self._direct: _Cache[DirectBench | None] = _Cache(self._direct_bench)

    def _direct_bench(
        self,
        rig: Any,
        device: Any,
        alarms_only: bool,  # noqa: FBT001 - part of the key
    ) -> AbstractContextManager[DirectBench | None]:
        opened, planned = self._rigs.get(rig), device_of(device)
        if not can_be_direct(opened, planned):
            return contextlib.nullcontext()
        return contextlib.nullcontext(direct_bench(opened, planned, alarms_only=alarms_only))

    def play(self, case: Case, *, alarms_only: bool = False) -> Run:
        """Play a case, without a line where that makes no difference. After an invalid run the device is reopened.

        :param alarms_only: omit the estimates where that makes it faster.
        :raises ConfigurationError: the case cannot be played, the device refuses its configuration, or is another build
            than was planned.
        :raises LinkError, DeviceError, RigError: the device or the rig cannot be had.
        :raises KeyboardInterrupt: the user ended it.
        """
        bench = self._direct.get(case.rig, case.device, alarms_only)
        try:
            used = bench or Bench(self._rigs.get(case.rig), self._devices.get(case.device))
            run = used.play(case.scenario, case.seed)
        except BaseException as error:
            self._devices.drop(case.device)
            if isinstance(error, RigError):
                self._rigs.drop(case.rig)
            raise
        if run.conditions.faults:
            self._devices.drop(case.device)
        return raise_if_interrupted(run)

    def play_together(self, case: Case, seeds: Sequence[int]) -> list[Run]:
        """Runs of a case with these seeds instead of its own; none where ``play`` must play them one by one."""
        bench = self._direct.get(case.rig, case.device, False)
        with contextlib.suppress(AnalogrigError):
            return [] if bench is None else bench.play_all(case.scenario, seeds)
        return []

    def close(self) -> None:
        for kept in (self._direct, self._devices, self._rigs):
            kept.close()


_benches = _Benches()


class PlayedTask(NamedTuple):
    """Result of a task, as a worker returns it."""

    parts: list[tuple[Part, tuple[bytes, ...]]]
    """Parts, each with the columns of its trials (``trials.encode``)."""
    seconds: float
    """Time that they took."""


def play_task(plan: str, task: Sequence[Part]) -> PlayedTask:
    """Play the parts of a task of the plan (``Plan.as_json``): the same trials in every process on every machine.

    :raises ConfigurationError: the build here is another, or a device refuses its configuration; names cell and seed.
    """
    start_s = time.monotonic()
    planned, _ = _plan(plan)
    axes = list(planned.spec.draw)
    parts = [(part, encode(columns_of(play_part(plan, part), axes))) for part in task]
    return PlayedTask(parts, time.monotonic() - start_s)


def play_part(plan: str, part: Part) -> list[Trial]:
    """Trials of a part; errors as ``play_task``."""
    planned, _ = _plan(plan)
    seeds, step = planned.seeds(part), max(1, BATCH_SAMPLES // planned.samples)
    batches = (seeds[first : first + step] for first in range(0, len(seeds), step))
    return [trial for batch in batches for trial in _play_batch(plan, part.cell, batch)]


def _play_batch(plan: str, cell: int, seeds: Sequence[int]) -> Iterator[Trial]:
    """Some trials, played together where they can be. One that cannot be played is inconclusive."""
    drawn = [_plan(plan)[0].draw(seed) for seed in seeds]
    played: Sequence[Run | str] = [] if any(drawn) else _benches.play_together(_fixed_case(plan, cell), seeds)
    played = played or [_play_trial(plan, cell, *each) for each in zip(seeds, drawn, strict=True)]
    verdicts = iter(judge_all(each for each in played if isinstance(each, Run)))
    for each, seed, values in zip(played, seeds, drawn, strict=True):
        if isinstance(each, Run):
            yield Trial.of(each, next(verdicts), values)
        else:
            yield Trial(seed, "inconclusive", each, drawn=values)


def _play_trial(plan: str, cell: int, seed: int, drawn: Mapping[str, float]) -> Run | str:
    """Run of a trial; the reason if it cannot be played. The next one may succeed."""
    planned, cells = _plan(plan)
    try:
        case = planned.case(cells[cell], seed, drawn) if drawn else _fixed_case(plan, cell)
        return _benches.play(dataclasses.replace(case, seed=seed))
    except (DeviceError, LinkError, RigError) as error:
        return " ".join(str(error).split())
    except ConfigurationError as error:
        raise ConfigurationError(f"campaign {planned.spec.name}, cell {cell}, seed {seed}: {error}") from error


@functools.lru_cache(maxsize=MOST_KEPT)
def _fixed_case(plan: str, cell: int) -> Case:
    """Case of a cell without drawn values; its trials differ in the seed alone."""
    planned, cells = _plan(plan)
    return planned.case(cells[cell], planned.spec.first_seed, {})


@dataclass(frozen=True)
class Count:
    """Alarms and exposure of a trial in which nothing changes."""

    alarms: int
    armed: int
    """Samples in which the trigger was armed."""
    fault: str = ""
    """Reason why the trial is no evidence; empty if it is."""


def count_alarms(case: Case, seeds: Sequence[int]) -> list[Count]:
    """Count the alarms of a case with each seed by the fastest available way; errors as ``_Benches.play``."""
    runs = _benches.play_together(case, seeds) if len(seeds) > 1 else []
    runs = runs or [_benches.play(dataclasses.replace(case, seed=seed), alarms_only=True) for seed in seeds]
    alike = runs[0].records == runs[-1].records
    shown = exposures(runs) if alike else [exposure(run) for run in runs]
    counts = []
    for seed, run, each in zip(seeds, runs, shown, strict=True):
        faults = invalid_reasons(run, each, case.scenario.expect)
        alarms = len(until_latched(run).alarm_index)
        counts.append(Count(alarms, each.armed, f"seed {seed}: {faults[0]}" if faults else ""))
    return counts


@functools.lru_cache(maxsize=2)
def _plan(text: str) -> tuple[Plan, list[Cell]]:
    plan = Plan.from_json(text)
    builds.check_analogrig(plan.analogrig)
    return plan, plan.cells()


def close_devices() -> None:
    """Close the devices and rigs that this thread's chunks have opened."""
    _benches.close()
