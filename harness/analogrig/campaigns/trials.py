"""Trials: what a campaign keeps of each run, as a record and as columns of many records.

Columns are one structured array (``Trials``), in which trials are stored, counted and compared.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.verdict import ChangeVerdict, Verdict
from analogrig.plant import MAX_SAMPLES
from analogrig.run import Run

OUTCOMES = ("passed", "failed", "inconclusive")
PASSED, FAILED, INCONCLUSIVE = range(3)

EXISTS, MISSED, LATE = 1, 2, 4
"""Bits of the column ``change``."""

MOST_TRIALS = 20_000
"""Largest number of trials in one part."""

MOST_ERRORS = 3
"""Estimated parameters whose errors are kept."""

_MOST_BYTES = 16_000_000
"""Largest size of a column of one part."""

_MOST_REASON = 300
"""Most characters of a reason."""

_NONE = -1

COLUMNS = (
    "outcome",  # index of OUTCOMES
    "samples",
    "armed",  # samples in which the trigger was armed
    "false_alarms",
    "change",  # (c,) bits EXISTS, MISSED, LATE; 0: the trial ended before this change
    "latency_n",  # (c,) detection delays in samples; -1: not detected
    "bound_n",  # (c,) information bounds; -1: not detectable
    "error",  # (MOST_ERRORS,) relative errors of the last estimates; NaN: none
    "theta",  # first 64 bits of the hash of all estimates; 0: nothing was played
    "drawn",  # (axes,) drawn values, rounded
    "why",  # first reason of a trial that has not passed; empty otherwise
)
"""Names of the columns of ``Trials``, and of those of the store. c is the number of changes."""

_PER_CHANGE = frozenset({"change", "latency_n", "bound_n"})

Trials: TypeAlias = NDArray[np.void]
"""Array (n,) with the fields COLUMNS."""


class Change(NamedTuple):
    """Change of the plant, and its detection; samples are relative to the change."""

    latency_n: int | None
    bound_n: int | None
    """Information bound; None: the change was not detectable."""
    missed: bool
    late: bool

    @classmethod
    def of(cls, change: ChangeVerdict) -> Self:
        """Change at its likeliest instant; one that was not found in the samples is recorded as not detectable."""
        if change.unseen:
            return cls(None, None, missed=False, late=False)
        return cls(change.latency_n, change.bound_n, change.missed, change.late)


class Trial(NamedTuple):
    """Record of one trial."""

    seed: int
    outcome: str
    """One of OUTCOMES."""
    why: str = ""
    """First reason why the trial has not passed."""
    samples: int = 0
    armed: int = 0
    """Samples in which the trigger was armed."""
    false_alarms: int = 0
    changes: tuple[Change, ...] = ()
    errors: tuple[float, ...] = ()
    """Relative errors of the last estimates; empty if there are none, or one is non-finite."""
    theta: int = 0
    """First 64 bits of the hash of all estimates, which identifies the build."""
    drawn: Mapping[str, float] = {}
    """Drawn values, by axis."""

    @classmethod
    def of(cls, run: Run, verdict: Verdict, drawn: Mapping[str, float] | None = None) -> Self:
        """Record of a run."""
        errors = tuple(verdict.estimates[-1].error.values()) if verdict.estimates else ()
        return cls(
            seed=run.conditions.seed,
            outcome=verdict.outcome if verdict.valid else "inconclusive",
            why=verdict.reasons[0] if verdict.reasons else "",
            samples=run.samples,
            armed=verdict.armed_n,
            false_alarms=len(verdict.false_alarms),
            changes=tuple(map(Change.of, verdict.changes)),
            errors=errors if all(map(math.isfinite, errors)) else (),
            theta=int((verdict.theta_hash or verdict.alarm_hash)[:16] or "0", 16),
            drawn=drawn or {},
        )

    @property
    def is_valid(self) -> bool:
        return self.outcome != "inconclusive"


def _fields(changes: int, axes: int) -> np.dtype[np.void]:
    """Type of an element of ``Trials``."""
    kinds = ("u1", "<u4", "<u4", "<u4", "u1", "<i4", "<i4", "<f4", "<u8", "<f4", object)
    shapes = ((), (), (), (), (changes,), (changes,), (changes,), (MOST_ERRORS,), (), (axes,), ())
    return np.dtype(list(zip(COLUMNS, kinds, shapes, strict=True)))


def _blank(count: int, changes: int, axes: int) -> Trials:
    """So many trials without any result."""
    trials = np.zeros(count, _fields(changes, axes))
    trials["latency_n"] = trials["bound_n"] = _NONE
    trials["error"], trials["why"] = np.nan, ""
    return trials


def columns_of(records: Sequence[Trial], axes: Sequence[str] = ()) -> Trials:
    """Columns of records; ``axes``: names of the drawn values."""
    trials = _blank(len(records), max((len(each.changes) for each in records), default=0), len(axes))
    change, latency_n, bound_n, error = (trials[name] for name in ("change", "latency_n", "bound_n", "error"))
    for i, each in enumerate(records):
        for k, one in enumerate(each.changes):
            change[i, k] = EXISTS | MISSED * one.missed | LATE * one.late
            latency_n[i, k] = _NONE if one.latency_n is None else one.latency_n
            bound_n[i, k] = _NONE if one.bound_n is None else one.bound_n
    trials["outcome"] = [OUTCOMES.index(each.outcome) for each in records]
    trials["why"] = [" ".join(each.why.split())[:_MOST_REASON] for each in records]
    for name in ("samples", "armed", "false_alarms", "theta"):
        trials[name] = [getattr(each, name) for each in records]
    if len(records):
        trials["drawn"] = [[each.drawn.get(axis, 0.0) for axis in axes] for each in records]
        with np.errstate(over="ignore"):  # an error beyond float32 is none
            error[:] = [[*each.errors, *[math.nan] * MOST_ERRORS][:MOST_ERRORS] for each in records]
    error[~np.isfinite(error[:, 0])] = np.nan
    return trials


def is_valid(trials: Trials) -> NDArray[np.bool_]:
    """(n,): True for trials that are not inconclusive."""
    return np.asarray(trials["outcome"] != INCONCLUSIVE)


def join(parts: Sequence[Trials]) -> Trials:
    """Trials of all parts, in order. In a part with fewer changes than another, the rest of them never came."""
    widths = [part["change"].shape[1] for part in parts]
    trials = _blank(sum(map(len, parts)), max(widths, default=0), parts[0]["drawn"].shape[1] if parts else 0)
    end = 0
    for part, width in zip(parts, widths, strict=True):
        begin, end = end, end + len(part)
        for name in COLUMNS:
            column = trials[name][begin:end]
            (column[:, :width] if name in _PER_CHANGE else column)[:] = part[name]
    return trials


def encode(trials: Trials) -> tuple[bytes, ...]:
    """Columns as zlib streams of little-endian numbers, trial by trial, in the order of COLUMNS.

    ``why`` has one line of UTF-8 for each trial that has not passed.
    """
    why = "\n".join(trials["why"][trials["outcome"] != PASSED])
    numbers = (trials[name].tobytes() for name in COLUMNS[:-1])
    return tuple(map(zlib.compress, (*numbers, why.encode("utf-8", "replace"))))


def decode(count: int, columns: Sequence[bytes], axes: int) -> Trials:
    """Trials of ``encode``; ``axes``: number of drawn axes.

    :raises ValueError: no campaign writes such columns.
    """
    streams = dict(zip(COLUMNS, map(_inflate, columns), strict=True))
    width, rest = divmod(len(streams["change"]), count)
    fields = _fields(width, axes)
    if rest or any(len(streams[name]) != count * fields[name].itemsize for name in COLUMNS[:-1]):
        raise ValueError("columns of different lengths")
    trials = _blank(count, width, axes)
    for name in COLUMNS[:-1]:
        trials[name] = np.frombuffer(streams[name], trials.dtype[name].base).reshape(trials[name].shape)
    lines = streams["why"]
    reasons = lines.decode().split("\n") if lines.count(b"\n") < count else []
    not_passed = np.flatnonzero(trials["outcome"] != PASSED)
    if len(reasons) != max(1, len(not_passed)):
        raise ValueError("reasons of other trials")
    trials["why"][not_passed] = reasons[: len(not_passed)]
    _check(trials)
    return trials


def _check(trials: Trials) -> None:
    """:raises ValueError: the values are impossible."""
    if trials["outcome"].max(initial=0) > INCONCLUSIVE:
        raise ValueError("a trial without an outcome")
    counts = np.stack([trials[name] for name in ("false_alarms", "armed", "samples")])
    if (np.diff(counts.astype(np.int64), axis=0) < 0).any() or counts.max(initial=0) > MAX_SAMPLES:
        raise ValueError("counts that cannot be")
    if (trials["change"] > (EXISTS | MISSED | LATE)).any():
        raise ValueError("a change without a result")
    times = np.stack((trials["latency_n"], trials["bound_n"]))
    if ((times < _NONE) | (times > MAX_SAMPLES)).any():
        raise ValueError("a time that cannot be")
    if np.isinf(trials["error"]).any():
        raise ValueError("an infinite error")
    if not np.isfinite(trials["drawn"]).all():
        raise ValueError("drawn values that cannot be")


def _inflate(stream: bytes) -> bytes:
    """:raises ValueError: no zlib stream, or one of too many bytes."""
    decoder = zlib.decompressobj()
    try:
        whole = decoder.decompress(stream, _MOST_BYTES + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(whole) > _MOST_BYTES or not decoder.eof or decoder.unused_data:
        raise ValueError("a column that is no whole zlib stream")
    return whole
