"""Expected answers of a device that computes what it describes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.estimator_config import EstimatorConfig
from analogrig.run import Run
from tests.reference.estimator import ReferenceEstimator
from tests.reference.isolation import ReferenceIsolation

ROUNDING = 0.1
"""Largest deviation of an innovation from the reference, in standard deviations of that innovation: float32 may cost a
tenth of what noise costs. Half of it is the most that was measured."""

THETA_ROUNDING = 0.2
"""The same of an element of theta, in its own standard deviations."""

STATISTIC_ROUNDING = 0.2
"""The same of the statistic, relative to the statistic and 1."""

EXTENT_ROUNDING = 0.0075
"""The same of the extent of a change, in its own standard deviations."""


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


def differences(run: Run, expected: Expected) -> Iterator[str]:
    """Differences of a run from the reference, the most telling first, as far as rounding decides nothing."""
    sure = slice(0, expected.sure_n)
    if not np.array_equal(run.flags[sure], expected.flags[sure]):
        at = int(np.argmax(run.flags != expected.flags))
        yield f"flags at sample {at} are {run.flags[at]:#04x}, expected {expected.flags[at]:#04x}"
    alarms, wanted = ([k for k in each if k < sure.stop] for each in (run.alarm_index.tolist(), expected.alarms))
    if alarms != wanted:
        yield f"alarms at {alarms[:9]}, expected at {wanted[:9]}"
    for name, deviation in (
        ("innovation", ROUNDING * expected.deviation),
        ("theta", THETA_ROUNDING * expected.theta_deviation),
        ("statistic", STATISTIC_ROUNDING * (1.0 + expected.statistic)),
    ):
        yield from _beyond(name, getattr(run, name)[sure], getattr(expected, name)[sure], deviation[sure])
    if not np.array_equal(run.alarm_statistic, run.statistic[run.alarm_index]):
        yield "an alarm has another statistic than its sample"
    yield from _other_diagnoses(run, expected)
    for name, count in expected.counters.items() if sure.stop == run.samples else ():
        if run.conditions.counters[name] != count:
            yield f"{run.conditions.counters[name]} {name} counted, expected {count}"


def _other_diagnoses(run: Run, expected: Expected) -> Iterator[str]:
    sure = run.diagnosis_index < expected.sure_diagnoses_n
    named = np.column_stack([run.diagnosis_index, run.diagnosis_change, run.diagnosis_onset])[sure].tolist()
    diagnoses = [each for each in expected.diagnoses if each[0] < expected.sure_diagnoses_n]
    wanted = [list(each[:3]) for each in diagnoses]
    if named != wanted:
        yield f"diagnoses (sample, change, onset) {named}, expected {wanted}"
        return
    extents, deviations = (np.array([each[i] for each in diagnoses]) for i in (3, 4))
    yield from _beyond("extent", run.diagnosis_extent[sure], extents, EXTENT_ROUNDING * deviations)


def _beyond(
    name: str, found: NDArray[np.float32], expected: NDArray[np.float64], allowed: NDArray[np.float64]
) -> Iterator[str]:
    if found.shape != expected.shape:
        yield f"{name} has the shape {found.shape}, expected {expected.shape}"
        return
    outside = np.argwhere(~(np.abs(found - expected) <= allowed + 1e-6 * (1.0 + np.abs(expected))))
    if len(outside):
        at = tuple(outside[0].tolist())
        element = f"[{at[1]}]" if len(at) > 1 else ""
        yield f"{name}{element} at sample {at[0]} is {found[at]:g}, expected {expected[at]:g} +- {allowed[at]:.2g}"
