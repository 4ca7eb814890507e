"""Trials as columns: the form in which they are stored, counted and compared."""

from __future__ import annotations

import dataclasses
import itertools
import math
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.campaigns.rows import Row, changes
from analogrig.plant import MAX_SAMPLES

OUTCOMES = ("passed", "failed", "inconclusive")
PASSED, FAILED, INCONCLUSIVE = range(3)

EXISTS, MISSED, LATE = 1, 2, 4
"""Bits of ``Trials.change``."""

MOST_TRIALS = 20_000
"""Largest number of trials in one part."""

_MOST_BYTES = 16_000_000
"""Largest size of a column of one part."""

_NONE = -1

_MOST_WHY = 300
"""Most characters of a reason."""

_TYPES = {
    "outcome": "u1",
    "samples": "<u4",
    "armed": "<u4",
    "false_alarms": "<u4",
    "change": "u1",
    "latency_n": "<i4",
    "bound_n": "<i4",
    "error": "<f4",
    "theta": "<u8",
    "drawn": "<f4",
}
"""Types of the columns of numbers."""

_COUNTS = ("outcome", "samples", "armed", "false_alarms", "theta")

_PER_CHANGE = ("change", "latency_n", "bound_n")

COLUMNS = (*_TYPES, "why")
"""Names of all columns, in the order of ``Trials.encode``."""


MOST_ERRORS = 3
"""Estimated parameters whose errors are kept."""

_NO_ERRORS = [math.nan] * MOST_ERRORS


@dataclass(frozen=True, eq=False)
class Trials:
    """n trials of one cell with consecutive seeds; c is the number of changes, d of drawn axes."""

    outcome: NDArray[np.uint8]
    """(n,) indices of OUTCOMES."""
    samples: NDArray[np.uint32]
    armed: NDArray[np.uint32]
    """(n,) samples in which the trigger was armed."""
    false_alarms: NDArray[np.uint32]
    change: NDArray[np.uint8]
    """(n, c) bits EXISTS, MISSED, LATE; 0: the trial ended before this change."""
    latency_n: NDArray[np.int32]
    """(n, c) detection delays in samples; -1: not detected."""
    bound_n: NDArray[np.int32]
    """(n, c) information bounds; -1: not detectable."""
    error: NDArray[np.float32]
    """(n, MOST_ERRORS) relative errors of the last estimates; NaN: none."""
    theta: NDArray[np.uint64]
    """(n,) first 64 bits of the hash of all estimates; 0: nothing was played."""
    drawn: NDArray[np.float32]
    """(n, d) drawn values, rounded."""
    why: tuple[str, ...]
    """First reason of each trial that has not passed; empty otherwise."""

    def __len__(self) -> int:
        return len(self.outcome)

    @property
    def is_valid(self) -> NDArray[np.bool_]:
        """(n,): not inconclusive."""
        return np.asarray(self.outcome != INCONCLUSIVE)

    @classmethod
    def of(cls, rows: Sequence[Row], axes: Sequence[str] = ()) -> Trials:
        """Columns of rows; ``axes``: names of the drawn values."""
        n = len(rows)
        found = [changes(row) for row in rows]
        width = max(map(len, found), default=0)
        change, latency_n, bound_n = np.zeros((n, width), np.uint8), *np.full((2, n, width), _NONE, np.int32)
        for i, each in enumerate(found):
            for k, one in enumerate(each):
                change[i, k] = EXISTS | MISSED * one.missed | LATE * one.late
                latency_n[i, k] = _NONE if one.latency_n is None else one.latency_n
                bound_n[i, k] = _NONE if one.bound_n is None else one.bound_n
        with np.errstate(over="ignore"):  # an error beyond float32 is none
            error = np.array([[*row["errors"], *_NO_ERRORS][:MOST_ERRORS] for row in rows], np.float32)
        error = error.reshape(n, MOST_ERRORS)
        error[~np.isfinite(error[:, 0])] = np.nan
        drawn = np.array([[row.get("drawn", {}).get(axis, 0.0) for axis in axes] for row in rows], np.float32)
        return cls(
            outcome=np.array([OUTCOMES.index(row["outcome"]) for row in rows], np.uint8),
            samples=np.array([row["samples"] for row in rows], np.uint32),
            armed=np.array([row["armed"] for row in rows], np.uint32),
            false_alarms=np.array([row["false_alarms"] for row in rows], np.uint32),
            change=change,
            latency_n=latency_n,
            bound_n=bound_n,
            error=error,
            theta=np.array([int(row["theta"] or "0", 16) for row in rows], np.uint64),
            drawn=drawn.reshape(n, len(axes)),
            why=tuple(" ".join(row.get("why", "").split())[:_MOST_WHY] for row in rows),
        )

    def __getitem__(self, part: slice) -> Trials:
        return Trials(**{field.name: getattr(self, field.name)[part] for field in dataclasses.fields(self)})

    def at(self, places: NDArray[np.int64]) -> Trials:
        """Trials at these places, without their reasons."""
        numbers = {name: getattr(self, name)[places] for name in _TYPES}
        return Trials(**numbers, why=("",) * len(places))

    @classmethod
    def joined(cls, parts: Sequence[Trials]) -> Trials:
        """Trials of all parts, in order; the ends of shorter lists of changes are filled as changes that never came."""
        if not parts:
            return cls.of([])
        width = max(part.change.shape[1] for part in parts)
        found = {}
        for name in _TYPES:
            columns = [getattr(part, name) for part in parts]
            if name in _PER_CHANGE:
                fill = 0 if name == "change" else _NONE
                columns = [np.pad(each, ((0, 0), (0, width - each.shape[1])), constant_values=fill) for each in columns]
            found[name] = np.concatenate(columns)
        return cls(**found, why=tuple(text for part in parts for text in part.why))

    def encode(self) -> tuple[bytes, ...]:
        """Columns as zlib streams of little-endian numbers, row by row, in the order of COLUMNS.

        ``why`` has one line of UTF-8 for each trial that has not passed.
        """
        numbers = (np.ascontiguousarray(getattr(self, name), kind).tobytes() for name, kind in _TYPES.items())
        why = "\n".join(text for text, outcome in zip(self.why, self.outcome, strict=True) if outcome != PASSED)
        return tuple(map(zlib.compress, (*numbers, why.encode("utf-8", "replace"))))

    @classmethod
    def decode(cls, count: int, columns: Mapping[str, bytes], axes: int) -> Trials:
        """Trials of ``encode``, or of some of its columns: the others are zero.

        :param axes: number of drawn axes.
        :raises ValueError: no campaign writes such columns.
        """
        found: dict[str, NDArray[np.generic]] = {}
        for name, kind in _TYPES.items():
            numbers = np.frombuffer(_inflate(columns[name]), kind) if name in columns else np.zeros(0, kind)
            if name in _COUNTS:
                found[name] = numbers if name in columns else np.zeros(count, kind)
            else:
                found[name] = numbers.reshape(count, -1) if numbers.size else np.zeros((count, 0), kind)
        outcome = found["outcome"]
        why = [""] * count
        if "why" in columns:
            lines = _inflate(columns["why"])
            texts = lines.decode().split("\n") if lines.count(b"\n") < count else []
            not_passed = np.flatnonzero(outcome != PASSED).tolist()
            if len(texts) != max(1, len(not_passed)):
                raise ValueError("reasons of other trials")
            for i, text in zip(not_passed, texts, strict=False):
                why[i] = text
        trials = cls(**found, why=tuple(why))  # type: ignore[arg-type]  # their types are those of _TYPES
        trials._check(count, columns.keys(), axes)
        return trials

    def _check(self, count: int, names: Collection[str], axes: int) -> None:
        """:raises ValueError: the values are impossible."""
        if {len(getattr(self, name)) for name in _TYPES} != {count}:
            raise ValueError("columns of different lengths")
        if self.outcome.max(initial=0) > INCONCLUSIVE:
            raise ValueError("a trial without an outcome")
        rising = [getattr(self, name) for name in ("false_alarms", "armed", "samples") if name in names]
        if any((low > high).any() for low, high in itertools.pairwise([*rising, np.uint32(MAX_SAMPLES)])):
            raise ValueError("counts that cannot be")
        if "change" in names:
            self._check_changes()
        if "error" in names and self.error.shape != (count, MOST_ERRORS):
            raise ValueError(f"errors that are not {MOST_ERRORS}")
        if np.isinf(self.error).any():
            raise ValueError("an infinite error")
        if "drawn" in names and (self.drawn.shape[1] != axes or not np.isfinite(self.drawn).all()):
            raise ValueError("drawn values of another campaign")

    def _check_changes(self) -> None:
        """:raises ValueError: the values are impossible."""
        if not self.change.shape == self.latency_n.shape == self.bound_n.shape:
            raise ValueError("columns of different lengths")
        if (self.change > (EXISTS | MISSED | LATE)).any():
            raise ValueError("a change without a result")
        for times in (self.latency_n, self.bound_n):
            if ((times < _NONE) | (times > MAX_SAMPLES)).any():
                raise ValueError("a time that cannot be")


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
