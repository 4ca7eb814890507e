"""Faults of single samples: one edit after the other of what the library gets, until its answers are the device's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from analogrig.claims.answered import DeviceAnswers
from analogrig.claims.feed import Feed, Library
from analogrig.claims.sample_faults import HIGH, LOW, Alter, torn

MOST_EVENTS = 12

_BACK_N = 6
"""Samples before the first difference in which its cause may lie: some have no equation of their own."""

_WINDOW_N = 300
"""Samples after the first difference that an edit must explain in part."""

_LEAST_GAIN_N = 3

_BITS = 16


@dataclass(frozen=True)
class Edit:
    """Fault of one sample."""

    kind: str
    at: int
    """Step of the library."""


def find_events(answered: DeviceAnswers, library: Library, feed: Feed) -> tuple[list[Edit], Feed]:
    """Faults of single samples, in order, and the feed with all of them."""
    found: list[Edit] = []
    n = len(answered.values)
    while (first := answered.first_difference(library.replay(feed))) < n and len(found) < MOST_EVENTS:
        best = _best_edit(answered, library, feed, first)
        if best is None:
            break
        found.append(best[0])
        feed = best[1](feed)
        if (repeated := _repeated(answered, library, feed, found)) is not None:
            return found, repeated
    return found, feed


def _best_edit(answered: DeviceAnswers, library: Library, feed: Feed, first: int) -> tuple[Edit, Alter] | None:
    """Edit after which the answers agree for longest."""
    n = min(len(answered.values), first + _WINDOW_N)
    shown, short = answered.upto(n), feed.upto(n)
    here, longest = int(short.answer[first]), min(first + _LEAST_GAIN_N, n) - 1
    best: tuple[Edit, Alter] | None = None
    for at in range(here, max(here - _BACK_N, -1), -1):
        for kind, change in _edits(short, at):
            agreed = shown.first_difference(library.replay(change(short)))
            if agreed > longest:
                longest, best = agreed, (Edit(kind, at), change)
    return best


def _repeated(answered: DeviceAnswers, library: Library, feed: Feed, found: list[Edit]) -> Feed | None:
    """The feed with the last edit repeated at the distance of the last two, if that explains the rest."""
    if len(found) < 2 or found[-1].kind != found[-2].kind or found[-1].kind in _SHIFTING:
        return None
    period = found[-1].at - found[-2].at
    for at in range(found[-1].at + period, len(feed.u), period):
        change = dict(_edits(feed, at)).get(found[-1].kind)
        if change is None:
            return None
        feed = change(feed)
    return feed if answered.first_difference(library.replay(feed)) == len(answered.values) else None


_LOST, _TWICE = "sample lost: never entered", "sample entered twice"
_SHIFTING = (_LOST, _TWICE)
"""Edits that move the steps after them."""


def _edits(feed: Feed, at: int) -> Iterator[tuple[str, Alter]]:
    """Every fault of one step, by its name."""
    u, y = feed.u, feed.y
    before, after = max(at - 1, 0), min(at + 1, len(u) - 1)
    stale = {"u": u[before], "y": y[before]}
    yield _LOST, lambda feed: feed.without(feed.at(at))
    yield "stale sample: that before it is taken again", lambda feed: feed.put(at, **stale)
    yield _TWICE, lambda feed: feed.twice(feed.at(at))
    if feed.valid[at]:
        yield "sample treated as missing", lambda feed: feed.put(at, valid=False)
    else:
        measured = "missing sample treated as measured"
        yield measured, lambda feed: feed.put(at, valid=True)
        yield f"{measured}: the last one again", lambda feed: feed.put(at, valid=True, **stale)
    yield "reset before the sample", lambda feed: feed.restarted(at)
    if at + 1 < len(u):
        yield "reset after the sample", lambda feed: feed.restarted(at + 1)
    for name, x in (("u", u), ("y", y)):
        for kind, value in _values(x[at], x[before], x[after]):
            yield kind.format(name), _put(at, name, value)


def _put(at: int, name: str, value: float) -> Alter:
    return lambda feed: feed.put(at, **{name: value})


def _values(now: float, before: float, after: float) -> Iterator[tuple[str, float]]:
    """Values that may be read instead of one, by the fault; {} stands for the name of the signal."""
    yield "stale {}: that of the sample before", before
    yield "{} of the next sample", after
    yield "{} = 0", 0.0
    for other, which in ((before, "before"), (after, "after")):
        for bits, part in ((HIGH, "high"), (LOW, "low")):
            value = torn(np.array([now]), np.array([other]), bits)[0]
            if value not in (now, other):
                yield f"torn read of {{}}: {part} byte of the sample {which}", float(value)
    for bit in range(_BITS):
        yield f"bit {bit} of {{}} inverted", float(int(now) ^ 1 << bit)
