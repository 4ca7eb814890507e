"""Work of a worker: play the trials of one chunk, and return a row for each."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from analogrig.campaigns import build
from analogrig.campaigns.plan import Case, Cell, Chunk, Plan
from analogrig.campaigns.players import Players
from analogrig.campaigns.rows import Row, row, row_of_none
from analogrig.campaigns.trials import Trials
from analogrig.errors import ConfigurationError, DeviceError, LinkError, RigError
from analogrig.judging.exposure import Exposure, exposure
from analogrig.judging.verdict import evidence_gaps, judge

_players = Players()


def play_chunk(plan: str, chunk: tuple[int, int]) -> list[Row]:
    """Rows of a chunk of the plan (``Plan.as_json``): the same in every process on every machine.

    :raises ConfigurationError: the build here is another, or a device refuses its configuration; names cell and seed.
    """
    planned, cells = _plan(plan)
    numbered = Chunk(chunk)
    rows = []
    for seed in planned.seeds(numbered):
        try:
            rows.append(_played(planned, cells[numbered.cell], seed))
        except ConfigurationError as error:
            raise ConfigurationError(
                f"campaign {planned.spec.name}, cell {numbered.cell}, seed {seed}: {error}"
            ) from error
    return rows


def _played(plan: Plan, cell: Cell, seed: int) -> Row:
    """Row of a trial. One that cannot be played is inconclusive: the next one may succeed."""
    drawn = plan.drawn(seed)
    try:
        run = _players.play(plan.case(cell, seed))
    except (DeviceError, LinkError, RigError) as error:
        return row_of_none(seed, drawn, " ".join(str(error).split()))
    return row(run, judge(run), drawn)


@dataclass(frozen=True)
class Count:
    """Alarms and exposure of a trial in which nothing changes."""

    alarms: int
    armed: int
    """Samples in which the trigger was armed."""
    fault: str = ""
    """Reason why the trial is no evidence; empty if it is."""


def count_alarms(case: Case) -> Count:
    """Count the alarms of a case by the fastest available way.

    :raises ConfigurationError: it cannot be played.
    :raises LinkError, DeviceError, RigError: the device or the rig cannot be had.
    """
    trials = _players.trials(case)
    return _counted_on_bench(case) if trials is None else _counted(trials, case)


def _counted(trials: Trials, case: Case) -> Count:
    seen, scenario = trials.watched(case.scenario, case.seed), case.scenario
    reasons = evidence_gaps(seen.exposure, scenario.expect, refused=seen.refused, missing=seen.missing)
    return _count(len(seen.alarms), seen.exposure, case.seed, [*scenario.caveats, *reasons])


def _counted_on_bench(case: Case) -> Count:
    run = _players.play(case)
    verdict = judge(run)
    return _count(len(run.alarm_index), exposure(run), case.seed, () if verdict.valid else verdict.reasons)


def _count(alarms: int, shown: Exposure, seed: int, faults: Sequence[str]) -> Count:
    return Count(alarms, shown.armed, f"seed {seed}: {faults[0]}" if faults else "")


@functools.lru_cache(maxsize=2)
def _plan(text: str) -> tuple[Plan, list[Cell]]:
    plan = Plan.from_json(text)
    build.check_analogrig(plan.analogrig)
    return plan, plan.cells()


def close_devices() -> None:
    """Close the devices and rigs that this thread's chunks have opened."""
    _players.close()
