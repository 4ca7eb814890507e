"""Pot changes outside the instrument: requested while a record is taken, and dated by its samples afterwards."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from analogrig import Plant
from analogrig.links import Clock
from analogrig.plant import SampledPlant, Segment
from analogrig_instruments.dating.instants import NoInstant, TurnInstants, date_jump, date_turn
from analogrig_instruments.dating.two_filter import Signals
from analogrig_instruments.instrument import Pots

BEFORE_S, AFTER_S = 0.02, 0.05
"""Margins of the search: a record may start late, and a pot may still move after it was reported set."""

LEAST_SEARCH_N = 8

_NEAR_N = 4096
"""Samples before and after a scheduled instant in which its change is searched: the search takes 0.1 ms a sample. A
change farther away is one that the samples do not show."""

_CERTAIN_INFORMATION = 1000.0
"""Information, as in ``analogrig.judging.information``, with which a change is always detected."""
_BEYOND_DOUBT = 1.0 - 1e-6
"""Confidence with which the samples must contradict an instant: one false contradiction in a million changes."""
_GRACE_N = 1
"""Tolerance: instants of an instrument lie between samples."""


@dataclass(frozen=True)
class PlannedChange:
    """Change of the pots at a sample, and the plant before and after it."""

    sample: int
    """Index at which the change is due."""
    dials: Mapping[str, float]
    """Positions of the pots that change, in the order in which they are set."""
    before: Plant
    after: Plant

    @property
    def words(self) -> str:
        """Target values for the operator prompt."""
        changed = self.before.changes_to(self.after)
        return ", ".join(f"{name} {new:g}" for name, (_, new) in changed.items())

    @property
    def middle(self) -> Plant | None:
        """Plant between the jumps of two pots that are set one after the other; None unless two pots change it."""
        changed = self.before.changes_to(self.after)
        in_turn = [pot for pot in self.dials if pot in changed]
        if len(changed) != 2 or len(in_turn) != 2:
            return None
        old, new = changed[in_turn[0]]
        return self.before.scaled(in_turn[0], new / old)


class HandChanges:
    """Changes of one record that are made at unknown instants."""

    def __init__(
        self,
        pots: Pots,
        changes: Sequence[PlannedChange],
        rate_hz: float,
        clock: Clock = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        """``changes`` count samples from the start of the record."""
        self._pots = pots
        self._changes = changes
        self._rate_hz = rate_hz
        self._clock = clock
        self._pause = pause
        self._spans_n: list[tuple[float, float]] = []

    def make_all(self) -> None:
        """Make each change when it is due. Call it when the record has started.

        :raises RigError: a pot could not be set.
        """
        begun_s = self._clock()
        for change in self._changes:
            self._pause(max(0.0, begun_s + change.sample / self._rate_hz - self._clock()))
            asked_s = self._clock()
            self._pots.set(change.dials, change.words, recording=True)
            span_s = asked_s - begun_s - BEFORE_S, self._clock() - begun_s + AFTER_S
            self._spans_n.append((span_s[0] * self._rate_hz, span_s[1] * self._rate_hz))

    def date(self, signals: Signals, first: int) -> list[Segment]:
        """Segments of the plant as the samples of the record show them; ``first`` is its first sample in the run."""
        out: list[Segment] = []
        earliest = 1
        for i, (change, (low_n, high_n)) in enumerate(zip(self._changes, self._spans_n, strict=True)):
            following = self._spans_n[i + 1][0] if i + 1 < len(self._spans_n) else float(len(signals))
            search = range(max(earliest, int(low_n)), min(len(signals) - 1, int(following), int(high_n) + 1))
            within = range(min(earliest, search.start), max(int(min(following, len(signals))), search.stop))
            segment = _date_change(signals, change, search, within, slow=self._pots.slow)
            earliest = (segment.end_high or segment.start_high or search.stop) + 1
            segment = _shift(segment, first)
            if out and segment.start <= out[-1].start:  # both after the end of the record
                out[-1] = dataclasses.replace(out[-1], plant=segment.plant)
            else:
                out.append(segment)
        return out


def _date_change(signals: Signals, change: PlannedChange, search: range, within: range, *, slow: bool) -> Segment:
    """Segment that a change begins, in samples of the record; ``unseen`` says why it could not be dated."""
    before, after = change.before, change.after
    if len(search) < LEAST_SEARCH_N:
        start = min(search.start, len(signals) - 1)
        return Segment(start, after, unseen="the pot was turned when the record was over, or nearly so")
    found = (
        date_turn(signals, before, after, search, middle=None if slow else change.middle, within=within)
        if slow or len(before.changes_to(after)) > 1
        else date_jump(signals, before, after, search, within=within)
    )
    if isinstance(found, NoInstant):
        return Segment(search.start, after, ramp_n=len(search), unseen=found.reason)
    if not isinstance(found, TurnInstants):
        return Segment(found.sample, after, start_low=found.low, start_high=found.high)
    begin, end = found.begin, found.end
    return Segment(
        begin.sample,
        after,
        ramp_n=end.sample - begin.sample,
        start_low=begin.low,
        start_high=begin.high,
        end_low=end.low,
        end_high=end.high,
    )


def _shift(segment: Segment, by: int) -> Segment:
    """The segment with all sample indices moved by ``by``."""
    indices = {name: getattr(segment, name) for name in ("start", "start_low", "start_high", "end_low", "end_high")}
    moved = {name: index + by for name, index in indices.items() if index is not None}
    return dataclasses.replace(segment, **moved)


def contradictions(signals: Signals, changes: Sequence[PlannedChange], first: int) -> list[str]:
    """Contradictions between the samples of a record and the scheduled instants of its changes.

    Each change is searched in all samples within _NEAR_N that no other one affects. A search that ended nearer to the
    scheduled instant would attribute a displaced change to the plant around it.
    """
    out = []
    starts = [change.sample for change in changes]
    for change, previous, following in zip(changes, [0, *starts], [*starts[1:], len(signals)], strict=False):
        before, after = max(previous, change.sample - _NEAR_N), min(following, change.sample + _NEAR_N)
        search = range(before + 2, after - 1)
        if len(search) < LEAST_SEARCH_N:
            continue
        alone = range(before + 1, after)
        found = date_jump(signals, change.before, change.after, search, within=alone, confidence=_BEYOND_DOUBT)
        where = f"the pot scheduled for sample {first + change.sample} ({change.words})"
        if isinstance(found, NoInstant):
            if found.unchanged and _is_detectable(signals, change, range(change.sample, after)):
                out.append(f"{where}: {found.reason}")
        elif not found.low - _GRACE_N <= change.sample <= found.high + _GRACE_N:
            span = f"{first + found.low} to {first + found.high}"
            out.append(f"{where} moved at {first + found.sample} ({span}) by the samples")
    return out


def _is_detectable(signals: Signals, change: PlannedChange, stretch: range) -> bool:
    """True if the change, made at the start of ``stretch``, would be detected with certainty."""
    plants = [SampledPlant.from_plant(plant, signals.period_s) for plant in (change.before, change.after)]
    states = [plant.at_rest for plant in plants]
    information = 0.0
    for k in range(stretch.stop):
        inside = k >= stretch.start
        states = [
            plants[1 if inside and i else 0].next(state, float(signals.force_n[k])) for i, state in enumerate(states)
        ]
        information += (
            0.5 * ((plants[1].output(states[1]) - plants[0].output(states[0])) / signals.noise_m) ** 2
            if inside
            else 0.0
        )
    return information > _CERTAIN_INFORMATION
