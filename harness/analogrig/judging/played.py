"""Courses from noise-free plays of the machine of a run: any program, with its real components."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.judging.courses import Values
from analogrig.rigs.emulator import EmulatorDescription, EmulatorRig, emulator_errors, nominal_courses
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig_emulator import Course, Courses, LinearMode, Moment, RepeatedCourses

_PREFIX = "no bound from a play of the machine: "


class _Played:
    """Course in LSB."""

    def __init__(self, played: Course, lsb_v: float) -> None:
        self._played, self._lsb_v = played, lsb_v

    def advance(self, samples: int) -> NDArray[np.float64]:
        with emulator_errors(_PREFIX):
            return self._played.advance(samples) / self._lsb_v

    def moment(self) -> Moment:
        with emulator_errors(_PREFIX):
            return self._played.moment()


class Machine:
    """Machine of a run, as a model of its plant."""

    def __init__(self, courses: Courses, lsb_v: float) -> None:
        self._courses, self._lsb_v = courses, lsb_v

    def at_rest(self, start: int, values: Values) -> Moment:  # noqa: ARG002 - a machine plays one record
        with emulator_errors(_PREFIX):
            return self._courses.at_rest(values)

    def course(self, moment: Moment, before: Values, after: Values, ramp_n: int) -> _Played:
        with emulator_errors(_PREFIX):
            return _Played(self._courses.course(moment, before, after, ramp_n), self._lsb_v)

    def linear_mode(self, values: Values) -> LinearMode:
        """State space of the circuit from input to output, in volts and seconds of the machine.

        :raises ConfigurationError: it has multipliers.
        """
        with emulator_errors("no linear mode of the machine: "):
            return self._courses.linear_mode(values)

    def rival(self, moment: Moment, values: Values) -> _Played | None:
        try:
            return self.course(moment, values, values, 0)
        except ConfigurationError:
            return None


class _Together:
    """Courses of the machines of several runs with the same changes, played for all of them when the first one asks."""

    def __init__(self, courses: RepeatedCourses, run: Run) -> None:
        """``run``: one of them."""
        self._courses, self._lsb_v = courses, run.conditions.output.lsb_v
        self._ends = {start: min(end, run.samples - 1) for start, end, _ in run.segments}
        self._values = {start: plant.parameters() for start, _, plant in run.segments}
        self.at_rest = courses.at_rest
        self.play = functools.cache(self._play)

    def _play(
        self, start: int, values: tuple[tuple[str, float], ...]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Courses in LSB, (runs, n), from a change to the next one, and states (runs, s) there."""
        before = max((other for other in self._ends if other < start), default=None)
        states_v = None if before is None else self.play(before, tuple(self._values[before].items()))[1]
        with emulator_errors(_PREFIX):
            volts, ends_v = self._courses.play(dict(values), start, self._ends[start] - start, states_v)
        return volts / self._lsb_v, ends_v


class _PartOfMany:
    """Course in LSB that was played together with others, up to the next change."""

    def __init__(self, course_lsb: NDArray[np.float64], end: Moment) -> None:
        self._coming_lsb, self._end = course_lsb, end

    def advance(self, samples: int) -> NDArray[np.float64]:
        now, self._coming_lsb = self._coming_lsb[:samples], self._coming_lsb[samples:]
        return now.copy()  # a judge overwrites it

    def moment(self) -> Moment:
        return self._end


class _OneOfMany:
    """Machine of a run, as a model of its plant: courses up to the next change are played for all runs together."""

    def __init__(self, run: Run, together: _Together, place: int) -> None:
        self._run, self._together, self._place = run, together, place

    @functools.cached_property
    def _alone(self) -> Machine:
        return _machine(self._run)

    def at_rest(self, start: int, values: Values) -> Moment:  # noqa: ARG002 - as of a machine
        return self._together.at_rest

    def course(self, moment: Moment, before: Values, after: Values, ramp_n: int) -> _PartOfMany:  # noqa: ARG002
        courses_lsb, ends_v = self._together.play(moment.sample, tuple(after.items()))
        end = Moment(moment.sample + courses_lsb.shape[1], ends_v[self._place])
        return _PartOfMany(courses_lsb[self._place], end)

    def rival(self, moment: Moment, values: Values) -> _Played | None:
        return self._alone.rival(moment, values)


class _Recorded(NamedTuple):
    """Rig and scenario of a run, with the tables that describe them."""

    tables: tuple[Mapping[str, Any], Mapping[str, Any]]
    rig: EmulatorRig
    scenario: Scenario


_last: _Recorded | None = None
"""Those of the last run: consecutive runs of a bench share their tables."""


def machine_of(run: Run) -> Machine | None:
    """Machine that played a run; None unless the rig was an emulator.

    :raises ConfigurationError: the recorded rig or scenario does not describe a machine.
    """
    return _machine(run) if is_played(run) else None


def _machine(run: Run) -> Machine:
    conditions = run.conditions
    recorded = _recorded(conditions.rig, conditions.scenario)
    with emulator_errors(_PREFIX):
        courses = recorded.rig.courses(recorded.scenario, conditions.seed, run.samples)
    return Machine(courses, conditions.output.lsb_v)


def machines_of(runs: Sequence[Run]) -> Sequence[_OneOfMany]:
    """Machine of each run, for runs that differ in the seed alone; none if they have little to share.

    :raises ConfigurationError: as ``machine_of``.
    """
    first = runs[0]
    has_ramps = any(segment.ramp_n for segment in first.conditions.segments)
    if len(runs) == 1 or not is_played(first) or len(first.segments) < 2 or has_ramps:
        return ()
    recorded = _recorded(first.conditions.rig, first.conditions.scenario)
    with emulator_errors(_PREFIX):
        seeds = [run.conditions.seed for run in runs]
        courses = recorded.rig.courses_together(recorded.scenario, seeds, first.samples)
    if courses is None:
        return ()
    together = _Together(courses, first)
    return [_OneOfMany(run, together, place) for place, run in enumerate(runs)]


def is_played(run: Run) -> bool:
    """True if an emulator played a run without a gap, so that it has a machine."""
    return run.conditions.rig.get("kind") == "emulator" and len(run.conditions.records) <= 1


def nominal(scenario: Scenario, lsb_v: float) -> Machine:
    """Machine with nominal components, sampled at the rate of the emulated card.

    :raises ConfigurationError: it cannot play the excitation of the scenario.
    """
    with emulator_errors(f"scenario {scenario.name}: "):
        return Machine(nominal_courses(scenario), lsb_v)


def _recorded(rig: Mapping[str, Any], scenario: Mapping[str, Any]) -> _Recorded:
    global _last  # noqa: PLW0603 - a cache of one entry
    if _last is None or _last.tables[0] is not rig or _last.tables[1] is not scenario:
        description = config.build(EmulatorDescription, config.plain(rig), "the recorded rig")
        with emulator_errors("the recorded rig: "):
            opened = EmulatorRig(description)
        _last = _Recorded((rig, scenario), opened, Scenario.from_table(config.plain(scenario), "the recorded scenario"))
    return _last
