"""Promises of the estimator in numbers, on a few of the cells of tests.bench.bench_statistics.

Seeds are fixed, so that a test passes or fails for good; the probabilities stated are those of another seed.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from analogrig.plant import SampledPlant
from tests.estimator_c import performance
from tests.estimator_c.est_driver import Estimator
from tests.estimator_c.performance import (
    ARL0,
    FULL,
    FULL_FREE,
    OWN_CLOCK,
    QUARTER,
    QUARTER_FREE,
    SHARED_CLOCK,
    Settings,
)
from tests.estimator_c.plants import (
    DISPLACEMENT_RANGE_M,
    FRONT,
    LIGHT,
    SHOCK,
    VARIANCE_LSB2,
    Excitation,
    Mechanics,
    random_plants,
    simulate,
)
from tests.estimator_c.test_est_trigger import suspension
from tests.harness.plants import front

SHARED = [(FULL, "K", 1.05), (FULL, "B", 0.95), (FULL, "M", 0.8), (QUARTER, "M", 1.1), (QUARTER, "K", 0.9)]
FREE = [(FULL_FREE, "B", 0.95), (FULL_FREE, "M", 0.95), (QUARTER_FREE, "M", 1.1)]
CELLS = [(SHARED_CLOCK, *cell) for cell in SHARED] + [(OWN_CLOCK, *cell) for cell in FREE]


@pytest.mark.parametrize(("settings", "excitation", "parameter", "factor"), CELLS)
def test_change_is_noticed_close_to_the_information_bound(
    estimator: Estimator, settings: Settings, excitation: Excitation, parameter: str, factor: float
) -> None:
    """The measured ratios are at least four standard errors below the limits: one seed in 10,000 fails a cell."""
    plants = (FRONT, FRONT.scaled(parameter, factor))
    found = performance.delay(estimator, settings, plants, excitation, trials=400, seed=17)
    assert found.missed <= 1, "an edge that slips across a sampling instant just then may hide a change"
    assert found.ratio < (1.3 if excitation == FULL else 1.5)
    assert found.ratio > 0.9, "a test that knows both plants has 0.962"


@pytest.mark.parametrize("plant", [FRONT, SHOCK, LIGHT], ids=["front", "shock", "light"])
def test_healthy_plant_raises_no_more_alarms_than_promised(estimator: Estimator, plant: Mechanics) -> None:
    """With 99 % confidence; at the measured rates, below 1e-6, three alarms or more have a probability of 8 %."""
    found = performance.false_alarms(estimator, SHARED_CLOCK, plant, FULL, 1_000_000, seed=29)
    assert performance.upper_rate(found, 1_000_000) <= 1.0 / ARL0


@pytest.mark.heavy
@pytest.mark.parametrize(("settings", "excitation"), [(SHARED_CLOCK, FULL), (OWN_CLOCK, FULL_FREE)])
def test_random_healthy_plants_raise_no_more_alarms_than_promised(
    estimator: Estimator, settings: Settings, excitation: Excitation
) -> None:
    """Ten plants, 200,000 samples each; at the measured rate of 1.5e-6 ten alarms have a probability of 0.1 %."""
    samples = 200_000
    found = [
        performance.false_alarms(estimator, settings, plant, excitation, samples, seed)
        for seed, plant in enumerate(random_plants(10, seed=2))
    ]
    assert performance.upper_rate(sum(found), samples * len(found)) <= 1.0 / ARL0


def test_parameters_come_within_three_cramer_rao_bounds_in_200_samples(estimator: Estimator) -> None:
    """The root mean square of 400 trials has a standard error of 3.5 %; the largest ratio is 2.4."""
    found = performance.accuracy(estimator, SHARED_CLOCK, trials=400, samples=200)
    assert (found.rms < 3.0 * found.bounds).all()
    assert (found.rms > 0.9 * found.bounds).all(), "no unbiased estimator is that good"


def test_prefilter_follows_a_slow_plant_until_the_innovations_are_white(estimator: Estimator) -> None:
    """An early refresh had left C with a zero at 0.994, each coefficient 0.02 from A: variance 2, 48 false alarms."""
    plant = random_plants(50, seed=1)[25]
    played = simulate((plant, plant), np.full(40, 10_000), FULL, 10_000, seed=225)
    assert estimator.init(**SHARED_CLOCK, kind=0)
    result = estimator.run(played.u[9], played.y[9])
    assert 1.0 < result.innovation[5000:].var() < 1.2


@pytest.mark.parametrize("excitation", [FULL, FULL_FREE], ids=["on samples", "anywhere"])
def test_plants_move_as_exact_steps_say(excitation: Excitation) -> None:
    """Against matrix exponentials between the edges; nothing but rounding and noise lies between the two."""
    played = simulate((FRONT, FRONT.scaled("K", 0.8)), np.array([180]), excitation, 400, seed=3)
    first = excitation.first_edges(np.random.default_rng(3), 1)[0]
    edges = first + np.arange(9.0) * 50.0 * (1.0 + excitation.drift_ppm * 1e-6)
    front, changed = (115.0, 3021.0, 24500.0), (115.0, 3021.0, 19600.0)
    _, y = suspension([(0, front), (180, changed)], edges, 400, 0.0, 3)
    error = played.y[0] - (y - 410.0) * (2940.0 / 2900.0)
    assert np.abs(error).max() < 6.0
    assert np.sqrt(np.mean(error**2)) == pytest.approx(math.sqrt(VARIANCE_LSB2 + 1.0 / 12.0), rel=0.2)


def test_information_is_that_of_the_two_plants_from_one_state() -> None:
    """Against the steps of analogrig.plant, sample by sample from the change on."""
    onset, samples = 130, 145
    excitation = Excitation(half_period_n=60.0)
    played = simulate((FRONT, FRONT.scaled("M", 1.2)), np.array([onset]), excitation, samples, seed=5)
    first = excitation.first_edges(np.random.default_rng(5), 1)[0]
    force = [2940.0 * ((k - first) // 60.0 % 2.0 == 0.0) * (k >= first) for k in range(samples)]
    before, after = (SampledPlant.from_plant(front(mass), 0.01) for mass in (115.0, 138.0))
    state = before.at_rest
    for k in range(onset):
        state = before.next(state, force[k])
    unchanged = changed = state
    information = 0.0
    for k in range(onset, samples - 1):
        unchanged, changed = before.next(unchanged, force[k]), after.next(changed, force[k])
        difference_lsb = (changed[0] - unchanged[0]) * 4096.0 / DISPLACEMENT_RANGE_M
        information += difference_lsb**2 / (2.0 * VARIANCE_LSB2)
        assert played.information[0, k + 1] == pytest.approx(information, rel=1e-6)
    assert information > 0.0
