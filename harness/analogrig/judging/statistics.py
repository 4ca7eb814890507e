"""What runs say about a rate, with proof: exact bounds for a length fixed beforehand, and tests that may stop early.

Clopper-Pearson bounds and ``Design`` are for a number of samples that was fixed before the first one was looked at. Who
looks while samples come, and stops when it suits, uses a ``SequentialTest`` (two rates, fixed error probabilities) or a
``ConfidenceSequence`` (a bound that holds at all times at once). Sources: Clopper and Pearson, Biometrika 26 (1934);
Wald, Sequential Analysis (1947); Robbins, Annals of Mathematical Statistics 41 (1970).
Where a rate is estimated and not counted (analogrig.campaigns.rare), ``mean_bounds`` are those of the mean of many
estimates.

False alarms are counted as events among samples: after each the estimator begins anew, so that they are as good as
independent.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

MOST_EVENTS = 10**9

LEAST_FOR_MEAN = 8
"""Estimates from which bounds of their mean can be had."""

LEAST_SKEWNESS = 1e-6
"""Less of it is none."""


class Decision(enum.Enum):
    """What can be said of a rate."""

    BELOW = "below"
    ABOVE = "above"
    OPEN = "open"


# ------------------------------------------------------------------------------------------- for a length fixed before


def upper_rate(events: int, trials: int, confidence: float) -> float:
    """The largest rate per trial with which so few events are not a surprise (Clopper and Pearson, one-sided).

    :raises ValueError: impossible counts, or a confidence that is none.
    """
    _check(events, trials, confidence)
    if events == trials:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(events + 1, trials - events, confidence))


def lower_rate(events: int, trials: int, confidence: float) -> float:
    """The smallest rate per trial with which so many events are not a surprise; errors as ``upper_rate``."""
    _check(events, trials, confidence)
    if events == 0:
        return 0.0
    from scipy.special import betaincinv

    return float(betaincinv(events, trials - events + 1, 1.0 - confidence))


def poisson_mean(events: int, confidence: float) -> float:
    """The largest mean number of rare events with which so few are not a surprise: ``upper_rate`` times trials, for
    many of them; errors as there."""
    _check(events, MOST_EVENTS, confidence)
    from scipy.special import gammaincinv

    return float(gammaincinv(events + 1, confidence))


def rate_interval(events: int, trials: int, confidence: float) -> tuple[float, float]:
    """Both bounds, each wrong with half of 1 - confidence; errors as ``upper_rate``."""
    one_sided = 0.5 * (1.0 + confidence)
    return lower_rate(events, trials, one_sided), upper_rate(events, trials, one_sided)


def mean_bounds(estimates: Sequence[float], confidence: float) -> tuple[float, float]:
    """One-sided bounds of what independent unbiased estimates, none negative, have for mean, each with this confidence.

    Student's t after Hall's transformation, which takes out the skewness (Journal of the Royal Statistical Society B
    54, 1992; after Johnson, JASA 73, 1978). Unlike those of counts these bounds are not exact: what is left of the
    error falls with the number of estimates.

    :raises ValueError: fewer than LEAST_FOR_MEAN estimates, or a confidence that is none.
    """
    count = len(estimates)
    if count < LEAST_FOR_MEAN:
        raise ValueError(f"there must be at least {LEAST_FOR_MEAN} estimates, not {count}")
    _check(0, count, confidence)
    from scipy.special import stdtrit

    mean = math.fsum(estimates) / count
    off = [each - mean for each in estimates]
    deviation = math.sqrt(math.fsum(each**2 for each in off) / (count - 1))
    third = math.fsum(each**3 for each in off) * count / ((count - 1) * (count - 2))
    skewness = third / deviation**3 / math.sqrt(count) if deviation > 0.0 else 0.0
    quantile, error = float(stdtrit(count - 1, confidence)), deviation / math.sqrt(count)
    low, high = (mean - _invert_hall(at, skewness) * error for at in (quantile, -quantile))
    return max(low, 0.0), high


def _invert_hall(quantile: float, skewness: float) -> float:
    """The quantile of (mean - truth) / error, whose skewness is that of a mean: Hall's transformation, inverted."""
    if abs(skewness) < LEAST_SKEWNESS:
        return quantile
    return 3.0 / skewness * (math.cbrt(1.0 + skewness * (quantile - skewness / 6.0)) - 1.0)


@dataclass(frozen=True)
class Design:
    """A test of fixed length: so many trials, of which at most ``allowed`` may have an event."""

    rate: float
    """To be shown: the rate is not above it."""
    confidence: float
    allowed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < 1.0:
            raise ValueError(f"rate must be between 0 and 1, not {self.rate:g}")
        _check(self.allowed, MOST_EVENTS, self.confidence)

    @property
    def trials(self) -> int:
        """The fewest that show it: then the upper bound with ``allowed`` events is not above the rate."""
        low, high = self.allowed + 1, self.allowed + 2
        while upper_rate(self.allowed, high, self.confidence) > self.rate:
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            if upper_rate(self.allowed, middle, self.confidence) > self.rate:
                low = middle
            else:
                high = middle
        return high

    def pass_probability(self, true_rate: float) -> float:
        """The probability that a device with that rate passes; at ``rate`` it is 1 - confidence."""
        from scipy.stats import binom

        return float(binom.cdf(self.allowed, self.trials, true_rate))


def mean_interval(values: ArrayLike, confidence: float) -> tuple[float, float, float]:
    """The mean of two values or more and both bounds of it, each wrong with half of 1 - confidence (Student 1908).

    :raises ValueError: fewer values, or a confidence that is none.
    """
    sample = np.asarray(values, dtype=np.float64)
    _check(0, len(sample), confidence)
    if len(sample) < 2:
        raise ValueError("one value says nothing about the next")
    from scipy.special import stdtrit

    mean, error = float(sample.mean()), float(sample.std(ddof=1)) / math.sqrt(len(sample))
    margin = float(stdtrit(len(sample) - 1, 0.5 * (1.0 + confidence))) * error
    return mean, mean - margin, mean + margin


# ---------------------------------------------------------------------------------------------- where stopping is free


@dataclass
class SequentialTest:
    """Wald's test of a good rate against a bad one; it may be looked at after every trial.

    The probability to call a rate of ``bad`` or more BELOW is at most ``miss``, to call one of ``good`` or less ABOVE
    at most ``false_alarm`` (Wald 1947, section 3.2: with 1 / false_alarm and miss for A and B, both hold).
    """

    good: float
    bad: float
    miss: float
    false_alarm: float
    trials: int = 0
    events: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.good < self.bad < 1.0:
            raise ValueError(f"good must be below bad, both between 0 and 1, not {self.good:g} and {self.bad:g}")
        if not (0.0 < self.miss < 0.5 and 0.0 < self.false_alarm < 0.5):
            raise ValueError("the error probabilities must be between 0 and 0.5")

    def add(self, trials: int, events: int) -> Decision:
        """What can be said after so many more."""
        _check_counts(events, trials)
        self.trials += trials
        self.events += events
        return self.decision

    @property
    def log_ratio(self) -> float:
        """Logarithm of the likelihood of the bad rate over that of the good one."""
        return self.events * math.log(self.bad / self.good) + (self.trials - self.events) * (
            math.log1p(-self.bad) - math.log1p(-self.good)
        )

    @property
    def decision(self) -> Decision:
        if self.log_ratio <= math.log(self.miss):
            return Decision.BELOW
        if self.log_ratio >= -math.log(self.false_alarm):
            return Decision.ABOVE
        return Decision.OPEN

    @property
    def fewest_trials(self) -> int:
        """Without any event it says BELOW after so many."""
        return math.ceil(math.log(self.miss) / (math.log1p(-self.bad) - math.log1p(-self.good)))


@dataclass
class ConfidenceSequence:
    """Bounds of a rate that hold with ``confidence`` after every trial at once: Robbins' mixture over Beta(a, b).

    By Ville's inequality the true rate is ever outside with a probability of at most 1 - confidence. The mixture is
    meant for rare events: ``expected_rate`` says where the bounds shall be tightest.
    """

    confidence: float
    expected_rate: float
    trials: int = 0
    events: int = 0
    _a: float = field(init=False, default=0.5)
    _b: float = field(init=False, default=0.0)

    def __post_init__(self) -> None:
        _check(0, 1, self.confidence)
        if not 0.0 < self.expected_rate < 1.0:
            raise ValueError(f"expected_rate must be between 0 and 1, not {self.expected_rate:g}")
        self._b = self._a * (1.0 - self.expected_rate) / self.expected_rate

    def add(self, trials: int, events: int) -> tuple[float, float]:
        """The bounds after so many more."""
        _check_counts(events, trials)
        self.trials += trials
        self.events += events
        return self.bounds

    @property
    def bounds(self) -> tuple[float, float]:
        """The rates that are not refuted yet: those whose martingale has stayed below 1 / (1 - confidence)."""
        if self.trials == 0:
            return 0.0, 1.0
        most_likely = self.events / self.trials
        low = 0.0 if self.events == 0 else self._bisect_bound(most_likely, 0.0)
        high = 1.0 if self.events == self.trials else self._bisect_bound(most_likely, 1.0)
        return low, high

    def decision(self, rate: float) -> Decision:
        """Of the true rate against that one."""
        low, high = self.bounds
        return Decision.BELOW if high <= rate else Decision.ABOVE if low > rate else Decision.OPEN

    def _bisect_bound(self, inside: float, outside: float) -> float:
        """Where the martingale reaches its limit between a rate that is in and one that is out."""
        for _ in range(200):
            middle = 0.5 * (inside + outside)
            if middle in (inside, outside):
                break
            if self._log_martingale(middle) < -math.log1p(-self.confidence):
                inside = middle
            else:
                outside = middle
        return outside

    def _log_martingale(self, rate: float) -> float:
        failures = self.trials - self.events
        mixed = _log_beta(self._a + self.events, self._b + failures) - _log_beta(self._a, self._b)
        return mixed - self.events * math.log(rate) - failures * math.log1p(-rate)


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def _check(events: int, trials: int, confidence: float) -> None:
    _check_counts(events, trials)
    if trials < 1:
        raise ValueError("nothing is known without a trial")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must be between 0 and 1, not {confidence:g}")


def _check_counts(events: int, trials: int) -> None:
    if not 0 <= events <= trials:
        raise ValueError(f"there cannot be {events} events in {trials} trials")
