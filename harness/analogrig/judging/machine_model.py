"""Courses from noise-free plays of the machine of a run: any program, with its real components."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.errors import ConfigurationError
from analogrig.judging.courses import Values
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorDescription, EmulatorRig, emulator_errors, is_emulated
from analogrig.rigs.rig import Rig
from analogrig.run import OUTPUT, Channel, Conditions, Run
from analogrig.scenario import DEFAULT_SEED, Scenario
from analogrig_emulator import Course, Courses, LinearMode, Moment

PREFIX = "no bound from a play of the machine: "


class _Played:
    """Course in LSB."""

    def __init__(self, played: Course, lsb_v: float) -> None:
        self._played, self._lsb_v = played, lsb_v

    def advance(self, samples: int) -> NDArray[np.float64]:
        with emulator_errors(PREFIX):
            return self._played.advance(samples) / self._lsb_v

    def moment(self) -> Moment:
        with emulator_errors(PREFIX):
            return self._played.moment()


class Machine:
    """Machine of a run, as a model of its plant."""

    def __init__(self, courses: Courses, lsb_v: float) -> None:
        self._courses, self._lsb_v = courses, lsb_v

    def at_rest(self, start: int, values: Values) -> Moment:  # noqa: ARG002 - a machine plays one record
        with emulator_errors(PREFIX):
            return self._courses.at_rest(values)

    def course(self, moment: Moment, before: Values, after: Values, ramp_n: int) -> _Played:
        with emulator_errors(PREFIX):
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


class RecordedRig(NamedTuple):
    """Rig and scenario of a run."""

    rig: EmulatorRig
    scenario: Scenario

    @classmethod
    def of(cls, conditions: Conditions) -> RecordedRig:
        """:raises ConfigurationError: the recorded rig or scenario does not describe a machine."""
        description = config.build(EmulatorDescription, config.plain(conditions.rig), "the recorded rig")
        with emulator_errors("the recorded rig: "):
            rig = EmulatorRig(description)
        return cls(rig, Scenario.from_table(config.plain(conditions.scenario), "the recorded scenario"))

    def machine(self, run: Run) -> Machine:
        """Machine that played one of their runs."""
        with emulator_errors(PREFIX):
            courses = self.rig.courses(self.scenario, run.conditions.seed, run.samples)
        return Machine(courses, run.conditions.output.lsb_v)


def machine_of(run: Run) -> Machine | None:
    """Machine that played a run; None unless the rig was an emulator.

    :raises ConfigurationError: the recorded rig or scenario does not describe a machine.
    """
    return RecordedRig.of(run.conditions).machine(run) if is_played(run) else None


def is_played(run: Run) -> bool:
    """True if an emulator played a run without a gap, so that it has a machine."""
    return run.conditions.source.kind == "emulator" and len(run.conditions.records) <= 1


def predicted(scenario: Scenario, rig: str | Rig) -> tuple[Machine, Channel]:
    """Machine of a scenario on an emulated rig before it is played, and the channel of its output.

    :raises ConfigurationError: the rig is not emulated, or cannot play the scenario.
    """
    opened = open_rig(rig) if isinstance(rig, str) else rig
    if not is_emulated(opened):
        raise ConfigurationError(f"{opened.description()['name']}: only an emulated rig predicts bounds; name one")
    in_phase = dataclasses.replace(scenario, random_phase=False)
    seed = DEFAULT_SEED if scenario.seed is None else scenario.seed
    output = opened.perform(in_phase, seed).channels[scenario.program.channels[OUTPUT]]
    with emulator_errors(f"scenario {scenario.name}: "):
        return Machine(opened.courses(in_phase, seed, scenario.samples), output.lsb_v), output
