"""Faults on the way to the estimator: samples lost, repeated, late, missing, or entered in a wrong record."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.claims.feed import Feed

Mask = NDArray[np.bool_]
Where = Callable[[Feed], Mask]
Alter = Callable[[Feed], Feed]

_CYCLES = (*(1 << bits for bits in range(16, 1, -1)), 10_000, 1000, 255, 127, 100, 50, 10, 7, 5, 3)
_GAP_N = 64
_LONG_GAPS_N = (8, 16, 32)


class Suspect(NamedTuple):
    """Cause of differences, with what the library would have to be given."""

    cause: str
    alter: Alter
    settings: Mapping[str, Any] = {}

    def with_other(self, other: Suspect) -> Suspect:
        """Both causes at once."""

        def alter(feed: Feed) -> Feed:
            return other.alter(self.alter(feed))

        return Suspect(f"{self.cause}; and {other.cause}", alter, {**self.settings, **other.settings})


def input_hypotheses(feed: Feed, before: Feed | None, alarms: NDArray[np.int64]) -> Iterator[Suspect]:
    """Hypotheses about the samples that reach the estimator, and when it is reset.

    :param before: steps of the record before the first one, if they are known.
    :param alarms: samples in which the device has raised an alarm.
    """
    if before is not None:
        yield from _left_from(before)
    yield from _records()
    yield from _after_alarms(alarms)
    if not feed.valid.all():
        yield from _missing()
    yield from _order()
    for cycle in _CYCLES:
        if cycle < len(feed.u):
            yield from _cycles(cycle)


# ------------------------------------------------------------------------------------------------------ building blocks


def previous(x: NDArray[Any]) -> NDArray[Any]:
    """Values of the step before."""
    return np.concatenate([x[:1], x[:-1]])


def previous_or_zero(x: NDArray[Any]) -> NDArray[Any]:
    """Values of the step before, and 0 before the first."""
    return np.concatenate([np.zeros_like(x[:1]), x[:-1]])


def following(x: NDArray[Any]) -> NDArray[Any]:
    """Values of the step after."""
    return np.concatenate([x[1:], x[-1:]])


def treat_as_missing(feed: Feed, mask: Mask) -> Feed:
    return feed.altered(valid=feed.valid & ~mask)


def _replaced(replacement: Callable[[NDArray[Any]], NDArray[Any]], feed: Feed, mask: Mask) -> Feed:
    arrays = {name: np.where(mask, replacement(getattr(feed, name)), getattr(feed, name)) for name in ("u", "y")}
    return feed.altered(**arrays)


def _reset(feed: Feed, mask: Mask) -> Feed:
    return feed.restarted(*np.flatnonzero(mask).tolist())


_TREATMENTS: Mapping[str, Callable[[Feed, Mask], Feed]] = {
    "lost: never entered": Feed.without,
    "treated as missing": treat_as_missing,
    "entered twice": Feed.twice,
    "stale: that before it is taken again": functools.partial(_replaced, previous),
    "replaced by the next one": functools.partial(_replaced, following),
    "read as zero": functools.partial(_replaced, np.zeros_like),
}
"""Treatments of single samples, by the end of the sentence that names the cause."""


def on(where: Where, treat: Callable[[Feed, Mask], Feed], feed: Feed) -> Feed:
    """The feed with a treatment of some of its steps."""
    return treat(feed, where(feed))


def _treated(which: str, where: Where) -> Iterator[Suspect]:
    for treatment, treat in _TREATMENTS.items():
        yield Suspect(f"{which} {treatment}", functools.partial(on, where, treat))


def _since_restart(feed: Feed) -> NDArray[np.int64]:
    """Number of steps since the record began."""
    index = np.arange(len(feed.u))
    starts = np.zeros(len(feed.u), np.bool_)
    starts[[each for each in feed.restarts if each < len(starts)]] = True
    return np.asarray(index - np.maximum.accumulate(np.where(starts, index, 0)))


# -------------------------------------------------------------------------------------------------------------- records


def _left_from(before: Feed) -> Iterator[Suspect]:
    yield Suspect(
        "not reset between records: the estimator keeps its state from the record before",
        lambda feed: feed.after(before),
    )
    u, y = before.u[-1], before.y[-1]
    yield Suspect(
        "first sample of a record is stale: the last one of the record before is taken instead",
        lambda feed: feed.put(0, u=u, y=y),
    )
    yield Suspect(
        "one sample late: each sample is the one before, the first the last of the record before",
        lambda feed: feed.altered(u=np.append(u, feed.u[:-1]), y=np.append(y, feed.y[:-1])),
    )
    yield Suspect(
        "last sample of the record before is entered after the reset, before the first",
        lambda feed: feed.twice(_first(1, feed)).put(0, u=u, y=y),
    )


def _records() -> Iterator[Suspect]:
    yield Suspect(
        "not reset between records: the estimator keeps its state when a record begins",
        lambda feed: dataclasses.replace(feed, restarts=(0,)),
    )
    yield from _treated("first sample of a record", functools.partial(_first, 1))
    yield from _treated("first two samples of a record", functools.partial(_first, 2))
    yield Suspect("reset with the second sample of a record", lambda feed: _reset(feed, _since_restart(feed) == 1))


def _first(number: int, feed: Feed) -> Mask:
    return np.asarray(_since_restart(feed) < number)


def _after_alarms(alarms: NDArray[np.int64]) -> Iterator[Suspect]:
    if not len(alarms):
        return

    def after(feed: Feed) -> Mask:
        return feed.at(*alarms + 1)

    yield Suspect("reset after each alarm", functools.partial(on, after, _reset))
    yield Suspect(
        "nothing entered after the first alarm", lambda feed: feed.without(np.arange(len(feed.u)) > alarms[0])
    )
    yield from _treated("sample after each alarm", after)


# ------------------------------------------------------------------------------------------------------ missing samples


def _missing() -> Iterator[Suspect]:
    as_measured = "missing samples treated as measured"
    yield Suspect(f"{as_measured}: their codes are entered", lambda feed: feed.altered(valid=feed.valid | True))
    yield Suspect(f"{as_measured}: the last sample is entered again", _held)
    yield Suspect(f"{as_measured}: zeros are entered", _zeroed)
    yield Suspect(f"{as_measured}: the codes 65535 are entered", functools.partial(_zeroed, code=65535.0))
    yield Suspect(
        "missing samples left out: the estimator is not told, and time shrinks", lambda feed: feed.without(~feed.valid)
    )
    yield Suspect(
        "one missing sample for each gap: its length is ignored",
        lambda feed: feed.without(~feed.valid & ~_after_valid(feed)),
    )
    yield Suspect(
        "a gap ends one sample late: the sample after a missing one is treated as missing",
        lambda feed: feed.altered(valid=feed.valid & _after_valid(feed)),
    )
    yield Suspect(
        "the mark of a missing sample is one sample late", lambda feed: feed.altered(valid=_after_valid(feed))
    )
    yield Suspect(
        "the mark of a missing sample is one sample early", lambda feed: feed.altered(valid=following(feed.valid))
    )
    yield Suspect("reset after each gap", functools.partial(on, functools.partial(_ends_of_gaps, 1), _reset))
    for length in _LONG_GAPS_N:
        where = functools.partial(_ends_of_gaps, length)
        yield Suspect(f"reset after each gap of {length} samples or more", functools.partial(on, where, _reset))
    yield from _treated("sample after each gap", functools.partial(_ends_of_gaps, 1))
    yield from _treated("sample before each gap", _starts_of_gaps)


def _after_valid(feed: Feed) -> Mask:
    """True where the step before is valid."""
    return np.concatenate([[True], feed.valid[:-1]])


def _ends_of_gaps(length: int, feed: Feed) -> Mask:
    """Valid steps after a gap of at least so many."""
    index = np.arange(len(feed.u))
    last = np.maximum.accumulate(np.where(feed.valid, index, -1))
    since = index - np.concatenate([[-1], last[:-1]]) - 1
    return np.asarray(feed.valid & (since >= length))


def _starts_of_gaps(feed: Feed) -> Mask:
    return np.asarray(feed.valid & ~np.append(feed.valid[1:], True))


def _held(feed: Feed) -> Feed:
    last = np.maximum.accumulate(np.where(feed.valid, np.arange(len(feed.u)), -1))
    arrays = {name: np.where(last < 0, 0.0, getattr(feed, name)[np.maximum(last, 0)]) for name in ("u", "y")}
    return feed.altered(valid=feed.valid | True, **arrays)


def _zeroed(feed: Feed, code: float = 0.0) -> Feed:
    u, y = (np.where(feed.valid, x, code) for x in (feed.u, feed.y))
    return feed.altered(valid=feed.valid | True, u=u, y=y)


# ---------------------------------------------------------------------------------------------------- order of samples


def _order() -> Iterator[Suspect]:
    yield Suspect("u and y swapped", lambda feed: feed.altered(u=feed.y, y=feed.u))
    yield Suspect(
        "channels shifted by one conversion: u is y of the sample before, y is u",
        lambda feed: feed.altered(u=previous(feed.y), y=feed.u),
    )
    yield Suspect(
        "channels shifted by one conversion: u is y, y is u of the next sample",
        lambda feed: feed.altered(u=feed.y, y=following(feed.u)),
    )
    yield Suspect("u taken for y", lambda feed: feed.altered(y=feed.u))
    yield Suspect("y taken for u", lambda feed: feed.altered(u=feed.y))
    both = ((("u", "y"), "u and y are"), (("u",), "u is"), (("y",), "y is"))
    for (by, late), (names, what), fill in itertools.product(
        ((1, "one sample late"), (2, "two samples late"), (3, "three samples late")), both, (None, 0.0)
    ):
        yield Suspect(f"{late}: {what} of an earlier sample", functools.partial(_late, names, by, fill))
    for names, what in both[1:]:
        yield Suspect(f"one sample early: {what} of the next sample", functools.partial(_early, names))
    yield from _treated("each second sample", lambda feed: _since_restart(feed) % 2 == 1)
    yield Suspect("each sample entered twice", lambda feed: feed.twice(feed.valid | True))
    yield Suspect("the first of each two samples lost", lambda feed: feed.without(_since_restart(feed) % 2 == 0))
    yield Suspect("each two samples in reverse order", _pairs_reversed)


def _late(names: Sequence[str], by: int, fill: float | None, feed: Feed) -> Feed:
    arrays = {}
    for name in names:
        x = getattr(feed, name)
        head = np.full(by, x[0] if fill is None else fill, np.float32)
        arrays[name] = np.concatenate([head, x[:-by]])[: len(x)]
    valid = np.concatenate([np.ones(by, np.bool_), feed.valid[:-by]])[: len(feed.u)] if len(names) > 1 else feed.valid
    return feed.altered(valid=valid, **arrays)


def _early(names: Sequence[str], feed: Feed) -> Feed:
    return feed.altered(**{name: following(getattr(feed, name)) for name in names})


def _pairs_reversed(feed: Feed) -> Feed:
    order = np.minimum(np.arange(len(feed.u)) ^ 1, len(feed.u) - 1)
    return feed.altered(u=feed.u[order], y=feed.y[order], valid=feed.valid[order])


# --------------------------------------------------------------------------------------------------------------- cycles


def _cycles(cycle: int) -> Iterator[Suspect]:
    for phase in (0, -1):
        place = ", ".join(str(number * cycle + phase) for number in (1, 2))
        where = functools.partial(_each, cycle, phase)
        yield from _treated(f"each {cycle}th sample ({place}, ...)", where)
        yield Suspect(f"reset at each {cycle}th sample ({place}, ...)", functools.partial(on, where, _reset))
    beyond = functools.partial(_beyond, cycle)
    yield Suspect(f"nothing entered after {cycle} samples", functools.partial(on, beyond, Feed.without))
    yield Suspect(f"samples treated as missing after {cycle} samples", functools.partial(on, beyond, treat_as_missing))
    yield Suspect(f"a gap taken for where the index wraps at {cycle}", functools.partial(_gap_each, cycle))


def _each(cycle: int, phase: int, feed: Feed) -> Mask:
    index = _since_restart(feed)
    return np.asarray((index > 0) & ((index - phase) % cycle == 0))


def _beyond(number: int, feed: Feed) -> Mask:
    return np.asarray(_since_restart(feed) >= number)


def _gap_each(cycle: int, feed: Feed) -> Feed:
    """The feed with missing samples before each wrap of the index."""
    times = 1 + _each(cycle, 0, feed) * _GAP_N
    longer = feed.times(times)
    return longer.altered(valid=longer.valid & longer.at(*np.cumsum(times) - 1))
