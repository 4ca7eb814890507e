"""Faults on the way from the estimator: each field of the answers as another field, sample, scale or form of it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.claims.answered import DeviceAnswers
from analogrig.claims.feed import ALARM, Matrix

Values = NDArray[np.float64]
Form = Callable[[Values], Values]

_FACTORS = (0.5, 2.0, 1000.0, 0.001, 100.0, 0.01, 10.0, 0.1, 1e6, 1e-6, 65536.0, 256.0, 1 / 256.0, 1 / 65536.0)
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
    yield from _FORMS
    low, high = all_found.min(), all_found.max()
    yield f"limited to {low:g} .. {high:g}", partial(np.clip, a_min=low, a_max=high)
    yield f"limited to {high:g}", partial(np.minimum, high)
    yield f"limited from {low:g} on", partial(np.maximum, low)
    yield from _OVERFLOWS
    if (big := np.abs(expected) > 0.5 * np.abs(expected).max()).any():
        ratio = float(np.median(found[big] / expected[big]))
        yield f"scaled by {ratio:.4g}", partial(np.multiply, ratio)
    shift = float(np.median(found - expected))
    yield f"shifted by {shift:.4g}", partial(np.add, shift)


def _unpadded(digits: int, rounding: Form) -> Form:
    """Fraction printed as a whole number of ``digits`` digits without leading zeros."""

    def form(x: Values) -> Values:
        whole, fraction = np.divmod(rounding(np.abs(x) * 10.0**digits), 10.0**digits)
        length = np.floor(np.log10(np.maximum(fraction, 1.0))) + 1.0
        return np.asarray(np.sign(x) * (whole + fraction / 10.0**length))

    return form


def _rounded(digits: int, x: Values) -> Values:
    return np.round(x, digits)


def _of_bits(change: Callable[[NDArray[np.uint32]], NDArray[Any]]) -> Form:
    """Change of the bits of the float."""

    def form(x: Values) -> Values:
        bits = change(np.ascontiguousarray(x.astype(np.float32)).view(np.uint32))
        with np.errstate(invalid="ignore"):
            return np.asarray(bits.view(np.float32).astype(np.float64))

    return form


_FORMS: Sequence[tuple[str, Form]] = (
    ("", np.asarray),
    ("with the other sign", np.negative),
    *((f"scaled by {factor:g}", partial(np.multiply, factor)) for factor in _FACTORS),
    ("without its sign", np.abs),
    ("without its sign between -1 and 0", lambda x: np.where(np.abs(x) < 1.0, np.abs(x), x)),
    *(
        (f"zeros after the point lost: {digits} digits printed as a whole number", _unpadded(digits, rounding))
        for digits, rounding in itertools.product((6, 5, 4, 3, 2), (np.rint, np.trunc))
    ),
    *((f"rounded to {n} digits after the point", partial(_rounded, n)) for n in range(6)),
    *(
        (f"cut to {n} digits after the point", partial(lambda n, x: np.trunc(x * 10.0**n) / 10.0**n, n))
        for n in range(6)
    ),
    ("squared", np.square),
    ("of the square root", lambda x: np.sqrt(np.abs(x))),
    ("byte-swapped float", _of_bits(lambda bits: bits.byteswap())),
    ("float with its 16-bit halves swapped", _of_bits(lambda bits: bits >> 16 | bits << 16)),
    ("float with the bytes of each half swapped", _of_bits(lambda bits: bits.view(np.uint16).byteswap())),
    ("bits of the float read as a whole number", lambda x: x.astype(np.float32).view(np.int32).astype(np.float64)),
    ("cut to the upper 16 bits of the float", _of_bits(lambda bits: bits >> 16 << 16)),
)

_OVERFLOWS: Sequence[tuple[str, Form]] = [
    (
        f"in units of {1.0 / unit:g} that overflow {bits} bits",
        partial(
            lambda unit, rounding, half, x: ((rounding(x * unit) + half) % (2.0 * half) - half) / unit,
            unit,
            rounding,
            float(1 << bits - 1),
        ),
    )
    for bits, unit, rounding in itertools.product((8, 16), _UNITS, (np.rint, np.trunc, np.floor))
]


def _cause_of_alarms(found: Values, expected: NDArray[np.float32]) -> str | None:
    """Cause that explains the samples with alarms."""
    is_due = expected.astype(np.float64)
    raised, due = np.flatnonzero(found), np.flatnonzero(is_due)
    if not len(raised):
        return f"never raised: {len(due)} are due"
    forms = {
        "one sample late": _lagged(is_due, 1),
        **{f"{lag} samples late": _lagged(is_due, lag) for lag in range(2, 17)},
        "one sample early": _lagged(is_due, -1),
        "inverted: raised where none is due": 1.0 - is_due,
        "held for ever: the alarm is a level that nothing clears": np.maximum.accumulate(is_due),
    }
    if cause := next((cause for cause, form in forms.items() if np.array_equal(form, found)), ""):
        return cause
    ends = np.flatnonzero(found[due[0] :] == 0) if len(due) else due
    length = int(ends[0]) if len(ends) else 0
    if _HELD[0] <= length <= _HELD[1] and np.array_equal(
        np.convolve(is_due, np.ones(length))[: len(found)] > 0, found > 0
    ):
        return f"held for {length} samples: the alarm is a level, not an event"
    lost = sorted(set(due.tolist()) - set(raised.tolist()))
    return f"lost: {len(lost)} of {len(due)}, the first at sample {lost[0]}" if set(raised) < set(due) else None


def _torn(answered: DeviceAnswers, expected: Matrix, wrong: NDArray[np.bool_], columns: Sequence[int]) -> str:
    """Cause if every wrong value of some columns is one of the samples before."""
    ages: set[int] = set()
    rows: set[int] = set()
    for column in columns:
        at = np.flatnonzero(wrong[:, column])
        for age in range(1, _OLDEST + 1):
            earlier = np.where(at >= age, expected[np.maximum(at - age, 0), column], 0.0)
            near = np.abs(answered.values[at, column] - earlier) <= answered.tolerance[at, column]
            if near.any():
                ages.add(age)
                rows.update(at[near].tolist())
            at = at[~near]
            if not len(at):
                break
        else:
            return ""
    first, steps = min(rows), set(np.diff(sorted(rows)).tolist())
    oldest = "the sample before" if ages == {1} else f"up to {max(ages)} samples before"
    spacing = f", then each {steps.pop()}" if len(steps) == 1 and len(rows) > 2 else ""
    return (
        f"partially updated record: of {oldest} in {len(rows)} samples, the first {first}{spacing}"
        " (torn: read while it was written, or one page of several was not updated)"
    )


def _swapped(answered: DeviceAnswers, expected: Matrix, columns: Sequence[int]) -> str:
    """Cause if the values of some columns change places in some samples."""
    for column in columns:
        use = answered.compared[:, column]
        found, tolerance = answered.values[use, column], answered.tolerance[use, column]
        near = [np.abs(found - expected[use, other]) <= tolerance for other in range(expected.shape[1] - 1)]
        if not np.any(near, axis=0).all():
            return ""
    return "values of other fields in some samples: pages of the answer are mixed up"
