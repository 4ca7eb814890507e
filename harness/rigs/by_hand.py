"""Tweaks that the instrument cannot make: asked for while a record is taken, and dated by its samples afterwards."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from harness.links.wire import Clock
from harness.onset import NoOnset, Onset, onset
from harness.plant import Plant
from harness.rigs.pots import Pots
from harness.run import Segment
from harness.turn import turn
from harness.two_filter import Record

BEFORE_S, AFTER_S = 0.02, 0.05
"""Machine time by which a record may have begun later than it was asked to, and a pot move after whoever turned it said
that it stood."""

LEAST_SEARCH_N = 8


@dataclass(frozen=True)
class Tweak:
    """Of one record."""

    sample: int
    """In the record: it is asked for when the clock says that this sample is taken."""
    dials: Mapping[str, float]
    before: Plant
    after: Plant

    @property
    def words(self) -> str:
        """As an operator thinks of it."""
        changed = self.before.changes_to(self.after)
        return ", ".join(f"{name} {new:g}" for name, (_, new) in changed.items())


class ByHand:
    """The tweaks of one record."""

    def __init__(
        self,
        pots: Pots,
        tweaks: Sequence[Tweak],
        rate_hz: float,
        clock: Clock = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._pots = pots
        self._tweaks = tweaks
        self._rate_hz = rate_hz
        self._clock = clock
        self._pause = pause
        self._spans_n: list[tuple[float, float]] = []

    def turn_all(self) -> None:
        """Each when it is due, from now on; called when the record has begun.

        :raises RigError: a pot could not be turned.
        """
        begun_s = self._clock()
        for tweak in self._tweaks:
            self._pause(max(0.0, begun_s + tweak.sample / self._rate_hz - self._clock()))
            asked_s = self._clock()
            self._pots.turn(tweak.dials, tweak.words)
            span_s = asked_s - begun_s - BEFORE_S, self._clock() - begun_s + AFTER_S
            self._spans_n.append((span_s[0] * self._rate_hz, span_s[1] * self._rate_hz))

    def dated(self, record: Record, first: int) -> list[Segment]:
        """What became of the plant, by the samples of the record, the first of which has this index in the run."""
        out: list[Segment] = []
        earliest = 1
        for i, (tweak, (low_n, high_n)) in enumerate(zip(self._tweaks, self._spans_n, strict=True)):
            following = self._spans_n[i + 1][0] if i + 1 < len(self._spans_n) else float(len(record))
            search = range(max(earliest, int(low_n)), min(len(record) - 1, int(following), int(high_n) + 1))
            segment = _dated(record, tweak, search)
            earliest = (segment.end_high or segment.start_high or search.stop) + 1
            out.append(_moved(segment, first))
        return out


def _dated(record: Record, tweak: Tweak, search: range) -> Segment:
    if len(search) < LEAST_SEARCH_N:
        start = min(search.start, len(record) - 1)
        return Segment(start, tweak.after, unseen="the pot was turned when the record was over, or nearly so")
    jump = onset(record, tweak.before, tweak.after, search)
    if isinstance(jump, Onset):
        return Segment(jump.sample, tweak.after, start_low=jump.low, start_high=jump.high)
    way = turn(record, tweak.before, tweak.after, search)
    if isinstance(way, NoOnset):
        return Segment(search.start, tweak.after, ramp_n=len(search), unseen=way.reason)
    return Segment(
        way.begin.sample,
        tweak.after,
        ramp_n=way.end.sample - way.begin.sample,
        start_low=way.begin.low,
        start_high=way.begin.high,
        end_low=way.end.low,
        end_high=way.end.high,
    )


def _moved(segment: Segment, by: int) -> Segment:
    """To the indices of the run."""

    def index(sample: int | None) -> int | None:
        return None if sample is None else sample + by

    return Segment(
        segment.start + by,
        segment.plant,
        segment.ramp_n,
        start_low=index(segment.start_low),
        start_high=index(segment.start_high),
        end_low=index(segment.end_low),
        end_high=index(segment.end_high),
        unseen=segment.unseen,
    )
