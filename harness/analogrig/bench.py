"""Bench: joins a rig and a device, and plays scenarios. The one route from a circuit to a Run."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import itertools
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from analogrig.answers import NO_EVENTS, AlarmLevel, Answers, Events, Samples
from analogrig.datasheet import Datasheet
from analogrig.devices.device import Device
from analogrig.devices.pace import Pace
from analogrig.errors import DeviceError, LinkError, RigError, TimeLimitReached
from analogrig.links.link import Clock
from analogrig.rigs.rig import Block, Hindsight, Performance, Rig
from analogrig.run import Conditions, Run
from analogrig.scenario import Scenario, check_seed

__all__ = ["Progress", "RunBuilder", "raise_if_interrupted"]
"""Names for packages beside the core."""

Progress = Callable[[int, int], None]
"""Callback after each block, with the number of samples done and of samples asked."""

_INTERRUPTED_BY = "interrupted by "
"""Start of the fault of an interrupted run; the name of the signal follows."""


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
        self._events: dict[str, list[Events]] = {name: [none] for name, none in NO_EVENTS.items()}
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
        for name, found in self._events.items():
            found.append(getattr(shifted, name))
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
            **reports({name: np.concatenate(found) for name, found in self._events.items()}),
        )


def reports(events: Mapping[str, Events]) -> dict[str, Any]:
    """Fields of a run that hold the alarms, diagnoses and misfits, each of which is empty by default."""
    prefixes = {"alarms": "alarm", "diagnoses": "diagnosis", "misfits": "misfit"}
    return {
        f"{prefixes[name]}_{key}": np.ascontiguousarray(found[key])
        for name, found in events.items()
        if len(found)
        for key in found.dtype.names
    }


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
    messages (``analogrig.campaigns.together``). ``progress`` is called after each block with the samples done and the
    samples asked. ``real_time`` is the wall-clock time per machine time; None: lock-step, where no sample is late.
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

    def play(self, scenario: Scenario | str, seed: int) -> Run:
        """Play a scenario or one of this name, and collect the answers of the device, in lock-step or in real time.

        In real time, late messages are counted and make the run invalid. The emulated machine is computed in advance.

        A failure of rig, link or device after the first sample ends the run and does not raise. The Run holds the
        complete blocks until then, and ``conditions.faults`` names the failure. The time limit ends the run likewise;
        the Run then holds every answered sample.

        :raises DeviceError, LinkError, RigError: before the first sample.
        :raises ConfigurationError: real time does not fit the line, there is no such scenario, or the seed is no whole
            number from 0 to 2^63 - 1.
        """
        seed = check_seed(seed)
        if not isinstance(scenario, Scenario):
            scenario = Scenario.load(scenario)
        until_s = self._clock() + self._time_limit_s
        performance = self.rig.perform(scenario, seed)
        pace = None if self._real_time is None else self.pace(performance.sample_period_s * self._real_time)
        blocks = performance.blocks if pace is None else list(performance.blocks)
        self.dut.suit(scenario.poles(performance.sample_period_s * performance.time_scale))
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
            overloads=overloads_until(known, builder.samples),
            records=tuple(builder.records) or (0,),
            line_s=builder.line_s,
            losses=self.dut.losses,
            remarks=self.dut.remarks,
            counters=builder.counters,
            link_counters=self.dut.link_counters,
        )

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

        level = AlarmLevel()
        for answers in self.dut.play(samples_of_record()):
            if not len(answers):
                continue
            block = sent.popleft()
            events = level.rises(answers, block.first - start) if self.dut.holds_alarms else answers
            builder.add(block, events)
            if self._progress is not None:
                self._progress(builder.samples, samples)


def overloads_until(known: Hindsight, samples: int) -> dict[str, int]:
    """First sample with a lit overload lamp, by amplifier, in a run of so many samples."""
    return {amplifier: sample for amplifier, sample in known.lamps.items() if sample < samples}
