"""Information bounds: delays of the best detector and of the best isolation of a change, to first order.

Detection: with a mean time between false alarms of ARL0, the least mean delay grows with ARL0 as the number of samples
in which

    I(n) = sum over the first n samples of (y_changed - y_unchanged)^2 / (2 sigma^2)

reaches ln ARL0 (Lorden 1971; Lai 1998). This is an asymptotic bound as ARL0 grows. At an ARL0 of 1e5, a window-limited
GLR test that knows both plants has 0.962 of it. A single delay may be shorter still. I(n) compares the plant before and
after the change. It depends on the phase of the excitation, so it is computed for each change in each run.

Isolation: the changed parameter is known with 95 % confidence once I(n) between the true plant and its best rival
reaches ln 20. A rival is a plant with one other parameter changed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analogrig.plant import AT_REST, PARAMETERS, Plant, SampledPlant, State, discretise
from analogrig.run import CHUNK_SAMPLES, Run
from analogrig_emulator import PROGRAMS, TICKS_PER_SAMPLE, Edges, sampled_response

if TYPE_CHECKING:
    from analogrig.scenario import Scenario

QUANTISATION_VARIANCE_LSB2 = 1.0 / 12.0

ISOLATION_INFORMATION = math.log(20.0)
"""Information at which a rival hypothesis is rejected with 95 % confidence."""

ISOLATION_HORIZON_N = 300
"""Samples after a change in which it must be isolated; later counts as never."""

_RATE_HZ = 20e3
"""Sample rate of predictions: that of the emulated card."""

_RIVAL_FACTORS = np.exp(np.linspace(math.log(0.25), math.log(4.0), 221))
"""Factors on the rival parameter; the most similar one is interpolated."""


@dataclass(frozen=True)
class _Change:
    """One change of the plant in a run."""

    before: Plant
    after: Plant
    ramp: Sequence[SampledPlant]
    """Plant in each sample period of the ramp; empty for a jump."""
    state: State
    """State of the plant at the change."""
    force_n: NDArray[np.float64]
    """(n,) measured force in newtons."""
    weight: NDArray[np.float64]
    """(n,) information per squared metre of displacement after each force; 0 for a missing sample."""


def change_information(run: Run) -> list[NDArray[np.float64]]:
    """I(1), I(2), ... of each change of ``run``, up to the next change or the end: float64 arrays.

    Both plants start from the true state at the change and follow the measured force. Samples that the device could
    not use carry no information.
    """
    period_s = run.conditions.sample_period_problem_s
    return [_information(change, period_s) for change in _run_changes(run)]


def _information(change: _Change, period_s: float) -> NDArray[np.float64]:
    """I(1), I(2), ... of one change, float64."""
    changed = _Motion.of_change(change, period_s)
    unchanged = _Motion(change.state, SampledPlant.from_plant(change.before, period_s))
    out = np.empty(len(change.force_n))
    gathered = 0.0
    for first in range(0, len(out), CHUNK_SAMPLES):
        part = slice(first, first + CHUNK_SAMPLES)
        difference_m = changed.displacement_m(change.force_n[part]) - unchanged.displacement_m(change.force_n[part])
        out[part] = np.cumsum(np.append(gathered, difference_m**2 * change.weight[part]))[1:]
        gathered = float(out[part][-1])
    return out


class _Motion:
    """Simulation of a plant under a force, chunk by chunk."""

    def __init__(self, state: State, settled: SampledPlant, ramp: Sequence[SampledPlant] = ()) -> None:
        """Start from ``state``; ``ramp`` is the plant in each of the first sample periods."""
        self._state = np.array(state)
        self._settled = settled
        self._ramp = ramp

    @classmethod
    def of_change(cls, change: _Change, period_s: float) -> _Motion:
        """Motion of the true plant from the change on."""
        return cls(change.state, SampledPlant.from_plant(change.after, period_s), change.ramp)

    @property
    def state(self) -> State:
        """State after the last force."""
        x, v = self._state.tolist()
        return x, v

    def displacement_m(self, force_n: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement after each of the next n forces, (n,) metres."""
        ramp, self._ramp = self._ramp[: len(force_n)], self._ramp[len(force_n) :]
        parts = [self._displacement_m(step, force_n[k : k + 1]) for k, step in enumerate(ramp)]
        parts.append(self._displacement_m(self._settled, force_n[len(ramp) :]))
        return np.concatenate(parts) if ramp else parts[0]

    def _displacement_m(self, plant: SampledPlant, force_n: NDArray[np.float64]) -> NDArray[np.float64]:
        return sampled_response(*plant.matrices, self._state, force_n)


def detectable(scenario: Scenario, arl0: float, *, noise_lsb: float = 1.0, lsb_v: float = 10.0 / 4096) -> bool:
    """True if every change of a scenario is detectable before the next one: its information I(n) reaches ln ARL0.

    A prediction from the plant and the excitation of the scenario, with its own phase even if the seed draws one. The
    bounds of a run come from the measured force.

    :param arl0: average run length between false alarms, in samples.
    :param noise_lsb: noise of the displacement channel, rms in LSB.
    :param lsb_v: resolution of the displacement channel, in volts.
    """
    return all(bound is not None for bound in predicted_bounds(scenario, arl0, noise_lsb=noise_lsb, lsb_v=lsb_v))


def predicted_bounds(
    scenario: Scenario, arl0: float, *, noise_lsb: float = 1.0, lsb_v: float = 10.0 / 4096
) -> list[int | None]:
    """Predicted information bound of each change of a scenario; None: not detectable before the next one or the end.

    Parameters as ``detectable``.
    """
    scales = PROGRAMS[scenario.plant.set].scales
    lsb_m = lsb_v / scales.volts("displacement")
    weight = np.full(scenario.samples, 1.0 / (2.0 * (noise_lsb**2 + QUANTISATION_VARIANCE_LSB2) * lsb_m**2))
    volts = _mean_levels(scenario.excitation.edges(0, scenario.samples * TICKS_PER_SAMPLE, _RATE_HZ), scenario.samples)
    force_n = volts / scales.volts("force")
    segments = scenario.segments()
    ends = [*(segment.start for segment in segments[1:]), scenario.samples]
    stretches = [(segment.start, end, segment.plant) for segment, end in zip(segments, ends, strict=True)]
    ramps_n = {segment.start: segment.ramp_n for segment in segments}
    period_s = scales.time / _RATE_HZ
    return [
        first_at_level(_information(change, period_s), math.log(arl0))
        for change in _changes_between(stretches, ramps_n, force_n, weight, period_s)
    ]


def _mean_levels(edges: Edges, samples: int) -> NDArray[np.float64]:
    """Mean voltage in the period after each sample, (n,) volts."""
    ticks = np.append(edges.ticks, samples * TICKS_PER_SAMPLE).astype(np.float64) / TICKS_PER_SAMPLE
    integral = np.interp(np.arange(samples + 1), ticks, np.append(0.0, np.cumsum(edges.levels_v * np.diff(ticks))))
    return np.asarray(np.diff(integral))


def isolation_bounds(run: Run) -> list[int | None]:
    """Isolation bound of each change of ``run`` in samples; None: not before the next change or the end.

    The rival hypotheses are changes of one other parameter by any factor from 1/4 to 4.
    """
    period_s = run.conditions.sample_period_problem_s
    out: list[int | None] = []
    for (start, _, _), change in zip(run.segments[1:], _run_changes(run), strict=True):
        if start in run.conditions.records or change.before == change.after:
            out.append(None)  # the device restarts with each record and has nothing to isolate
            continue
        changed = tuple(change.before.changes_to(change.after))
        course = _Motion.of_change(change, period_s).displacement_m(change.force_n[:ISOLATION_HORIZON_N])
        least = np.full(len(course), np.inf)
        for name in PARAMETERS:
            if changed != (name,):
                apart = (_rival_displacements(change, name, period_s) - course) ** 2 * change.weight[: len(course)]
                least = np.minimum(least, _interpolate_minimum(np.cumsum(apart, axis=1)))
        out.append(first_at_level(least, ISOLATION_INFORMATION))
    return out


def _run_changes(run: Run) -> Iterator[_Change]:
    """Changes of the plant in ``run``, including those at the start of a record."""
    conditions = run.conditions
    force_n = run.channel("force")
    displacement = conditions.channels["displacement"]
    variance_m2 = (displacement.noise_lsb**2 + QUANTISATION_VARIANCE_LSB2) * displacement.lsb**2
    weight = np.where(run.missing, 0.0, 1.0 / (2.0 * variance_m2))
    ramps_n = {segment.start: segment.ramp_n for segment in conditions.segments}
    return _changes_between(
        run.segments, ramps_n, force_n, weight, conditions.sample_period_problem_s, records=conditions.records
    )


def _changes_between(
    stretches: Iterable[tuple[int, int, Plant]],
    ramps_n: Mapping[int, int],
    force_n: NDArray[np.float64],
    weight: NDArray[np.float64],
    period_s: float,
    records: Sequence[int] = (0,),
) -> Iterator[_Change]:
    """Changes between stretches (start, end, plant) under a force. The plant is at rest at the start of each record."""
    state = AT_REST
    before: Plant | None = None
    for start, end, plant in stretches:
        if start in records:
            state = AT_REST
        ramp = _ramp_plants(before or plant, plant, ramps_n.get(start, 0), end - start, period_s)
        change = _Change(before or plant, plant, ramp, state, force_n[start : end - 1], weight[start + 1 : end])
        if before is not None:
            yield change
        if end < len(force_n):
            motion = _Motion.of_change(change, period_s)
            for first in range(start, end, CHUNK_SAMPLES):
                motion.displacement_m(force_n[first : min(first + CHUNK_SAMPLES, end)])
            state = motion.state
        before = plant


def _ramp_plants(before: Plant, after: Plant, ramp_n: int, samples: int, period_s: float) -> list[SampledPlant]:
    """Plant in the middle of each sample period of a ramp."""
    if not ramp_n:
        return []
    return SampledPlant.from_plants(
        [before.interpolate(after, (k + 0.5) / ramp_n) for k in range(min(ramp_n, samples))], period_s
    )


def first_at_level(information: Sequence[float] | NDArray[np.float64], level: float) -> int | None:
    """Smallest n with I(n) >= level, or None."""
    reached = np.flatnonzero(np.asarray(information) >= level)
    return int(reached[0]) + 1 if len(reached) else None


def _rival_displacements(change: _Change, name: str, period_s: float) -> NDArray[np.float64]:
    """Displacement if only the parameter ``name`` had changed, for each rival factor: (f, n) metres, to the horizon."""
    plants = np.tile(list(change.before.parameters().values()), (len(_RIVAL_FACTORS), 1))
    plants[:, PARAMETERS.index(name)] *= _RIVAL_FACTORS
    (xx, xv, xf), (vx, vv, vf) = discretise(plants, period_s).transpose(1, 2, 0)
    x, v = (np.full(len(plants), value) for value in change.state)
    forces = change.force_n[:ISOLATION_HORIZON_N].tolist()
    out = np.empty((len(plants), len(forces)))
    for k, force in enumerate(forces):
        x, v = xx * x + xv * v + xf * force, vx * x + vv * v + vf * force
        out[:, k] = x
    return out


def _interpolate_minimum(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Minimum over evenly spaced f of (f, n), interpolated by a parabola through three points: (n,)."""
    at = np.clip(information.argmin(axis=0), 1, len(information) - 2)
    low, mid, high = (information[at + i, np.arange(information.shape[1])] for i in (-1, 0, 1))
    curvature = low + high - 2.0 * mid
    dip = np.divide((high - low) ** 2, 8.0 * curvature, out=np.zeros_like(mid), where=curvature > 0.0)
    return np.asarray(np.maximum(np.minimum(mid, mid - dip), 0.0))
