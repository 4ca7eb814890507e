"""Answers of a form: which fields a message has, and what they mean for a record."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analogrig import DeviceError
from analogrig.answers import (
    LARGEST_FLOAT32,
    not_finite_text,
    plausible_orders,
    raised_alarms,
)
from analogrig.config import suggest
from analogrig.datasheet import MOST_THETA
from analogrig.devices import LOST, UNARMED, Answers, Datasheet, SteppedFlag
from analogrig.run import Channel
from analogrig_lines.templates import CHECKSUM, PAD, TemplateField

INDEX = "index"

_SWITCHES = ("alarm", "armed", "valid", "refused")
"""Fields that are 0 or not 0."""

_VALUES = ("statistic", "innovation")

KNOWN = (INDEX, *_SWITCHES, *_VALUES, CHECKSUM)
"""Fields with a meaning of their own."""

_NOT_WHOLE = ("g", "a", "f32", "f64", "f32be", "f64be")
"""Types that are not whole numbers."""

_FLAGS = (("armed", False, UNARMED), ("valid", False, SteppedFlag.REFUSED), ("refused", True, SteppedFlag.REFUSED))
"""Switches, the state in which they set a flag, and the flag."""

LOST_ON_THE_WAY = LOST | SteppedFlag.MISSING

NO_ANSWER = 0x100
"""Flag of a row that repeats the one before."""


class AnswerForm:
    """Fields of an answer by name. All names that are not known here are elements of theta, in their order."""

    def __init__(self, names: Sequence[str], theta: Sequence[str] | None) -> None:
        """:param theta: elements of theta in their order; other names that are not known are ignored.

        :raises ValueError: an element of theta is not there, there are too many, or a name is almost a known one.
        """
        present = tuple(name for name in names if name not in (*KNOWN, PAD))
        if theta is None:
            for name in present:
                if suggestion := suggest(name, KNOWN, cutoff=0.8):
                    raise ValueError(f"receive: field {name}{suggestion} If it is an element of theta, state theta")
        self.theta = present if theta is None else tuple(theta)
        for name in self.theta:
            if name not in present:
                raise ValueError(f"theta: receive has no field {name}")
        if len(self.theta) > MOST_THETA:
            raise ValueError(f"receive: {len(self.theta)} elements of theta, more than {MOST_THETA}")
        self._known = frozenset(names) & frozenset(KNOWN)

    def ignores(self, name: str) -> bool:
        return name not in KNOWN and name not in self.theta

    def has(self, name: str) -> bool:
        return name in self._known

    def check_types(self, fields: Sequence[TemplateField]) -> None:
        """:raises ValueError: an index, or a field that is 0 or not 0, is no whole number."""
        for field in fields:
            if field.name in (INDEX, *_SWITCHES) and field.type in _NOT_WHOLE:
                raise ValueError(f"receive: {field.name} must be a whole number, not of the type {field.type}")

    def complete(self, stated: Datasheet, cannot_tell: Sequence[str]) -> Datasheet:
        """Data sheet with the fields reported here.

        :raises ValueError: the stated model has another number of parameters.
        """
        return dataclasses.replace(
            stated,
            theta_n=len(self.theta),
            innovation=self.has("innovation"),
            statistic=self.has("statistic"),
            armed=self.has("armed"),
            alarms=self.has("alarm"),
            cannot_tell=tuple(dict.fromkeys((*stated.cannot_tell, *cannot_tell))),
        )

    @property
    def columns(self) -> tuple[str, ...]:
        """Fields that are read, beside index and checksum: theta, values, switches."""
        return (*self.theta, *(name for name in (*_VALUES, *_SWITCHES) if name in self._known))


class AnswerAssembler:
    """Answers of one record in the order of its samples."""

    def __init__(self, form: AnswerForm, name: str, to_codes: ToCodes | None) -> None:
        """``name`` is that of the device, for errors."""
        self._form = form
        self._name = name
        self._to_codes = to_codes
        self._last = np.zeros((1, len(form.columns)))
        self._switches_n = sum(name in _SWITCHES for name in form.columns)

    def answers(self, values: NDArray[np.float64], flags: NDArray[np.int64], first: int) -> Answers:
        """Answers to the n samples from ``first`` on.

        :param values: (m, k) values of ``columns`` in the m answers.
        :param flags: (n,) flags that are known without them; NO_ANSWER at n - m samples.
        :raises DeviceError: a value is not finite.
        """
        form, is_answer = self._form, (flags & NO_ANSWER) == 0
        self._check(values, first + np.flatnonzero(is_answer), flags[is_answer])
        values = np.concatenate([self._last, values])[np.cumsum(is_answer)]
        if len(values):
            self._last = values[-1:]
        column = dict(zip(form.columns, values.T, strict=True))
        for key, is_set, flag in _FLAGS:
            if key in column:
                flags = np.where(is_answer & ((column[key] != 0.0) == is_set), flags | flag, flags)
        theta, statistic, innovation = values[:, : len(form.theta)], column.get("statistic"), column.get("innovation")
        if self._to_codes is not None:
            theta = self._to_codes.theta(theta)
            innovation = None if innovation is None else innovation / self._to_codes.y.lsb_v
        raised = np.flatnonzero(is_answer & (column["alarm"] != 0.0)) if "alarm" in column else np.empty(0, np.int64)
        return Answers(
            flags=(flags & 0xFF).astype(np.uint8),
            alarms=raised_alarms(first + raised, 0.0 if statistic is None else statistic[raised]),
            theta=theta.astype(np.float32) if form.theta else None,
            innovation=None if innovation is None else innovation.astype(np.float32),
            statistic=None if statistic is None else statistic.astype(np.float32),
        )

    def _check(self, values: NDArray[np.float64], samples: NDArray[np.int64], flags: NDArray[np.int64]) -> None:
        """:raises DeviceError: a value is not finite."""
        bad = ~(np.abs(values) <= LARGEST_FLOAT32)
        if bad.any():
            row, at = (int(each[0]) for each in np.nonzero(bad))
            with np.errstate(over="ignore", invalid="ignore"):
                numbers = values[:, : len(self._form.columns) - self._switches_n].astype(np.float32)
            found = [order for order, *_ in plausible_orders(numbers.ravel())]
            cure = f"; {' or '.join(found)}, such values are plausible: correct the byte order" if found else ""
            why = not_finite_text(is_missing=bool(flags[row] & SteppedFlag.MISSING))
            raise DeviceError(
                f"device {self._name}: {self._form.columns[at]} = {values[row, at]:g} for sample {samples[row]},"
                f" which is {why}{cure}"
            )


@dataclasses.dataclass(frozen=True)
class ToCodes:
    """Conversion of a model of signals in volts to one of signals in codes."""

    sheet: Datasheet
    u: Channel
    y: Channel

    def theta(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, p) parameters in codes; as they are without a stated model."""
        model = self.sheet.model
        if model is None:
            return theta
        out = theta.copy()
        b = slice(model.na, model.na + model.nb)
        out[:, b] *= self.u.lsb_v / self.y.lsb_v
        if model.offset:
            at_rest = theta[:, b].sum(axis=1) * self.u.low_v - (1.0 + theta[:, : model.na].sum(axis=1)) * self.y.low_v
            out[:, -1] = (theta[:, -1] + at_rest) / self.y.lsb_v
        return out
