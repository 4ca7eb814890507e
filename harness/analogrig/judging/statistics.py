"""Confidence bounds and tests for rates of independent events and for means.

Clopper-Pearson bounds require a sample size fixed in advance. A ``SequentialTest`` (two rates, fixed error
probabilities) may stop early. Sources: Clopper and Pearson, Biometrika 26 (1934); Wald, Sequential Analysis (1947).

Trials are independent plays, diagnoses or machines. False alarms among samples are not: analogrig.judging.betting.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

_PRECISION = 1e-12
"""Relative precision of a root."""


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
    check_trials(events, trials, confidence)
    if events == trials:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(events + 1, trials - events, confidence))


def lower_rate(events: int, trials: int, confidence: float) -> float:
    """Lower confidence bound of a rate per trial; errors as ``upper_rate``."""
    check_trials(events, trials, confidence)
    if events == 0:
        return 0.0
    from scipy.special import betaincinv

    return float(betaincinv(events, trials - events + 1, 1.0 - confidence))


def one_sided(low: float, high: float, confidence: float) -> str:
    """Two one-sided bounds in words that do not pass for one interval, which would be wrong twice as often."""
    return f"at least {low:.3g} and at most {high:.3g}, each one-sided with error {1.0 - confidence:.2g}"


def mean_interval(values: ArrayLike, confidence: float) -> tuple[float, float, float]:
    """Mean with its two-sided confidence interval, as (mean, low, high) (Student 1908).

    :raises ValueError: fewer than two values, or ``confidence`` not between 0 and 1.
    """
    sample = np.asarray(values, dtype=np.float64)
    check_trials(0, len(sample), confidence)
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
        check_counts(events, trials)
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


def check_trials(events: int, trials: int, confidence: float) -> None:
    """:raises ValueError: impossible counts, or ``confidence`` not between 0 and 1."""
    check_counts(events, trials)
    if trials < 1:
        raise ValueError("there must be at least one trial")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must be between 0 and 1, not {confidence:g}")


def check_counts(events: int, trials: int) -> None:
    """:raises ValueError: more events than trials, or fewer than none."""
    if not 0 <= events <= trials:
        raise ValueError(f"there cannot be {events} events in {trials} trials")


def rising_root(function: Callable[[float], float]) -> float:
    """Root above 0 of a rising function that is negative at 0."""
    low, high = 0.0, 1.0
    while function(high) < 0.0:
        low, high = high, 2.0 * high
    while high - low > _PRECISION * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) < 0.0 else (low, middle)
    return high
