"""Faults on the way to the estimator: samples that are lost, repeated, late, missing, or have other codes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.claims.feed import Feed
from analogrig.run import Channel

Codes = NDArray[np.float32]
Mask = NDArray[np.bool_]
Alter = Callable[[Feed], Feed]
Where = Callable[[Feed], Mask]
Treat = Callable[[Feed, Mask], Feed]
Change = Callable[[Codes], Codes]

HIGH, LOW = 0xFF00, 0x00FF

_CYCLES = (*(1 << bits for bits in range(16, 1, -1)), 10_000, 1000, 255, 127, 100, 50, 10, 7, 5, 3)
_GAP_N = 64
_LONG_GAPS_N = (8, 16, 32)

_U, _Y, _BOTH = ("u",), ("y",), ("u", "y")


class Suspect(NamedTuple):
    """Cause of differences, with what the library would have to be given."""

    cause: str
    alter: Alter
    settings: Mapping[str, Any] = {}

    def with_other(self, other: Suspect) -> Suspect:
        """Both causes at once."""
        settings = {**self.settings, **other.settings}
        return Suspect(f"{self.cause}; and {other.cause}", lambda feed: other.alter(self.alter(feed)), settings)


def input_hypotheses(feed: Feed, before: Feed | None, alarms: NDArray[np.int64]) -> Iterator[Suspect]:
    """Hypotheses about the samples that reach the estimator, and when it is reset.

    :param before: steps of the record before the first one, if they are known.
    :param alarms: samples in which the device has raised an alarm.
    """
    if before is not None:
        yield from itertools.starmap(Suspect, _left_from(before).items())
    yield from itertools.starmap(Suspect, _RECORDS.items())
    if len(alarms):
        yield from itertools.starmap(Suspect, _after_alarms(alarms).items())
    if not feed.valid.all():
        yield from itertools.starmap(Suspect, _MISSING.items())
    yield from itertools.starmap(Suspect, _ORDER)
    for cycle in _CYCLES:
        if cycle < len(feed.u):
            yield from itertools.starmap(Suspect, _in_cycles(cycle).items())


def code_hypotheses() -> Iterator[Suspect]:
    """Hypotheses about the codes that reach the estimator: their scale, sign, bytes, digits and limits."""
    for (cause, change), (names, what) in itertools.product(_CHANGES.items(), _WHICH.items()):
        yield Suspect(f"{what} {cause}", changed(names, change))
    for (cause, test), (names, what) in itertools.product(_TESTS.items(), _WHICH.items()):
        where = partial(
            lambda names, test, feed: np.any([test(getattr(feed, each)) for each in names], axis=0), names, test
        )
        samples = f"where {what.replace('and', 'or')} {cause}"
        yield Suspect(f"samples treated as missing {samples}", on(where, treat_as_missing))
        yield Suspect(f"samples lost {samples}", on(where, Feed.without))
    for name, (cause, step) in itertools.product(_BOTH, _MISALIGNED.items()):
        yield Suspect(f"{name} read one byte off: {cause}", partial(_misread, name, step))
    for names, what in _WHICH.items():
        cause = f"repeated values of {what} lost: a sample equal to the one before is taken for a repetition"
        yield Suspect(cause, on(partial(_are_repeated, names), Feed.without))


def unit_hypotheses(channels: Mapping[str, Channel]) -> Iterator[Suspect]:
    """Hypotheses that the estimator gets another unit than codes."""
    units = (("volts", 1.0), ("millivolts", 1000.0), ("physical units", 0.0))
    for (unit, factor), (offset, zero) in itertools.product(units, (("", 1.0), (" that are 0 at code 0", 0.0))):
        scales = {}
        for name, channel in channels.items():
            by = factor or channel.unit_per_v
            scales[name] = np.float32(channel.lsb_v * by), np.float32(zero * channel.low_v * by)
        for names, what in _WHICH.items():
            chosen = {name: scales[name] for name in names}
            yield Suspect(f"{what} in {unit}{offset} instead of codes", partial(_rescaled, chosen))


# ------------------------------------------------------------------------------------------------------ building blocks


def previous(x: NDArray[Any]) -> NDArray[Any]:
    """Values of the step before."""
    return np.concatenate([x[:1], x[:-1]])


def _previous_or_zero(x: NDArray[Any]) -> NDArray[Any]:
    """Values of the step before, and 0 before the first."""
    return np.concatenate([np.zeros_like(x[:1]), x[:-1]])


def _following(x: NDArray[Any]) -> NDArray[Any]:
    """Values of the step after."""
    return np.concatenate([x[1:], x[-1:]])


def on(where: Where, treat: Treat) -> Alter:
    """Treatment of some of the steps."""
    return lambda feed: treat(feed, where(feed))


def treat_as_missing(feed: Feed, mask: Mask) -> Feed:
    return feed.altered(valid=feed.valid & ~mask)


def _reset(feed: Feed, mask: Mask) -> Feed:
    return feed.restarted(*np.flatnonzero(mask).tolist())


def _replaced(change: Change) -> Treat:
    return lambda feed, mask: feed.altered(
        u=np.where(mask, change(feed.u), feed.u), y=np.where(mask, change(feed.y), feed.y)
    )


def changed(names: Sequence[str], change: Change) -> Alter:
    return lambda feed: feed.altered(**{name: change(getattr(feed, name)) for name in names})


_TREATMENTS: Mapping[str, Treat] = {
    "lost: never entered": Feed.without,
    "treated as missing": treat_as_missing,
    "entered twice": Feed.twice,
    "stale: that before it is taken again": _replaced(previous),
    "replaced by the next one": _replaced(_following),
    "read as zero": _replaced(np.zeros_like),
}
"""Treatments of single samples, by the end of the sentence that names the cause."""


def _treated(which: str, where: Where) -> dict[str, Alter]:
    return {f"{which} {treatment}": on(where, treat) for treatment, treat in _TREATMENTS.items()}


def _since_restart(feed: Feed) -> NDArray[np.int64]:
    """Number of steps since the record began."""
    index = np.arange(len(feed.u))
    return np.asarray(index - np.maximum.accumulate(np.where(feed.at(*feed.restarts), index, 0)))


# -------------------------------------------------------------------------------------------------------------- records


def _left_from(before: Feed) -> dict[str, Alter]:
    u, y = before.u[-1], before.y[-1]
    return {
        "not reset between records: the estimator keeps its state from the record before": (
            lambda feed: feed.after(before)
        ),
        "first sample of a record is stale: the last one of the record before is taken instead": (
            lambda feed: feed.put(0, u=u, y=y)
        ),
        "one sample late: each sample is the one before, the first the last of the record before": (
            lambda feed: feed.altered(u=np.append(u, feed.u[:-1]), y=np.append(y, feed.y[:-1]))
        ),
        "last sample of the record before is entered after the reset, before the first": (
            lambda feed: feed.twice(_first(1)(feed)).put(0, u=u, y=y)
        ),
    }


def _first(number: int) -> Where:
    return lambda feed: _since_restart(feed) < number


_RECORDS: Mapping[str, Alter] = {
    "not reset between records: the estimator keeps its state when a record begins": (
        lambda feed: dataclasses.replace(feed, restarts=(0,))
    ),
    **_treated("first sample of a record", _first(1)),
    **_treated("first two samples of a record", _first(2)),
    "reset with the second sample of a record": lambda feed: _reset(feed, _since_restart(feed) == 1),
}


def _after_alarms(alarms: NDArray[np.int64]) -> dict[str, Alter]:
    def after(feed: Feed) -> Mask:
        return feed.at(*alarms + 1)

    return {
        "reset after each alarm": on(after, _reset),
        "nothing entered after the first alarm": lambda feed: feed.without(np.arange(len(feed.u)) > alarms[0]),
        **_treated("sample after each alarm", after),
    }


# ------------------------------------------------------------------------------------------------------ missing samples


def _filled(fill: Callable[[Codes, Mask], Codes]) -> Alter:
    """All samples are entered, the missing ones with other codes."""
    return lambda feed: feed.altered(valid=feed.valid | True, u=fill(feed.u, feed.valid), y=fill(feed.y, feed.valid))


def _held(x: Codes, valid: Mask) -> Codes:
    last = np.maximum.accumulate(np.where(valid, np.arange(len(x)), -1))
    return np.where(last < 0, np.float32(0.0), x[np.maximum(last, 0)])


def _after_valid(feed: Feed) -> Mask:
    """True where the step before is valid."""
    return np.concatenate([[True], feed.valid[:-1]])


def _ends_of_gaps(length: int, feed: Feed) -> Mask:
    """Valid steps after a gap of at least so many."""
    index = np.arange(len(feed.u))
    last = np.maximum.accumulate(np.where(feed.valid, index, -1))
    since = index - np.append(-1, last[:-1]) - 1
    return np.asarray(feed.valid & (since >= length))


_AS_MEASURED = "missing samples treated as measured"

_MISSING: Mapping[str, Alter] = {
    f"{_AS_MEASURED}: their codes are entered": lambda feed: feed.altered(valid=feed.valid | True),
    f"{_AS_MEASURED}: the last sample is entered again": _filled(_held),
    f"{_AS_MEASURED}: zeros are entered": _filled(lambda x, valid: np.where(valid, x, np.float32(0.0))),
    f"{_AS_MEASURED}: the codes 65535 are entered": _filled(lambda x, valid: np.where(valid, x, np.float32(65535.0))),
    "missing samples left out: the estimator is not told, and time shrinks": lambda feed: feed.without(~feed.valid),
    "one missing sample for each gap: its length is ignored": (
        lambda feed: feed.without(~feed.valid & ~_after_valid(feed))
    ),
    "a gap ends one sample late: the sample after a missing one is treated as missing": (
        lambda feed: feed.altered(valid=feed.valid & _after_valid(feed))
    ),
    "the mark of a missing sample is one sample late": lambda feed: feed.altered(valid=_after_valid(feed)),
    "the mark of a missing sample is one sample early": lambda feed: feed.altered(valid=_following(feed.valid)),
    "reset after each gap": on(partial(_ends_of_gaps, 1), _reset),
    **{f"reset after each gap of {n} samples or more": on(partial(_ends_of_gaps, n), _reset) for n in _LONG_GAPS_N},
    **_treated("sample after each gap", partial(_ends_of_gaps, 1)),
    **_treated("sample before each gap", lambda feed: np.asarray(feed.valid & ~np.append(feed.valid[1:], True))),
}

# ---------------------------------------------------------------------------------------------------- order of samples


def _late(names: Sequence[str], by: int, fill: float | None, feed: Feed) -> Feed:
    late = changed(names, lambda x: np.append(np.full(by, x[0] if fill is None else fill), x[:-by])[: len(x)])(feed)
    return late.altered(valid=[*[True] * by, *feed.valid[:-by]][: len(feed.u)]) if len(names) > 1 else late


def _pairs_reversed(feed: Feed) -> Feed:
    order = np.minimum(np.arange(len(feed.u)) ^ 1, len(feed.u) - 1)
    return feed.altered(u=feed.u[order], y=feed.y[order], valid=feed.valid[order])


_OF = {_BOTH: "u and y are", _U: "u is", _Y: "y is"}

_ORDER: Sequence[tuple[str, Alter]] = (
    ("u and y swapped", lambda feed: feed.altered(u=feed.y, y=feed.u)),
    (
        "channels shifted by one conversion: u is y of the sample before, y is u",
        lambda feed: feed.altered(u=previous(feed.y), y=feed.u),
    ),
    (
        "channels shifted by one conversion: u is y, y is u of the next sample",
        lambda feed: feed.altered(u=feed.y, y=_following(feed.u)),
    ),
    ("u taken for y", lambda feed: feed.altered(y=feed.u)),
    ("y taken for u", lambda feed: feed.altered(u=feed.y)),
    *(
        (f"{late}: {what} of an earlier sample", partial(_late, names, by, fill))
        for by, late in ((1, "one sample late"), (2, "two samples late"), (3, "three samples late"))
        for names, what in _OF.items()
        for fill in (None, 0.0)
    ),
    *((f"one sample early: {_OF[names]} of the next sample", changed(names, _following)) for names in (_U, _Y)),
    *_treated("each second sample", lambda feed: _since_restart(feed) % 2 == 1).items(),
    ("each sample entered twice", lambda feed: feed.twice(feed.valid | True)),
    ("the first of each two samples lost", lambda feed: feed.without(_since_restart(feed) % 2 == 0)),
    ("each two samples in reverse order", _pairs_reversed),
)


def _in_cycles(cycle: int) -> dict[str, Alter]:
    found: dict[str, Alter] = {}
    for phase in (0, -1):
        which, where = (
            f"each {cycle}th sample ({cycle + phase}, {2 * cycle + phase}, ...)",
            partial(_each, cycle, phase),
        )
        found |= {**_treated(which, where), f"reset at {which}": on(where, _reset)}

    def gap_each(feed: Feed) -> Feed:
        times = 1 + _each(cycle, 0, feed) * _GAP_N
        longer = feed.times(times)
        return longer.altered(valid=longer.valid & longer.at(*np.cumsum(times) - 1))

    return {
        **found,
        f"nothing entered after {cycle} samples": lambda feed: feed.without(_since_restart(feed) >= cycle),
        f"samples treated as missing after {cycle} samples": (
            lambda feed: treat_as_missing(feed, _since_restart(feed) >= cycle)
        ),
        f"a gap taken for where the index wraps at {cycle}": gap_each,
    }


def _each(cycle: int, phase: int, feed: Feed) -> Mask:
    index = _since_restart(feed)
    return np.asarray((index > 0) & ((index - phase) % cycle == 0))


# ---------------------------------------------------------------------------------------------------------------- codes


_WHICH = {_BOTH: "u and y", _Y: "y", _U: "u"}

_SCALES = (0.5, 2.0, 0.1, 10.0, 0.25, 4.0, 0.0625, 16.0, 0.01, 100.0, 0.001, 1000.0, 0.00390625, 256.0, -1.0)
_OFFSETS = (1.0, -1.0, 0.5, -0.5, -2048.0, 2048.0, -128.0, -512.0, -32768.0)
_LIMITS = (127, 255, 511, 999, 1000, 1023, 2047, 2048, 3000, 3500, 4000, 4090, 4094, 4095)
_TOP = 4095


def torn(now: Codes, other: Codes, mask: int) -> Codes:
    """Codes with the bits of ``mask`` of others."""
    return (now.astype(np.int64) & ~mask | other.astype(np.int64) & mask).astype(np.float32)


def _signed(half: int, x: Codes) -> Codes:
    return ((x.astype(np.int64) + half & 2 * half - 1) - half).astype(np.float32)


def _shifted(right: int, left: int, x: Codes) -> Codes:
    return (x.astype(np.int64) >> right << left).astype(np.float32)


def _remainder(of: float, x: Codes) -> Codes:
    return np.remainder(x, np.float32(of))


def _first_digits(digits: int, x: Codes) -> Codes:
    length = np.floor(np.log10(np.maximum(x, 1.0).astype(np.float64)) + 1e-12) + 1.0
    return np.floor(x / 10.0 ** np.maximum(length - digits, 0.0)).astype(np.float32)


def _averaged(number: int, x: Codes) -> Codes:
    padded = np.concatenate([np.repeat(x[:1], number - 1), x]).astype(np.float64)
    return (np.convolve(padded, np.ones(number), "valid") / number).astype(np.float32)


_NEIGHBOURS: Mapping[str, Change] = {
    "sample before": previous,
    "sample before (0 at first)": _previous_or_zero,
    "next sample": _following,
}

_CHANGES: Mapping[str, Change] = {
    **{f"scaled by {factor:g}": partial(np.multiply, np.float32(factor)) for factor in _SCALES},
    **{f"shifted by {offset:g} codes": partial(np.add, np.float32(offset)) for offset in _OFFSETS},
    f"inverted: {_TOP} - code": lambda x: _TOP - x,
    # where several agree, that of the converter
    **{f"read as signed codes of {bits} bits": partial(_signed, 1 << bits - 1) for bits in (12, 16, 13, 11, 10, 8)},
    **{f"cut to the low {bits} bits: the code overflows": partial(_remainder, 1 << bits) for bits in (11, 10, 8)},
    **{f"without the low {bits} bits": partial(_shifted, bits, bits) for bits in (1, 2, 3, 4, 8)},
    **{f"shifted right by {bits} bits": partial(_shifted, bits, 0) for bits in (1, 2, 3, 4, 8)},
    **{f"cut to the first {digits} digits": partial(_first_digits, digits) for digits in (1, 2, 3)},
    **{f"cut to the last {digits} digits": partial(_remainder, 10**digits) for digits in (1, 2, 3)},
    "byte-swapped": lambda x: x.astype(np.uint16).byteswap().astype(np.float32),
    **{f"limited to {limit}": partial(np.minimum, np.float32(limit)) for limit in _LIMITS[:-1]},
    "constant: the first sample for ever": lambda x: np.full_like(x, x[0]),
    "always 0": np.zeros_like,
    **{f"averaged over {number} samples": partial(_averaged, number) for number in (2, 3, 4, 8)},
    **{
        f"torn: {part} byte of the {which}, {rest} byte of this one": partial(
            lambda neighbour, mask, x: torn(x, neighbour(x), mask), neighbour, mask
        )
        for mask, part, rest in ((HIGH, "high", "low"), (LOW, "low", "high"))
        for which, neighbour in _NEIGHBOURS.items()
    },
}


def _has_low_byte(values: Sequence[int], x: Codes) -> Mask:
    return np.isin(x.astype(np.int64) & LOW, values)


def _has_byte(values: Sequence[int], x: Codes) -> Mask:
    return _has_low_byte(values, x) | np.isin(x.astype(np.int64) >> 8, values)


_SPECIAL = {"of 0": (0,), "of a line end": (10, 13), "of 0 or a line end": (0, 10, 13)}
"""Bytes that a framing may give a meaning."""

_TESTS: Mapping[str, Callable[[Codes], Mask]] = {
    **{f"is {limit} or more": partial(np.less_equal, np.float32(limit)) for limit in _LIMITS},
    "is 0": lambda x: x == 0,
    **{f"has a low byte {which}": partial(_has_low_byte, values) for which, values in _SPECIAL.items()},
    **{f"has a byte {which}": partial(_has_byte, values) for which, values in _SPECIAL.items()},
}

_MISALIGNED = {
    "high byte of u, then low byte of y": 1,
    "low byte of y as low byte, high byte of u as high byte": -1,
}
"""Readings one byte off, with the step through the high byte of u and the low byte of y from the low byte on."""


def _misread(name: str, step: int, feed: Feed) -> Feed:
    low, high = (feed.u.astype(np.int64) >> 8 & LOW, feed.y.astype(np.int64) & LOW)[::step]
    return feed.altered(**{name: low | high << 8})


def _are_repeated(names: Sequence[str], feed: Feed) -> Mask:
    same = [np.append([False], np.diff(getattr(feed, name)) == 0) for name in names]
    return np.asarray(np.all(same, axis=0))


def _rescaled(scales: Mapping[str, tuple[np.float32, np.float32]], feed: Feed) -> Feed:
    return feed.altered(**{name: getattr(feed, name) * factor + zero for name, (factor, zero) in scales.items()})
