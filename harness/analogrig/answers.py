"""Samples to a device, and its answers: what passes between the bench and every device."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analogrig.catalogue import SteppedFlag

__all__ = [
    "LARGEST_FLOAT32",
    "AlarmIs",
    "AlarmLevel",
    "AnswerRows",
    "not_finite_text",
    "plausible_orders",
    "raised_alarms",
]
"""Names for packages beside the core."""

LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
"""Largest magnitude of a reported quantity."""
LOST = 0x20
"""Flag of a sample, beside SteppedFlag: lost on the way to the device."""
MOST_FREQUENCY = 0.5
"""Largest frequency of a disturbance in cycles per sample."""


@dataclass(frozen=True, eq=False)
class Samples:
    """n consecutive samples; all arrays are (n,)."""

    first: int
    """Index of the first sample, from 0 in each record. A device takes skipped indices as missing samples."""
    u: NDArray[np.uint16]
    """Input of the plant in codes."""
    y: NDArray[np.uint16]
    """Output of the plant in codes."""
    valid: NDArray[np.bool_]
    """False where the sample is missing; u and y mean nothing there."""

    def __len__(self) -> int:
        return len(self.u)

    @classmethod
    def missing(cls, first: int, n: int) -> Self:
        """``n`` missing samples."""
        nothing = np.zeros(n, np.uint16)
        return cls(first, nothing, nothing, np.zeros(n, np.bool_))

    def cut(self, start: int, stop: int) -> Samples:
        """Samples from row ``start`` up to ``stop``."""
        rows = slice(start, stop)
        return Samples(self.first + start, self.u[rows], self.y[rows], self.valid[rows])

    def skipped_after(self, next_index: int) -> int:
        """Number of samples from ``next_index`` to the first.

        :raises ValueError: the first has been sent before.
        """
        if self.first < next_index:
            raise ValueError(f"sample {self.first} comes again: the next one is {next_index}")
        return self.first - next_index


@dataclass(frozen=True)
class RaisedAlarm:
    """An alarm of the device."""

    index: int
    """Sample after which it was raised, counted from the start of the record without wrap-around."""
    kind: int = 0
    """Trigger of the catalogue that raised it; 0 for a device with triggers of its own."""
    statistic: float = 0.0
    """Statistic of the trigger; 0.0 if the device does not report it."""


@dataclass(frozen=True)
class ReportedDiagnosis:
    """A diagnosis of the device: the parameter that has changed, or the fault of a channel."""

    index: int
    """Sample after which it was sent, counted, like ``onset``, from the start of the record without wrap-around."""
    change: int
    """Change of the catalogue."""
    onset: int
    """Most likely sample of the change; that of the alarm if several parameters have changed."""
    extent: float
    """Parameter, or gain of a channel, after the change over that before; 1 for all other changes."""


@dataclass(frozen=True)
class ReportedMisfit:
    """A change of the cause of a poor fit, as the device reports it."""

    index: int
    """Sample after which it was found, counted from the start of the record without wrap-around."""
    cause: int
    """Cause of the catalogue; NONE: the model fits again."""
    frequency: float = 0.0
    """Frequency of the disturbance in cycles per sample; 0 unless the cause is HUM."""
    strength: float = 0.0
    """Statistic over its limit; 0 if the device does not report it."""


EVENTS = {
    "alarms": np.dtype([("index", "<i8"), ("kind", "u1"), ("statistic", "<f4")]),
    "diagnoses": np.dtype([("index", "<i8"), ("change", "u1"), ("onset", "<i8"), ("extent", "<f4")]),
    "misfits": np.dtype([("index", "<i8"), ("cause", "u1"), ("frequency", "<f4"), ("strength", "<f4")]),
}
"""Fields of ``RaisedAlarm``, ``ReportedDiagnosis`` and ``ReportedMisfit`` in the arrays of ``Answers``."""

Events = Any
"""Array of one of these types, with its fields as attributes: ``answers.alarms.index``."""

NO_EVENTS: Mapping[str, Events] = {name: np.empty(0, kind).view(np.recarray) for name, kind in EVENTS.items()}


def raised_alarms(indices: NDArray[np.int64], statistics: ArrayLike = 0.0, kind: int = 0) -> Events:
    """Alarms after the samples ``indices``."""
    alarms = np.empty(len(indices), EVENTS["alarms"]).view(np.recarray)
    alarms["index"], alarms["kind"], alarms["statistic"] = indices, kind, statistics
    return alarms


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers to the n oldest unanswered samples, with p parameters.

    None stands for a quantity that the device does not report (``Datasheet``). Alarms, diagnoses and misfits are given
    as arrays of ``EVENTS``, or as sequences of ``RaisedAlarm``, ``ReportedDiagnosis`` and ``ReportedMisfit``.
    """

    flags: NDArray[np.uint8]
    """(n,): SteppedFlag of the catalogue, LOST, UNREPORTED and UNARMED of ``analogrig.run``."""
    alarms: Events = ()
    """In ascending order."""
    theta: NDArray[np.float32] | None = None
    """(n, p): the estimate after each sample, in codes."""
    innovation: NDArray[np.float32] | None = None
    """(n,) codes."""
    statistic: NDArray[np.float32] | None = None
    """(n,): of the trigger."""
    diagnoses: Events = ()
    misfits: Events = ()
    """In ascending order."""

    def __post_init__(self) -> None:
        for name, kind in EVENTS.items():
            if not isinstance(given := getattr(self, name), np.recarray):
                rows = [dataclasses.astuple(each) for each in given]
                object.__setattr__(self, name, np.array(rows, kind).view(np.recarray) if rows else NO_EVENTS[name])

    def __len__(self) -> int:
        return len(self.flags)

    def shifted(self, first: int) -> Self:
        """The same answers with ``first`` added to every sample index."""
        if not first:
            return self
        moved = {name: getattr(self, name).copy() for name in EVENTS}
        for events in moved.values():
            events["index"] += first
        moved["diagnoses"]["onset"] += first
        return dataclasses.replace(self, **moved)

    @classmethod
    def joined(cls, parts: Sequence[Answers]) -> Answers:
        """Answers to consecutive blocks in one."""
        if len(parts) == 1:
            return parts[0]
        whole: dict[str, Any] = {}
        for field in dataclasses.fields(cls):
            arrays = [getattr(part, field.name) for part in parts]
            whole[field.name] = None if arrays[0] is None else np.concatenate(arrays)
        return cls(**whole | {name: whole[name].view(np.recarray) for name in EVENTS})


AlarmIs = Literal["event", "level"] | tuple[int | str, ...]
"""Meaning of the alarm in an answer: each one is an alarm; one in a row of them is; or the states that stand for an
alarm, of which the first in a row is one."""

_PLAUSIBLE = 1e-9, 1e9
"""Magnitudes of a plausible quantity that is not 0."""
_MOST_PLAUSIBLE, _LEAST_PLAUSIBLE = 0.6, 0.95
"""Largest share of plausible values as they are read, and least share in the order that is right."""
_LEAST_VALUES = 8
"""Different values by which a byte order can be told."""

_ORDERS = {"byte-swapped": (3, 2, 1, 0), "word-swapped": (2, 3, 0, 1), "with swapped bytes in each half": (1, 0, 3, 2)}


def _are_plausible(values: NDArray[np.float32]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray((values == 0.0) | ((np.abs(values) >= _PLAUSIBLE[0]) & (np.abs(values) <= _PLAUSIBLE[1])))


def plausible_orders(values: NDArray[np.float32]) -> Iterator[tuple[str, float, float]]:
    """Byte orders in which implausible values are plausible, each with a value as it is read and in that order."""
    values = np.unique(values[np.isnan(values) | (values != 0.0)])
    is_read_well = _are_plausible(values)
    if len(values) < _LEAST_VALUES or is_read_well.mean() > _MOST_PLAUSIBLE:
        return
    at = int(np.argmin(is_read_well))
    for name, order in _ORDERS.items():
        swapped = np.ascontiguousarray(values.view(np.uint8).reshape(-1, 4)[:, order]).view(np.float32).ravel()
        if _are_plausible(swapped).mean() >= _LEAST_PLAUSIBLE:
            yield name, float(values[at]), float(swapped[at])


def not_finite_text(*, is_missing: bool) -> str:
    """What is wrong with a number of a device that is not finite, for the end of an error."""
    cure = ": the sample is missing; answer it with the last value, or with 0" if is_missing else ""
    return f"not finite or too large for a float{cure}"


_UNDECIDED = np.uint8(SteppedFlag.MISSING | LOST)
"""Flags of samples that leave a level as it was, unless their answer holds an alarm."""


class AlarmLevel:
    """Level of a device's alarm within a record."""

    def __init__(self) -> None:
        self._is_raised = False

    def rises(self, answers: Answers, first: int) -> Answers:
        """The answers to the samples from ``first`` on, with only those alarms that raise the level."""
        n = len(answers)
        raised = np.zeros(n + 1, np.bool_)
        raised[0] = was_raised = self._is_raised
        rows = np.maximum(answers.alarms["index"] - first + 1, 0)
        raised[rows] = True
        is_decided = np.concatenate(([True], (answers.flags & _UNDECIDED) == 0)) | raised
        raised = raised[np.maximum.accumulate(np.where(is_decided, np.arange(n + 1), 0))]
        self._is_raised = bool(raised[-1])
        held = np.concatenate(([was_raised], raised))
        return dataclasses.replace(answers, alarms=answers.alarms[~held[rows]])


class AnswerRows:
    """Answers not yet taken, in lists: numpy takes as long for one number as for a hundred."""

    def __init__(self, width: int) -> None:
        self.width = width
        """Number of elements of theta, plus one for the innovation."""
        self.values: list[float] = []
        self.statistics: list[float] = []
        self.flags: list[int] = []
        self.alarms: list[RaisedAlarm] = []
        self.diagnoses: list[ReportedDiagnosis] = []
        self.misfits: list[ReportedMisfit] = []
        self._last_taken = (width * [0.0], 0.0)

    def repeat(self, flags: int, statistic: float | None = None) -> None:
        """Enter a sample without a report: the estimate of the sample before, and no innovation."""
        row = self.values[-self.width :] or self._last_taken[0]
        self.values += [*row[:-1], 0.0]
        self.finish(flags, self.statistic if statistic is None else statistic)

    @property
    def statistic(self) -> float:
        """Statistic of the latest sample."""
        return (self.statistics or self._last_taken[1:])[-1]

    def finish(self, flags: int, statistic: float) -> None:
        self.flags.append(flags)
        self.statistics.append(statistic)

    def take(self, n: int, before: int) -> Answers:
        """Remove and return the first n samples, and all that was reported before the index ``before``."""
        cut = n * self.width
        values = np.array(self.values[:cut], dtype=np.float32).reshape(n, self.width)
        events = {name: [each for each in getattr(self, name) if each.index < before] for name in EVENTS}
        out = Answers(
            theta=values[:, :-1],
            innovation=values[:, -1],
            statistic=np.array(self.statistics[:n], dtype=np.float32),
            flags=np.array(self.flags[:n], dtype=np.uint8),
            **events,
        )
        if n:
            self._last_taken = (self.values[cut - self.width : cut], self.statistics[n - 1])
        del self.values[:cut], self.statistics[:n], self.flags[:n], self.alarms[: len(out.alarms)]
        del self.diagnoses[: len(out.diagnoses)], self.misfits[: len(out.misfits)]
        return out
