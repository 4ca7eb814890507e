"""What an estimator made of some data, and how good that is."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.devices.estimator import Estimator
from analogrig.devices.estimator_config import EstimatorConfig
from analogrig.judging.verdict import trajectory
from analogrig.plant import physical_parameters
from analogrig.run import Run, Segment
from analogrig_thesis.document import Mark, Signal
from analogrig_thesis.model import PERIOD_S

CONVERGED = 0.05
"""M, B and K have converged once each is, and stays, this close to the truth, relative to it."""

SPIKE = 0.5
"""Each excursion of M, B or K farther than this from the truth is a spike."""

LARGEST_INPUT = 2.0**19
"""The device refuses readings of more than 1e6: larger data are divided by a power of two, and P0 is multiplied by its
square, which is the same estimator to the bit."""


@dataclass(frozen=True, eq=False)
class Track:
    """What came of n samples."""

    theta: Signal
    """(n, p) in the units of the data."""
    innovation: Signal
    """(n,)"""
    statistic: Signal
    """(n,) of the trigger."""
    alarms: NDArray[np.int64]
    """Samples."""
    parameters: Signal
    """(n, 3) M, B, K in kg, N s/m, N/m; NaN where theta describes no suspension."""


def track(config: EstimatorConfig, u: Signal, y: Signal, y_per_m: float = 1.0) -> Track:
    """Run the C estimator over data in any units.

    :param u: (n,) force, newtons.
    :param y: (n,) displacement, ``y_per_m`` units to the metre, the units of the ceiling too.
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
        parameters=physical_parameters(theta, dataclasses.asdict(config), 1.0, 1.0 / y_per_m, PERIOD_S),
    )


def tracked(run: Run) -> Track:
    """What a device answered over the link; theta in codes."""
    return Track(
        theta=run.theta.astype(np.float64),
        innovation=run.innovation.astype(np.float64),
        statistic=run.statistic.astype(np.float64),
        alarms=run.alarm_index,
        parameters=trajectory(run),
    )


@dataclass(frozen=True)
class Performance:
    """How well a track follows the truth."""

    latency_n: tuple[int | None, ...]
    """Of each change, to the first alarm before the next one."""
    missed: int
    extra_alarms: int
    """Every alarm that is not the first after a change."""
    reconverged_n: tuple[int | None, ...]
    """Of each change, until M, B and K are within 5 % and stay there until the next one; None: never."""
    spread: tuple[float | None, ...]
    """Standard deviation of M, B, K over the truth, in the second halves of the stretches; None if one is undefined."""
    undefined: float
    """The part of those samples at which theta describes no suspension at all."""
    spikes: int


def performance(track: Track, segments: Sequence[Segment]) -> Performance:
    """Judge a track by the truth; a scheme without a trigger has no latency."""
    n = len(track.theta)
    starts = [segment.start for segment in segments]
    stretches = list(itertools.pairwise([*starts, n]))
    truth = np.empty((n, 3))
    for segment, (start, end) in zip(segments, stretches, strict=True):
        truth[start:end] = list(segment.plant.parameters().values())
    error = track.parameters / truth - 1.0
    changes = stretches[1:]
    latency = tuple(_first_alarm(track.alarms, start, end) for start, end in changes)
    return Performance(
        latency_n=latency,
        missed=sum(each is None for each in latency),
        extra_alarms=len(track.alarms) - sum(each is not None for each in latency),
        reconverged_n=tuple(settled(error[start + 1 : end], CONVERGED) for start, end in changes),
        spread=_spread(error, stretches),
        undefined=float(np.concatenate([np.isnan(_late(error, *each)).any(axis=1) for each in stretches]).mean()),
        spikes=spikes(error, changes),
    )


def settled(error: Signal, within: float) -> int | None:
    """Samples until no row of (n, p) errors is beyond ``within`` any more, counted from 1; None if the last one is."""
    beyond = np.flatnonzero(~(np.abs(error) <= within).all(axis=1))
    if not len(beyond):
        return 1
    return None if beyond[-1] == len(error) - 1 else int(beyond[-1]) + 2


def spikes(error: Signal, stretches: Iterable[tuple[int, int]]) -> int:
    """How often an estimate that was within SPIKE of the truth, or a change, is followed by one that is not."""
    count = 0
    for start, end in stretches:
        beyond: NDArray[np.bool_] = np.asarray(~(np.abs(error[start + 1 : end]) <= SPIKE).all(axis=1))
        count += int((beyond[1:] & ~beyond[:-1]).sum())
    return count


def marks(track: Track, segments: Sequence[Segment], labels: Sequence[str] = ()) -> tuple[Mark, ...]:
    """The changes, and the alarms: those that noticed one, and the others."""
    starts = [segment.start for segment in segments]
    stretches = list(itertools.pairwise([*starts, len(track.theta)]))[1:]
    found = {start + n for start, end in stretches if (n := _first_alarm(track.alarms, start, end)) is not None}
    names = [*labels, *[""] * len(starts)]
    changes = [Mark(float(start), "change", names[i]) for i, start in enumerate(starts[1:])]
    alarms = [Mark(float(k), "alarm" if int(k) in found else "false") for k in track.alarms]
    return (*changes, *alarms)


def _first_alarm(alarms: NDArray[np.int64], start: int, end: int) -> int | None:
    """A pot that jumps at sample k is first felt by sample k + 1."""
    after = alarms[(alarms > start) & (alarms <= end)]
    return int(after[0]) - start if len(after) else None


def _late(error: Signal, start: int, end: int) -> Signal:
    return error[(start + end) // 2 : end]


def _spread(error: Signal, stretches: Iterable[tuple[int, int]]) -> tuple[float | None, ...]:
    variances = np.stack([_late(error, *each).var(axis=0) for each in stretches])
    return tuple(None if np.isnan(each) else float(each) for each in np.sqrt(variances.mean(axis=0)))
