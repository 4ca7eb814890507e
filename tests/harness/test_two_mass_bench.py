"""Benchmark of the two-mass quarter car, on few trials."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig.estimator_config import EstimatorConfig
from tests.bench.bench_two_mass import delays, device, false_alarms


def test_changes_of_the_suspension_are_detected_within_the_bound_of_the_benchmark() -> None:
    """The page states 400 changes and a mean ratio of 1.2; eight of each have a ratio below 1.6 with certainty."""
    made = device()
    for parameter in ("M2", "B2", "K2", "K1"):
        found = delays(made, parameter, 8)
        assert found.missed == 0
        assert found.trials == 8
        assert found.ratio()[0] < 1.6
    alarms, armed = false_alarms(made, 2, 20_000)
    assert alarms == 0
    assert 0.99 < armed / (2 * (20_000 - EstimatorConfig().warm_up_n)) <= 1.0


@pytest.mark.parametrize("order", [1, 2])
def test_default_serves_up_to_order_2(order: int) -> None:
    assert EstimatorConfig.of_poles([0.9] * order) == EstimatorConfig()


def test_higher_order_has_the_prefilter_of_the_poles_a_tenth_nearer_the_origin() -> None:
    settings = EstimatorConfig.of_poles([0.5 + 0.5j, 0.5 - 0.5j, 1.0, 2.0])
    assert (settings.na, settings.nb, settings.parameters) == (4, 5, 10)
    assert sorted(np.roots([1.0, *settings.c]), key=lambda zero: zero.imag) == pytest.approx(
        [0.45 - 0.45j, 0.9, 0.9, 0.45 + 0.45j], abs=1e-6
    )
