"""Courses of a linear program under the measured input, for runs of a rig without a machine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.courses import Values
from analogrig.plant import Plant, SampledPlant, State
from analogrig.program import Program
from analogrig.run import INPUT, Run


class _Moment(NamedTuple):
    sample: int
    state: State


class _Simulated:
    """Simulation of the plant under the input from one sample on."""

    def __init__(
        self,
        moment: _Moment,
        ramp: Iterator[SampledPlant],
        settled: SampledPlant,
        driven: NDArray[np.float64],
        lsb: float,
    ) -> None:
        """``ramp`` yields the plant of each of the first sample periods."""
        self._moment = moment
        self._ramp, self._settled = ramp, settled
        self._driven, self._lsb = driven, lsb

    def advance(self, samples: int) -> NDArray[np.float64]:
        first, state = self._moment
        driven, ramped = self._driven[first : first + samples], []
        for value, step in zip(driven.tolist(), self._ramp, strict=False):
            state = step.next(state, value)
            ramped.append(step.output(state))
        out, state = self._settled.play(state, driven[len(ramped) :])
        self._moment = _Moment(first + samples, state)
        return np.append(ramped, out) / self._lsb

    def moment(self) -> _Moment:
        return self._moment


class LinearPlant:
    """Model of the plant that follows the measured input."""

    def __init__(self, program: Program, driven: NDArray[np.float64], lsb: float, period_s: float) -> None:
        self._program, self._driven, self._lsb, self._period_s = program, driven, lsb, period_s

    @classmethod
    def of(cls, run: Run) -> Self:
        """Model of the plant in a run."""
        conditions = run.conditions
        driven = run.channel(conditions.program.channels[INPUT])
        return cls(conditions.program, driven, conditions.output.lsb, conditions.sample_period_problem_s)

    def at_rest(self, start: int, values: Values) -> _Moment:
        return _Moment(start, SampledPlant.from_plant(self._plant(values), self._period_s).at_rest)

    def course(self, moment: _Moment, before: Values, after: Values, ramp_n: int) -> _Simulated:
        first, last = self._plant(before), self._plant(after)
        length = min(ramp_n, len(self._driven) - moment.sample)
        ramp = SampledPlant.from_plants(
            [first.interpolate(last, (k + 0.5) / ramp_n) for k in range(length)], self._period_s
        )
        settled = SampledPlant.from_plant(last, self._period_s)
        return _Simulated(moment, iter(ramp), settled, self._driven, self._lsb)

    def rival(self, moment: _Moment, values: Values) -> _Simulated:
        return self.course(moment, values, values, 0)

    def _plant(self, values: Values) -> Plant:
        return Plant(self._program, tuple(values.values()))
