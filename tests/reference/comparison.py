"""Expected answers of a device that computes what it describes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.estimator_config import EstimatorConfig
from analogrig.testing.reference.estimator import ReferenceEstimator
from analogrig.testing.reference.isolation import ReferenceIsolation


@dataclass(frozen=True, eq=False)
class Expected:
    """Answers of the reference to n samples."""

    theta: NDArray[np.float64]
    """(n, p)"""
    theta_deviation: NDArray[np.float64]
    """(n, p) standard deviation of theta."""
    innovation: NDArray[np.float64]
    deviation: NDArray[np.float64]
    """(n,) predicted standard deviation of the innovation."""
    statistic: NDArray[np.float64]
    flags: NDArray[np.uint8]
    alarms: tuple[int, ...]
    diagnoses: tuple[tuple[int, int, int, float, float], ...]
    """Sample after which each was sent, change, onset, extent and its standard deviation."""
    counters: Mapping[str, int]
    sure_n: int
    """Samples before rounding may decide a threshold. From then on the answers of a sound device may differ."""
    sure_diagnoses_n: int
    """The same for diagnoses."""

    @property
    def is_doubtful(self) -> bool:
        """True if rounding may decide a threshold."""
        return self.sure_diagnoses_n < len(self.flags)


def expected_of(
    config: EstimatorConfig, u: NDArray[np.uint16], y: NDArray[np.uint16], valid: NDArray[np.bool_]
) -> Expected:
    """Answers of the reference, which is run once for the same samples."""
    return _expected(_in_single_precision(config), u.tobytes(), y.tobytes(), valid.tobytes())


def _in_single_precision(config: EstimatorConfig) -> EstimatorConfig:
    """The configuration with the values that a device holds."""
    real = {key: value for key, value in dataclasses.asdict(config).items() if type(value) is float}
    rounded: dict[str, Any] = {key: float(np.float32(value)) for key, value in real.items()}
    return dataclasses.replace(config, **rounded, c=tuple(float(np.float32(c)) for c in config.c))


@functools.lru_cache(maxsize=1024)
def _expected(config: EstimatorConfig, u: bytes, y: bytes, valid: bytes) -> Expected:
    reference = ReferenceEstimator(config)
    isolation = ReferenceIsolation(reference)
    diagnoses, alarm, sure_n, sure_diagnoses_n = [], 0, 0, 0
    force, displacement = (np.frombuffer(codes, np.uint16).tolist() for codes in (u, y))
    theta, spread, deviation, steps = [], [], [], []
    samples = zip(force, displacement, np.frombuffer(valid, np.bool_).tolist(), strict=True)
    for index, (at_u, at_y, is_valid) in enumerate(samples):
        steps.append(reference.step(at_u, at_y, valid=is_valid))
        alarm = index if steps[-1].alarm else alarm
        if found := isolation.enter(at_u, at_y, steps[-1]):
            diagnoses.append((index, int(found.change), alarm - found.onset_n, found.extent, found.deviation))
        sure_n += not reference.is_doubtful
        sure_diagnoses_n += not (reference.is_doubtful or isolation.is_doubtful)
        theta.append(reference.theta)
        spread.append(reference.deviations)
        deviation.append(reference.deviation)
    return Expected(
        theta=np.array(theta),
        theta_deviation=np.array(spread),
        innovation=np.array([step.innovation for step in steps]),
        deviation=np.array(deviation),
        statistic=np.array([step.statistic for step in steps]),
        flags=np.array([step.flags for step in steps], np.uint8),
        alarms=tuple(k for k, step in enumerate(steps) if step.alarm),
        diagnoses=tuple(diagnoses),
        counters=reference.counters,
        sure_n=sure_n,
        sure_diagnoses_n=sure_diagnoses_n,
    )
