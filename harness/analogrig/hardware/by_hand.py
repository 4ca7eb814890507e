"""Tweaks that the instrument cannot make: asked for while a record is taken, and dated by its samples afterwards."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from analogrig.hardware.dating.jump import NoInstant, date_jump
from analogrig.hardware.dating.turn import TurnInstants, date_turn
from analogrig.hardware.dating.two_filter import Signals
from analogrig.hardware.pots import Pots
from analogrig.links.wire import Clock
from analogrig.plant import AT_REST, Plant, SampledPlant
from analogrig.run import Segment

BEFORE_S, AFTER_S = 0.02, 0.05
"""Machine time by which a record may have begun later than it was asked to, and a pot move after whoever turned it said
that it stood."""

LEAST_SEARCH_N = 8

_PLAIN = 1000.0
"""With so much information, in the sense of ``analogrig.judging.information``, a change cannot but be found."""
_BEYOND_DOUBT = 1.0 - 1e-6
"""With which the samples must date a turn elsewhere: of a hundred campaigns of ten thousand turns each on a sound rig,
one has a turn that is doubted."""
_GRACE_N = 1
"""An instrument's own instants lie between its samples."""


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

    @property
    def middle(self) -> Plant | None:
        """The plant between the jumps of two pots, which are set one after the other; None: not two change it."""
        changed = self.before.changes_to(self.after)
        in_turn = [pot for pot in self.dials if pot in changed]
        if len(changed) != 2 or len(in_turn) != 2:
            return None
        old, new = changed[in_turn[0]]
        return self.before.scaled(in_turn[0], new / old)


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

    def dated(self, signals: Signals, first: int) -> list[Segment]:
        """What became of the plant, by the samples of the record, the first of which has this index in the run."""
        out: list[Segment] = []
        earliest = 1
        for i, (tweak, (low_n, high_n)) in enumerate(zip(self._tweaks, self._spans_n, strict=True)):
            following = self._spans_n[i + 1][0] if i + 1 < len(self._spans_n) else float(len(signals))
            search = range(max(earliest, int(low_n)), min(len(signals) - 1, int(following), int(high_n) + 1))
            within = range(min(earliest, search.start), max(int(min(following, len(signals))), search.stop))
            segment = _dated(signals, tweak, search, within, slow=self._pots.slow)
            earliest = (segment.end_high or segment.start_high or search.stop) + 1
            moved = _moved(segment, first)
            if out and moved.start <= out[-1].start:  # both when the record was over
                out[-1] = dataclasses.replace(out[-1], plant=moved.plant)
            else:
                out.append(moved)
        return out


def _dated(signals: Signals, tweak: Tweak, search: range, within: range, *, slow: bool) -> Segment:
    if len(search) < LEAST_SEARCH_N:
        start = min(search.start, len(signals) - 1)
        return Segment(start, tweak.after, unseen="the pot was turned when the record was over, or nearly so")
    if slow or len(tweak.before.changes_to(tweak.after)) > 1:
        middle = None if slow else tweak.middle
        turned = date_turn(signals, tweak.before, tweak.after, search, middle=middle, within=within)
        if isinstance(turned, TurnInstants):
            begin, end = turned.begin, turned.end
            return Segment(
                begin.sample,
                tweak.after,
                ramp_n=end.sample - begin.sample,
                start_low=begin.low,
                start_high=begin.high,
                end_low=end.low,
                end_high=end.high,
            )
        return Segment(search.start, tweak.after, ramp_n=len(search), unseen=turned.reason)
    found = date_jump(signals, tweak.before, tweak.after, search, within=within)
    if isinstance(found, NoInstant):
        return Segment(search.start, tweak.after, ramp_n=len(search), unseen=found.reason)
    return Segment(found.sample, tweak.after, start_low=found.low, start_high=found.high)


def doubts(signals: Signals, tweaks: Sequence[Tweak], first: int) -> list[str]:
    """What the samples of a record say against tweaks whose instants are taken for exact.

    Each is looked for in all samples that no other one changes: where it came is what is in doubt, and a search that
    ends near the instant that is told would take the turn itself for what is amiss with the plant around it.
    """
    out = []
    starts = [tweak.sample for tweak in tweaks]
    for tweak, before, after in zip(tweaks, [0, *starts], [*starts[1:], len(signals)], strict=False):
        search = range(before + 2, after - 1)
        if len(search) < LEAST_SEARCH_N:
            continue
        alone = range(before + 1, after)
        found = date_jump(signals, tweak.before, tweak.after, search, within=alone, confidence=_BEYOND_DOUBT)
        where = f"the pot that was to be turned at sample {first + tweak.sample} ({tweak.words})"
        if isinstance(found, NoInstant):
            if found.unchanged and _is_plain(signals, tweak, range(tweak.sample, after)):
                out.append(f"{where}: {found.reason}")
        elif not found.low - _GRACE_N <= tweak.sample <= found.high + _GRACE_N:
            span = f"{first + found.low} to {first + found.high}"
            out.append(f"{where} was turned at {first + found.sample} ({span}) by the samples")
    return out


def _is_plain(signals: Signals, tweak: Tweak, stretch: range) -> bool:
    """Whether a change could not have stayed unseen."""
    plants = [SampledPlant.from_plant(plant, signals.period_s) for plant in (tweak.before, tweak.after)]
    states = [AT_REST, AT_REST]
    information = 0.0
    for k in range(stretch.stop):
        inside = k >= stretch.start
        states = [
            plants[1 if inside and i else 0].next(state, float(signals.force_n[k])) for i, state in enumerate(states)
        ]
        information += 0.5 * ((states[1][0] - states[0][0]) / signals.noise_m) ** 2 if inside else 0.0
    return information > _PLAIN


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
