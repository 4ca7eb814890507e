"""Plays of one scenario with many seeds, within this process: computed and judged together, in half of the time.

The runs and verdicts are those of ``Bench.play`` and ``judge``, to the bit, without what needs messages.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import EVENTS, AlarmLevel, Answers
from analogrig.bench import Bench, RunBuilder, overloads_until, reports
from analogrig.campaigns.repeated import DIRECT_BLOCK_SAMPLES, RepeatedRig
from analogrig.devices.device import DeviceDescription
from analogrig.judging import information
from analogrig.judging.courses import Model, Trajectory, Values
from analogrig.judging.exposure import exposures
from analogrig.judging.machine_model import PREFIX, Machine, RecordedRig, is_played
from analogrig.judging.verdict import Verdict, is_exact, judge_with, segment_estimates
from analogrig.rigs.emulator import EmulatorRig, emulator_errors, is_emulated
from analogrig.rigs.rig import Block, Performance, Rig
from analogrig.run import Conditions, Run
from analogrig.scenario import Scenario
from analogrig_emulator import Moment, RepeatedCourses

_RETAINED_BYTES = 30_000_000
"""Size of the largest array whose memory the allocator keeps for the next play."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt() in malloc.h of glibc."""

_Played = tuple[Block, tuple[Answers, Mapping[str, int]]]
"""Block that is a whole run, with the answers to it and the counters of its record."""


def can_be_direct(rig: Rig, device: DeviceDescription) -> TypeGuard[EmulatorRig]:
    """True if a direct bench yields the runs of the device over its line.

    The rig must be emulated, and the line must not alter the samples.
    """
    return is_emulated(rig) and "blocks" in device.capabilities


def direct_bench(rig: EmulatorRig, device: DeviceDescription, *, alarms_only: bool = False) -> DirectBench:
    """Bench with the estimator in this process and whole blocks: the fastest way.

    :param alarms_only: omit the estimates, which take a twentieth of the time: theta of the runs has no columns.
    :raises ConfigurationError: the estimator refuses its configuration.
    :raises LinkError: the library of the device was not built.
    """
    _retain_freed_memory()
    return DirectBench(RepeatedRig(rig), device.direct(alarms_only=alarms_only))


def _retain_freed_memory() -> None:
    """Make glibc keep the arrays of a play for the next one; otherwise each play faults their pages in again.

    Its thresholds would grow by themselves, but not in a worker of Dask: they are fixed at 128 kB by the variable
    MALLOC_TRIM_THRESHOLD_, whatever its value, and Dask sets it.
    """
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_M_MMAP_THRESHOLD, _RETAINED_BYTES)
        mallopt(_M_TRIM_THRESHOLD, 2 * _RETAINED_BYTES)


class DirectBench(Bench):
    """Bench of an emulated rig and a device without messages."""

    rig: RepeatedRig

    def play_all(self, scenario: Scenario, seeds: Sequence[int]) -> list[Run]:
        """Runs of ``play`` with each seed. Those of one block are computed together.

        :raises ConfigurationError, DeviceError, RigError: one of them would raise it, or have it as a fault.
        """
        if scenario.samples > DIRECT_BLOCK_SAMPLES:
            return [self.play(scenario, seed) for seed in seeds]
        performances = self.rig.perform_all(scenario, seeds)
        first = performances[0]
        self.dut.suit(scenario.poles(first.sample_period_s * first.time_scale))
        self.dut.prepare(first.of_device, first.sample_period_s)
        blocks = [next(each.blocks) for each in performances]
        records = self.dut.play_records([block.samples() for block in blocks])
        if self.dut.holds_alarms:
            records = ((AlarmLevel().rises(answers, 0), counters) for answers, counters in records)
        played = list(zip(blocks, records, strict=True))
        common = self._common_conditions(first, scenario, seeds[0], played[0])
        return [
            _run_of_block(
                common.again(
                    seed=seed,
                    overloads=overloads_until(performance.hindsight(), scenario.samples),
                    counters=counters,
                ),
                block,
                answers,
            )
            for seed, performance, (block, (answers, counters)) in zip(seeds, performances, played, strict=True)
        ]

    def _common_conditions(
        self, performance: Performance, scenario: Scenario, seed: int, played: _Played
    ) -> Conditions:
        """Conditions of runs that are played together, with the seed, overloads and counters of one of them."""
        block, (answers, counters) = played
        builder = RunBuilder(scenario.samples, len(scenario.program.channels), self.dut.datasheet)
        builder.begin_record()
        builder.add(block, answers)
        builder.end_record(self.dut.line_s, counters)
        initial = self._initial_conditions(performance, scenario, seed)
        return self._final_conditions(initial, performance.hindsight(), (), builder)


def _run_of_block(conditions: Conditions, block: Block, answers: Answers) -> Run:
    """Run of one block."""
    n = len(block.codes)
    return Run(
        conditions=conditions,
        codes=block.codes,
        clipped=block.clipped,
        theta=np.empty((n, 0), np.float32) if answers.theta is None else answers.theta,
        innovation=np.zeros(n, np.float32) if answers.innovation is None else answers.innovation,
        statistic=np.zeros(n, np.float32) if answers.statistic is None else answers.statistic,
        flags=answers.flags,
        **reports({name: getattr(answers, name) for name in EVENTS}),
    )


# ------------------------------------------------------------------------------------------------------------- judging


def judge_all(runs: Iterable[Run]) -> list[Verdict]:
    """Verdict on each run, as of ``judge``.

    Consecutive runs that differ in seed and samples alone are judged together, in a part of the time.
    """
    return [verdict for _, alike in itertools.groupby(runs, _common) for verdict in _judge_alike(list(alike))]


def _common(run: Run) -> tuple[object, ...]:
    """What two runs must share to be judged together."""
    known = run.conditions
    return run.samples, known.segments, known.records, known.channels, known.scenario, known.dut, known.rig


def _judge_alike(runs: Sequence[Run]) -> Iterator[Verdict]:
    models = models_of(runs) if is_exact(runs[0]) else [None] * len(runs)
    expect = itertools.repeat(runs[0].conditions.played.expect)
    return map(judge_with, runs, expect, models, exposures(runs), segment_estimates(runs))


def models_of(runs: Sequence[Run]) -> Sequence[Model | None]:
    """Model of each run, as of ``model_of``, for runs that differ in the seed alone.

    :raises ConfigurationError: as ``model_of``.
    """
    first = runs[0]
    has_ramps = any(segment.ramp_n for segment in first.conditions.segments)
    if len(runs) > 1 and is_played(first) and len(first.segments) > 1 and not has_ramps:
        recorded, repeated = _recorded(first.conditions)
        with emulator_errors(PREFIX):
            seeds = [run.conditions.seed for run in runs]
            courses = repeated.courses_together(recorded.scenario, seeds, first.samples)
        if courses is not None:
            together = _Together(courses, first)
            return [_OneOfMany(run, recorded, together, place) for place, run in enumerate(runs)]
    return [information.model_of(run) for run in runs]


_last: tuple[Conditions, tuple[RecordedRig, RepeatedRig]] | None = None
"""Rig of the last runs, with the one that plays them together: consecutive runs share their descriptions."""


def _recorded(conditions: Conditions) -> tuple[RecordedRig, RepeatedRig]:
    global _last  # noqa: PLW0603 - a cache of one entry
    if _last is None or _last[0].rig is not conditions.rig or _last[0].scenario is not conditions.scenario:
        recorded = RecordedRig.of(conditions)
        _last = conditions, (recorded, RepeatedRig(recorded.rig))
    return _last[1]


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
        with emulator_errors(PREFIX):
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

    def __init__(self, run: Run, recorded: RecordedRig, together: _Together, place: int) -> None:
        self._run, self._recorded, self._together, self._place = run, recorded, together, place

    @functools.cached_property
    def _alone(self) -> Machine:
        return self._recorded.machine(self._run)

    def at_rest(self, start: int, values: Values) -> Moment:  # noqa: ARG002 - as of a machine
        return self._together.at_rest

    def course(self, moment: Moment, before: Values, after: Values, ramp_n: int) -> _PartOfMany:  # noqa: ARG002
        courses_lsb, ends_v = self._together.play(moment.sample, tuple(after.items()))
        end = Moment(moment.sample + courses_lsb.shape[1], ends_v[self._place])
        return _PartOfMany(courses_lsb[self._place], end)

    def rival(self, moment: Moment, values: Values) -> Trajectory | None:
        return self._alone.rival(moment, values)
