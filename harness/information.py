"""How soon a change can be seen at all.

No detector whose mean time between false alarms is ARL0 can, to first order, raise the alarm before the information

    I(n) = sum over the first n samples of (y_changed - y_unchanged)^2 / (2 sigma^2)

between the plant as it was and the plant as it has become reaches ln ARL0 (Lorden 1971; Moustakides 1986; Lai 1998).
It depends on where in the excitation the change fell, so it is computed for that very change in that very run.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from harness.plant import AT_REST, Plant, SampledPlant, State
from harness.run import Run

QUANTISATION_VARIANCE_LSB2 = 1.0 / 12.0


def changes(run: Run) -> list[NDArray[np.float64]]:
    """For each change of the plant in ``run``: I(1), I(2), ... up to the next change or the end.

    Both plants start from the state in which the change finds the true one and feel the force that was measured.
    Samples that the device could not use carry no information.
    """
    conditions = run.conditions
    force_n = run.channel("force").tolist()
    displacement = conditions.channels["displacement"]
    variance_lsb2 = displacement.noise_lsb**2 + QUANTISATION_VARIANCE_LSB2
    usable = ~run.missing
    period_s = conditions.sample_period_problem_s
    ramps_n = {segment.start: segment.ramp_n for segment in conditions.segments}
    state = AT_REST
    before: Plant | None = None
    out: list[NDArray[np.float64]] = []
    for start, end, plant in run.segments:
        steps = _steps(before or plant, plant, ramps_n[start], end - start, period_s)
        if before is not None:
            unchanged = SampledPlant.of(before, period_s)
            difference_m = _displacement_difference(unchanged, steps, state, force_n[start : end - 1])
            seen = np.where(usable[start + 1 : end], difference_m / displacement.lsb, 0.0)
            out.append(np.cumsum(seen**2) / (2.0 * variance_lsb2))
        for step, force in zip(steps, force_n[start:end], strict=True):
            state = step.next(state, force)
        before = plant
    return out


def _steps(before: Plant, after: Plant, ramp_n: int, samples: int, period_s: float) -> list[SampledPlant]:
    """The plant in each of the sample periods after a change; on a ramp that of the period's middle."""
    turning = [
        SampledPlant.of(before.on_the_way(after, (k + 0.5) / ramp_n), period_s) for k in range(min(ramp_n, samples))
    ]
    return turning + [SampledPlant.of(after, period_s)] * (samples - len(turning))


def first_reaching(information: Sequence[float] | NDArray[np.float64], level: float) -> int | None:
    """The first n with I(n) >= level, or None."""
    reached = np.flatnonzero(np.asarray(information) >= level)
    return int(reached[0]) + 1 if len(reached) else None


def _displacement_difference(
    before: SampledPlant, after: Sequence[SampledPlant], state: State, force_n: Sequence[float]
) -> NDArray[np.float64]:
    """(n,) metres, after each of the n forces."""
    unchanged, changed = state, state
    out = np.empty(len(force_n))
    for k, force in enumerate(force_n):
        unchanged, changed = before.next(unchanged, force), after[k].next(changed, force)
        out[k] = changed[0] - unchanged[0]
    return out
