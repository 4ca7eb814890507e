"""Confidence bounds and tests for event rates: fixed sample size, and sequential.

Clopper-Pearson bounds and ``Design`` require a sample size fixed in advance. A test that may stop early needs a
``SequentialTest`` (two rates, fixed error probabilities) or a ``ConfidenceSequence`` (bounds valid at all times at
once). ``mean_bounds`` bounds a rate that is estimated, not counted (analogrig.campaigns.rare). Sources: Clopper and
Pearson, Biometrika 26 (1934); Wald, Sequential Analysis (1947); Robbins, Annals of Mathematical Statistics 41 (1970).

False alarms are counted as events among samples. The estimator restarts after each, so they are nearly independent.
"""

from __future__ import annotations

import bisect
import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

MOST_EVENTS = 10**9

LEAST_FOR_MEAN = 8
"""Fewest estimates that ``mean_bounds`` accepts."""

LEAST_SKEWNESS = 1e-6
"""Smaller skewness is not corrected."""


class Decision(enum.Enum):
    """Decision of a test: the rate is below or above the limit, or the test is still open."""

    BELOW = "below"
    ABOVE = "above"
    OPEN = "open"


# ---------------------------------------------------------------------------------------------------- fixed sample size


def upper_rate(events: int, trials: int, confidence: float) -> float:
    """Upper confidence bound of a rate per trial (Clopper and Pearson, one-sided).

    :raises ValueError: impossible counts, or ``confidence`` not between 0 and 1.
    """
    _check(events, trials, confidence)
    if events == trials:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(events + 1, trials - events, confidence))


def lower_rate(events: int, trials: int, confidence: float) -> float:
    """Lower confidence bound of a rate per trial; errors as ``upper_rate``."""
    _check(events, trials, confidence)
    if events == 0:
        return 0.0
    from scipy.special import betaincinv

    return float(betaincinv(events, trials - events + 1, 1.0 - confidence))


def poisson_mean(events: int, confidence: float) -> float:
    """Upper confidence bound of a Poisson mean: limit of ``trials * upper_rate`` for many trials; errors as there."""
    _check(events, MOST_EVENTS, confidence)
    from scipy.special import gammaincinv

    return float(gammaincinv(events + 1, confidence))


def rate_interval(events: int, trials: int, confidence: float) -> tuple[float, float]:
    """Two-sided confidence interval of a rate (Clopper and Pearson); errors as ``upper_rate``."""
    one_sided = 0.5 * (1.0 + confidence)
    return lower_rate(events, trials, one_sided), upper_rate(events, trials, one_sided)


def mean_bounds(estimates: Sequence[float], confidence: float) -> tuple[float, float]:
    """Lower and upper one-sided confidence bound of the mean of independent, unbiased, non-negative estimates.

    Student's t after Hall's transformation, which corrects the skewness (Journal of the Royal Statistical Society B
    54, 1992; after Johnson, JASA 73, 1978). These bounds are approximate; their error falls with the number of
    estimates.

    :raises ValueError: fewer than LEAST_FOR_MEAN estimates, or ``confidence`` not between 0 and 1.
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
    """Inverse of Hall's transformation: Student's quantile, corrected for the skewness of the mean."""
    if abs(skewness) < LEAST_SKEWNESS:
        return quantile
    return 3.0 / skewness * (math.cbrt(1.0 + skewness * (quantile - skewness / 6.0)) - 1.0)


@dataclass(frozen=True)
class Design:
    """Test of fixed length, passed with at most ``allowed`` events. ValueError: a value is out of range."""

    rate: float
    """Claimed upper limit of the rate."""
    confidence: float
    allowed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < 1.0:
            raise ValueError(f"rate must be between 0 and 1, not {self.rate:g}")
        _check(self.allowed, MOST_EVENTS, self.confidence)

    @property
    def trials(self) -> int:
        """Fewest trials that prove the claim: the upper bound with ``allowed`` events is at most ``rate``."""
        least = high = self.allowed + 2
        while not self._proves(high):
            high *= 2
        return bisect.bisect_left(range(high), 1, lo=max(least, high // 2), key=self._proves)

    def _proves(self, trials: int) -> bool:
        return upper_rate(self.allowed, trials, self.confidence) <= self.rate


def mean_interval(values: ArrayLike, confidence: float) -> tuple[float, float, float]:
    """Mean with its two-sided confidence interval, as (mean, low, high) (Student 1908).

    :raises ValueError: fewer than two values, or ``confidence`` not between 0 and 1.
    """
    sample = np.asarray(values, dtype=np.float64)
    _check(0, len(sample), confidence)
    if len(sample) < 2:
        raise ValueError("there must be at least two values, not one")
    from scipy.special import stdtrit

    mean, error = float(sample.mean()), float(sample.std(ddof=1)) / math.sqrt(len(sample))
    margin = float(stdtrit(len(sample) - 1, 0.5 * (1.0 + confidence))) * error
    return mean, mean - margin, mean + margin


# ----------------------------------------------------------------------------------------------------------- sequential


@dataclass
class SequentialTest:
    """Wald's sequential test of a good rate against a bad one; may be evaluated after every trial.

    BELOW for a rate of ``bad`` or more has a probability of at most ``miss``. ABOVE for a rate of ``good`` or less has
    a probability of at most ``false_alarm``. Source: Wald 1947, section 3.2, with A = 1 / false_alarm and B = miss.
    ValueError: a value is out of range.
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
        """Add the counts of more trials; return the decision."""
        _check_counts(events, trials)
        self.trials += trials
        self.events += events
        return self.decision

    @property
    def log_ratio(self) -> float:
        """Log-likelihood ratio of the bad rate to the good one."""
        return self.events * math.log(self.bad / self.good) + (self.trials - self.events) * (
            math.log1p(-self.bad) - math.log1p(-self.good)
        )

    @property
    def decision(self) -> Decision:
        """Decision after the trials so far."""
        if self.log_ratio <= math.log(self.miss):
            return Decision.BELOW
        if self.log_ratio >= -math.log(self.false_alarm):
            return Decision.ABOVE
        return Decision.OPEN


@dataclass
class ConfidenceSequence:
    """Confidence sequence of a rate: bounds valid after every trial at once (Robbins' mixture over Beta(a, b)).

    By Ville's inequality the true rate ever leaves the bounds with a probability of at most 1 - confidence. The bounds
    are tightest near ``expected_rate``. ValueError: a value is out of range.
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
        """Add the counts of more trials; return the bounds."""
        _check_counts(events, trials)
        self.trials += trials
        self.events += events
        return self.bounds

    @property
    def bounds(self) -> tuple[float, float]:
        """Interval of the rates whose martingale is below 1 / (1 - confidence)."""
        if self.trials == 0:
            return 0.0, 1.0
        most_likely = self.events / self.trials
        low = 0.0 if self.events == 0 else self._bisect_bound(most_likely, 0.0)
        high = 1.0 if self.events == self.trials else self._bisect_bound(most_likely, 1.0)
        return low, high

    def decision(self, rate: float) -> Decision:
        """Decision whether the true rate is below or above ``rate``."""
        low, high = self.bounds
        return Decision.BELOW if high <= rate else Decision.ABOVE if low > rate else Decision.OPEN

    def _bisect_bound(self, inside: float, outside: float) -> float:
        """Rate at which the martingale reaches its limit, by bisection between ``inside`` and ``outside``."""
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
        """Logarithm of the mixture likelihood over the likelihood of ``rate``."""
        failures = self.trials - self.events
        mixed = _log_beta(self._a + self.events, self._b + failures) - _log_beta(self._a, self._b)
        return mixed - self.events * math.log(rate) - failures * math.log1p(-rate)


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def _check(events: int, trials: int, confidence: float) -> None:
    _check_counts(events, trials)
    if trials < 1:
        raise ValueError("there must be at least one trial")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must be between 0 and 1, not {confidence:g}")


def _check_counts(events: int, trials: int) -> None:
    if not 0 <= events <= trials:
        raise ValueError(f"there cannot be {events} events in {trials} trials")
