"""Plays of one scenario with many seeds, within this process: computed and judged together, in half of the time.

The runs and verdicts are those of ``Bench.play`` and ``judge``, to the bit, without what needs messages. Computed
together are plays whose seeds draw offsets and phase alone.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import operator
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import EVENTS, AlarmLevel, Answers
from analogrig.bench import Bench, RunBuilder, overloads_until, reports
from analogrig.devices.device import DeviceDescription
from analogrig.errors import RigError
from analogrig.judging import information
from analogrig.judging.courses import Model, Trajectory, Values
from analogrig.judging.exposure import exposures
from analogrig.judging.machine_model import PREFIX, Machine, RecordedRig, is_played
from analogrig.judging.verdict import Verdict, is_exact, judge_with, segment_estimates
from analogrig.plant import Segment
from analogrig.rigs.emulator import (
    EmulatorRig,
    Stream,
    channels_of,
    drawn_machine,
    emulator_errors,
    is_emulated,
    lit_lamps,
    nominal_machine,
)
from analogrig.rigs.rig import Block, Hindsight, Performance, Rig
from analogrig.run import OUTPUT, Channel, Conditions, Run
from analogrig.scenario import Scenario
from analogrig_emulator import (
    Card,
    Moment,
    RepeatedCourses,
    RepeatedPlay,
    SuspensionComputer,
    Wired,
    ahead_ticks,
    drawn_offsets_v,
    is_repeatable,
    normals,
    probes_per_sample,
    sample_plays,
    uniforms,
)

DIRECT_BLOCK_SAMPLES = 131_072
"""Longest play that is computed together. The circuit of a longer one is prepared anew for each seed."""

_RETAINED_BYTES = 30_000_000
"""Size of the largest array whose memory the allocator keeps for the next play."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt() in malloc.h of glibc."""

_Played = tuple[Block, tuple[Answers, Mapping[str, int]]]
"""Block that is a whole run, with the answers to it and the counters of its record."""


class _Prepared(NamedTuple):
    """Data that all plays of one scenario share, for every seed."""

    key: tuple[object, ...]
    """Parts of the scenario on which the data depend."""
    computer: SuspensionComputer
    card: Card
    play: RepeatedPlay | None
    """Repeated play; None where more than offsets and phase depends on the seed."""
    channels: Mapping[str, Channel]
    segments: tuple[Segment, ...]


class RepeatedRig(EmulatorRig):
    """Emulated rig whose plays are those of ``EmulatorRig`` to the bit, in blocks of DIRECT_BLOCK_SAMPLES.

    Data for a scenario that fits in one block are prepared once for all seeds.
    """

    def __init__(self, rig: EmulatorRig) -> None:
        """Rig of the description of ``rig``."""
        super().__init__(rig.described, DIRECT_BLOCK_SAMPLES)
        self._last_prepared: _Prepared | None = None

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        return (self._repeat(scenario, [seed]) or [super().perform(scenario, seed)])[0]

    def perform_all(self, scenario: Scenario, seeds: Sequence[int]) -> list[Performance]:
        """Performance of each seed, as of ``perform``; their blocks are computed together where they can be."""
        return self._repeat(scenario, seeds) or [self.perform(scenario, seed) for seed in seeds]

    def courses_together(self, scenario: Scenario, seeds: Sequence[int], samples: int) -> RepeatedCourses | None:
        """Courses without ramps of the machines of several plays; None where these differ in more than offsets.

        :raises EmulatorError: as ``courses``.
        """
        program, card = scenario.program, self.card(scenario.program)
        if not self._draws_offsets_and_phase_alone(scenario):
            return None
        machine = drawn_machine(self.described.computer, program.circuit, seeds[0], card.true_rate_hz)
        if not is_repeatable(machine, ()):
            return None
        wired = Wired(machine, nominal_machine(program) if self.described.computer.pots == "dial" else machine)
        phases, offsets_v = self._draw(scenario, seeds, machine)
        return RepeatedCourses(wired, scenario.excitation, phases, offsets_v, samples, OUTPUT)

    def _draw(
        self, scenario: Scenario, seeds: Sequence[int], computer: SuspensionComputer
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Phases (seeds,) and offsets of the amplifiers (seeds, amplifiers) in volts."""
        numbers = uniforms(seeds, Stream.COMPONENTS, computer.program.amplifiers)
        offsets_v = drawn_offsets_v(self.amplifier, numbers, self.described.computer.offset_v)
        if scenario.random_phase:
            return uniforms(seeds, Stream.EXCITATION, 1)[:, 0], offsets_v
        return np.full(len(seeds), scenario.excitation.phase), offsets_v

    def _prepare(self, scenario: Scenario, seed: int) -> _Prepared:
        """Prepared data of the scenario; the last set is reused for the same key."""
        key = (scenario.samples, scenario.plant, scenario.changes, scenario.excitation)
        if self._last_prepared is None or self._last_prepared.key != key:
            computer, excitation, changes = self.set_up(scenario, seed)
            card = self.card(scenario.program)
            with emulator_errors(f"scenario {scenario.name}: "):
                excitation.check_rate(computer.sample_rate_hz)
                able = self._draws_offsets_and_phase_alone(scenario) and is_repeatable(computer, changes)
                play = RepeatedPlay(computer, scenario.samples, changes) if able else None
            channels = channels_of(card, computer, scenario.program)
            self._last_prepared = _Prepared(key, computer, card, play, channels, scenario.segments())
        return self._last_prepared

    def _draws_offsets_and_phase_alone(self, scenario: Scenario) -> bool:
        """True if plays of the scenario differ in the amplifiers' offsets and the phase of their edges alone."""
        card, drawn = self.card(scenario.program), self.described.computer
        is_nominal = drawn.components == "nominal" and not drawn.wiper_noise_ohm
        is_nominal &= not drawn.noise and not drawn.supply_hum_v
        is_nominal &= drawn.specimen is None and drawn.values is None
        is_on_time = probes_per_sample(card) == 1 and not ahead_ticks(card) and card.clock_drift_ppm == 0
        return is_nominal and is_on_time and not scenario.excitation.is_smooth

    def _repeat(self, scenario: Scenario, seeds: Sequence[int]) -> list[Performance]:
        """Performances whose blocks are computed together with the first one; none if there is no repeated play."""
        if scenario.samples > self._block_samples:
            return []
        prepared = self._prepare(scenario, seeds[0])
        if (play := prepared.play) is None:
            return []
        taken: list[tuple[Block, Mapping[str, int]]] = []

        def blocks(i: int) -> Iterator[Block]:
            if not taken:
                taken.extend(self._repeated_blocks(prepared, play, scenario, seeds))
            yield taken[i][0]

        def hindsight(i: int) -> Hindsight:
            return Hindsight(prepared.segments, taken[i][1] if taken else {})

        return [
            Performance(
                sample_period_s=1.0 / prepared.card.rate_hz,
                time_scale=prepared.computer.scales.time,
                channels=prepared.channels,
                blocks=blocks(i),
                hindsight=functools.partial(hindsight, i),
            )
            for i in range(len(seeds))
        ]

    def _repeated_blocks(
        self, prepared: _Prepared, play: RepeatedPlay, scenario: Scenario, seeds: Sequence[int]
    ) -> Iterator[tuple[Block, Mapping[str, int]]]:
        """Samples and lit lamps of each seed."""
        phases, offsets_v = self._draw(scenario, seeds, prepared.computer)
        with emulator_errors(as_error=RigError):
            volts, lamps = play.play_all(scenario.excitation, phases, offsets_v)
            codes, clipped = sample_plays(prepared.card, volts, normals(seeds, Stream.CARD, volts.shape[1:]))
        for each, *samples in zip(lamps, volts, codes, clipped, strict=True):
            yield Block(0, *samples), lit_lamps(each, 1)


# ------------------------------------------------------------------------------------------------------------ playing


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
    # glibc keeps the arrays of a play for the next one; otherwise each play would fault their pages in again. Its
    # thresholds would grow by themselves, but not in a worker of Dask: they are fixed at 128 kB by the variable
    # MALLOC_TRIM_THRESHOLD_, whatever its value, and Dask sets it.
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_M_MMAP_THRESHOLD, _RETAINED_BYTES)
        mallopt(_M_TRIM_THRESHOLD, 2 * _RETAINED_BYTES)
    return DirectBench(RepeatedRig(rig), device.direct(alarms_only=alarms_only))


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
    verdicts: list[Verdict] = []
    for _, group in itertools.groupby(runs, _COMMON):
        alike = list(group)
        models = models_of(alike) if is_exact(alike[0]) else [None] * len(alike)
        expect = itertools.repeat(alike[0].conditions.played.expect)
        verdicts += map(judge_with, alike, expect, models, exposures(alike), segment_estimates(alike))
    return verdicts


_COMMON = operator.attrgetter(
    "samples", *(f"conditions.{name}" for name in ("segments", "records", "channels", "scenario", "dut", "rig"))
)
"""Values that runs share if they are judged together."""


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


class _Last(threading.local):
    """Rig of a thread's last runs, with the one that plays them together: consecutive runs share their descriptions."""

    conditions: Conditions | None = None
    rigs: tuple[RecordedRig, RepeatedRig]


_last = _Last()


def _recorded(conditions: Conditions) -> tuple[RecordedRig, RepeatedRig]:
    last = _last.conditions
    if last is None or last.rig is not conditions.rig or last.scenario is not conditions.scenario:
        recorded = RecordedRig.of(conditions)
        _last.conditions, _last.rigs = conditions, (recorded, RepeatedRig(recorded.rig))
    return _last.rigs


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
