"""Courses of a mass, a damper and a spring under the measured force, for runs of a rig without a machine."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.courses import Values
from analogrig.plant import AT_REST, PARAMETERS, Plant, SampledPlant, State
from analogrig.run import Run


class _Moment(NamedTuple):
    sample: int
    state: State


class _Simulated:
    """Simulation of the plant under the force from one sample on."""

    def __init__(
        self, moment: _Moment, steps: Iterator[SampledPlant], force_n: NDArray[np.float64], lsb_m: float
    ) -> None:
        """``steps`` yields the plant of each sample period."""
        self._moment = moment
        self._steps, self._force_n, self._lsb_m = steps, force_n, lsb_m

    def advance(self, samples: int) -> NDArray[np.float64]:
        first, state = self._moment
        out = np.empty(samples)
        for k, (force, step) in enumerate(
            zip(self._force_n[first : first + samples].tolist(), self._steps, strict=False)
        ):
            state = step.next(state, force)
            out[k] = state[0]
        self._moment = _Moment(first + samples, state)
        return out / self._lsb_m

    def moment(self) -> _Moment:
        return self._moment


class LinearPlant:
    """Model of the plant that follows the measured force."""

    def __init__(self, force_n: NDArray[np.float64], lsb_m: float, period_s: float) -> None:
        self._force_n, self._lsb_m, self._period_s = force_n, lsb_m, period_s

    @classmethod
    def of(cls, run: Run) -> Self:
        """Model of the plant in a run."""
        conditions = run.conditions
        lsb_m = conditions.channels["displacement"].lsb
        return cls(run.channel("force"), lsb_m, conditions.sample_period_problem_s)

    def at_rest(self, start: int, values: Values) -> _Moment:  # noqa: ARG002 - rest is the same for all
        return _Moment(start, AT_REST)

    def course(self, moment: _Moment, before: Values, after: Values, ramp_n: int) -> _Simulated:
        first, last = _plant(before), _plant(after)
        length = min(ramp_n, len(self._force_n) - moment.sample)
        ramp = SampledPlant.from_plants(
            [first.interpolate(last, (k + 0.5) / ramp_n) for k in range(length)], self._period_s
        )
        settled = itertools.repeat(SampledPlant.from_plant(last, self._period_s))
        return _Simulated(moment, itertools.chain(ramp, settled), self._force_n, self._lsb_m)

    def rival(self, moment: _Moment, values: Values) -> _Simulated:
        return self.course(moment, values, values, 0)


def _plant(values: Values) -> Plant:
    return Plant(*(values[name] for name in PARAMETERS))
