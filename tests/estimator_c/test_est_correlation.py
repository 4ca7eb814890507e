"""Serially correlated innovations: their second reading, and the dispersion of their squares (est_correlation.h)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter

from tests.estimator_c.est_driver import (
    CUSTOM,
    LOCKED,
    MAY_SLIP,
    MEAN_BETWEEN_FAULTS,
    NONE,
    PREDICTION_ERROR,
    WARM_UP_N,
    Estimator,
    Result,
)
from tests.estimator_c.test_est_adversarial import VAGUE, barely_excited
from tests.estimator_c.test_est_trigger import FRONT, INFLATION, suspension

Array = NDArray[np.float64]

GIVEN: dict[str, float | tuple[float, float]] = {
    "na": 1,
    "nb": 1,
    "nk": 1,
    "offset": 0,
    "c": (0.0, 0.0),
    "forgetting": 1.0,
    "p0": 1e-9,
    "refresh_n": 0,
    "stuck_n": 0,
    "noise_variance": 1.0,
    "edge_instants": LOCKED,
    "warm_up_n": WARM_UP_N,
}
"""A theta that stays zero: with u = 0, y is the innovation."""

CEILING = float(np.log(1e5))
GAIN, DRIFT = 0.4945, 1.1305
"""Of the cumulative sum, est_trigger.h."""

SOFT = (115.0, 3021.0, 18000.0)


def correlated(partial: Sequence[float], samples: int, seed: int) -> Array:
    """Autoregression of order 2 and variance 1 with these partial correlations."""
    first, second = partial
    white = np.random.default_rng(seed).normal(0.0, np.sqrt((1.0 - first**2) * (1.0 - second**2)), samples + 1000)
    return np.asarray(lfilter([1.0], [1.0, -first * (1.0 - second), -second], white)[1000:])


def enter(estimator: Estimator, innovations: ArrayLike) -> Result:
    """Result of a run whose innovations are given."""
    y = np.asarray(innovations, np.float64)
    return estimator.run(np.zeros(len(y)), y)


def follow(estimator: Estimator, innovations: Array, step_n: int = 100) -> tuple[Array, NDArray[np.bool_]]:
    """Partial correlations (k, 2), and whether there is a second reading (k,), after every step_n samples."""
    partial, reads = [], []
    for part in np.split(innovations, range(step_n, len(innovations), step_n)):
        enter(estimator, part)
        partial.append(estimator.partial_correlations())
        reads.append(estimator.reads_twice())
    return np.array(partial), np.array(reads)


def first_reading(innovations: NDArray[np.floating], variance: float) -> Array:
    """Cumulative sum without a second reading."""
    sums, total = [], 0.0
    for e in innovations:
        total = max(0.0, total + GAIN * float(e) ** 2 / variance - DRIFT)
        sums.append(total)
    return np.array(sums)


def front_with_noise(
    pole: float, samples: int, seed: int, onset: int | None = None, period_n: float = 50.0
) -> tuple[Array, Array]:
    """Codes of a front suspension whose displacement has autoregressive noise of 1 code."""
    plants = [(0, FRONT)] if onset is None else [(0, FRONT), (onset, SOFT)]
    u, y = suspension(plants, np.arange(10.0, samples, period_n), samples, 0.0, seed)
    return u, np.round(y + correlated((pole, 0.0), samples, seed))


# ---- correlations


@pytest.mark.parametrize("partial", [(0.5, -0.4), (-0.5, 0.4), (0.8, 0.0), (0.3, 0.3)], ids=str)
def test_partial_correlations_of_the_innovations_are_followed(
    estimator: Estimator, partial: tuple[float, float]
) -> None:
    assert estimator.init(**GIVEN | {"ceiling": 1e6})
    followed, reads = follow(estimator, correlated(partial, 40_000, 1))
    assert followed[50:].mean(axis=0) == pytest.approx(np.array(partial) / 1.05, abs=0.05)
    assert (followed[50:].std(axis=0) < 0.05).all()
    assert reads[50:].all()


def test_innovations_at_lag_2_alone_need_lag_1_to_be_looked_at(estimator: Estimator) -> None:
    """While most steps are without work, the correlation at lag 1 alone is estimated."""
    assert estimator.init(**GIVEN | {"ceiling": 1e6})
    white, reads = follow(estimator, correlated((0.0, 0.0), 40_000, 1))
    assert reads[50:].mean() < 0.02
    assert np.abs(white[50:]).max() < 0.15


def test_declared_noise_has_no_second_reading(estimator: Estimator) -> None:
    """The scale is not followed, and so nothing is known of the innovations."""
    innovations = correlated((0.8, 0.0), 4000, 1)
    assert estimator.init(**GIVEN | {"noise_estimated": 0, "warm_up_n": 0, "ceiling": 1e6})
    statistic = enter(estimator, innovations).statistic[1:]
    assert statistic == pytest.approx(first_reading(innovations[1:], 1.0), rel=1e-3, abs=1e-3)
    assert not estimator.reads_twice()


# ---- false alarms


@pytest.mark.parametrize("partial", [(0.7, 0.0), (0.5, -0.4)], ids=str)
def test_correlated_innovations_raise_no_alarm_where_the_first_reading_alone_would(
    estimator: Estimator, partial: tuple[float, float]
) -> None:
    would = 0
    for seed in range(3):
        innovations = correlated(partial, 40_000, seed)
        assert estimator.init(**GIVEN)
        assert not len(enter(estimator, innovations).alarms)
        would += int((first_reading(innovations[WARM_UP_N:], 1.1 * estimator.scale()) > CEILING).any())
    assert would > 0


def test_plant_with_autoregressive_noise_raises_no_alarm_where_the_first_reading_alone_would(
    estimator: Estimator,
) -> None:
    for seed in range(3):
        u, y = front_with_noise(0.9, 6000, seed)
        assert estimator.init(warm_up_n=WARM_UP_N)
        result = estimator.run(u, y)
        assert not len(result.alarms)
        alone = first_reading(result.innovation[WARM_UP_N + 50 :], 1.1 * result.noise_variance)
        assert alone.max() > CEILING


@pytest.mark.parametrize("partial", [(0.7, 0.0), (0.5, -0.4)], ids=str)
def test_hypotheses_after_a_gap_begin_anew_as_stated(estimator: Estimator, partial: tuple[float, float]) -> None:
    """The first innovation after a gap follows no other. Both hypotheses begin from the same sum."""
    assert estimator.init(**GIVEN | {"ceiling": 1e6})
    enter(estimator, correlated(partial, 8000, 1))
    before = float(enter(estimator, [-12.0, 3.0]).statistic[-1])
    assert not estimator.run(np.zeros(20), np.zeros(20), np.zeros(20)).innovation.any()
    first, second = estimator.partial_correlations()
    innovations = np.array([0.0, 5.0, 4.0, 3.0, 2.0, 4.0, 6.0, 5.0])  # the first one is gathered
    statistic = enter(estimator, innovations).statistic[1:]
    weight = (float(statistic[0]) - before + DRIFT) / 5.0**2
    assert weight == pytest.approx(GAIN / estimator.scale(), rel=0.1)
    one = other = before
    last = [0.0, 0.0]
    for k, e in enumerate(innovations[1:]):
        left = e - first * last[0] - second * (last[1] - first * last[0])
        one = max(0.0, one + weight * e**2 - DRIFT)
        other = max(0.0, other + weight * left**2 / ((1.0 - first**2) * (1.0 - second**2)) - DRIFT)
        assert statistic[k] == pytest.approx(min(one, other), rel=0.02)
        last = [float(e), last[0]]


# ---- changes


@pytest.mark.parametrize(("pole", "mean_n"), [(0.0, 9.0), (0.7, 18.0)])
def test_change_of_correlated_noise_is_seen_later_by_its_correlation(
    estimator: Estimator, pole: float, mean_n: float
) -> None:
    """Three times the innovations."""
    delays = []
    for seed in range(10):
        innovations = correlated((pole, 0.0), 9000, seed)
        innovations[8000:] *= 3.0
        assert estimator.init(**GIVEN)
        delays.append(int(enter(estimator, innovations).alarms[0]) - 8000)
    assert min(delays) >= 0
    assert max(delays) < 60
    assert np.mean(delays) < mean_n


@pytest.mark.parametrize("after_n", [3, 25], ids=["ambiguous edge", "between edges"])
@pytest.mark.parametrize("edge_instants", [LOCKED, MAY_SLIP])
def test_change_of_a_plant_with_autoregressive_noise_is_seen_by_the_next_edge(
    estimator: Estimator, edge_instants: int, after_n: int
) -> None:
    """Edges come at samples 10, 60, ...; the stiffness falls soon after one of them."""
    for seed in range(4):
        u, y = front_with_noise(0.9, 4300, seed, onset=4010 + after_n)
        assert estimator.init(warm_up_n=WARM_UP_N, edge_instants=edge_instants)
        first, *_ = estimator.run(u, y).alarms
        assert 4010 + after_n < first < 4080


def test_peak_where_theta_is_uncertain_raises_no_alarm_with_a_second_reading(estimator: Estimator) -> None:
    """The largest regressor so far: a poor model leaves most there."""
    alarms = {}
    for pole in (0.0, 0.7):
        assert estimator.init(**GIVEN)
        innovations = correlated((pole, 0.0), 8040, 1)
        enter(estimator, innovations[:8000])
        assert estimator.reads_twice() == (pole > 0.0)
        u, y = np.zeros(40), innovations[8000:]
        u[9] = 1.6e5  # variance 1 + p0 u^2
        y[10:] += 40.0 * 0.7 ** np.arange(30.0)
        alarms[pole] = len(estimator.run(u, y).alarms)
    assert alarms[0.0] > 0
    assert alarms[0.7] == 0


def test_single_innovation_of_8_deviations_is_an_alarm_under_both_hypotheses(estimator: Estimator) -> None:
    innovations = correlated((0.7, 0.0), 8100, 1)
    innovations[8050] = 8.0
    assert estimator.init(**GIVEN)
    assert enter(estimator, innovations).alarms[0] == 8050


def test_theta_that_overflows_raises_an_alarm_while_there_is_a_second_reading(estimator: Estimator) -> None:
    """Armed and held."""
    read = 0
    for warm_up_n, seed in itertools.product((150, 4000), range(120)):
        settings = VAGUE | {"p0": 1e6, "offset": 0, "warm_up_n": warm_up_n, "ceiling": 1e9}
        u, y = barely_excited(seed, 2000, rest=1e-4, busy=0.2)
        assert estimator.init(**settings)
        result = estimator.run(u, y)
        overflown = result.alarms[~(result.statistic[result.alarms] < np.finfo(np.float32).max)]
        assert (result.theta[overflown] == 0.0).all()
        assert estimator.init(**settings)
        for first, end in itertools.pairwise([0, *overflown]):
            estimator.run(u[first:end], y[first:end])
            read += estimator.reads_twice()
    assert read > 0


# ---- no second reading


def test_smooth_innovations_have_no_second_reading_and_no_dispersion(estimator: Estimator) -> None:
    """The slow residual of a poor model."""
    for pole, smooth in ((0.97, True), (0.7, False)):
        assert estimator.init(**GIVEN | {"ceiling": 1e6})
        _, reads = follow(estimator, 1.5 * correlated((pole, 0.0), 8000, 1))
        assert (~reads[30:]).all() if smooth else reads[30:].all()
        noise_variance = enter(estimator, [0.0]).noise_variance
        assert (estimator.scale() == noise_variance) == smooth


def test_second_reading_ends_when_the_innovations_are_white_again(estimator: Estimator) -> None:
    assert estimator.init(**GIVEN)
    _, before = follow(estimator, correlated((0.8, 0.0), 8000, 0))
    partial, after = follow(estimator, correlated((0.0, 0.0), 12_000, 100))
    assert before[-1]
    assert not after[60:].any()
    assert (partial[60:] ** 2).sum(axis=1).max() < 0.05
    assert after[0]  # not at once


TRIGGERS: list[tuple[dict[str, float], object]] = [
    ({"kind": PREDICTION_ERROR}, np.abs),
    ({"kind": MEAN_BETWEEN_FAULTS, "absolute": 1}, lambda e: np.cumsum(np.abs(e)) / np.arange(1, len(e) + 1)),
    ({"kind": CUSTOM, "custom": 1}, lambda e: np.arange(1, len(e) + 1)),
    ({"kind": NONE}, np.zeros_like),
]


@pytest.mark.parametrize(("settings", "expected"), TRIGGERS, ids=["prediction error", "mean", "custom", "none"])
def test_other_triggers_see_correlated_innovations_as_they_are(
    estimator: Estimator, settings: dict[str, float], expected: object
) -> None:
    assert callable(expected)
    innovations = correlated((0.8, 0.0), 3000, 1)
    assert estimator.init(**GIVEN | {"warm_up_n": 0, "ceiling": 1e6} | settings)
    result = enter(estimator, innovations)
    assert result.statistic[1:] == pytest.approx(expected(result.innovation[1:].astype(float)), rel=1e-4)
    assert not estimator.partial_correlations().any()
    assert not estimator.reads_twice()


def test_second_reading_ends_where_edges_are_known_to_come_anywhere(estimator: Estimator) -> None:
    """The correlations so far are those of the wrong model. The inflation ends at the same sample."""
    seen = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        edges = np.arange(10.0, 4000.0, 50.0) + np.where(np.arange(80) < 40, 0.0, rng.uniform(0.0, 1.0, 80))
        u, y = suspension([(0, FRONT)], edges, 4000, 0.0, seed)
        y = np.round(y + correlated((0.9, 0.0), 4000, seed))
        assert estimator.init(warm_up_n=WARM_UP_N)
        estimator.run(u[:2000], y[:2000])
        estimator.inflate(INFLATION)
        twice = False
        for k in range(2000, len(u)):
            before, twice = twice, False
            noise_variance = estimator.run(u[k : k + 1], y[k : k + 1]).noise_variance
            twice = estimator.reads_twice()
            if estimator.scale() < 0.01 * INFLATION:
                assert not twice
                assert not estimator.partial_correlations().any()
                assert estimator.scale() == noise_variance
                seen += before
                break
    assert seen > 0


# ---- dispersion


@pytest.mark.parametrize("seed", range(4))
def test_noise_that_rises_from_1_to_3_codes_enlarges_the_scale_and_raises_no_alarm(
    estimator: Estimator, seed: int
) -> None:
    rise = np.interp(np.arange(12_000), [5000, 10_000], [1.0, 3.0])
    innovations = correlated((0.0, 0.0), 12_000, seed) * rise
    assert estimator.init(**GIVEN)
    assert not len(enter(estimator, innovations[:5000]).alarms)
    steady = estimator.scale() / enter(estimator, [0.0]).noise_variance
    result = enter(estimator, innovations[5001:10_000])
    assert not len(result.alarms)
    assert estimator.scale() / result.noise_variance > 1.15 * steady
    assert result.noise_variance == pytest.approx(9.0, rel=0.4)


def test_dispersion_is_that_of_the_blocks(estimator: Estimator) -> None:
    """Mean squares of 0.4 and 1.6, for 200 equations each: squared, and averaged, 1.36; twice what is beyond 1.15."""
    variance = np.where(np.arange(40_000) // 192 % 2, 0.4, 1.6)
    assert estimator.init(**GIVEN | {"ceiling": 1e6})
    ratios = []
    for part in np.split(correlated((0.0, 0.0), 40_000, 1) * np.sqrt(variance), 100):
        result = enter(estimator, part)
        ratios.append(estimator.scale() / result.noise_variance)
    assert np.mean(ratios[20:]) == pytest.approx(1.0 + 2.0 * (1.36 * 1.0625 - 1.15), abs=0.15)
