"""The C estimator against its reference in plain Python: two texts of one algorithm, in float32 and in float64."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.devices.library import Estimator, StepStatus
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.rigs.description import open_rig
from analogrig.run import INPUT, OUTPUT, missing_samples
from analogrig.testing.properties.cases import PlayedCase, SpoiledRig
from tests.estimator_c.test_est_trigger import FRONT, suspension
from tests.reference.cases import CASES as NAMED
from tests.reference.comparison import ROUNDING, STATISTIC_ROUNDING, THETA_ROUNDING, Expected, expected_of
from tests.reference.drawn import DRAWN, TELLING, drawn
from tests.reference.estimator import ReferenceEstimator

N = 900
FEW_DRAWN = (*DRAWN[:12], *TELLING)
"""Drawn cases; test_reference_device.py tries them all."""
FEW_NAMED = tuple(name for name in NAMED if "outliers" in name or "alarms" in name)
"""Named cases with outliers, or with alarms in close succession, which the records of this file lack."""
FIXED: dict[str, Any] = {"refresh_n": 0, "warm_up_n": 0}
LOCKED: dict[str, Any] = FIXED | {"nb": 2, "nk": 1, "offset": False, "edge_instants": "locked", "forgetting": 1.0}


def record(drift: float = 0.0, seed: int = 4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The front suspension, softer from sample 520 on; with a drift its edges cross a sampling instant at 310."""
    edges = np.arange(10.0, N, 50.0)
    changes = [(0, FRONT), (520, (115.0, 3021.0, 18000.0))]
    u, y = suspension(changes, edges + (edges - 300.0) * drift, N, 1.0, seed)
    return u, y - 410.0


CASES: dict[str, EstimatorConfig] = {
    "default": EstimatorConfig(**FIXED),
    "locked": EstimatorConfig(**LOCKED),
    "anywhere": EstimatorConfig(**FIXED, edge_instants="anywhere"),
    "none": EstimatorConfig(**FIXED, trigger="none", c=()),
    "walk": EstimatorConfig(**LOCKED, random_walk=1e-6),
    "noise": EstimatorConfig(**FIXED, noise_estimated=True, noise_variance=3.0),
    "refresh": EstimatorConfig(refresh_n=160, c=(-0.9, 0.2)),
    # with 15 and 18, A comes so near to a threshold of C that float32 and float64 say otherwise
    "often refreshed": EstimatorConfig(refresh_n=17, c=(-0.9, 0.2)),
    "first order": EstimatorConfig(na=1, nb=2, refresh_n=200, c=(-0.5,), trigger="none"),
    "armax": EstimatorConfig(**(LOCKED | {"nc": 2, "c": ()}), trigger="none"),
    "prediction error": EstimatorConfig(
        **(LOCKED | {"warm_up_n": 30}), c=(), trigger="prediction-error", ceiling=200.0, hold_off_n=20, reset="all"
    ),
    "mean": EstimatorConfig(
        **(FIXED | {"warm_up_n": 30}), trigger="mean-between-faults", ceiling=30.0, hold_off_n=4, absolute=True
    ),
}


class Followed(NamedTuple):
    """Output of the reference for a record."""

    theta: NDArray[np.float64]
    """(n, p) after each sample."""
    innovation: NDArray[np.float64]
    alarms: list[int]
    slips: int
    refreshes: int


def followed(
    config: EstimatorConfig, u: NDArray[np.float64], y: NDArray[np.float64], valid: NDArray[np.bool_]
) -> Followed:
    reference, theta, steps = ReferenceEstimator(config), [], []
    for force, displacement, good in zip(u.tolist(), y.tolist(), valid.tolist(), strict=True):
        steps.append(reference.step(force, displacement, valid=good))
        theta.append(list(reference.theta))
    alarms = [k for k, step in enumerate(steps) if step.alarm]
    innovation = np.array([step.innovation for step in steps])
    return Followed(np.array(theta), innovation, alarms, reference.slips, reference.refreshes)


MISSING = [100, 314, 315, 700]


@pytest.mark.parametrize(
    ("drift", "missing"),
    [
        (0.0, []),
        (2e-5, MISSING),
        *(pytest.param(*each, marks=pytest.mark.heavy) for each in ((0.0, MISSING), (2e-5, []), (-2e-5, []))),
        pytest.param(-2e-5, MISSING, marks=pytest.mark.heavy),
    ],
    ids=["still", "late, gaps", "gaps", "late", "early", "early, gaps"],
)
@pytest.mark.parametrize("case", CASES)
def test_estimator_and_reference_agree(case: str, drift: float, missing: list[int]) -> None:
    u, y = record(drift)
    valid = np.ones(N, bool)
    valid[missing] = False
    estimator, reference = Estimator(CASES[case]), followed(CASES[case], u, y, valid)
    steps = estimator.run(u, y, valid)
    assert steps.alarms.tolist() == reference.alarms
    scale = np.maximum(np.abs(reference.theta).max(axis=0), 1e-3)
    after_n = 60  # the first equations determine little, and float32 less
    settled = np.array([all(k - a > after_n for a in (0, *steps.alarms) if a <= k) for k in range(N)])
    assert settled.sum() > 200
    assert np.abs((steps.theta - reference.theta) / scale)[settled].max() < 0.015
    assert np.sqrt(np.mean((steps.innovation - reference.innovation)[settled] ** 2)) < 0.15
    assert (estimator.counters["slips"], estimator.counters["refreshes"]) == (reference.slips, reference.refreshes)


def case_of(name: str) -> PlayedCase:
    return drawn(int(name)) if name.isdecimal() else NAMED[name]


@functools.cache
def played(name: str) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.bool_], Expected]:
    """Codes of a named or drawn case, valid samples, and the answers of the reference."""
    case = case_of(name)
    with open_rig("emulator") as rig:
        blocks = list((SpoiledRig(rig, case.spoil) if case.spoil else rig).perform(case.scenario, 1).blocks)
    codes = np.concatenate([block.codes for block in blocks])
    valid = ~missing_samples(np.concatenate([block.clipped for block in blocks]))
    u, y = (np.ascontiguousarray(codes[:, channel]) for channel in (INPUT, OUTPUT))
    return u, y, valid, expected_of(EstimatorConfig(**case.settings), u, y, valid)


@pytest.mark.parametrize("case", [*map(str, FEW_DRAWN), *FEW_NAMED])
def test_estimator_and_reference_agree_in_shipped_cases(case: str) -> None:
    u, y, valid, expected = played(case)
    steps = Estimator(EstimatorConfig(**case_of(case).settings)).run(u, y, valid)
    sure = slice(0, expected.sure_n)
    assert [k for k in steps.alarms if k < expected.sure_n] == [k for k in expected.alarms if k < expected.sure_n]
    for found, wanted, allowed in (
        (steps.theta, expected.theta, THETA_ROUNDING * expected.theta_deviation),
        (steps.innovation, expected.innovation, ROUNDING * expected.deviation),
        (steps.statistic, expected.statistic, STATISTIC_ROUNDING * (1.0 + expected.statistic)),
    ):
        assert (np.abs(found - wanted) <= allowed + 1e-6 * (1.0 + np.abs(wanted)))[sure].all()


def test_cases_show_what_they_are_for() -> None:
    u, y = record(2e-5)
    default, refresh = Estimator(CASES["default"]), Estimator(CASES["refresh"])
    assert 520 < default.run(u, y).alarms[0] < 540
    refresh.run(u, y)
    assert default.counters["slips"] == 1
    assert refresh.counters["refreshes"] >= 1


def test_blocks_of_any_length_give_the_same_estimates() -> None:
    u, y = record()
    whole, pieces = Estimator(), Estimator()
    steps = whole.run(u, y)
    parts = [pieces.run(u[at : at + 37], y[at : at + 37]) for at in range(0, N, 37)]
    assert np.concatenate([part.theta for part in parts]).tobytes() == steps.theta.tobytes()
    whole.restart()
    assert whole.run(u, y, with_theta=False).alarms.tolist() == steps.alarms.tolist()
    assert whole.counters == pieces.counters


def test_missing_samples_are_told_by_their_status() -> None:
    u, y = record()
    valid = np.arange(N) != 100
    status = Estimator().run(u, y, valid).status
    assert [StepStatus(s).name for s in status[99:104]] == ["UPDATED", "MISSING", "GATHERING", "GATHERING", "UPDATED"]


def test_configuration_that_the_estimator_cannot_take_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="forgetting = 2"):
        Estimator(dataclasses.replace(EstimatorConfig(), forgetting=2.0))
    with pytest.raises(ConfigurationError, match="do not go together"):
        Estimator(EstimatorConfig(nb=3, nc=2))


def test_samples_of_unlike_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="one length"):
        Estimator().run(np.zeros(3), np.zeros(4))
