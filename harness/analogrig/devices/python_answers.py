"""Answers of a Python object, checked and collected to arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import LARGEST_FLOAT32, Answers, RaisedAlarm, ReportedDiagnosis, ReportedMisfit, Samples
from analogrig.catalogue import Cause, Change, SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.run import MOST_FREQUENCY, UNARMED, UNREPORTED

_QUANTITIES = ("alarm", "theta", "innovation", "statistic", "armed", "diagnosis", "misfit")
"""Names in an answer: keys of a mapping, or attributes of an object."""

_CHANGES = {change.name.lower(): change for change in Change if change is not Change.UNDECIDED}

_DIAGNOSIS = ("change", "onset", "extent")

_CAUSES = {cause.name.lower().replace("_", " "): cause for cause in Cause}

_MISFIT = ("cause", "frequency")

_CURES = {name: f"datasheet.{name} = true" for name in _QUANTITIES} | {
    "theta": "datasheet.theta_n = number of elements",
    "diagnosis": "datasheet.diagnoses = true",
    "misfit": "datasheet.misfits = true",
}

_MOST_SHOWN = 60


class WrongAnswer(Exception):  # noqa: N818 - PythonDevice makes a DeviceError of it
    """The object returned something else than an answer."""


class Rows:
    """Rows of the answers to one block after another, one row a sample."""

    def __init__(self, sheet: Datasheet) -> None:
        self._sheet = sheet
        reported = {"theta": sheet.theta_n > 0, "innovation": sheet.innovation, "statistic": sheet.statistic}
        self._shapes = {name: (sheet.theta_n,) if name == "theta" else () for name, is_in in reported.items() if is_in}
        """Shape of one row of each reported quantity of numbers."""
        reported |= {"armed": sheet.armed, "diagnosis": sheet.diagnoses, "misfit": sheet.misfits, "alarm": True}
        self._unstated = frozenset(name for name in _QUANTITIES if not reported[name])
        self._last = {name: np.zeros(shape) for name, shape in self._shapes.items()}
        """Last reported row of each, which stands for those that are not reported."""
        self.n = 0
        """Number of rows of this block."""

    @property
    def next_sample(self) -> int:
        """Index of the sample that has no row yet."""
        return self._block.first + self.n

    def begin(self, block: Samples) -> None:
        """Begin the answers to a block."""
        self._block = block
        self._values = {name: np.empty((len(block), *shape)) for name, shape in self._shapes.items()}
        self._flags = np.where(block.valid, 0, SteppedFlag.MISSING).astype(np.uint8)
        self._alarms: list[int] = []
        self._diagnoses: list[ReportedDiagnosis] = []
        self._misfits: list[ReportedMisfit] = []
        self.n = 0

    def add(self, result: object) -> None:
        """Add the answer to the next sample.

        :raises WrongAnswer: it is none.
        """
        answer = self._quantities({"alarm": result} if isinstance(result, bool | np.bool_) else result)
        alarm = answer.get("alarm")
        if not isinstance(alarm, bool | np.bool_):
            raise WrongAnswer(f"must return True, False or an object with such an alarm, not {_shown(result)}")
        here = slice(self.n, self.n + 1)
        for name, shape in self._shapes.items():
            if (value := answer.get(name)) is not None:
                self._last[name] = _numbers(value, shape, name)
                self._values[name][here] = self._last[name]
            else:
                self._repeat(name, here)
        if self._sheet.armed and not answer.get("armed"):
            self._flags[here] |= UNARMED
        if (diagnosis := answer.get("diagnosis")) is not None:
            self._diagnoses.append(_diagnosis(diagnosis, self.next_sample))
        if (misfit := answer.get("misfit")) is not None:
            self._misfits.append(_misfit(misfit, self.next_sample))
        if alarm:
            self._alarms.append(self.n)
        self.n += 1

    def fill(self, result: object) -> None:
        """Add the answers to the whole block: an array of alarms, or an object with an array of each quantity.

        :raises WrongAnswer: it is none.
        """
        n, first = len(self._block), self._block.first
        answer = self._quantities({"alarm": result} if isinstance(result, np.ndarray) else result)
        alarm = _bools(answer.get("alarm"), n, "alarm")
        for name, shape in self._shapes.items():
            if (value := answer.get(name)) is None:
                self._repeat(name, slice(n))
            elif n:
                self._values[name][:] = _numbers(value, (n, *shape), name)
                self._last[name] = self._values[name][-1]
        if self._sheet.armed:
            self._flags[~_bools(answer.get("armed"), n, "armed")] |= UNARMED
        diagnoses, misfits = (_list(answer.get(name), n, name) for name in ("diagnosis", "misfit"))
        self._diagnoses = [_diagnosis(each, first + at) for at, each in enumerate(diagnoses) if each is not None]
        self._misfits = [_misfit(each, first + at) for at, each in enumerate(misfits) if each is not None]
        self._alarms = np.flatnonzero(alarm).tolist()
        self.n = n

    def _quantities(self, result: object) -> Mapping[str, Any]:
        """Quantities of an answer by name.

        :raises WrongAnswer: one is unknown, or the data sheet says that it is not reported.
        """
        answer = _named(result, _QUANTITIES)
        for name in self._unstated:
            if answer.get(name) is not None:
                raise WrongAnswer(f"returned {name}, which the data sheet does not state: {_CURES[name]}")
        return answer

    def _repeat(self, name: str, rows: slice) -> None:
        """Repeat the last value of a quantity that was not reported. A missing sample needs none."""
        self._flags[rows] |= np.where(self._block.valid[rows], UNREPORTED, 0).astype(np.uint8)
        self._values[name][rows] = self._last[name]

    def answers(self) -> Answers:
        """Answers to the samples that have rows."""
        values = {name: each[: self.n].astype(np.float32) for name, each in self._values.items()}
        statistic = values.get("statistic")
        return Answers(
            flags=self._flags[: self.n],
            alarms=tuple(
                RaisedAlarm(self._block.first + at, statistic=0.0 if statistic is None else float(statistic[at]))
                for at in self._alarms
            ),
            theta=values.get("theta"),
            innovation=values.get("innovation"),
            statistic=statistic,
            diagnoses=tuple(self._diagnoses),
            misfits=tuple(self._misfits),
        )


def _named(result: object, names: Sequence[str]) -> Mapping[str, Any]:
    """The values of a mapping, or of the attributes of these names.

    :raises WrongAnswer: the mapping has other keys.
    """
    if not isinstance(result, Mapping):
        return {name: getattr(result, name, None) for name in names}
    for key in result:
        if key not in names:
            raise WrongAnswer(f"unknown key {key!r} (known: {', '.join(names)})")
    return result


def _numbers(value: object, shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    """Finite numbers of this shape.

    :raises WrongAnswer: the value is something else; names the row.
    """
    array = np.asarray(value)
    if array.shape != shape or array.dtype.kind not in "iuf":
        wanted = f"{' x '.join(map(str, shape))} numbers, as the data sheet states" if shape else "a number"
        raise WrongAnswer(f"{name} must be {wanted}, not {_shown(value)}")
    if not (np.abs(array) <= LARGEST_FLOAT32).all():
        raise WrongAnswer(f"{name} is {_shown(value)}: non-finite, or beyond float32")
    return array


def _bools(value: object, n: int, name: str) -> NDArray[np.bool_]:
    """:raises WrongAnswer: the value is no array of ``n`` truth values."""
    array = np.asarray(value)
    if array.shape != (n,) or array.dtype != np.bool_:
        raise WrongAnswer(f"{name} must be an array of {n} truth values, not {_shown(value)}")
    return array


def _list(value: object, n: int, name: str) -> Sequence[object]:
    """Reports of n samples; None where there is none.

    :raises WrongAnswer: the value is no such list.
    """
    given = value or [None] * n
    if not isinstance(given, Sequence) or len(given) != n:
        raise WrongAnswer(f"{name} must be a list of {n}, with None for no {name}, not {_shown(given)}")
    return given


def _misfit(value: object, index: int) -> ReportedMisfit:
    """:raises WrongAnswer: the value is no misfit."""
    given = _named(value, _MISFIT)
    cause, frequency = given.get("cause"), given.get("frequency")
    if not (isinstance(cause, str) and cause in _CAUSES):
        raise WrongAnswer(f"misfit: cause must be one of {', '.join(_CAUSES)}, not {_shown(cause)}")
    if frequency is None:
        return ReportedMisfit(index, _CAUSES[cause])
    if (
        isinstance(frequency, bool)
        or not isinstance(frequency, int | float | np.floating)
        or not 0.0 <= frequency <= MOST_FREQUENCY
    ):
        wanted = f"must be 0 to {MOST_FREQUENCY:g} cycles per sample"
        raise WrongAnswer(f"misfit: frequency {wanted}, not {_shown(frequency)}")
    return ReportedMisfit(index, _CAUSES[cause], float(frequency))


def _diagnosis(value: object, index: int) -> ReportedDiagnosis:
    """:raises WrongAnswer: the value is no diagnosis."""
    given = _named(value, _DIAGNOSIS)
    change, onset, extent = (given.get(name) for name in _DIAGNOSIS)
    if not (isinstance(change, str) and change in _CHANGES):
        raise WrongAnswer(f"diagnosis: change must be one of {', '.join(_CHANGES)}, not {_shown(change)}")
    if isinstance(onset, bool) or not isinstance(onset, int | np.integer) or not 0 <= onset <= index:
        raise WrongAnswer(f"diagnosis: onset must be a sample from 0 to {index}, not {_shown(onset)}")
    if (
        isinstance(extent, bool)
        or not isinstance(extent, int | float | np.floating)
        or not 0.0 < extent <= LARGEST_FLOAT32
    ):
        raise WrongAnswer(f"diagnosis: extent must be a number above 0, not {_shown(extent)}")
    return ReportedDiagnosis(index, _CHANGES[change], int(onset), float(extent))


def _shown(value: object) -> str:
    """A value in a message."""
    text = " ".join(repr(value).split())
    return f"{text if len(text) <= _MOST_SHOWN else f'{text[:_MOST_SHOWN]}...'} ({type(value).__name__})"
