"""Bounds of rates: the figures of facts.md section 4, and the errors that the tests promise, counted exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from harness.statistics import SequentialTest, lower_rate, rate_at_any_time, trials_for, upper_rate


@pytest.mark.parametrize(
    ("confidence", "allowed", "samples"),
    [(0.95, 0, 299_573), (0.95, 5, 1_051_303), (0.999, 0, 690_775), (0.999, 1, 923_341), (0.999, 5, 1_645_474)],
)
def test_fixed_length_is_that_of_the_tables(confidence: float, allowed: int, samples: int) -> None:
    """The tables are Poisson's limit, which is longer by some samples."""
    assert trials_for(1e-5, confidence, allowed) == pytest.approx(samples, rel=1e-5)


def test_exact_bounds_are_where_the_binomial_tail_is_the_error() -> None:
    assert stats.binom.cdf(3, 400, upper_rate(3, 400, 0.99)) == pytest.approx(0.01)
    assert stats.binom.sf(2, 400, lower_rate(3, 400, 0.99)) == pytest.approx(0.01)
    assert lower_rate(0, 10, 0.9) == 0.0
    assert upper_rate(10, 10, 0.9) == 1.0


def ever(decides: np.ndarray, rate: float) -> float:
    """The exact probability that a walk of (trials, events) ever comes where it is decided; decides[n, k]."""
    alive, ended = np.array([1.0]), 0.0
    for n in range(1, len(decides)):
        alive = np.append(alive * (1.0 - rate), 0.0) + np.append(0.0, alive * rate)
        stops = decides[n, : n + 1]
        ended += float(alive[stops].sum())
        alive[stops] = 0.0
    return ended


@pytest.mark.parametrize("rate", [0.05, 0.3])
def test_confidence_sequence_misses_the_rate_at_any_time_with_at_most_its_error(rate: float) -> None:
    """Counted exactly over 200 trials; a bound for fixed length, looked at as often, misses it more often."""
    n = 200
    sequence = np.zeros((n + 1, n + 1), bool)
    fixed = np.zeros((n + 1, n + 1), bool)
    for trials in range(1, n + 1):
        for events in range(trials + 1):
            low, high = rate_at_any_time(events, trials, 0.9)
            sequence[trials, events] = not low <= rate <= high
        events_ = np.arange(trials + 1)
        tails = np.minimum(stats.binom.cdf(events_, trials, rate), stats.binom.sf(events_ - 1, trials, rate))
        fixed[trials, : trials + 1] = tails < 0.05
    assert 0.0 < ever(sequence, rate) <= 0.1
    assert ever(fixed, rate) > 0.1


@pytest.mark.parametrize(("rate", "wrong"), [(0.02, "below"), (0.02, "above")])
def test_sequential_test_errs_at_the_limit_at_most_as_often_as_it_says(rate: float, wrong: str) -> None:
    test, n = SequentialTest(0.02, 0.9), 600
    decides = np.array([[k <= t and test.decision(k, t) == wrong for k in range(n + 1)] for t in range(n + 1)])
    assert 0.0 < ever(decides, rate) <= 0.1


def test_sequential_test_decides_below_at_its_least_number_of_trials() -> None:
    test = SequentialTest(1e-5, 0.999)
    assert test.decision(0, test.least_trials) == "below"
    assert test.decision(0, test.least_trials - 1) is None
    assert test.least_trials == pytest.approx(math.log(1000) / 0.9e-5, rel=1e-4)
    assert test.decision(4, 1000) == "above"
