"""est_isolation_parameters() finds M, B and K of the plant whose samples theta describes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.estimator_c.est_driver import LOCKED, Estimator
from tests.estimator_c.test_est_trigger import FRONT, M_PER_CODE, N_PER_CODE, PERIOD_S, suspension

UNITS = (PERIOD_S, N_PER_CODE, M_PER_CODE)


@pytest.mark.parametrize(
    "plant",
    [FRONT, (30.0, 2123.0, 20_000.0), (115.0, 1000.0, 24_500.0), (60.0, 3453.0, 18_000.0)],
    ids=["front", "light", "underdamped", "overdamped"],
)
@pytest.mark.parametrize("offset_samples", [0.0, 0.3])
def test_parameters_are_those_of_the_plant(
    estimator: Estimator, plant: tuple[float, float, float], offset_samples: float
) -> None:
    """The instant of the edges within a sample does not matter: the sum of the b's stays."""
    u, y = suspension([(0, plant)], np.arange(10.0, 3000.0, 50.0) + offset_samples, 3000, 0.0, 1)
    assert estimator.init(edge_instants=LOCKED)
    estimator.run(u, y)
    assert estimator.parameters(*UNITS) == pytest.approx(plant, rel=0.01)


def test_theta_without_an_edge_describes_no_plant(estimator: Estimator) -> None:
    assert estimator.init()
    estimator.run(np.full(50, 1000.0), np.full(50, 1500.0))
    assert estimator.parameters(*UNITS) is None


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["first order", "negative gain"])
def test_another_plant_has_no_such_parameters(estimator: Estimator, sign: float) -> None:
    u, y = suspension([(0, FRONT)], np.arange(10.0, 500.0, 50.0), 500, 0.0, 1)
    assert estimator.init(na=1, c=(-0.8, 0.0)) if sign > 0.0 else estimator.init()
    estimator.run(u, 2000.0 + sign * (y - 410.0))
    assert estimator.parameters(*UNITS) is None


def test_alternating_poles_are_no_such_plant(estimator: Estimator) -> None:
    """y(k) = -0.5 y(k-1) + ...: the pole of no continuous plant without a delay."""
    u = np.where(np.arange(500) // 50 % 2, 3000.0, 1000.0)
    y = np.zeros(500)
    for k in range(2, 500):
        y[k] = -1.4 * y[k - 1] - 0.5 * y[k - 2] + 1.5 * u[k - 1]
    assert estimator.init(edge_instants=LOCKED)
    estimator.run(u, y)
    assert estimator.parameters(*UNITS) is None


def test_configuration_for_codes_has_their_range(estimator: Estimator) -> None:
    assert estimator.for_codes(-1.0, 4096.0) == (-1.0, 4096.0)
