"""Rows: the record of each trial in plain values, and counts over many of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from analogrig.config import MOST_NUMBER
from analogrig.judging.bursts import BURST, ConfidenceSequence
from analogrig.judging.exposure import exposure
from analogrig.judging.verdict import ChangeVerdict, Verdict
from analogrig.plant import MAX_SAMPLES, PARAMETERS
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
    def of(cls, tweak: ChangeVerdict) -> Change:
        """Change at its likeliest instant; one that was not found in the samples is recorded as not detectable."""
        if tweak.unseen:
            return cls(None, None, missed=False, late=False)
        return cls(tweak.latency_n, tweak.bound_n, tweak.missed, tweak.late)


def changes(row: Row) -> list[Change]:
    """Changes of a trial."""
    return [Change(*each) for each in row["changes"]]


def row(run: Run, verdict: Verdict, drawn: Mapping[str, float] | None = None) -> Row:
    """Record of a trial.

    ``armed``: the samples in which the trigger was armed. ``changes``: the fields of ``Change`` of each. ``errors``:
    relative errors of M, B, K at the end, or none. ``theta``: the first digits of the hash of all estimates, which
    identifies the build. ``why``: the first reason why the trial has not passed.
    """
    return _row(
        run.conditions.seed,
        verdict.outcome,
        drawn,
        why=verdict.reasons[0] if verdict.reasons else "",
        samples=run.samples,
        armed=exposure(run).armed,
        false_alarms=len(verdict.false_alarms),
        changes=[list(Change.of(tweak)) for tweak in verdict.tweaks],
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


def check_rows(rows: Sequence[Any], seeds: range) -> None:
    """Check rows from a file.

    :raises ValueError, TypeError, LookupError, AttributeError, OverflowError: one is not of ``row``, or they are of
        other seeds.
    """
    for each in rows:
        _check_row(each)
    if [each["seed"] for each in rows] != list(seeds):
        raise ValueError("rows of other seeds than the plan has")


def _check_row(row: Any) -> None:
    if row["outcome"] not in ("passed", "failed", "inconclusive"):
        raise ValueError("a row without an outcome")
    rising = [row[name] for name in ("false_alarms", "armed", "samples")]
    if not all(type(count) is int and 0 <= count <= MAX_SAMPLES for count in rising) or rising != sorted(rising):
        raise ValueError("a row whose counts cannot be")
    if not all(map(_is_change, changes(row))):
        raise ValueError("a change with values of the wrong types")
    if (
        not isinstance(row["errors"], list)
        or len(row["errors"]) not in (0, len(PARAMETERS))
        or not all(map(_is_number, row["errors"]))
    ):
        raise ValueError(f"errors that are not {len(PARAMETERS)} finite numbers")
    if not all(isinstance(text, str) for text in (row["theta"], row.get("why", ""))):
        raise ValueError("a text that is not a string")
    if not all(map(_is_number, row.get("drawn", {}).values())):
        raise ValueError("a drawn value that is not a finite number")


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and abs(value) <= MOST_NUMBER  # type: ignore[arg-type]


def _is_change(change: Change) -> bool:
    latency_n, bound_n, *flags = change
    times = all(value is None or type(value) is int for value in (latency_n, bound_n))
    return times and all(type(flag) is bool for flag in flags)


# ------------------------------------------------------------------------------------------------------------- of many


@dataclass(frozen=True)
class Rate:
    """Rate of events per exposure; both are keys of ``counts``."""

    events: str
    exposure: str
    unit: str
    """Unit of the exposure, in words."""
    burst: float
    """Mean number of events of a burst that the bounds cover."""

    def sequence(self, counted: Mapping[str, int], confidence: float, burst: float = 1.0) -> ConfidenceSequence:
        """Confidence sequence for the rate; ``burst``: mean number of events of a burst, where more were observed."""
        burst = max(burst, self.burst)
        return ConfidenceSequence(confidence, burst, trials=counted[self.exposure], events=counted[self.events])


RATES = {
    rate.events: rate
    for rate in (Rate("missed", "visible", "changes", 1.0), Rate("false_alarms", "armed", "samples", BURST))
}


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Counts over the valid trials.

    ``samples``, ``armed`` (samples in which the trigger was armed), ``false_alarms``, ``visible`` (detectable changes)
    and ``missed`` (of those).
    """
    sound = list(filter(is_valid, rows))
    visible = [change for each in sound for change in changes(each) if change.bound_n is not None]
    return {
        **{name: sum(each[name] for each in sound) for name in ("samples", "armed", "false_alarms")},
        "visible": len(visible),
        "missed": sum(change.missed for change in visible),
    }


def is_valid(row: Row) -> bool:
    """True if the trial is not inconclusive."""
    return bool(row["outcome"] != "inconclusive")
