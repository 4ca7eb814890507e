"""Estimates over some data, and their quality against the true plants."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.devices.estimator import Estimator
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import trajectory
from analogrig.plant import Plant, Segment, physical_parameters
from analogrig.run import Run
from analogrig_thesis.document import Mark, Signal
from analogrig_thesis.plants import CHANGE_LABELS, PERIOD_S, stretches

CONVERGED = 0.05
"""M, B and K have converged once each is, and stays, this close to the truth, relative to it."""

SPIKE = 0.5
"""An excursion of M, B or K farther than this from the truth, relative to it, is a spike."""

LARGEST_INPUT = 2.0**19
"""The device rejects readings above 1e6: larger data are divided by a power of two and P0 is multiplied by its square,
which gives the same estimator to the bit."""


@dataclass(frozen=True, eq=False)
class Track:
    """Output of an estimator over n samples."""

    theta: Signal
    """(n, p) in the units of the data."""
    innovation: Signal
    """(n,)"""
    statistic: Signal
    """(n,) of the trigger."""
    alarms: NDArray[np.int64]
    """Sample indices."""
    parameters: Signal
    """(n, 3) M, B, K in kg, N s/m, N/m; NaN where theta describes no suspension."""


def track(config: EstimatorConfig, u: Signal, y: Signal, m_per_unit: float = 1.0, n_per_unit: float = 1.0) -> Track:
    """Run the C estimator in this process over data in any units.

    :param u: (n,) force in units of ``n_per_unit`` newtons.
    :param y: (n,) displacement in units of ``m_per_unit`` metres, the unit of the ceiling too.
    """
    shrunk = 2.0 ** -max(0.0, np.ceil(np.log2(max(np.abs(u).max(), np.abs(y).max()) / LARGEST_INPUT)))
    ceiling = None if config.trigger == "cusum" or config.ceiling is None else config.ceiling * shrunk
    fitted = dataclasses.replace(config, p0=config.p0 / shrunk**2, ceiling=ceiling)
    steps = Estimator(fitted).run(u * shrunk, y * shrunk)
    theta = steps.theta.astype(np.float64)
    codes = 1.0 if config.trigger == "cusum" else shrunk
    return Track(
        theta=theta,
        innovation=steps.innovation / shrunk,
        statistic=steps.statistic / codes,
        alarms=steps.alarms,
        parameters=physical_parameters(theta, dataclasses.asdict(config), n_per_unit, m_per_unit, PERIOD_S),
    )


def track_of_run(run: Run) -> Track:
    """Device estimates of a run; theta in codes."""
    return Track(
        theta=run.theta.astype(np.float64),
        innovation=run.innovation.astype(np.float64),
        statistic=run.statistic.astype(np.float64),
        alarms=run.alarm_index,
        parameters=trajectory(run),
    )


@dataclass(frozen=True)
class TrackQuality:
    """Detection and convergence of a track, judged by the true plants."""

    latency_n: tuple[int | None, ...]
    """Samples from each change to the first alarm before the next change."""
    missed: int
    extra_alarms: int
    """Alarms that are not the first after a change."""
    reconverged_n: tuple[int | None, ...]
    """Samples from each change until M, B and K stay within 5 % up to the next change; None: never."""
    spread: tuple[float | None, ...]
    """Standard deviation of M, B, K over the truth, in the second halves of the stretches; None if one is undefined."""
    undefined: float
    """Fraction of those samples at which theta describes no suspension."""
    spikes: int


def assess(track: Track, segments: Sequence[Segment]) -> TrackQuality:
    """Judge a track by the true plants."""
    ranges = stretches(segments, len(track.theta))
    error = np.concatenate(
        [relative_errors(track, segment.plant, *each) for segment, each in zip(segments, ranges, strict=True)]
    )
    late = [error[(start + end) // 2 : end] for start, end in ranges]
    spread = np.sqrt(np.mean([each.var(axis=0) for each in late], axis=0))
    latency = [_first_alarm(track.alarms, *each) for each in ranges[1:]]
    return TrackQuality(
        latency_n=tuple(latency),
        missed=latency.count(None),
        extra_alarms=len(track.alarms) - len(latency) + latency.count(None),
        reconverged_n=tuple(reconverged(error, segments)),
        spread=tuple(None if np.isnan(each) else float(each) for each in spread),
        undefined=float(np.concatenate([np.isnan(each).any(axis=1) for each in late]).mean()),
        spikes=_spikes(error, ranges[1:]),
    )


def relative_errors(track: Track, plant: Plant, start: int = 0, end: int | None = None) -> Signal:
    """Errors (n, 3) of M, B, K in samples ``start`` to ``end``, relative to the plant."""
    return np.asarray(track.parameters[start:end] / list(plant.parameters().values()) - 1.0)


def settling_n(error: Signal, within: float = CONVERGED) -> int | None:
    """Samples until all rows of (n, p) errors stay within a bound, counted from 1; None if the last row does not."""
    beyond = np.flatnonzero(~(np.abs(error) <= within).all(axis=1))
    if not len(beyond):
        return 1
    return None if beyond[-1] == len(error) - 1 else int(beyond[-1]) + 2


def reconverged(error: Signal, segments: Sequence[Segment]) -> list[int | None]:
    """Samples from each change until all columns of (n, p) errors stay within 5 % up to the next change."""
    return [settling_n(error[start + 1 : end]) for start, end in stretches(segments, len(error))[1:]]


def marks(track: Track, segments: Sequence[Segment], *, with_alarms: bool = True) -> tuple[Mark, ...]:
    """Changes of the plant and, on request, alarms: the first after each change, and the others."""
    ranges = stretches(segments, len(track.theta))[1:]
    changes = [Mark(float(start), "change", label) for (start, _), label in zip(ranges, CHANGE_LABELS, strict=True)]
    found = {start + n for start, end in ranges if (n := _first_alarm(track.alarms, start, end)) is not None}
    alarms = [Mark(float(k), "alarm" if int(k) in found else "false") for k in track.alarms]
    return (*changes, *(alarms if with_alarms else ()))


def _first_alarm(alarms: NDArray[np.int64], start: int, end: int) -> int | None:
    """Latency of a change at ``start``, which acts on sample ``start + 1`` for the first time."""
    after = alarms[(alarms > start) & (alarms <= end)]
    return int(after[0]) - start if len(after) else None


def _spikes(error: Signal, ranges: Iterable[tuple[int, int]]) -> int:
    """Number of times that (n, 3) errors leave the bound SPIKE, or become undefined, after a change."""
    count = 0
    for start, end in ranges:
        beyond = np.asarray(~(np.abs(error[start + 1 : end]) <= SPIKE).all(axis=1))
        count += int((beyond[1:] & ~beyond[:-1]).sum())
    return count
