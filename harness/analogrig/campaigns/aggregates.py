"""Aggregates of trials: counts, delays and errors, folded part by part, and their summary.

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

from analogrig.campaigns.trials import (
    EXISTS,
    LATE,
    MISSED,
    MOST_ERRORS,
    OUTCOMES,
    PASSED,
    Trials,
    is_valid,
)
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
    counts: Counter[str] = field(default_factory=Counter)
    """COUNTED, OUTCOMES, ``trials``, ``late``; the sum of the bounds of the changes that were detected and detectable
    (``bound_n``), and their number (``bounds``); the number of trials with an estimate (``estimates``)."""
    latency_n: Histogram = field(default_factory=Histogram)
    error_squares: NDArray[np.float64] = field(default_factory=lambda: np.zeros(MOST_ERRORS))
    """Sums over the trials with an estimate."""
    plays: dict[str, Counter[tuple[int, int]]] = field(default_factory=lambda: {name: Counter() for name in RATES})
    """Number of valid trials by events and exposure, for each of RATES."""
    longest: dict[str, int] = field(default_factory=lambda: dict.fromkeys(RATES, 1))
    """Largest exposure that a trial can have, for each of RATES."""
    inconclusive_reason: str = ""
    """Seed of the first inconclusive trial, with the reason; empty if there is none."""
    not_passed: list[tuple[int, str, str]] = field(default_factory=list)
    """Seed, outcome and reason of the first trials that have not passed."""

    @property
    def trials(self) -> int:
        """Number of trials."""
        return self.counts["trials"]

    def add(self, trials: Trials, first_seed: int) -> None:
        """Fold the next trials."""
        outcomes, reasons, mask = trials["outcome"], trials["why"], is_valid(trials)
        if not mask.all():
            i = int(np.argmin(mask))
            self.inconclusive_reason = self.inconclusive_reason or f"seed {first_seed + i}: {reasons[i]}"
        for i in np.flatnonzero(outcomes != PASSED)[: MOST_NOT_PASSED - len(self.not_passed)].tolist():
            self.not_passed.append((first_seed + i, OUTCOMES[outcomes[i]], reasons[i]))
        self.counts.update(dict(zip(OUTCOMES, np.bincount(outcomes, minlength=3).tolist(), strict=True)))
        self.counts["trials"] += len(trials)
        valid = trials if mask.all() else trials[mask]
        exists = (valid["change"] & EXISTS) > 0
        visible, detected = exists & (valid["bound_n"] >= 0), exists & (valid["latency_n"] >= 0)
        by_trial = {name: valid[name] for name in ("samples", "armed", "false_alarms")} | {
            "visible": visible.sum(axis=1),
            "missed": (visible & ((valid["change"] & MISSED) > 0)).sum(axis=1),
        }
        bounded = valid["bound_n"][detected & visible]
        known = valid["error"][~np.isnan(valid["error"][:, 0])].astype(np.float64)
        late = exists & ((valid["change"] & LATE) > 0)
        sums = {**by_trial, "late": late, "bound_n": bounded}
        self.counts.update({name: int(each.sum(dtype=np.int64)) for name, each in sums.items()})
        self.counts.update(bounds=len(bounded), estimates=len(known))
        self.latency_n.add(valid["latency_n"][detected])
        # cumsum adds one by one, where sum adds in an order that depends on the length
        self.error_squares = np.cumsum(np.vstack((self.error_squares, known**2)), axis=0)[-1]
        self.longest["missed"] = max(self.longest["missed"], exists.shape[1])
        self.longest["false_alarms"] = max(self.longest["false_alarms"], int(by_trial["samples"].max(initial=1)))
        for rate in RATES.values():
            both = (by_trial[rate.events].astype(np.int64) << 32) + by_trial[rate.exposure].astype(np.int64)
            for key, times in zip(*(each.tolist() for each in np.unique(both, return_counts=True)), strict=True):
                self.plays[rate.events][key >> 32, key & 0xFFFFFFFF] += times

    @classmethod
    def merged(cls, parts: Iterable[Aggregate]) -> Self:
        """Aggregate of all of them, in this order."""
        whole = cls()
        for each in parts:
            whole.most_alarms = max(whole.most_alarms, each.most_alarms)
            whole.counts.update(each.counts)
            whole.latency_n.add(each.latency_n.values, each.latency_n.counts)
            whole.error_squares = whole.error_squares + each.error_squares
            for name in RATES:
                whole.plays[name] += each.plays[name]
                whole.longest[name] = max(whole.longest[name], each.longest[name])
            whole.inconclusive_reason = whole.inconclusive_reason or each.inconclusive_reason
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
    inconclusive_reason: str
    """Seed of the first inconclusive trial, with the reason; empty if there is none."""

    @classmethod
    def of(cls, found: Aggregate, estimates: Sequence[str]) -> Summary:
        """Summary of an aggregate; ``estimates``: names of the estimated parameters."""
        rates = {name: found.sequence(name).bounds for name in RATES}
        estimated = found.counts["estimates"]
        rms = np.sqrt(found.error_squares / max(1, estimated)).tolist()
        return cls(
            **{name: found.counts[name] for name in ("trials", "late", *OUTCOMES, *COUNTED)},
            false_alarm_rate=rates["false_alarms"],
            miss_rate=rates["missed"],
            latency_n=found.latency_n.mean,
            latency_p95_n=found.latency_n.quantile(95),
            bound_n=found.counts["bound_n"] / found.counts["bounds"] if found.counts["bounds"] else None,
            error=dict(zip(estimates, rms, strict=False)) if estimated else {},
            inconclusive_reason=found.inconclusive_reason,
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
        valid, error, latency_n = is_valid(trials), trials["error"], trials["latency_n"]
        known = error[valid & ~np.isnan(error[:, 0])].astype(np.float64)
        bins = np.clip(np.floor(known / ERROR_STEP) + ERROR_BINS // 2 + 1, 0, ERROR_BINS + 1).astype(np.int64)
        self.errors += [np.bincount(each, minlength=ERROR_BINS + 2) for each in bins.T]
        if not self.axes:
            return
        exists = ((trials["change"] & EXISTS) > 0) & valid[:, None]
        visible, detected = exists & (trials["bound_n"] >= 0), exists & (latency_n >= 0)
        ends = np.array(list(self.axes.values()), np.float64)
        shares = (trials["drawn"][:, : len(ends)].astype(np.float64) - ends[:, 0]) / (ends[:, 1] - ends[:, 0])
        places = tuple(np.clip((shares * DRAWN_BINS).astype(np.int64), 0, DRAWN_BINS - 1).T)
        for counts, values in (
            (self.visible, visible),
            (self.missed, visible & ((trials["change"] & MISSED) > 0)),
            (self.detected, detected),
            (self.latency_n, np.where(detected, latency_n, 0)),
        ):
            np.add.at(counts, places, values.sum(axis=1, dtype=np.int64))
