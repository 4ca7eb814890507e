"""Confidence bounds of rates, compared with published figures and by simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from analogrig.judging.statistics import Decision, SequentialTest, lower_rate, upper_rate


def test_no_event_in_n_has_the_bound_in_closed_form() -> None:
    assert upper_rate(0, 1000, 0.95) == pytest.approx(1.0 - 0.05 ** (1 / 1000), rel=1e-12)
    assert lower_rate(1000, 1000, 0.95) == pytest.approx(0.05 ** (1 / 1000), rel=1e-12)
    assert (lower_rate(0, 10, 0.9), upper_rate(10, 10, 0.9)) == (0.0, 1.0)


def test_bounds_of_clopper_and_pearson_are_the_published_ones() -> None:
    """10 of 100 at 95 %, two-sided: 0.0490 to 0.1762 (Newcombe, Statistics in Medicine 17, 1998, and many tables)."""
    bounds = lower_rate(10, 100, 0.975), upper_rate(10, 100, 0.975)
    assert bounds == pytest.approx((0.0490, 0.1762), abs=5e-5)


def test_sequential_test_keeps_its_error_probabilities() -> None:
    """Simulate 1000 runs at each of the two rates: error probability 1/5, tolerance 4.7 standard errors."""
    rng = np.random.default_rng(7)
    wrong = dict.fromkeys((0.01, 0.05), 0)
    for rate in wrong:
        for _ in range(1000):
            test = SequentialTest(good=0.01, bad=0.05, miss=0.2, false_alarm=0.2)
            while test.decision is Decision.OPEN:
                test.add(20, int(rng.binomial(20, rate)))
            wrong[rate] += test.decision is (Decision.BELOW if rate == 0.05 else Decision.ABOVE)
    assert all(0 < count < 1000 * (0.2 + 4.7 * math.sqrt(0.2 * 0.8 / 1000)) for count in wrong.values()), wrong


def test_sequential_test_without_events_ends_when_the_likelihood_ratio_reaches_the_miss_probability() -> None:
    test = SequentialTest(good=1e-6, bad=1e-5, miss=1e-3, false_alarm=1e-6)
    trials = math.ceil(math.log(1e-3) / (math.log1p(-1e-5) - math.log1p(-1e-6)))
    assert test.add(trials - 1, 0) is Decision.OPEN
    assert test.add(1, 0) is Decision.BELOW


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: upper_rate(2, 1, 0.9), "there cannot be 2 events in 1 trials"),
        (lambda: upper_rate(0, 0, 0.9), "there must be at least one trial"),
        (lambda: lower_rate(0, 1, 1.0), "confidence must be between 0 and 1, not 1"),
        (lambda: SequentialTest(0.2, 0.1, 0.1, 0.1), "good must be below bad"),
        (lambda: SequentialTest(0.1, 0.2, 0.6, 0.1), "error probabilities must be between 0 and 0.5"),
    ],
)
def test_values_out_of_range_are_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]
