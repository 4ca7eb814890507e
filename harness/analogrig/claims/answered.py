"""Answers of a device beside those of a replay: which may be compared, how finely, and where they differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import SteppedFlag
from analogrig.claims.feed import ALARM, INNOVATION, STATISTIC, Library, Matrix
from analogrig.errors import ConfigurationError
from analogrig.run import UNREPORTED, Run

ULP = 1.2e-7
"""Relative distance of neighbouring float32."""

_HALF_ULP, _HALF_LEAST = 2.0**-10, 6e-8
"""The same of half-precision floats, and the smallest of them."""

_MOST_DIGITS, _MOST_BITS = 8, 21
"""Digits and bits after the point that a whole number of units may stand for."""

_MOST_COUNTS = 1e6
"""Largest number of units. Any float is a whole number of a small enough one."""

_LEAST_VALUES = 12
"""Distinct values of a column below which its resolution is not estimated."""

_COARSE = 0.02
"""Resolution, relative to the spread of a column, above which it is mentioned."""

_NEARLY = 0.02
"""Deviation, relative to that of the claimed answers, that counts as explained."""


@dataclass(frozen=True, eq=False)
class DeviceAnswers:
    """Answers of a device in the columns of a replay."""

    columns: tuple[str, ...]
    values: Matrix
    """(n, c)"""
    compared: NDArray[np.bool_]
    """(n, c): true where the device has reported the value."""
    tolerance: NDArray[np.float64]
    """(n, c): resolution of the device's protocol, or more where rounding may have led to more."""

    @classmethod
    def of(cls, run: Run, library: Library, theta: Sequence[str] = ()) -> Self:
        """Answers of a run.

        :param theta: names of the elements of theta; used if they are not as many as those of the library.
        :raises ConfigurationError: the device reports elements of theta that the library does not have.
        """
        names = _theta_names(run.theta.shape[1], library, theta)
        columns, n = library.columns, run.samples
        values = np.zeros((n, len(columns)), np.float32)
        compared = np.zeros((n, len(columns)), np.bool_)
        sheet = run.datasheet
        is_reported = ~(((run.flags & UNREPORTED) != 0) | run.lost)
        is_measured = is_reported & ((run.flags & SteppedFlag.MISSING) == 0)
        for i, name in enumerate(names):
            values[:, columns.index(name)] = run.theta[:, i]
            compared[:, columns.index(name)] = is_reported
        for name, is_there in ((INNOVATION, sheet.innovation), (STATISTIC, sheet.statistic)):
            if is_there:
                values[:, columns.index(name)] = getattr(run, name)
                compared[:, columns.index(name)] = is_measured
        if sheet.alarms:
            values[run.alarm_index, columns.index(ALARM)] = 1.0
            compared[:, columns.index(ALARM)] = ~run.lost
        units, parts = zip(*(_resolution(values[compared[:, i], i]) for i in range(len(columns))), strict=True)
        tolerance = np.array(units) + np.array(parts) * np.abs(values.astype(np.float64))
        return cls(columns, values, compared, tolerance)

    def upto(self, samples: int) -> Self:
        """The answers to the first samples."""
        return type(self)(self.columns, self.values[:samples], self.compared[:samples], self.tolerance[:samples])

    @property
    def coarse(self) -> str:
        """Columns whose resolution is no small part of their spread, with the resolution."""
        found = []
        for i, name in enumerate(self.columns[:-1]):
            use = self.compared[:, i]
            step = float(np.median(self.tolerance[use, i])) if use.any() else 0.0
            with np.errstate(over="ignore", invalid="ignore"):  # misread floats may be as large as any
                spread = float(np.std(self.values[use, i]))
            if step > _COARSE * spread:
                found.append(f"{name} to {step:.1g}")
        return ", ".join(found)

    def widened(self, tolerance: NDArray[np.float64]) -> Self:
        """The same with at least this tolerance, (n, c)."""
        return type(self)(self.columns, self.values, self.compared, np.maximum(self.tolerance, tolerance))

    def wrong(self, expected: Matrix) -> NDArray[np.bool_]:
        """(n, c): true where an answer differs from the expected one."""
        near = np.abs(self.values.astype(np.float64) - expected) <= self.tolerance
        return np.asarray(self.compared & ~near)

    def first_difference(self, expected: Matrix) -> int:
        """First sample with a difference; the number of samples if there is none."""
        rows = np.flatnonzero(self.wrong(expected).any(axis=1))
        return int(rows[0]) if len(rows) else len(self.values)

    def unexplained(self, expected: Matrix, claimed: Matrix) -> float:
        """Part of the differences from the ``claimed`` answers that are differences from the expected ones too."""
        deviation = np.abs(self.values.astype(np.float64) - claimed)
        wrong = self.wrong(claimed)
        scale = np.where(wrong, deviation, 0.0).sum(axis=0) / np.maximum(wrong.sum(axis=0), 1)
        left = np.abs(self.values.astype(np.float64) - expected) > self.tolerance + _NEARLY * scale
        return float((left & self.compared).sum() / max(int(wrong.sum()), 1))


def _theta_names(reported: int, library: Library, theta: Sequence[str]) -> Sequence[str]:
    known = library.columns[: library.config.parameters]
    if reported in (0, len(known)):
        return known[:reported]
    names = [{"d": "offset"}.get(each, each) for each in theta]
    if len(names) == reported and set(names) <= set(known):
        return names
    raise ConfigurationError(
        f"the device reports {reported} elements of theta, and [estimator] has {len(known)}: {', '.join(known)};"
        " correct na, nb, nc or offset, or name the elements so in the device file"
    )


def _resolution(values: NDArray[np.float32]) -> tuple[float, float]:
    """Resolution of a column, found from its values: a unit, and a part of the value.

    A firmware prints so many digits, or sends whole numbers of some unit. The rest are floats.
    """
    distinct = np.unique(values[np.isfinite(values) & (values != 0)]).astype(np.float64)
    if len(distinct) >= _LEAST_VALUES:
        for unit in (*(10.0**-digits for digits in range(_MOST_DIGITS)), *(2.0**-bits for bits in range(_MOST_BITS))):
            if _are_multiples(distinct, unit):
                return unit, ULP
        for digits in range(3, _MOST_DIGITS):
            if _are_multiples(distinct, 10.0 ** (np.floor(np.log10(np.abs(distinct))) - digits + 1)):
                return 0.0, 10.0 ** (1 - digits)
        with np.errstate(over="ignore"):
            if np.array_equal(distinct.astype(np.float16).astype(np.float64), distinct):
                return _HALF_LEAST, _HALF_ULP
    return 0.0, ULP


def _are_multiples(values: NDArray[np.float64], unit: float | NDArray[np.float64]) -> bool:
    """True if the values are whole multiples of ``unit``, as far as a float32 can tell."""
    counts = values / unit
    counts = counts[np.abs(counts) < _MOST_COUNTS]
    are_whole = np.abs(counts - np.round(counts)) <= ULP * np.abs(counts)
    return len(counts) >= _LEAST_VALUES and bool(are_whole.all())
