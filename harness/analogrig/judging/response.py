"""Estimates of a linear plant against the exact response of the circuit that played it.

Elements of theta need not be unique: poles that nearly cancel zeros may lie anywhere. The step response is unique. That
of the circuit includes its real components. A run of a rig without a machine is compared with its program.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.datasheet import ModelOrders
from analogrig.judging import machine_model
from analogrig.plant import Plant, exponentials
from analogrig.run import Run
from analogrig_emulator import LinearMode

_LEAST_N, _MOST_N = 50, 2000
"""Samples of a step response."""

_DECAYED = 5.0
"""Time constants of the slowest pole that a step response lasts."""

_STEPS = 20
"""Instants within a sample period at which an edge of the input may have come."""

_LATEST_N = 2
"""Largest time between an edge and the first sample that shows it: a sample, and the skew of the channels."""


@dataclass(frozen=True)
class StepResponse:
    """Estimate at the end of a segment of constant plant, samples ``start`` <= k < ``end``, against the circuit."""

    start: int
    end: int
    error: float | None
    """Largest difference of the step responses over the circuit's static gain, at the place of the edges that fits
    best; None: the estimate is unstable or non-finite."""


def step_responses(run: Run) -> tuple[StepResponse, ...]:
    """Comparison at the end of each segment; empty unless the program is linear and theta is that of a model.

    :raises ConfigurationError: the recorded rig or scenario does not describe a machine.
    """
    conditions, model = run.conditions, run.datasheet.model
    if not conditions.program.is_linear or model is None or not run.theta.shape[1]:
        return ()
    unseen = {segment.start for segment in conditions.segments if segment.unseen}
    machine, out = machine_model.machine_of(run), []

    @functools.lru_cache(maxsize=8)  # of 320 kB each
    def true_step(plant: Plant, samples: int) -> NDArray[np.float64]:
        mode = _of_program(run, plant) if machine is None else machine.linear_mode(plant.parameters())
        return _step(mode, conditions.sample_period_s / _STEPS, (samples + _LATEST_N) * _STEPS)

    for start, end, plant in run.segments:
        if start in unseen:
            continue
        samples = _length(run, plant)
        truth = true_step(plant, samples)
        found = _estimated_step(run.theta[end - 1], model, samples) * conditions.output.lsb_v / conditions.input.lsb_v
        late = [truth[first : first + samples * _STEPS : _STEPS] for first in range(_LATEST_N * _STEPS)]
        error = min(float(np.abs(found - each).max()) for each in late) / abs(truth[-1])
        out.append(StepResponse(start, end, error if np.isfinite(error) else None))
    return tuple(out)


def _of_program(run: Run, plant: Plant) -> LinearMode:
    """State space of the program in volts and seconds of the machine."""
    conditions = run.conditions
    matrix = plant.program.generators(np.array([plant.values]))[0]
    flow = matrix[:-1] * conditions.time_scale
    per_v = conditions.input.unit_per_v / conditions.output.unit_per_v
    return LinearMode(flow[:, :-1], flow[:, -1], matrix[-1, :-1] * per_v, float(matrix[-1, -1]) * per_v)


def _length(run: Run, plant: Plant) -> int:
    """Samples in which the program's step response settles."""
    matrix = plant.program.generators(np.array([plant.values]))[0]
    slowest = np.abs(np.linalg.eigvals(matrix[:-1, :-1]).real).min() * run.conditions.sample_period_problem_s
    return int(np.clip(_DECAYED / max(slowest, 1e-9), _LEAST_N, _MOST_N))


def _step(mode: LinearMode, period_s: float, count: int) -> NDArray[np.float64]:
    """Output at so many instants, every ``period_s`` after a step of the input from rest, (count,)."""
    n = len(mode.flow)
    generator = np.zeros((1, n + 1, n + 1))
    generator[0, :n] = np.column_stack([mode.flow, mode.driven]) * period_s
    transition = exponentials(generator)[0]
    now, reading, out = np.append(np.zeros(n), 1.0), np.append(mode.reading, mode.direct), np.empty(count)
    for k in range(count):
        out[k] = reading @ now
        now = transition @ now
    return out


def _estimated_step(theta: NDArray[np.float32], model: ModelOrders, samples: int) -> NDArray[np.float64]:
    """Output of the model in codes after a step of one code of the input, (samples,)."""
    a, b = np.split(theta[: model.na + model.nb].astype(np.float64), [model.na])
    if not np.isfinite(theta).all() or (np.abs(np.roots(np.append(1.0, a))) >= 1.0).any():
        return np.full(samples, np.inf)
    driven = np.cumsum(np.pad(b, (model.nk, samples))[:samples])
    out, past = np.empty(samples), np.zeros(model.na)
    for k in range(samples):
        out[k] = driven[k] - a @ past
        past = np.append(out[k], past[:-1])
    return out
