"""Bounds of a rate of events, exact for a fixed number of trials, and such that hold at all times at once.

Where the number of trials is fixed beforehand, Clopper and Pearson's bounds (1934) are exact. Where one may stop as
soon as one likes what one sees, they are not valid; a confidence sequence is, and so is a test of Wald's (1945) with
the thresholds of Ville's inequality: P(sup L >= 1/error) <= error for a likelihood ratio L under the hypothesis.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

_BISECTIONS = 100


def upper_rate(events: int, trials: int, confidence: float) -> float:
    """Clopper and Pearson's upper bound: a rate above it would give so few events with probability 1 - confidence."""
    from scipy.special import betaincinv

    _check(events, trials, confidence)
    return 1.0 if events == trials else float(betaincinv(events + 1, trials - events, confidence))


def lower_rate(events: int, trials: int, confidence: float) -> float:
    """Clopper and Pearson's lower bound: a rate below it would give so many events with probability 1 - confidence."""
    from scipy.special import betaincinv

    _check(events, trials, confidence)
    return 0.0 if events == 0 else float(betaincinv(events, trials - events + 1, 1.0 - confidence))


def trials_for(rate: float, confidence: float, allowed: int = 0) -> int:
    """The least number of trials in which at most ``allowed`` events show that the rate is below ``rate``."""
    from scipy.special import bdtr

    if not 0.0 < rate < 1.0 or allowed < 0:
        raise ValueError(f"no number of trials shows a rate below {rate:g} by at most {allowed} events")
    _check(0, 1, confidence)
    low, high = allowed, allowed + 1
    while float(bdtr(allowed, high, rate)) > 1.0 - confidence:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if float(bdtr(allowed, middle, rate)) > 1.0 - confidence else (low, middle)
    return high


def rate_at_any_time(events: int, trials: int, confidence: float) -> tuple[float, float]:
    """A confidence sequence: bounds (low, high) that hold for all numbers of trials at once with this confidence.

    The rates that the likelihood ratio of a Beta(1/2, 1/2) mixture does not refute by 1 / (1 - confidence): Robbins
    1970; the mixture is a martingale under the true rate.
    """
    _check(events, trials, confidence)
    if trials == 0:
        return 0.0, 1.0
    mixture = _log_beta(events + 0.5, trials - events + 0.5) - _log_beta(0.5, 0.5)
    level = mixture + math.log(1.0 - confidence)

    def refuted(rate: float) -> bool:
        return _log_likelihood(events, trials, rate) < level

    return _last(refuted, events / trials, 0.0), _last(refuted, events / trials, 1.0)


Decision = Literal["below", "above"]


@dataclass(frozen=True)
class SequentialTest:
    """Whether a rate is below a limit, asked after every trial: two tests of Wald's, each against the limit itself.

    P(ever "below") <= 1 - confidence for any rate not below the limit, and P(ever "above") <= 1 - confidence for any
    rate not above it. The quickest decision is for rates ``apart`` times below or above it.
    """

    limit: float
    confidence: float
    apart: float = 10.0

    def __post_init__(self) -> None:
        if not (self.limit > 0.0 and self.limit * self.apart < 1.0 < self.apart):
            raise ValueError(f"the limit must be more than 0 and less than 1 / {self.apart:g}, not {self.limit:g}")
        _check(0, 1, self.confidence)

    def decision(self, events: int, trials: int) -> Decision | None:
        """None: go on."""
        enough = -math.log(1.0 - self.confidence)
        if self._evidence(events, trials, self.limit / self.apart) >= enough:
            return "below"
        return "above" if self._evidence(events, trials, self.limit * self.apart) >= enough else None

    @property
    def least_trials(self) -> int:
        """So many without an event decide "below"; fewer cannot."""
        gain = math.log1p(-self.limit / self.apart) - math.log1p(-self.limit)
        return math.ceil(-math.log(1.0 - self.confidence) / gain)

    def _evidence(self, events: int, trials: int, other: float) -> float:
        return _log_likelihood(events, trials, other) - _log_likelihood(events, trials, self.limit)


def _check(events: int, trials: int, confidence: float) -> None:
    if not 0 <= events <= trials:
        raise ValueError(f"{events} events in {trials} trials")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must be between 0 and 1, not {confidence:g}")


def _log_likelihood(events: int, trials: int, rate: float) -> float:
    with_events = events * math.log(rate) if events and rate > 0.0 else (-math.inf if events else 0.0)
    without = trials - events
    return with_events + (without * math.log1p(-rate) if without and rate < 1.0 else (-math.inf if without else 0.0))


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def _last(refuted: Callable[[float], bool], inside: float, end: float) -> float:
    """The last rate that is not refuted, on the way from one that is not to an end of the scale; rather beyond it."""
    if not refuted(end):
        return end
    for _ in range(_BISECTIONS):
        middle = 0.5 * (inside + end)
        inside, end = (inside, middle) if refuted(middle) else (middle, end)
    return end
