"""The recursive estimate against batch least squares in float64, which shares no code with it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_triangular, toeplitz
from scipy.signal import lfilter

from analogrig.estimator_config import EstimatorConfig
from tests.estimator_c.est_driver import CUSUM, GATHERING, LOCKED, MISSING, NONE, REFUSED, UPDATED, Estimator

# y(k) = -0.5 y(k-1) - 0.8 y(k-2) - 0.9 u(k-1): the example of thesis section 3.5.
A, B = [1.0, 0.5, 0.8], [0.0, -0.9]


class Record(NamedTuple):
    u: NDArray[np.float64]
    y: NDArray[np.float64]


def record(n: int = 400, noise: float = 0.0, seed: int = 5, offset: float = 0.0) -> Record:
    rng = np.random.default_rng(seed)
    u = np.asarray(rng.integers(0, 2, n) * 2000.0 - 1000.0, dtype=np.float64)
    y = np.asarray(lfilter(B, A, u), dtype=np.float64)
    return Record(u, y + rng.normal(0.0, 1.0, n) * noise + offset)


def delayed(x: NDArray[np.float64], lag: int) -> NDArray[np.float64]:
    """x(k - lag), zero before the record."""
    return np.concatenate([np.zeros(lag), x])[: len(x)]


def equations(segment: Record, nb: int, nk: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Regressors and outputs of the samples whose equation reaches back to no unknown sample."""
    u, y = segment
    past = max(2, nb + nk - 1)
    columns = [-delayed(y, 1), -delayed(y, 2), *(delayed(u, nk + j) for j in range(nb)), np.ones(len(u))]
    return np.column_stack(columns)[past:], y[past:]


def batch(
    segments: list[Record], c: tuple[float, float], nb: int, nk: int, forgetting: float, p0: float, p0_offset: float
) -> NDArray[np.float64]:
    """Generalised least squares: the noise of a segment of contiguous samples is the moving average C(z) e, whose
    covariance matrix is whitened by its Cholesky factor (Brockwell and Davis, section 5.3); forgetting by equations."""
    rows, targets = [], []
    for segment in segments:
        phi, target = equations(segment, nb, nk)
        n = len(target)
        taps = np.array([1.0, *c])
        autocovariance = np.concatenate([np.correlate(taps, taps, "full")[2:], np.zeros(n)])[:n]
        factor = np.linalg.cholesky(toeplitz(autocovariance))
        whitened = solve_triangular(factor, np.column_stack([phi, target]), lower=True)
        rows.append(whitened[:, :-1])
        targets.append(whitened[:, -1])
    phi, target = np.concatenate(rows), np.concatenate(targets)
    total = len(target)
    weight = forgetting ** np.arange(total - 1, -1, -1.0)
    prior = np.concatenate([np.full(2 + nb, 1.0 / p0), [1.0 / p0_offset]])
    normal = (phi.T * weight) @ phi + np.diag(prior) * forgetting**total
    return np.asarray(np.linalg.solve(normal, (phi.T * weight) @ target))


SETTINGS = {"nb": 2, "nk": 0, "refresh_n": 0, "p0": 10.0, "p0_offset": 1e4, "kind": NONE}


@pytest.mark.parametrize("c", [(0.0, 0.0), (-1.6, 0.64)], ids=["no prefilter", "prefilter"])
@pytest.mark.parametrize("forgetting", [1.0, 0.97])
def test_estimate_is_the_weighted_least_squares_one(
    estimator: Estimator, c: tuple[float, float], forgetting: float
) -> None:
    data = record(noise=3.0, offset=40.0)
    assert estimator.init(**SETTINGS, c=c, forgetting=forgetting)
    theta = estimator.run(*data).theta
    for n in (50, 400):
        expected = batch([Record(data.u[:n], data.y[:n])], c, 2, 0, forgetting, 10.0, 1e4)
        assert theta[n - 1] == pytest.approx(expected, rel=2e-3, abs=2e-4)


@pytest.mark.parametrize("forgetting", [1.0, 0.97])
def test_variance_is_that_of_least_squares(estimator: Estimator, forgetting: float) -> None:
    data = record(noise=3.0)
    assert estimator.init(**SETTINGS, c=(0.0, 0.0), forgetting=forgetting)
    variance = estimator.run(*data).variance
    phi = np.column_stack([-delayed(data.y, 1), -delayed(data.y, 2), data.u, delayed(data.u, 1), np.ones(len(data.u))])[
        2:
    ]
    weight = forgetting ** np.arange(len(phi) - 1, -1, -1.0)
    prior = np.diag([0.1, 0.1, 0.1, 0.1, 1e-4]) * forgetting ** len(phi)
    covariance = np.linalg.inv((phi.T * weight) @ phi + prior)
    assert variance == pytest.approx(np.diag(covariance), rel=1e-2)


def test_variances_and_offset_are_those_at_codes_of_zero(estimator: Estimator) -> None:
    """With c(k) relative to the first codes: offset = relative offset + y(0) (1 + a1 + a2) - u(0) (b0 + b1)."""
    data = record(noise=3.0)
    u_0, y_0 = 500.0, 300.0
    settings = SETTINGS | {"kind": CUSUM, "ceiling": 1e9, "edge_instants": LOCKED}
    assert estimator.init(**settings, c=(0.0, 0.0), forgetting=1.0)
    result = estimator.run(data.u - data.u[0] + u_0, data.y - data.y[0] + y_0)
    u, y = data.u - data.u[0], data.y - data.y[0]
    phi = np.column_stack([-delayed(y, 1), -delayed(y, 2), u, delayed(u, 1), np.ones(len(u))])[2:]
    covariance = np.linalg.inv(phi.T @ phi + np.diag([0.1, 0.1, 0.1, 0.1, 1e-4]))
    by_offset = np.array([y_0, y_0, -u_0, -u_0, 1.0])
    expected = [*np.diag(covariance)[:4], by_offset @ covariance @ by_offset]
    assert result.variance == pytest.approx(expected, rel=1e-2)
    offset = by_offset @ covariance @ phi.T @ y[2:] + y_0
    assert result.theta[-1, 4] == pytest.approx(offset, rel=2e-3)


def test_offset_beside_a_coloured_residual_is_that_at_codes_of_zero(estimator: Estimator) -> None:
    """The means of the samples satisfy the model."""
    data = record(noise=3.0)
    u, y = data.u + 500.0, data.y + 300.0
    assert estimator.init(nb=2, nc=1, refresh_n=0, c=(0.0, 0.0), forgetting=1.0, ceiling=1e9, edge_instants=LOCKED)
    a1, a2, b0, b1, _, offset = estimator.run(u, y).theta[-1].tolist()
    assert offset == pytest.approx((1.0 + a1 + a2) * y.mean() - (b0 + b1) * u.mean(), abs=10.0)


def test_noise_free_estimate_is_the_plant(estimator: Estimator) -> None:
    """Thesis Fig. 3.5: a1 = 0.5, a2 = 0.8, b0 = -0.9."""
    assert estimator.init(na=2, nb=1, nk=1, offset=0, c=(0.0, 0.0), kind=NONE, forgetting=1.0, refresh_n=0)
    theta = estimator.run(*record()).theta
    assert theta[30] == pytest.approx([0.5, 0.8, -0.9], abs=1e-3)


@pytest.mark.parametrize("c", [(0.0, 0.0), (-1.6, 0.64)], ids=["no prefilter", "prefilter"])
def test_offset_is_that_of_the_model(estimator: Estimator, c: tuple[float, float]) -> None:
    """y(k) = -0.5 y(k-1) - 0.8 y(k-2) - 0.9 u(k-1) + d, by the definition of est.h: y shifts by d / A(1)."""
    data = record(offset=100.0)
    assert estimator.init(nb=1, nk=1, kind=NONE, c=c, forgetting=1.0, refresh_n=0)
    theta = estimator.run(*data).theta[-1]
    assert theta == pytest.approx([0.5, 0.8, -0.9, 100.0 * (1.0 + 0.5 + 0.8)], rel=1e-3)


@pytest.mark.parametrize("gap_n", [1, 2, 7, 60])
def test_gap_costs_only_its_own_samples(estimator: Estimator, gap_n: int) -> None:
    data = record(noise=3.0, offset=40.0)
    valid = np.ones(400)
    valid[150 : 150 + gap_n] = 0
    assert estimator.init(**SETTINGS, c=(-1.6, 0.64), forgetting=1.0)
    result = estimator.run(*data, valid)
    pieces = [Record(data.u[:150], data.y[:150]), Record(data.u[150 + gap_n :], data.y[150 + gap_n :])]
    assert result.theta[-1] == pytest.approx(batch(pieces, (-1.6, 0.64), 2, 0, 1.0, 10.0, 1e4), rel=3e-3, abs=3e-4)
    assert (result.status[150 : 150 + gap_n] == MISSING).all()
    assert result.counters["missing"] == gap_n
    assert result.counters["restarts"] == 2


def test_gap_that_an_unstable_model_would_bridge_with_absurd_codes_begins_the_equations_anew(
    estimator: Estimator,
) -> None:
    """y(k) = 30 y(k-1) + u(k-1), held by u; the prediction grows thirtyfold a sample while u rests."""
    n, gap_n = 400, 5
    y = np.round(np.random.default_rng(1).normal(0.0, 300.0, n + 1))
    u, y = y[1:] - 30.0 * y[:-1], y[:-1]
    valid = np.ones(n)
    valid[200 : 200 + gap_n] = 0
    u[200 : 200 + gap_n + 1] = u[199]
    assert estimator.init(**SETTINGS, c=(-1.6, 0.64), warm_up_n=0)
    result = estimator.run(u, y, valid)
    assert result.theta[199, 0] == pytest.approx(-30.0, abs=0.1)
    assert (result.status[200 + gap_n : 202 + gap_n] == GATHERING).all()
    assert np.abs(result.innovation).max() < 1e5


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1.1e6], ids=str)
@pytest.mark.parametrize("channel", ["u", "y"])
def test_absurd_sample_is_counted_and_leaves_theta_untouched(estimator: Estimator, bad: float, channel: str) -> None:
    data = record(noise=3.0)
    getattr(data, channel)[200] = bad
    assert estimator.init(kind=NONE, refresh_n=0)
    result = estimator.run(*data)
    assert result.status[200] == REFUSED
    assert result.theta[200].tobytes() == result.theta[199].tobytes()
    assert result.statistic[200] == result.statistic[199]
    assert result.counters["refused"] == 1
    gathering = [0, 1, 201, 202]
    assert (result.status[gathering] == GATHERING).all()
    assert (np.delete(result.status, [200, *gathering]) == UPDATED).all()


def test_lost_excitation_does_not_wind_up(estimator: Estimator) -> None:
    """Thesis section 3.6: P grows by 1/lambda a sample, to overflow after some 3000, when nothing is excited."""
    data = record(noise=1.0)
    quiet = 100_000
    u = np.concatenate([data.u, np.zeros(quiet), data.u])
    y = np.concatenate([data.y, np.zeros(quiet), data.y])
    assert estimator.init(**SETTINGS, c=(0.0, 0.0), forgetting=0.97)
    result = estimator.run(u, y)
    assert np.isfinite(result.theta).all()
    assert result.theta[-400 + 30, :4] == pytest.approx([0.5, 0.8, 0.0, -0.9], abs=0.02)


def test_default_configuration_is_that_of_the_harness(estimator: Estimator) -> None:
    harness = {key.name.lower(): np.float32(value) for key, value in EstimatorConfig().settings()}
    default = estimator.default()
    assert default == {name: harness[name] for name in default}


@pytest.mark.parametrize(
    "changes",
    [
        {"na": 0},
        {"na": 3},
        {"na": 9},
        {"nb": 0},
        {"nb": 4},
        {"nk": 2},
        {"forgetting": 0.49},
        {"forgetting": 1.01},
        {"forgetting": np.nan},
        {"p0": 0.0},
        {"p0": np.inf},
        {"p0_offset": -1.0},
        {"noise_variance": 0.0},
        {"c": (np.nan, 0.0)},
        {"c": (-3.0, 0.0)},
        {"c": (0.0, 1.0)},
        {"c": (-2.0, 1.0)},
        {"c": (70.0, -70.0)},
        {"nc": 1},
        {"random_walk": -1e-9},
        {"code_low": 10.0, "code_high": 10.0},
        {"code_high": np.nan},
        {"edge_codes": 0.0},
        {"edge_codes": 2.1e6},
        {"code_low": 0.0, "code_high": 64.0, "edge_codes": 64.1, "noise_variance": 4.0},
        {"code_low": 0.0, "code_high": 64.0, "edge_codes": 64.0, "noise_variance": 4.01},
        {"code_low": -1.1e6},
        {"code_high": 1.000001e6},
        {"random_walk": 1.1e9},
        {"nc": 3},
        {"ceiling": 1.1e9},
        {"edge_instants": 3},
        {"kind": 4},
        {"kind": 5},
        {"ceiling": 0.0},
        {"ceiling": np.nan},
        {"reset": 2},
    ],
    ids=str,
)
def test_configuration_out_of_range_is_refused(estimator: Estimator, changes: dict[str, float]) -> None:
    assert not estimator.init(**changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"na": 1, "c": (-0.9, 0.0)},
        {"na": 1, "c": (-0.9, 9.0)},
        {"nb": 1},
        {"nk": 1},
        {"nb": 2, "nc": 1},
        {"nb": 1, "nc": 2},
        {"forgetting": 0.5},
        {"forgetting": 1.0},
        {"p0": 1e-9},
        {"p0": 1e9},
        {"p0_offset": 1e-9},
        {"p0_offset": 1e9},
        {"noise_variance": 1e-9},
        {"noise_variance": 1e9},
        {"random_walk": 1e9},
        {"edge_codes": 2e6},
        {"code_low": 0.0, "code_high": 64.0, "edge_codes": 64.0, "noise_variance": 4.0},
        {"edge_codes": 1e-9},
        {"code_low": -2e-3, "code_high": 0.0, "edge_codes": 1e-9, "noise_variance": 1e-9},
        {"ceiling": 1e-9},
        {"ceiling": 1e9},
        {"edge_instants": 0},
        {"edge_instants": 2},
        {"kind": 0},
        {"kind": 4, "custom": 1},
        {"reset": 0},
        {"reset": 1},
    ],
    ids=str,
)
def test_configuration_at_the_end_of_its_range_is_taken(
    estimator: Estimator, changes: dict[str, float | tuple[float, float]]
) -> None:
    assert estimator.init(**changes)


def test_largest_order_fits(estimator: Estimator) -> None:
    assert estimator.init(na=2, nb=3, nk=1, offset=1)
    assert estimator.init(na=2, nb=2, nk=1, nc=2, offset=0)
    data = record(noise=1.0)
    assert np.isfinite(estimator.run(*data).theta).all()


@pytest.mark.parametrize(("every_n", "growth"), [(1000, 2.0), (6, 4.0)], ids=["at rest", "always in doubt"])
def test_a_variance_grows_without_excitation_and_no_further_than_it_may(
    estimator: Estimator, every_n: int, growth: float
) -> None:
    """Nothing is said of A while y stands still: each variance grows by 1 / forgetting an equation (thesis 3.6) until
    P is limited, at twice the prior, or at four times where edges in doubt make every step a long one."""
    forgetting, p0, n = 0.9, 10.0, 60
    u = np.where(np.arange(n) // every_n % 2, 1000.0, -1000.0)
    assert estimator.init(nb=1, nk=0, offset=0, forgetting=forgetting, p0=p0, c=(0.0, 0.0), refresh_n=0, stuck_n=0)
    largest = max(estimator.run(u[k : k + 1], np.zeros(1)).variance[0] for k in range(n))
    assert p0 * growth < largest <= p0 * growth / forgetting
