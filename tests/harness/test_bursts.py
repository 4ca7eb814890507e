"""Bounds of rates of events in bursts: against closed forms, published figures, simulation and dispersion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from analogrig.judging.bursts import (
    Design,
    bound_rate,
    dispersion,
    lower_count,
    upper_count,
)


@pytest.mark.parametrize(
    ("confidence", "allowed", "trials"),
    [
        *((0.95, allowed, n) for allowed, n in ((0, 299_573), (1, 474_386), (2, 629_579), (5, 1_051_303))),
        *((0.999, allowed, n) for allowed, n in ((0, 690_775), (1, 923_341), (2, 1_122_887), (5, 1_645_474))),
    ],
)
def test_length_for_independent_events_is_that_of_the_exact_bound(confidence: float, allowed: int, trials: int) -> None:
    """Compare with tables of the Poisson distribution."""
    assert Design(1e-5, confidence, allowed, burst=1.0).trials == pytest.approx(trials, rel=1e-5)


@pytest.mark.parametrize("events", [0, 1, 7, 1000])
def test_bounds_for_independent_events_are_garwoods(events: int) -> None:
    """Garwood, Biometrika 28 (1936): quantiles of chi-squared."""
    assert upper_count(events, 0.975) == pytest.approx(stats.chi2.ppf(0.975, 2 * events + 2) / 2.0, rel=1e-9)
    expected = stats.chi2.ppf(0.025, 2 * events) / 2.0 if events else 0.0
    assert lower_count(events, 0.975) == pytest.approx(expected, rel=1e-9)


def test_no_event_excludes_only_rates_at_which_a_burst_was_due() -> None:
    """P(no burst) = exp(-n rate / burst), whatever the sizes of the bursts."""
    assert upper_count(0, 0.999, 5.0) == pytest.approx(5.0 * math.log(1000.0), rel=1e-9)


@pytest.mark.parametrize(("burst", "events"), [(1.0, 3), (2.0, 6), (5.0, 11), (5.0, 0)])
def test_bounds_are_reached_with_the_error_probability(burst: float, events: int) -> None:
    """Counts of geometric bursts at either bound: binomial with 40,000 draws, false failure 1e-9 each."""
    rng, n, error = np.random.default_rng(1), 40_000, 0.05
    for mean, is_low in ((upper_count(events, 0.95, burst), True), (lower_count(events, 0.95, burst), False)):
        bursts = rng.poisson(mean / burst, n)
        more = np.array([int(each) and int(rng.negative_binomial(each, 1.0 / burst)) for each in bursts]) + bursts
        count = np.count_nonzero(more <= events if is_low else more >= events)
        if events or is_low:
            low, high = stats.binom.interval(1.0 - 1e-9, n, error)
            assert low <= count <= high


@pytest.mark.parametrize("events", [1, 3, 10])
def test_bounds_also_hold_for_smaller_bursts_than_assumed(events: int) -> None:
    smaller = np.linspace(1.0, 5.0, 9)
    assert max(upper_count(events, 0.95, each) for each in smaller) == upper_count(events, 0.95, 5.0)
    for burst in smaller:
        least = lower_count(events, 0.95, 5.0)
        count = stats.poisson(least / burst)
        more = sum(
            count.pmf(k) * (1.0 if k >= events else stats.nbinom.sf(events - 1 - k, k, 1.0 / burst))
            for k in range(1, 60)
        )
        assert more <= 0.05 * (1.0 + 1e-6)


def test_counts_of_plays_with_bursts_are_overdispersed_and_widen_the_bounds() -> None:
    rng, plays = np.random.default_rng(2), 50
    bursts = 20 * rng.poisson(0.4, plays)
    found = dispersion(bursts.tolist(), [1000] * plays)
    assert found.p <= 0.001
    assert found.index == pytest.approx(np.var(bursts, ddof=1) / np.mean(bursts))
    bounds = bound_rate(bursts.tolist(), [1000] * plays, 0.95)
    assert bounds.burst == pytest.approx(0.5 * (found.index + 1.0)) and bounds.burst > 5.0
    assert bounds.high == upper_count(int(bursts.sum()), 0.95, bounds.burst) / (1000 * plays)
    assert "observed" in bounds.basis


def test_independent_counts_are_called_overdispersed_as_seldom_as_the_level_says() -> None:
    """1000 devices with 8 alarms in 16 plays of unequal length: binomial, false failure 1e-6."""
    rng, exposure = np.random.default_rng(3), [1000, 3000] * 8
    counts = rng.multinomial(8, np.array(exposure) / sum(exposure), size=1000)
    wrong = sum(dispersion(each.tolist(), exposure).p <= 0.01 for each in counts)
    assert wrong <= stats.binom.isf(1e-6, 1000, 0.01)


def test_many_plays_are_merged_and_show_the_same_dispersion() -> None:
    rng = np.random.default_rng(4)
    counts = 5 * rng.poisson(0.01, 20_000)
    found = dispersion(counts.tolist(), [10] * len(counts))
    assert (found.blocks, found.events) == (1000, counts.sum())
    assert found.index == pytest.approx(5.0, rel=0.25)
    assert dispersion([1, 0], [9, 9]).burst == dispersion([], []).burst == 1.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: upper_count(-1, 0.9), "there cannot be -1 events"),
        (lambda: upper_count(0, 1.0), "confidence must be between 0 and 1, not 1"),
        (lambda: lower_count(0, 0.9, 0.5), "burst must be 1 or more, not 0.5"),
        (lambda: Design(0.0, 0.9), "rate must be between 0 and 1, not 0"),
        (lambda: bound_rate([0], [0], 0.9), "there must be at least one trial"),
        (lambda: bound_rate([2], [1], 0.9), "there cannot be 2 events in 1 trials"),
        (lambda: upper_count(0, 0.9, math.nan), "burst must be 1 or more, not nan"),
    ],
)
def test_values_out_of_range_are_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]
