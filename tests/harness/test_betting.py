"""Bounds of rates by betting: against closed forms, at the limit for any dependence within a play, at every look."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from scipy import optimize, stats

from analogrig.judging.betting import BettingSequence, quiet_plays
from analogrig.judging.statistics import Decision
from tests.harness.simulated_alarms import ARMED_N, BEYOND, COVERED, MOST, Law, bet


@pytest.mark.parametrize("name", [*COVERED, *BEYOND])
def test_device_at_the_limit_is_certified_or_refuted_as_seldom_as_promised(name: str) -> None:
    """250 devices, looks after every play: binomial, false failure 1e-8 each, 3e-7 for all."""
    (found,) = bet(Law({**COVERED, **BEYOND}[name], 1e-5), 1e-5, [0.9], 250)
    most = stats.binom.isf(1e-8, 250, 0.1)
    assert np.isfinite(found.certified).sum() <= most
    assert np.isfinite(found.refuted).sum() <= most


@pytest.mark.parametrize("name", [*COVERED, *BEYOND])
def test_simulated_devices_raise_alarms_at_the_rate_that_is_asked(name: str) -> None:
    """Mean over 100,000 plays with alarms, within five standard errors."""
    law = Law({**COVERED, **BEYOND}[name], 1e-4)
    alarms = law.draw(np.random.default_rng(0), (100_000,))
    assert alarms.min() >= 1 and alarms.max() <= MOST
    error = alarms.std() / 316.0 * law.chance
    assert alarms.mean() * law.chance == pytest.approx(law.mean, abs=5.0 * error + 1e-12)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5])
def test_device_below_the_limit_is_certified(share: float) -> None:
    (found,) = bet(Law(COVERED["independent"], max(share, 1e-9) * 1e-5), 1e-5, [0.999], 100)
    assert np.isfinite(found.certified).all()
    assert not np.isfinite(found.refuted).any()


@pytest.mark.parametrize("most", [1, 7, 582])
@pytest.mark.parametrize("confidence", [0.95, 0.99, 0.999])
def test_number_of_quiet_plays_is_that_which_every_test_needs_and_half_more_at_most(
    most: int, confidence: float
) -> None:
    """A device with a burst of ``most`` in one play of 1 / p is silent for ln(1 / error) / p plays."""
    rate, exposure = 1e-5, 10 * most
    needed = math.log1p(-confidence) / math.log1p(-rate * exposure / most)
    assert needed < quiet_plays(rate, confidence, most, exposure) < 1.5 * needed


@pytest.mark.parametrize(("events", "trials"), [(0, 3), (0, 100), (3, 100), (50, 100), (100, 100), (97, 1000)])
def test_bounds_of_independent_trials_enclose_those_of_clopper_and_pearson(events: int, trials: int) -> None:
    """Valid at any time, thus wider than exact bounds of a fixed length, and at most 2.5 times as far away."""
    bets = BettingSequence(0.975, 1, 1, +Counter({(1, 1): events, (0, 1): trials - events}))
    low, high = bets.bounds
    exact = stats.binomtest(events, trials).proportion_ci(0.95, method="exact")
    rate = events / trials
    assert rate - 2.5 * (rate - exact.low) <= low <= exact.low
    assert exact.high <= high <= rate + 2.5 * (exact.high - rate) or trials == 3


@pytest.mark.parametrize("plays", [{(0, 50): 40}, {(0, 50): 40, (3, 44): 2, (1, 48): 9}, {(5, 40): 7}])
def test_bounds_are_the_rates_at_which_the_wealth_reaches_one_over_the_error(plays: dict[tuple[int, int], int]) -> None:
    """Wealth of sixteen fixed stakes, written out in full for each of them."""
    bets = BettingSequence(0.99, 10, 50, Counter(plays))

    def log_wealth(rate: float, is_high: int) -> float:
        total = 0.0
        for i in range(16):
            wealth = 1.0 / ((i + 1) * (i + 2))
            for (events, exposure), times in plays.items():
                above, below = events / (rate * 50) - exposure / 50, (rate * exposure - events) / (10 * (1.0 - rate))
                wealth *= (1.0 + 31.0 / 32.0 / 2.0**i * (below if is_high else above)) ** times
            total += wealth
        return math.log(total)

    low, high = bets.bounds
    root = optimize.brentq(lambda rate: log_wealth(rate, 1) - math.log(100.0), 1e-9, 0.9, xtol=1e-15)
    assert high == pytest.approx(root, rel=1e-8)
    if low:
        assert log_wealth(low, 0) == pytest.approx(math.log(100.0), rel=1e-8)
    assert bets.decision(1.001 * high) is Decision.BELOW
    assert bets.decision(0.999 * high) is Decision.OPEN
    if low:
        assert bets.decision(1.001 * low) is Decision.OPEN
        assert bets.decision(0.999 * low) is Decision.ABOVE


@pytest.mark.parametrize("size", [1, 3, 10])
def test_bounds_hold_at_every_look_for_exposures_that_depend_on_the_alarms(size: int) -> None:
    """100 series of 100 plays; an alarm ends the exposure. Each side errs in 10 %: binomial, false failure 1e-6."""
    rng, chance = np.random.default_rng(size), 0.05
    rate = chance * size / (20.0 - chance * 10.0)
    wrong = Counter[Decision]()
    for _ in range(100):
        bets = BettingSequence(0.9, size, 20)
        for has_alarms in (rng.random(100) < chance).tolist():
            bets.add(size if has_alarms else 0, 10 if has_alarms else 20)
            if (decision := bets.decision(rate)) is not Decision.OPEN:
                wrong[decision] += 1
                break
    assert max(wrong.values(), default=0) <= stats.binom.isf(1e-6, 100, 0.1)


def test_order_of_the_plays_does_not_matter() -> None:
    rng, plays = np.random.default_rng(3), [(0, 50), (3, 44), (1, 48)] * 9
    found = set()
    for _ in range(5):
        bets = BettingSequence(0.9, 10, 50)
        for i in rng.permutation(len(plays)):
            bets.add(*plays[i])
        found.add(bets.bounds)
    assert len(found) == 1


def test_more_alarms_than_a_play_can_have_certify_nothing() -> None:
    bets = BettingSequence(0.9, 2, ARMED_N, Counter({(0, ARMED_N): 10**6}))
    assert bets.decision(1e-6) is Decision.BELOW
    bets.add(3, ARMED_N)
    assert bets.broken == "3 alarms in a play that can have 2"
    assert bets.decision(0.5) is Decision.OPEN
    assert bets.bounds[1] == 1.0


def test_plays_without_exposure_say_nothing() -> None:
    bets = BettingSequence(0.9, 2, 10, Counter({(0, 0): 1000}))
    assert bets.bounds == (0.0, 1.0) == BettingSequence(0.9, 2, 10).bounds
    assert bets.decision(0.5) is Decision.OPEN


def test_plays_still_needed_are_those_that_decide() -> None:
    few = BettingSequence(0.99, 10, 50, Counter({(0, 50): 4, (1, 48): 1}))
    times = few.needed(0.05) / 5.0
    enough = BettingSequence(0.99, 10, 50, Counter({play: math.ceil(n * times) for play, n in few.plays.items()}))
    assert few.decision(0.05) is Decision.OPEN and enough.decision(0.05) is Decision.BELOW
    assert few.needed(0.0001) == math.inf


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: BettingSequence(1.0, 1, 1), "confidence must be between 0 and 1, not 1"),
        (lambda: BettingSequence(0.9, 0, 1), "must be able to have an event"),
        (lambda: BettingSequence(0.9, 1, 1).add(2, 1), "there cannot be 2 events in 1 trials"),
    ],
)
def test_values_out_of_range_are_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]
