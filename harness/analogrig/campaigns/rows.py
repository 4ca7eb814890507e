"""Rows: the record of each trial in plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from analogrig.judging.verdict import ChangeVerdict, Verdict
from analogrig.run import Run

Row = dict[str, Any]
"""Record of one trial, in plain values; see ``row``."""


class Change(NamedTuple):
    """Change of the plant, and its detection; samples are relative to the change."""

    latency_n: int | None
    bound_n: int | None
    """Information bound; None: the change was not detectable."""
    missed: bool
    late: bool

    @classmethod
    def of(cls, change: ChangeVerdict) -> Change:
        """Change at its likeliest instant; one that was not found in the samples is recorded as not detectable."""
        if change.unseen:
            return cls(None, None, missed=False, late=False)
        return cls(change.latency_n, change.bound_n, change.missed, change.late)


def changes(row: Row) -> list[Change]:
    """Changes of a trial."""
    return [Change(*each) for each in row["changes"]]


def row(run: Run, verdict: Verdict, drawn: Mapping[str, float] | None = None) -> Row:
    """Record of a trial.

    ``armed``: the samples in which the trigger was armed. ``changes``: the fields of ``Change`` of each. ``errors``:
    relative errors of the estimates at the end, or none. ``theta``: the first digits of the hash of all estimates,
    which identifies the build. ``why``: the first reason why the trial has not passed.
    """
    return _row(
        run.conditions.seed,
        verdict.outcome if verdict.valid else "inconclusive",
        drawn,
        why=verdict.reasons[0] if verdict.reasons else "",
        samples=run.samples,
        armed=verdict.armed_n,
        false_alarms=len(verdict.false_alarms),
        changes=[list(Change.of(change)) for change in verdict.changes],
        errors=_errors(verdict),
        theta=(verdict.theta_hash or verdict.alarm_hash)[:16],
    )


def row_of_none(seed: int, drawn: Mapping[str, float], why: str) -> Row:
    """Record of a trial that could not be played."""
    return _row(seed, "inconclusive", drawn, why=why)


_NOTHING: Row = {"samples": 0, "armed": 0, "false_alarms": 0, "changes": [], "errors": [], "theta": ""}


def _row(seed: int, outcome: str, drawn: Mapping[str, float] | None, *, why: str, **found: Any) -> Row:
    said = {"drawn": dict(drawn or {}), "why": why}
    return {"seed": seed, "outcome": outcome, **_NOTHING, **found} | {key: each for key, each in said.items() if each}


def _errors(verdict: Verdict) -> list[float]:
    """Relative errors of the last estimate; empty if there is none or one is non-finite."""
    found = list(verdict.estimates[-1].error.values()) if verdict.estimates else []
    return found if all(map(math.isfinite, found)) else []


def is_valid(row: Row) -> bool:
    """True if the trial is not inconclusive."""
    return bool(row["outcome"] != "inconclusive")
