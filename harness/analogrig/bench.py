"""The bench: a rig, a link and a device on one table, and the one thing that is done there: play a scenario."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import itertools
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np

from analogrig.devices.dut import Dut, Stretch
from analogrig.errors import DeviceError, LinkError, RigError, TimeLimitReached
from analogrig.links.wire import Clock
from analogrig.protocol.exchange import RaisedAlarm, Replies, StatedDiagnosis
from analogrig.protocol.pace import Pace
from analogrig.rigs.rig import Block, Hindsight, Performance, Rig
from analogrig.run import CHANNELS, Conditions, Run, missing_samples
from analogrig.scenario import Scenario

Progress = Callable[[int, int], None]
"""Called after each block with the samples done and the samples asked."""

INTERRUPTED_BY_USER = "interrupted by the user"

_FORCE, _DISPLACEMENT = CHANNELS.index("force"), CHANNELS.index("displacement")


class _RunBuilder:
    """Samples and answers of one run. A Run refers to these very arrays: nothing is kept twice.

    The arrays have room for all samples that were asked for. Memory that is never written costs nothing.
    """

    def __init__(self, samples_asked: int, parameters: int) -> None:
        self._codes = np.empty((samples_asked, len(CHANNELS)), np.uint16)
        self._clipped = np.empty((samples_asked, len(CHANNELS)), np.bool_)
        self._theta = np.empty((samples_asked, parameters), np.float32)
        self._innovation = np.empty(samples_asked, np.float32)
        self._statistic = np.empty(samples_asked, np.float32)
        self._flags = np.empty(samples_asked, np.uint8)
        self._alarms: list[RaisedAlarm] = []
        self._diagnoses: list[StatedDiagnosis] = []
        self.samples = 0
        self.records: list[int] = []
        """Their first samples."""
        self.counters: Counter[str] = Counter()
        """The device's, of all records."""
        self.line_s = 0.0

    def begin_record(self) -> None:
        self.records.append(self.samples)

    def add(self, block: Block, reply: Replies) -> None:
        """Keep the samples of a block that were answered: all, unless the run ends here."""
        answered = len(reply.flags)
        to = slice(self.samples, self.samples + answered)
        self._codes[to] = block.codes[:answered]
        self._clipped[to] = block.clipped[:answered]
        self._theta[to], self._innovation[to] = reply.theta, reply.innovation
        self._statistic[to], self._flags[to] = reply.statistic, reply.flags
        shifted = _shift_replies(self.records[-1], reply)
        self._alarms += shifted.alarms
        self._diagnoses += shifted.diagnoses
        self.samples += answered

    def end_record(self, line_s: float, counters: Mapping[str, int]) -> None:
        self.line_s += line_s
        self.counters.update(counters)

    def build(self, conditions: Conditions) -> Run:
        alarms, diagnoses = self._alarms, self._diagnoses
        return Run(
            conditions=conditions,
            codes=self._codes[: self.samples],
            clipped=self._clipped[: self.samples],
            theta=self._theta[: self.samples],
            innovation=self._innovation[: self.samples],
            statistic=self._statistic[: self.samples],
            flags=self._flags[: self.samples],
            alarm_index=np.array([alarm.index for alarm in alarms], dtype=np.int64),
            alarm_kind=np.array([alarm.kind for alarm in alarms], dtype=np.uint8),
            alarm_statistic=np.array([alarm.statistic for alarm in alarms], dtype=np.float32),
            diagnosis_index=np.array([diagnosis.index for diagnosis in diagnoses], dtype=np.int64),
            diagnosis_change=np.array([diagnosis.change for diagnosis in diagnoses], dtype=np.uint8),
            diagnosis_onset=np.array([diagnosis.onset for diagnosis in diagnoses], dtype=np.int64),
            diagnosis_extent=np.array([diagnosis.extent for diagnosis in diagnoses], dtype=np.float32),
        )


def _shift_replies(first: int, reply: Replies) -> Replies:
    """What the device said of a record that begins with the sample ``first``, which is 0 to the device."""
    if not first:
        return reply
    return dataclasses.replace(
        reply,
        alarms=tuple(dataclasses.replace(alarm, index=first + alarm.index) for alarm in reply.alarms),
        diagnoses=tuple(
            dataclasses.replace(each, index=first + each.index, onset=first + each.onset) for each in reply.diagnoses
        ),
    )


def raise_if_interrupted(run: Run) -> Run:
    """Return the run, for a caller to whom a part of it is of no use.

    :raises KeyboardInterrupt: the user interrupted it.
    """
    if INTERRUPTED_BY_USER in run.conditions.faults:
        raise KeyboardInterrupt
    return run


@contextlib.contextmanager
def _pause_garbage_collection(pace: Pace | None) -> Iterator[None]:
    """In real time the collector of garbage waits: among as many answers it takes longer than a message lasts."""
    if pace is None or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class Bench:
    """A rig and a device, joined to play scenarios.

    The device is configured and its handshake is done, as ``open_dut`` returns it. ``progress`` is called after each
    block with the samples done and the samples asked. ``real_time`` stretches the time of the machine to that of the
    wall clock by this factor; None: lock-step, where no sample is late.
    """

    def __init__(
        self,
        rig: Rig,
        dut: Dut,
        progress: Progress | None = None,
        *,
        real_time: float | None = None,
        time_limit_s: float | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        """With ``real_time`` the samples go out as the machine takes them, in time stretched by that factor.

        ``time_limit_s`` is the longest time of one play, on ``clock``. It bounds every wait for the device. A rig is
        not interrupted: the limit is checked after each block of samples that it gives.
        """
        self.rig = rig
        self.dut = dut
        self._progress = progress
        self._real_time = real_time
        self._time_limit_s = math.inf if time_limit_s is None else time_limit_s
        self._clock = clock

    def play(self, scenario: Scenario, seed: int) -> Run:
        """Play ``scenario`` and collect the answers of the device, in lock-step or in real time.

        In real time the messages of samples that are late are counted, and make the run invalid. What the emulated
        machine does is worked out before.

        A rig, link or device that fails once samples flow ends the run, it does not raise: the Run holds all complete
        blocks until then, and its conditions say what failed. The time limit ends the run likewise, and the Run holds
        every sample that was answered until then.

        :raises DeviceError, LinkError, RigError: before the first sample.
        :raises ConfigurationError: real time does not fit the line.
        """
        until_s = self._clock() + self._time_limit_s
        performance = self.rig.perform(scenario, seed)
        pace, blocks = self._pace_blocks(performance)
        self.dut.set_force_zero(performance.channels["force"].zero)
        self.dut.start(pace)
        begun = self._initial_conditions(performance, scenario, seed)
        builder = _RunBuilder(scenario.samples, self.dut.parameters)
        faults = (*scenario.caveats, *self._collect_samples(blocks, pace, scenario.samples, builder, until_s))
        conditions = self._final_conditions(begun, performance.hindsight(), faults, builder)
        return builder.build(conditions)

    def _initial_conditions(self, performance: Performance, scenario: Scenario, seed: int) -> Conditions:
        """What is known before the first sample."""
        return Conditions(
            seed=seed,
            samples_asked=scenario.samples,
            sample_period_s=performance.sample_period_s,
            time_scale=performance.time_scale,
            channels=performance.channels,
            segments=(),
            scenario=scenario.as_table(),
            rig=self.rig.description(),
            dut=self.dut.description(),
            link=self.dut.link_name,
            line=self.dut.line,
            real_time=self._real_time or 0.0,
        )

    def _collect_samples(
        self, blocks: Iterable[Block], pace: Pace | None, samples: int, builder: _RunBuilder, until_s: float
    ) -> list[str]:
        """Exchanges the samples, and says what kept it from doing so to the end."""
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
                self.dut.handshake()  # it waits for samples: nothing of this run may reach the next one
        except (DeviceError, LinkError) as error:
            faults.append(str(error))
        except KeyboardInterrupt:
            faults.append(INTERRUPTED_BY_USER)
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
        """The blocks until the time limit.

        :raises TimeLimitReached: it is over.
        """
        for block in blocks:
            if self._clock() >= until_s:
                raise TimeLimitReached("the time limit of the run is over")
            yield block

    def _final_conditions(
        self, begun: Conditions, known: Hindsight, faults: tuple[str, ...], builder: _RunBuilder
    ) -> Conditions:
        """What is known after the last sample."""
        return dataclasses.replace(
            begun,
            channels={
                name: dataclasses.replace(channel, noise_lsb=known.noise_lsb.get(name, channel.noise_lsb))
                for name, channel in begun.channels.items()
            },
            segments=known.segments,
            faults=(*faults, *known.caveats),
            overloads={amplifier: sample for amplifier, sample in known.lamps.items() if sample < builder.samples},
            records=tuple(builder.records) or (0,),
            line_s=builder.line_s,
            counters=builder.counters,
            link_counters=self.dut.link_counters,
        )

    def _pace_blocks(self, performance: Performance) -> tuple[Pace | None, Iterable[Block]]:
        """The pace of the samples, and what to send."""
        if self._real_time is None:
            return None, performance.blocks
        pace = self.pace(performance.sample_period_s * self._real_time)
        return pace, list(performance.blocks)

    def pace(self, period_s: float) -> Pace:
        """Of a run in real time; counts its overruns."""
        return self.dut.pace(period_s)

    def _exchange(self, blocks: Iterable[Block], pace: Pace | None, samples: int, builder: _RunBuilder) -> None:
        """One record after the other; to the device each is a run of its own, the first of which has begun."""
        for record, its_blocks in itertools.groupby(blocks, key=lambda block: block.record):
            if record:
                self.dut.start(pace)
            builder.begin_record()
            self._exchange_record(its_blocks, samples, builder)
            line_s = self.dut.line_s
            builder.end_record(line_s, self.dut.stop())

    def _exchange_record(self, blocks: Iterable[Block], samples: int, builder: _RunBuilder) -> None:
        sent: deque[Block] = deque()
        start = builder.records[-1]

        def stretches() -> Iterator[Stretch]:
            for block in blocks:
                sent.append(block)
                yield (
                    block.first - start,
                    block.codes[:, _FORCE],
                    block.codes[:, _DISPLACEMENT],
                    missing_samples(block.clipped),
                )

        for reply in self.dut.play(stretches()):
            builder.add(sent.popleft(), reply)
            if self._progress is not None:
                self._progress(builder.samples, samples)
