"""What a worker does: play the trials of one chunk, and say of each what came of it."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.campaign import build
from harness.campaign.plan import Case, Cell, Chunk, Plan
from harness.campaign.players import Players
from harness.catalogue import SteppedFlag
from harness.errors import ConfigurationError, DeviceError, LinkError, RigError
from harness.exposure import exposure
from harness.run import Run
from harness.trials import Trials
from harness.verdict import TweakVerdict, Verdict, judge, refusals

Row = dict[str, Any]
"""Of one trial, in plain values; see ``row``."""

_players = Players()


def play_chunk(plan: str, chunk: tuple[int, int]) -> list[Row]:
    """The rows of a chunk of the plan (``Plan.as_json``): the same in every process on every machine.

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
    """A trial that cannot be played is inconclusive: the next may be none the worse for it."""
    drawn = plan.drawn(seed)
    try:
        run = _players.play(plan.case(cell, seed))
    except (DeviceError, LinkError, RigError) as error:
        return _row(seed, "inconclusive", drawn, why=" ".join(str(error).split()))
    return row(run, judge(run), drawn)


def _change(tweak: TweakVerdict) -> list[int | None]:
    """At its likeliest instant; one that was not found in the samples is as one that nobody could see."""
    if tweak.unseen:
        return [None, None, False, False]
    return [tweak.latency_n, tweak.bound_n, tweak.missed, tweak.late]


def row(run: Run, verdict: Verdict, drawn: Mapping[str, float] | None = None) -> Row:
    """What is kept of a trial.

    ``armed``: the samples in which the trigger was armed. ``changes``: for each [latency or null, bound or null,
    missed, late], in samples. ``errors``: relative errors of M, B, K at the end, or none. ``theta``: the first digits
    of the hash of all estimates, which tells builds apart. ``why``: the first reason why it has not passed. A trial
    that shows nothing, since the trigger was never armed, is inconclusive.
    """
    shown, outcome, reasons = exposure(run), verdict.outcome, verdict.reasons
    if outcome == "passed" and not shown.armed and verdict.ceiling is not None:
        outcome, reasons = "inconclusive", (shown.no_evidence,)
    return _row(
        run.conditions.seed,
        outcome,
        drawn,
        why=reasons[0] if reasons else "",
        samples=run.samples,
        armed=shown.armed,
        false_alarms=len(verdict.false_alarms),
        changes=[_change(tweak) for tweak in verdict.tweaks],
        errors=_errors(verdict),
        theta=verdict.theta_hash[:16],
    )


def _errors(verdict: Verdict) -> list[float]:
    """Of the last estimate; one of numbers beyond all measure is none."""
    found = list(verdict.estimates[-1].error.values()) if verdict.estimates else []
    return found if all(map(math.isfinite, found)) else []


_NOTHING: Row = {"samples": 0, "armed": 0, "false_alarms": 0, "changes": [], "errors": [], "theta": ""}


def _row(seed: int, outcome: str, drawn: Mapping[str, float] | None, *, why: str, **found: Any) -> Row:
    said = {"drawn": dict(drawn or {}), "why": why}
    return {"seed": seed, "outcome": outcome, **_NOTHING, **found} | {key: each for key, each in said.items() if each}


@dataclass(frozen=True)
class Count:
    """The alarms of a trial in which nothing changes."""

    alarms: int
    armed: int
    """Samples in which the trigger was armed."""
    fault: str = ""
    """Why the trial is no evidence."""


def count_alarms(case: Case) -> Count:
    """As fast as it goes.

    :raises ConfigurationError: it cannot be played.
    :raises LinkError, DeviceError, RigError: the device or the rig cannot be had.
    """
    trials = _players.trials(case)
    return _counted_on_bench(case) if trials is None else _counted(trials, case)


def _counted(trials: Trials, case: Case) -> Count:
    alarms, flags, shown = trials.exposed(case.scenario, case.seed)
    missing, refused = (int(np.count_nonzero(flags & flag)) for flag in (SteppedFlag.MISSING, SteppedFlag.REFUSED))
    invalid = [*case.scenario.caveats, *refusals(refused), *case.scenario.expect.gaps(len(flags), missing)]
    return _count(len(alarms), shown.armed, case.seed, [*invalid, shown.no_evidence])


def _counted_on_bench(case: Case) -> Count:
    run = _players.play(case)
    verdict, shown = judge(run), exposure(run)
    invalid = () if verdict.valid else verdict.reasons
    return _count(len(run.alarm_index), shown.armed, case.seed, [*invalid, shown.no_evidence])


def _count(alarms: int, armed: int, seed: int, faults: Sequence[str]) -> Count:
    return Count(alarms, armed, next((f"seed {seed}: {fault}" for fault in faults if fault), ""))


@functools.lru_cache(maxsize=2)
def _plan(text: str) -> tuple[Plan, list[Cell]]:
    plan = Plan.from_json(text)
    build.check_analogrig(plan.analogrig)
    return plan, plan.cells()


def close_devices() -> None:
    """Let go of the devices and rigs that this thread's chunks have opened."""
    _players.close()


def samples_of(rows: list[Row]) -> Mapping[str, int]:
    """Counts of valid trials: ``samples``, those in which the trigger was ``armed``, ``false_alarms``, ``visible``
    changes, ``missed`` ones."""
    valid = [each for each in rows if each["outcome"] != "inconclusive"]
    changes = [change for each in valid for change in each["changes"] if change[1] is not None]
    return {
        "samples": sum(each["samples"] for each in valid),
        "armed": sum(each["armed"] for each in valid),
        "false_alarms": sum(each["false_alarms"] for each in valid),
        "visible": len(changes),
        "missed": sum(change[2] for change in changes),
    }
