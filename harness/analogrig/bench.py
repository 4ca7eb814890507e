"""The bench: a rig, a link and a device on one table, and the one thing that is done there: play a scenario."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import itertools
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import DeviceError, LinkError, RigError
from analogrig.protocol.dut import Dut, Replies, Stretch
from analogrig.protocol.pace import Pace
from analogrig.rigs.rig import Block, Hindsight, Performance, Rig
from analogrig.run import CHANNELS, Conditions, Run, missing_to_device
from analogrig.scenario import Scenario

T = TypeVar("T", bound=np.generic)

Progress = Callable[[int, int], None]
"""Called after each block with the samples done and the samples asked."""

INTERRUPTED_BY_USER = "interrupted by the user"

_FORCE, _DISPLACEMENT = CHANNELS.index("force"), CHANNELS.index("displacement")


@dataclass
class _Collected:
    """What has come from rig and device so far, block by block; the volts are not kept."""

    codes: list[NDArray[np.uint16]] = field(default_factory=list)
    clipped: list[NDArray[np.bool_]] = field(default_factory=list)
    replies: list[Replies] = field(default_factory=list)
    samples: int = 0
    records: list[int] = field(default_factory=list)
    """Their first samples."""
    counters: Counter[str] = field(default_factory=Counter)
    """The device's, of all records."""
    line_s: float = 0.0

    def begin_record(self) -> None:
        self.records.append(self.samples)

    def add(self, block: Block, reply: Replies) -> None:
        self.codes.append(block.codes)
        self.clipped.append(block.clipped)
        self.replies.append(_since(self.records[-1], reply))
        self.samples += len(block.codes)

    def end_record(self, line_s: float, counters: Mapping[str, int]) -> None:
        self.line_s += line_s
        self.counters.update(counters)

    def run(self, conditions: Conditions, parameters: int) -> Run:
        alarms = [alarm for reply in self.replies for alarm in reply.alarms]
        diagnoses = [diagnosis for reply in self.replies for diagnosis in reply.diagnoses]
        return Run(
            conditions=conditions,
            codes=_stacked(self.codes, (0, len(CHANNELS)), np.uint16),
            clipped=_stacked(self.clipped, (0, len(CHANNELS)), np.bool_),
            theta=_stacked([reply.theta for reply in self.replies], (0, parameters), np.float32),
            innovation=_stacked([reply.innovation for reply in self.replies], (0,), np.float32),
            statistic=_stacked([reply.statistic for reply in self.replies], (0,), np.float32),
            flags=_stacked([reply.flags for reply in self.replies], (0,), np.uint8),
            alarm_index=np.array([alarm.index for alarm in alarms], dtype=np.int64),
            alarm_kind=np.array([alarm.kind for alarm in alarms], dtype=np.uint8),
            alarm_statistic=np.array([alarm.statistic for alarm in alarms], dtype=np.float32),
            diagnosis_index=np.array([diagnosis.index for diagnosis in diagnoses], dtype=np.int64),
            diagnosis_change=np.array([diagnosis.change for diagnosis in diagnoses], dtype=np.uint8),
            diagnosis_onset=np.array([diagnosis.onset for diagnosis in diagnoses], dtype=np.int64),
            diagnosis_extent=np.array([diagnosis.extent for diagnosis in diagnoses], dtype=np.float32),
        )


def _since(first: int, reply: Replies) -> Replies:
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


def _stacked(parts: Sequence[NDArray[T]], empty_shape: tuple[int, ...], dtype: type[T]) -> NDArray[T]:
    return np.concatenate(parts) if parts else np.zeros(empty_shape, dtype=dtype)


@contextlib.contextmanager
def _undisturbed(pace: Pace | None) -> Iterator[None]:
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

    def __init__(self, rig: Rig, dut: Dut, progress: Progress | None = None, *, real_time: float | None = None) -> None:
        """With ``real_time`` the samples go out as the machine takes them, in time stretched by that factor."""
        self.rig = rig
        self.dut = dut
        self._progress = progress
        self._real_time = real_time

    def play(self, scenario: Scenario, seed: int) -> Run:
        """Play ``scenario`` and collect the answers of the device, in lock-step or in real time.

        In real time the messages of samples that are late are counted, and make the run invalid. What the emulated
        machine does is worked out before.

        A rig, link or device that fails once samples flow ends the run, it does not raise: the Run holds all complete
        blocks until then, and its conditions say what failed.

        :raises DeviceError, LinkError, RigError: before the first sample.
        :raises ConfigurationError: real time does not fit the line.
        """
        performance = self.rig.perform(scenario, seed)
        pace, blocks = self._paced(performance)
        self.dut.set_force_zero(performance.channels["force"].zero)
        self.dut.start(pace)
        begun = self._begun(performance, scenario, seed)
        collected = _Collected()
        faults = (*scenario.caveats, *self._failures(blocks, pace, scenario.samples, collected))
        conditions = self._concluded(begun, performance.hindsight(), faults, collected)
        return collected.run(conditions, self.dut.parameters)

    def _begun(self, performance: Performance, scenario: Scenario, seed: int) -> Conditions:
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

    def _failures(self, blocks: Iterable[Block], pace: Pace | None, samples: int, collected: _Collected) -> list[str]:
        """Exchanges the samples, and says what kept it from doing so to the end."""
        faults = []
        try:
            with _undisturbed(pace):
                self._exchange(blocks, pace, samples, collected)
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

    def _concluded(
        self, begun: Conditions, known: Hindsight, faults: tuple[str, ...], collected: _Collected
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
            overloads={amplifier: sample for amplifier, sample in known.lamps.items() if sample < collected.samples},
            records=tuple(collected.records) or (0,),
            line_s=collected.line_s,
            counters=collected.counters,
            link_counters=self.dut.link_counters,
        )

    def _paced(self, performance: Performance) -> tuple[Pace | None, Iterable[Block]]:
        """The pace of the samples, and what to send."""
        if self._real_time is None:
            return None, performance.blocks
        pace = self.pace(performance.sample_period_s * self._real_time)
        return pace, list(performance.blocks)

    def pace(self, period_s: float) -> Pace:
        """Of a run in real time; counts its overruns."""
        return self.dut.pace(period_s)

    def _exchange(self, blocks: Iterable[Block], pace: Pace | None, samples: int, collected: _Collected) -> None:
        """One record after the other; to the device each is a run of its own, the first of which has begun."""
        for record, its_blocks in itertools.groupby(blocks, key=lambda block: block.record):
            if record:
                self.dut.start(pace)
            collected.begin_record()
            self._exchange_record(its_blocks, samples, collected)
            line_s = self.dut.line_s
            collected.end_record(line_s, self.dut.stop())

    def _exchange_record(self, blocks: Iterable[Block], samples: int, collected: _Collected) -> None:
        sent: deque[Block] = deque()
        start = collected.records[-1]

        def stretches() -> Iterator[Stretch]:
            for block in blocks:
                sent.append(block)
                yield (
                    block.first - start,
                    block.codes[:, _FORCE],
                    block.codes[:, _DISPLACEMENT],
                    missing_to_device(block.clipped),
                )

        for reply in self.dut.play(stretches()):
            collected.add(sent.popleft(), reply)
            if self._progress is not None:
                self._progress(collected.samples, samples)
