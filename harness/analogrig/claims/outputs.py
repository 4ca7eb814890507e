"""Faults on the way from the estimator: each field of the answers as another field, sample, scale or form of it."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.claims.answered import DeviceAnswers
from analogrig.claims.feed import ALARM, Matrix

Values = NDArray[np.float64]
Form = Callable[[Values], Values]

_FACTORS = (-1.0, 0.5, 2.0, 1000.0, 0.001, 100.0, 0.01, 10.0, 0.1, 1e6, 1e-6, 65536.0, 256.0, 1 / 256.0, 1 / 65536.0)
_LAGS = (0, 1, 2, 3, -1)
_OLDEST = 64
"""Largest age in samples of a part of an answer that was left from before."""

_UNITS = (1.0, 10.0, 100.0, 1000.0, 10_000.0, 256.0, 65536.0)

_SETTLED_N = 3
"""First values of a column, which may be of before the record."""

_PROBES = 24
"""Values of a column that are compared at first."""

_RELATIVE, _LEAST = 2e-6, 1e-30
"""Deviations that the arithmetic of a form may cause: relative, and absolute."""

_HELD = (2, 1000)
_LEAST_MOVES = 8
"""Distinct expected values of a column that make a fit of it evidence."""


def explain_outputs(answered: DeviceAnswers, expected: Matrix) -> str:
    """Cause that explains every difference by faults on the way from the estimator; empty if there is none."""
    wrong = answered.wrong(expected)
    fields: dict[str, list[str]] = {}
    torn: list[int] = []
    for column in np.flatnonzero(wrong.any(axis=0)):
        cause = _cause_of_column(answered, expected, int(column))
        if cause is None:
            torn.append(int(column))
        else:
            fields.setdefault(cause, []).append(answered.columns[int(column)])
    if torn:
        cause = _torn(answered, expected, wrong, torn) or _swapped(answered, expected, torn)
        if not cause:
            return ""
        fields.setdefault(cause, []).extend(answered.columns[each] for each in torn)
    return "; ".join(f"{', '.join(names)}: {cause}" for cause, names in fields.items())


def _cause_of_column(answered: DeviceAnswers, expected: Matrix, column: int) -> str | None:
    """Cause that explains a whole column."""
    use = answered.compared[:, column]
    found = answered.values[use, column].astype(np.float64)
    if answered.columns[column] == ALARM:
        return _cause_of_alarms(found, expected[use, column])
    if len(np.unique(found)) == 1:
        return f"always {found[0]:g}"
    if len(found) <= _SETTLED_N:
        return None
    near = answered.tolerance[use, column]
    probe = np.unique(np.linspace(_SETTLED_N, len(found) - 1, _PROBES).astype(np.int64))
    names = answered.columns
    sources = [column, *(each for each in range(len(names) - 1) if each != column)]
    for source in sources:
        for lag in _LAGS:
            values = _lagged(expected[:, source].astype(np.float64), lag)[use]
            if len(np.unique(values)) < _LEAST_MOVES:
                continue
            place = "" if source == column else f"the value of {names[source]}"
            late = {0: "", 1: "one sample late", -1: "one sample early"}.get(lag, f"{lag} samples late")
            for form, change in _forms(values[probe], found[probe], found):
                if (form or place or late) and all(
                    _same(change, values[rows], found[rows], near[rows]) for rows in (probe, slice(_SETTLED_N, None))
                ):
                    return ", ".join(each for each in (place, late, form) if each)
    return None


def _same(change: Form, values: Values, found: Values, near: Values) -> bool:
    """True if the changed values are those found."""
    with np.errstate(all="ignore"):
        equal = np.abs(change(values) - found) <= np.maximum(near, _RELATIVE * np.abs(found)) + _LEAST
    return bool(equal.all())


def _lagged(x: Values, lag: int) -> Values:
    if not lag:
        return x
    if lag < 0:
        return np.concatenate([x[-lag:], np.repeat(x[-1:], -lag)])
    return np.concatenate([np.zeros(min(lag, len(x))), x[:-lag]])


def _forms(expected: Values, found: Values, all_found: Values) -> Iterator[tuple[str, Form]]:
    """Forms in which a value may arrive; ``expected`` and ``found`` are some of the values."""
    yield "", np.asarray
    for factor in _FACTORS:
        yield (
            "with the other sign" if factor == -1.0 else f"scaled by {factor:g}",
            functools.partial(np.multiply, factor),
        )
    yield "without its sign", np.abs
    yield "without its sign between -1 and 0", lambda x: np.where(np.abs(x) < 1.0, np.abs(x), x)
    for digits, rounding in itertools.product((6, 5, 4, 3, 2), (np.rint, np.trunc)):
        yield (
            f"zeros after the point lost: {digits} digits printed as a whole number",
            functools.partial(_unpadded, digits, rounding),
        )
    for digits in range(6):
        yield f"rounded to {digits} digits after the point", functools.partial(_rounded, digits)
        yield f"cut to {digits} digits after the point", functools.partial(_cut, digits)
    yield "squared", np.square
    yield "of the square root", lambda x: np.sqrt(np.abs(x))
    yield "byte-swapped float", lambda x: _float(_bits(x).byteswap())
    yield "float with its 16-bit halves swapped", lambda x: _float(_bits(x) >> 16 | _bits(x) << 16)
    yield (
        "float with the bytes of each half swapped",
        lambda x: _float(_bits(x).view(np.uint16).byteswap().view(np.uint32)),
    )
    yield "bits of the float read as a whole number", lambda x: _bits(x).view(np.int32).astype(np.float64)
    yield "cut to the upper 16 bits of the float", lambda x: _float(_bits(x) >> 16 << 16)
    low, high = all_found.min(), all_found.max()
    yield f"limited to {low:g} .. {high:g}", functools.partial(np.clip, a_min=low, a_max=high)
    yield f"limited to {high:g}", functools.partial(np.minimum, high)
    yield f"limited from {low:g} on", functools.partial(np.maximum, low)
    for bits, unit, rounding in itertools.product((8, 16), _UNITS, (np.rint, np.trunc, np.floor)):
        yield (
            f"in units of {1.0 / unit:g} that overflow {bits} bits",
            functools.partial(_wrapped, bits, unit, rounding),
        )
    if (big := np.abs(expected) > 0.5 * np.abs(expected).max()).any():
        ratio = float(np.median(found[big] / expected[big]))
        yield f"scaled by {ratio:.4g}", functools.partial(np.multiply, ratio)
    shift = float(np.median(found - expected))
    yield f"shifted by {shift:.4g}", functools.partial(np.add, shift)


def _unpadded(digits: int, rounding: Form, x: Values) -> Values:
    """Values whose fraction is printed as a whole number of ``digits`` digits without leading zeros."""
    scaled = rounding(np.abs(x) * 10.0**digits)
    whole, fraction = np.divmod(scaled, 10.0**digits)
    length = np.floor(np.log10(np.maximum(fraction, 1.0))) + 1.0
    return np.asarray(np.sign(x) * (whole + fraction / 10.0**length))


def _rounded(digits: int, x: Values) -> Values:
    return np.round(x, digits)


def _cut(digits: int, x: Values) -> Values:
    return np.asarray(np.trunc(x * 10.0**digits) / 10.0**digits)


def _bits(x: Values) -> NDArray[np.uint32]:
    return np.ascontiguousarray(x.astype(np.float32)).view(np.uint32)


def _float(bits: NDArray[Any]) -> Values:
    with np.errstate(invalid="ignore"):
        return np.asarray(bits.view(np.float32).astype(np.float64))


def _wrapped(bits: int, unit: float, rounding: Form, x: Values) -> Values:
    """Values as signed whole numbers of so many bits that overflow."""
    half = float(1 << bits - 1)
    return np.asarray(((rounding(x * unit) + half) % (2.0 * half) - half) / unit)


def _cause_of_alarms(found: Values, expected: NDArray[np.float32]) -> str | None:
    """Cause that explains the samples with alarms."""
    is_due = expected.astype(np.float64)
    raised, due = np.flatnonzero(found), np.flatnonzero(is_due)
    if not len(raised):
        return f"never raised: {len(due)} are due"
    for lag in (*range(1, 17), -1):
        if np.array_equal(_lagged(is_due, lag), found):
            return "one sample early" if lag < 0 else f"{'one sample' if lag == 1 else f'{lag} samples'} late"
    if np.array_equal(1.0 - is_due, found):
        return "inverted: raised where none is due"
    if len(due) and (cause := _held(found, is_due, due)):
        return cause
    if set(raised) < set(due):
        lost = sorted(set(due.tolist()) - set(raised.tolist()))
        return f"lost: {len(lost)} of {len(due)}, the first at sample {lost[0]}"
    return None


def _held(found: Values, is_due: Values, due: NDArray[np.int64]) -> str | None:
    """Cause if each alarm stays up: for a number of samples, or for ever."""
    if np.array_equal(np.maximum.accumulate(is_due), found):
        return "held for ever: the alarm is a level that nothing clears"
    ends = np.flatnonzero(found[int(due[0]) :] == 0)
    length = int(ends[0]) if len(ends) else 0
    if _HELD[0] <= length <= _HELD[1]:
        kernel = np.ones(length)
        if np.array_equal(np.convolve(is_due, kernel)[: len(found)] > 0, found > 0):
            return f"held for {length} samples: the alarm is a level, not an event"
    return None


def _torn(answered: DeviceAnswers, expected: Matrix, wrong: NDArray[np.bool_], columns: Sequence[int]) -> str:
    """Cause if every wrong value of some columns is one of the samples before."""
    ages: set[int] = set()
    rows: set[int] = set()
    for column in columns:
        at = np.flatnonzero(wrong[:, column])
        left = np.ones(len(at), np.bool_)
        for age in range(1, _OLDEST + 1):
            earlier = np.where(at >= age, expected[np.maximum(at - age, 0), column], 0.0)
            near = np.abs(answered.values[at, column] - earlier) <= answered.tolerance[at, column]
            if (left & near).any():
                ages.add(age)
                rows.update(at[left & near].tolist())
            left &= ~near
            if not left.any():
                break
        if left.any():
            return ""
    first = min(rows)
    oldest = "the sample before" if ages == {1} else f"up to {max(ages)} samples before"
    return (
        f"partially updated record: of {oldest} in {len(rows)} samples, the first {first}{_spacing(rows)}"
        " (torn: read while it was written, or one page of several was not updated)"
    )


def _swapped(answered: DeviceAnswers, expected: Matrix, columns: Sequence[int]) -> str:
    """Cause if the values of some columns change places in some samples."""
    for column in columns:
        use = answered.compared[:, column]
        near = [
            np.abs(answered.values[use, column] - expected[use, other]) <= answered.tolerance[use, column]
            for other in range(expected.shape[1] - 1)
        ]
        if not np.any(near, axis=0).all():
            return ""
    return "values of other fields in some samples: pages of the answer are mixed up"


def _spacing(rows: set[int]) -> str:
    steps: set[int] = set(np.diff(sorted(rows)).tolist())
    return f", then each {steps.pop()}" if len(steps) == 1 and len(rows) > 2 else ""
