"""Bench: joins a rig and a device, and plays scenarios. The one route from a circuit to a Run."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import gc
import itertools
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np

from analogrig.answers import Answers, RaisedAlarm, ReportedDiagnosis, ReportedMisfit, Samples
from analogrig.datasheet import Datasheet
from analogrig.devices.description import DeviceDescription
from analogrig.devices.device import Device
from analogrig.errors import DeviceError, LinkError, RigError, TimeLimitReached
from analogrig.links.wire import Clock
from analogrig.protocol.pace import Pace
from analogrig.rigs.emulator import EmulatorRig, is_emulated
from analogrig.rigs.rig import Block, Hindsight, Performance, Rig
from analogrig.run import Conditions, Run
from analogrig.scenario import Scenario

Progress = Callable[[int, int], None]
"""Callback after each block, with the number of samples done and of samples asked."""

_RETAINED_BYTES = 30_000_000
"""Size of the largest array whose memory the allocator keeps for the next play."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt() in malloc.h of glibc."""

_INTERRUPTED_BY = "interrupted by "
"""Start of the fault of an interrupted run; the name of the signal follows."""

DIRECT_BLOCK_SAMPLES = 131_072
"""Block length in samples of a direct bench. The circuit of a longer run is prepared anew for each seed."""


class RunBuilder:
    """Collector of the samples and answers of one run. The Run shares its arrays.

    The arrays are allocated for all samples asked. The operating system provides only the pages that are written.
    """

    def __init__(self, samples_asked: int, channels: int, sheet: Datasheet) -> None:
        n = samples_asked
        self._codes = np.empty((n, channels), np.uint16)
        self._clipped = np.empty((n, channels), np.bool_)
        self._theta = np.empty((n, sheet.theta_n), np.float32)
        self._innovation = np.empty(n, np.float32) if sheet.innovation else np.zeros(n, np.float32)
        self._statistic = np.empty(n, np.float32) if sheet.statistic else np.zeros(n, np.float32)
        self._flags = np.empty(n, np.uint8)
        self._alarms: list[RaisedAlarm] = []
        self._diagnoses: list[ReportedDiagnosis] = []
        self._misfits: list[ReportedMisfit] = []
        self.samples = 0
        self.records: list[int] = []
        """First samples of the records."""
        self.counters: Counter[str] = Counter()
        """Sums of the device's counters over all records."""
        self.line_s = 0.0

    def begin_record(self) -> None:
        """Start a record with the next sample."""
        self.records.append(self.samples)

    def add(self, block: Block, answers: Answers) -> None:
        """Append the answered samples of a block: all of them, unless the run ends here."""
        answered = len(answers)
        to = slice(self.samples, self.samples + answered)
        self._codes[to] = block.codes[:answered]
        self._clipped[to] = block.clipped[:answered]
        self._flags[to] = answers.flags
        if answers.theta is not None:
            self._theta[to] = answers.theta
        if answers.innovation is not None:
            self._innovation[to] = answers.innovation
        if answers.statistic is not None:
            self._statistic[to] = answers.statistic
        shifted = answers.shifted(self.records[-1])
        self._alarms += shifted.alarms
        self._diagnoses += shifted.diagnoses
        self._misfits += shifted.misfits
        self.samples += answered

    def end_record(self, line_s: float, counters: Mapping[str, int]) -> None:
        """Add the line time and the device's counters of the record."""
        self.line_s += line_s
        self.counters.update(counters)

    def build(self, conditions: Conditions) -> Run:
        """Run of the samples so far."""
        return Run(
            conditions=conditions,
            codes=self._codes[: self.samples],
            clipped=self._clipped[: self.samples],
            theta=self._theta[: self.samples],
            innovation=self._innovation[: self.samples],
            statistic=self._statistic[: self.samples],
            flags=self._flags[: self.samples],
            **_reports(self._alarms, self._diagnoses, self._misfits),
        )


def _reports(
    alarms: Sequence[RaisedAlarm], diagnoses: Sequence[ReportedDiagnosis], misfits: Sequence[ReportedMisfit]
) -> dict[str, Any]:
    """Fields of a run that hold the alarms, diagnoses and misfits; those of nothing have a default."""
    found = {
        "alarm_index": np.array([alarm.index for alarm in alarms], dtype=np.int64),
        "alarm_kind": np.array([alarm.kind for alarm in alarms], dtype=np.uint8),
        "alarm_statistic": np.array([alarm.statistic for alarm in alarms], dtype=np.float32),
    }
    if diagnoses:
        found |= {
            "diagnosis_index": np.array([diagnosis.index for diagnosis in diagnoses], dtype=np.int64),
            "diagnosis_change": np.array([diagnosis.change for diagnosis in diagnoses], dtype=np.uint8),
            "diagnosis_onset": np.array([diagnosis.onset for diagnosis in diagnoses], dtype=np.int64),
            "diagnosis_extent": np.array([diagnosis.extent for diagnosis in diagnoses], dtype=np.float32),
        }
    if misfits:
        found |= {
            "misfit_index": np.array([misfit.index for misfit in misfits], dtype=np.int64),
            "misfit_cause": np.array([misfit.cause for misfit in misfits], dtype=np.uint8),
            "misfit_frequency": np.array([misfit.frequency for misfit in misfits], dtype=np.float32),
            "misfit_strength": np.array([misfit.strength for misfit in misfits], dtype=np.float32),
        }
    return found


def was_interrupted(run: Run) -> bool:
    """True if a signal ended the run."""
    return any(fault.startswith(_INTERRUPTED_BY) for fault in run.conditions.faults)


def raise_if_interrupted(run: Run) -> Run:
    """Return ``run`` if no signal ended it.

    :raises KeyboardInterrupt: a signal ended the run.
    """
    if was_interrupted(run):
        raise KeyboardInterrupt
    return run


@contextlib.contextmanager
def _pause_garbage_collection(pace: Pace | None) -> Iterator[None]:
    """Disable garbage collection in real time: with so many objects it would take longer than a message."""
    if pace is None or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class Bench:
    """Rig and device, joined to play scenarios.

    The device is one behind a link, configured and with its handshake done, as ``open_dut`` returns it; or one without
    messages (``direct_bench``). ``progress`` is called after each block with the samples done and the samples asked.
    ``real_time`` is the wall-clock time per machine time; None: lock-step, where no sample is late.
    """

    def __init__(
        self,
        rig: Rig,
        dut: Device,
        progress: Progress | None = None,
        *,
        real_time: float | None = None,
        time_limit_s: float | None = None,
        clock: Clock = time.monotonic,
        builder: Callable[[int, int, Datasheet], RunBuilder] | None = None,
    ) -> None:
        """Join ``rig`` and ``dut``.

        ``builder`` makes the collector of each run, by default a ``RunBuilder``; one that overrides ``add`` watches
        the run being played.

        ``time_limit_s`` is the longest duration of one play, on ``clock``. It bounds every wait for the device. The
        rig is not interrupted: the limit is checked after each of its blocks.
        """
        self.rig = rig
        self.dut = dut
        self._progress = progress
        self._real_time = real_time
        self._time_limit_s = math.inf if time_limit_s is None else time_limit_s
        self._clock = clock
        self._builder = builder or RunBuilder
        self._scenario: tuple[Scenario | None, Mapping[str, Any]] = (None, {})

    def play(self, scenario: Scenario, seed: int) -> Run:
        """Play ``scenario`` and collect the answers of the device, in lock-step or in real time.

        In real time, late messages are counted and make the run invalid. The emulated machine is computed in advance.

        A failure of rig, link or device after the first sample ends the run and does not raise. The Run holds the
        complete blocks until then, and ``conditions.faults`` names the failure. The time limit ends the run likewise;
        the Run then holds every answered sample.

        :raises DeviceError, LinkError, RigError: before the first sample.
        :raises ConfigurationError: real time does not fit the line.
        """
        until_s = self._clock() + self._time_limit_s
        performance = self.rig.perform(scenario, seed)
        pace, blocks = self._pace_blocks(performance)
        self.dut.suit(scenario.program.order)
        self.dut.prepare(performance.of_device, performance.sample_period_s)
        self.dut.start(pace)
        initial = self._initial_conditions(performance, scenario, seed)
        builder = self._builder(scenario.samples, len(scenario.program.channels), self.dut.datasheet)
        faults = tuple(self._collect_samples(blocks, pace, scenario.samples, builder, until_s))
        conditions = self._final_conditions(initial, performance.hindsight(), faults, builder)
        return builder.build(conditions)

    def _initial_conditions(self, performance: Performance, scenario: Scenario, seed: int) -> Conditions:
        """Conditions known before the first sample."""
        if self._scenario[0] is not scenario:  # runs share the table, which takes long to write
            self._scenario = scenario, scenario.as_table()
        return Conditions(
            seed=seed,
            samples_asked=scenario.samples,
            sample_period_s=performance.sample_period_s,
            time_scale=performance.time_scale,
            channels=performance.channels,
            segments=(),
            scenario=self._scenario[1],
            rig=self.rig.description(),
            dut=self.dut.description(),
            link=self.dut.link_name,
            line=self.dut.line,
            real_time=self._real_time or 0.0,
            program=scenario.program,
        )

    def _collect_samples(
        self, blocks: Iterable[Block], pace: Pace | None, samples: int, builder: RunBuilder, until_s: float
    ) -> list[str]:
        """Exchange the samples; return the failures that ended the exchange early or make it invalid."""
        faults = []
        try:
            with _pause_garbage_collection(pace), self._limit_waits(until_s):
                self._exchange(self._take_until(blocks, until_s), pace, samples, builder)
        except TimeLimitReached:
            limit = f"time limit of {self._time_limit_s:g} s"
            faults.append(f"{limit} reached after {builder.samples} of {samples} samples")
        except RigError as error:
            faults.append(str(error))
            with contextlib.suppress(DeviceError, LinkError):
                self.dut.recover()  # the device awaits samples, which would reach it in the next run
        except (DeviceError, LinkError) as error:
            faults.append(str(error))
        except KeyboardInterrupt as error:
            faults.append(f"{_INTERRUPTED_BY}{str(error) or 'SIGINT'}")
        if pace is not None and pace.overruns:
            faults.append(
                f"{pace.overruns} of {pace.messages} messages of samples overran: late, or the window was full"
            )
        return faults

    @contextlib.contextmanager
    def _limit_waits(self, until_s: float) -> Iterator[None]:
        """Bound every wait for the device by the time limit."""
        self.dut.limit(until_s - self._clock())
        try:
            yield
        finally:
            self.dut.limit(math.inf)

    def _take_until(self, blocks: Iterable[Block], until_s: float) -> Iterator[Block]:
        """Blocks until the time limit.

        :raises TimeLimitReached: the time limit has passed.
        """
        for block in blocks:
            if self._clock() >= until_s:
                raise TimeLimitReached("the time limit of the run is over")
            yield block

    def _final_conditions(
        self, initial: Conditions, known: Hindsight, faults: tuple[str, ...], builder: RunBuilder
    ) -> Conditions:
        """Conditions known after the last sample."""
        return dataclasses.replace(
            initial,
            channels={
                name: dataclasses.replace(channel, noise_lsb=known.noise_lsb[name])
                if name in known.noise_lsb
                else channel
                for name, channel in initial.channels.items()
            },
            segments=known.segments,
            faults=(*faults, *known.caveats),
            overloads=_overloads(known, builder.samples),
            records=tuple(builder.records) or (0,),
            line_s=builder.line_s,
            counters=builder.counters,
            link_counters=self.dut.link_counters,
        )

    def _pace_blocks(self, performance: Performance) -> tuple[Pace | None, Iterable[Block]]:
        """Pace of the samples (None in lock-step), and the blocks, which are computed in advance in real time."""
        if self._real_time is None:
            return None, performance.blocks
        pace = self.pace(performance.sample_period_s * self._real_time)
        return pace, list(performance.blocks)

    def pace(self, period_s: float) -> Pace:
        """Pace of a real-time run with ``period_s`` between samples; counts the overruns."""
        return self.dut.pace(period_s)

    def _exchange(self, blocks: Iterable[Block], pace: Pace | None, samples: int, builder: RunBuilder) -> None:
        """Exchange all records. Each is a run of its own for the device, which has already started the first."""
        for record, record_blocks in itertools.groupby(blocks, key=lambda block: block.record):
            if record:
                self.dut.start(pace)
            builder.begin_record()
            self._exchange_record(record_blocks, samples, builder)
            line_s = self.dut.line_s
            builder.end_record(line_s, self.dut.stop())

    def _exchange_record(self, blocks: Iterable[Block], samples: int, builder: RunBuilder) -> None:
        """Send the blocks of one record and collect their replies."""
        sent: deque[Block] = deque()
        start = builder.records[-1]

        def samples_of_record() -> Iterator[Samples]:
            for block in blocks:
                if len(block.codes):
                    sent.append(block)
                yield block.samples(start)

        for answers in self.dut.play(samples_of_record()):
            if not len(answers):
                continue
            builder.add(sent.popleft(), answers)
            if self._progress is not None:
                self._progress(builder.samples, samples)


def can_be_direct(rig: Rig, device: DeviceDescription) -> TypeGuard[EmulatorRig]:
    """True if a direct bench yields the runs of the device over its line.

    The rig must be emulated, and the line must not alter the samples.
    """
    return is_emulated(rig) and "blocks" in device.capabilities


class DirectBench(Bench):
    """Bench of an emulated rig and a device without messages."""

    def play_all(self, scenario: Scenario, seeds: Sequence[int]) -> list[Run]:
        """Runs of ``play`` with each seed, to the bit. Those of one block are computed together, in half of the time.

        :raises ConfigurationError, DeviceError, RigError: one of them would raise it, or have it as a fault.
        """
        if scenario.samples > DIRECT_BLOCK_SAMPLES:
            return [self.play(scenario, seed) for seed in seeds]
        performances = self.rig.perform_all(scenario, seeds)
        self.dut.suit(scenario.program.order)
        self.dut.prepare(performances[0].of_device, performances[0].sample_period_s)
        blocks = [next(each.blocks) for each in performances]
        played = list(zip(blocks, self.dut.play_records([block.samples() for block in blocks]), strict=True))
        common = self._common_conditions(performances[0], scenario, seeds[0], played[0])
        return [
            _run_of_block(
                dataclasses.replace(
                    common,
                    seed=seed,
                    overloads=_overloads(performance.hindsight(), scenario.samples),
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


_Played = tuple[Block, tuple[Answers, Mapping[str, int]]]
"""Block that is a whole run, with the answers to it and the counters of its record."""


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
        **_reports(answers.alarms, answers.diagnoses, answers.misfits),
    )


def _overloads(known: Hindsight, samples: int) -> dict[str, int]:
    """First sample with a lit overload lamp, by amplifier, in a run of so many samples."""
    return {amplifier: sample for amplifier, sample in known.lamps.items() if sample < samples}


def _retain_freed_memory() -> None:
    """Make glibc keep the arrays of a play for the next one; otherwise each play faults their pages in again.

    Its thresholds would grow by themselves, but not in a worker of Dask: they are fixed at 128 kB by the variable
    MALLOC_TRIM_THRESHOLD_, whatever its value, and Dask sets it.
    """
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_M_MMAP_THRESHOLD, _RETAINED_BYTES)
        mallopt(_M_TRIM_THRESHOLD, 2 * _RETAINED_BYTES)


def direct_bench(rig: EmulatorRig, device: DeviceDescription, *, alarms_only: bool = False) -> DirectBench:
    """Bench with the estimator in this process and whole blocks: the fastest way.

    If ``can_be_direct``, the runs are those over the line to the bit, without what needs messages.

    :param alarms_only: omit the estimates, which take a twentieth of the time: theta of the runs has no columns.
    :raises ConfigurationError: the estimator refuses its configuration.
    :raises LinkError: the library of the device was not built.
    """
    _retain_freed_memory()
    return DirectBench(rig.in_blocks(DIRECT_BLOCK_SAMPLES), device.direct(alarms_only=alarms_only))
