"""Summary of trials: counts, delays and errors, folded part by part.

The trials of a cell are folded in the order of their seeds. Sums of integers are exact, and sums of floating-point
numbers are taken one by one, so that the result does not depend on how the trials are divided into parts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig.campaigns.trials import EXISTS, FAILED, INCONCLUSIVE, LATE, MISSED, MOST_ERRORS, OUTCOMES, PASSED, Trials
from analogrig.judging.betting import BettingSequence

CONFIDENCE = 0.95
"""Confidence level of the bounds in the tables; they hold at any stopping time of a campaign."""

COUNTED = ("samples", "armed", "false_alarms", "visible", "missed")
"""Counts over the valid trials.

``armed``: samples in which the trigger was armed; ``visible``: detectable changes; ``missed``: those without an alarm.
"""

MOST_NOT_PASSED = 3
"""Largest number of trials of a cell that are named because they have not passed."""

ERROR_STEP, ERROR_BINS = 0.01, 200
"""Width and number of the bins of relative errors, around 0; two more hold what is beyond."""

DRAWN_BINS = 16
"""Number of bins of each drawn axis."""


@dataclass(frozen=True)
class Rate:
    """Rate of events per exposure; both are names of COUNTED."""

    events: str
    exposure: str
    unit: str
    """Unit of the exposure, in words."""


RATES = {rate.events: rate for rate in (Rate("missed", "visible", "changes"), Rate("false_alarms", "armed", "samples"))}


def independent(events: int, exposure: int, confidence: float = CONFIDENCE) -> BettingSequence:
    """Confidence sequence with two-sided ``confidence`` where each unit of the exposure is a play of its own."""
    plays = Counter({(1, 1): events, (0, 1): exposure - events})
    return BettingSequence(0.5 * (1.0 + confidence), most=1, longest=1, plays=+plays)


class Histogram:
    """Number of occurrences of each integer."""

    def __init__(self) -> None:
        self.values: NDArray[np.int64] = np.zeros(0, np.int64)
        """Values that occurred, rising."""
        self.counts: NDArray[np.int64] = np.zeros(0, np.int64)

    def add(self, values: NDArray[np.integer], counts: NDArray[np.int64] | None = None) -> None:
        """Add values, each so many times; once by default."""
        if not len(values):
            return
        both = np.concatenate((self.values, values.astype(np.int64)))
        times = np.concatenate((self.counts, np.ones(len(values), np.int64) if counts is None else counts))
        self.values, place = np.unique(both, return_inverse=True)
        self.counts = np.zeros(len(self.values), np.int64)
        np.add.at(self.counts, place, times)

    @property
    def mean(self) -> float | None:
        """None: nothing occurred."""
        total = int(self.counts.sum())
        return int(self.values @ self.counts) / total if total else None

    def quantile(self, percent: int) -> float | None:
        """Smallest value that at least so many percent do not exceed."""
        total = int(self.counts.sum())
        if not total:
            return None
        return float(self.values[np.searchsorted(np.cumsum(self.counts), -(-percent * total // 100))])


@dataclass
class Aggregate:
    """Aggregates of the trials of a cell, or of all cells."""

    most_alarms: int = 0
    """Largest number of alarms that a trial can have; 0: one a sample."""
    trials: int = 0
    passed: int = 0
    failed: int = 0
    inconclusive: int = 0
    late: int = 0
    counted: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTED, 0))
    latency_n: Histogram = field(default_factory=Histogram)
    bound_n: int = 0
    """Sum over the changes that were detected and detectable, and their number."""
    bounds: int = 0
    error_squares: NDArray[np.float64] = field(default_factory=lambda: np.zeros(MOST_ERRORS))
    """Sums over the trials with an estimate, and their number."""
    estimates: int = 0
    plays: dict[str, Counter[tuple[int, int]]] = field(default_factory=lambda: {name: Counter() for name in RATES})
    """Number of valid trials by events and exposure, for each of RATES."""
    longest: dict[str, int] = field(default_factory=lambda: dict.fromkeys(RATES, 1))
    """Largest exposure that a trial can have, for each of RATES."""
    doubt: str = ""
    """Seed of the first inconclusive trial, with the reason; empty if there is none."""
    not_passed: list[tuple[int, str, str]] = field(default_factory=list)
    """Seed, outcome and reason of the first trials that have not passed."""

    def add(self, trials: Trials, first_seed: int) -> None:
        """Fold the next trials."""
        self.trials += len(trials)
        outcomes = np.bincount(trials.outcome, minlength=3).tolist()
        self.passed += outcomes[PASSED]
        self.failed += outcomes[FAILED]
        self.inconclusive += outcomes[INCONCLUSIVE]
        if outcomes[INCONCLUSIVE] and not self.doubt:
            i = int(np.argmax(trials.outcome == INCONCLUSIVE))
            self.doubt = f"seed {first_seed + i}: {trials.why[i]}"
        for i in np.flatnonzero(trials.outcome != PASSED)[: MOST_NOT_PASSED - len(self.not_passed)].tolist():
            self.not_passed.append((first_seed + i, OUTCOMES[trials.outcome[i]], trials.why[i]))
        sound = slice(None) if not outcomes[INCONCLUSIVE] else trials.is_valid
        change, latency_n, bound_n = trials.change[sound], trials.latency_n[sound], trials.bound_n[sound]
        exists = (change & EXISTS) > 0
        visible = exists & (bound_n >= 0)
        by_trial = {
            "samples": trials.samples[sound],
            "armed": trials.armed[sound],
            "false_alarms": trials.false_alarms[sound],
            "visible": visible.sum(axis=1),
            "missed": (visible & ((change & MISSED) > 0)).sum(axis=1),
        }
        for name, counts in by_trial.items():
            self.counted[name] += int(counts.sum(dtype=np.int64))
        self.longest["missed"] = max(self.longest["missed"], change.shape[1])
        self.longest["false_alarms"] = max(self.longest["false_alarms"], int(by_trial["samples"].max(initial=1)))
        for rate in RATES.values():
            both = (by_trial[rate.events].astype(np.int64) << 32) + by_trial[rate.exposure].astype(np.int64)
            for key, times in zip(*(each.tolist() for each in np.unique(both, return_counts=True)), strict=True):
                self.plays[rate.events][key >> 32, key & 0xFFFFFFFF] += times
        self.late += int((exists & ((change & LATE) > 0)).sum())
        detected = exists & (latency_n >= 0)
        self.latency_n.add(latency_n[detected])
        bounded = bound_n[detected & visible]
        self.bound_n += int(bounded.sum(dtype=np.int64))
        self.bounds += len(bounded)
        self._add_errors(trials.error[sound])

    def _add_errors(self, error: NDArray[np.float32]) -> None:
        known = error[~np.isnan(error[:, 0])].astype(np.float64)
        self.estimates += len(known)
        # cumsum adds one by one, where sum adds in an order that depends on the length
        self.error_squares = np.cumsum(np.vstack((self.error_squares, known**2)), axis=0)[-1]

    @classmethod
    def merged(cls, parts: Iterable[Aggregate]) -> Self:
        """Aggregate of all of them, in this order."""
        whole = cls()
        for each in parts:
            whole.most_alarms = max(whole.most_alarms, each.most_alarms)
            for name in ("trials", "passed", "failed", "inconclusive", "late", "bound_n", "bounds", "estimates"):
                setattr(whole, name, getattr(whole, name) + getattr(each, name))
            for name in COUNTED:
                whole.counted[name] += each.counted[name]
            whole.latency_n.add(each.latency_n.values, each.latency_n.counts)
            whole.error_squares = whole.error_squares + each.error_squares
            for name in RATES:
                whole.plays[name] += each.plays[name]
                whole.longest[name] = max(whole.longest[name], each.longest[name])
            whole.doubt = whole.doubt or each.doubt
        return whole

    def sequence(self, name: str, confidence: float = CONFIDENCE) -> BettingSequence:
        """Confidence sequence of one of RATES, with two-sided ``confidence``."""
        most = self.most_alarms if name == "false_alarms" and self.most_alarms else self.longest[name]
        return BettingSequence(0.5 * (1.0 + confidence), most, self.longest[name], self.plays[name])


@dataclass(frozen=True)
class Summary:
    """Summary of some trials; inconclusive ones are only counted."""

    trials: int
    passed: int
    failed: int
    inconclusive: int
    samples: int
    armed: int
    """Exposure: samples in which the trigger was armed."""
    false_alarms: int
    false_alarm_rate: tuple[float, float]
    """Bounds per sample in which the trigger was armed."""
    visible: int
    missed: int
    late: int
    miss_rate: tuple[float, float]
    latency_n: float | None
    """Mean detection delay; None: nothing was detected."""
    latency_p95_n: float | None
    bound_n: float | None
    """Mean information bound of the changes that were detected and detectable."""
    error: Mapping[str, float]
    """rms relative error of each estimate at the end."""
    doubt: str
    """Seed of the first inconclusive trial, with the reason; empty if there is none."""

    @classmethod
    def of(cls, found: Aggregate, estimates: Sequence[str]) -> Summary:
        """Summary of an aggregate; ``estimates``: names of the estimated parameters."""
        rates = {name: found.sequence(name).bounds for name in RATES}
        rms = np.sqrt(found.error_squares / max(1, found.estimates)).tolist()
        return cls(
            **found.counted,
            trials=found.trials,
            passed=found.passed,
            failed=found.failed,
            inconclusive=found.inconclusive,
            false_alarm_rate=rates["false_alarms"],
            late=found.late,
            miss_rate=rates["missed"],
            latency_n=found.latency_n.mean,
            latency_p95_n=found.latency_n.quantile(95),
            bound_n=found.bound_n / found.bounds if found.bounds else None,
            error=dict(zip(estimates, rms, strict=False)) if found.estimates else {},
            doubt=found.doubt,
        )


class Distribution:
    """Distributions over all trials of a campaign: errors of the estimates, and changes by drawn values."""

    def __init__(self, drawn: Mapping[str, Sequence[float]]) -> None:
        """Start with no trials; ``drawn``: ends of the drawn axes."""
        self.axes = dict(list(drawn.items())[:2])
        """The first two drawn axes, with their ends."""
        self.errors: NDArray[np.int64] = np.zeros((MOST_ERRORS, ERROR_BINS + 2), np.int64)
        """(3, bins): the first and the last bin hold what is beyond."""
        shape = (DRAWN_BINS,) * len(self.axes)
        self.visible, self.missed, self.detected, self.latency_n = (np.zeros(shape, np.int64) for _ in range(4))
        """Changes by drawn values, in DRAWN_BINS bins for each axis, and the sum of their delays."""

    def add(self, trials: Trials) -> None:
        """Add trials, in any order."""
        sound = trials.is_valid
        error = trials.error[sound & ~np.isnan(trials.error[:, 0])].astype(np.float64)
        place = np.clip(np.floor(error / ERROR_STEP) + ERROR_BINS // 2 + 1, 0, ERROR_BINS + 1).astype(np.int64)
        for i, places in enumerate(place.T):
            self.errors[i] += np.bincount(places, minlength=ERROR_BINS + 2)
        if self.axes:
            self._add_drawn(trials, sound)

    def _add_drawn(self, trials: Trials, sound: NDArray[np.bool_]) -> None:
        change, latency_n = trials.change, trials.latency_n
        exists = ((change & EXISTS) > 0) & sound[:, None]
        visible, detected = exists & (trials.bound_n >= 0), exists & (latency_n >= 0)
        places = []
        for i, (low, high) in enumerate(self.axes.values()):
            share = (trials.drawn[:, i].astype(np.float64) - low) / (high - low)
            places.append(np.clip((share * DRAWN_BINS).astype(np.int64), 0, DRAWN_BINS - 1))
        for counts, values in (
            (self.visible, visible),
            (self.missed, visible & ((change & MISSED) > 0)),
            (self.detected, detected),
            (self.latency_n, np.where(detected, latency_n, 0)),
        ):
            np.add.at(counts, tuple(places), values.sum(axis=1, dtype=np.int64))
