"""The bench: a rig, a link and a device on one table, and the one thing that is done there: play a scenario."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from harness.dut import Dut, Replies, Stretch
from harness.errors import DeviceError, LinkError, RigError
from harness.pace import Pace
from harness.rigs.rig import Block, Performance, Rig
from harness.run import CHANNELS, Conditions, Run, missing_to_device
from harness.scenario import Scenario

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

    def add(self, block: Block, reply: Replies) -> None:
        self.codes.append(block.codes)
        self.clipped.append(block.clipped)
        self.replies.append(reply)
        self.samples += len(block.codes)

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
    """Joins a rig and a device; the device is configured and its handshake is done."""

    def __init__(self, rig: Rig, dut: Dut, progress: Progress | None = None, *, real_time: float | None = None) -> None:
        """With ``real_time`` the samples go out as the machine takes them, in time stretched by that factor."""
        self.rig = rig
        self.dut = dut
        self._progress = progress
        self._real_time = real_time

    def play(self, scenario: Scenario, seed: int) -> Run:
        """Play ``scenario`` and collect what the device answers: in lock-step, where nothing is late, or in real time.

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
        conditions = Conditions(
            seed=seed,
            samples_asked=scenario.samples,
            sample_period_s=performance.sample_period_s,
            time_scale=performance.time_scale,
            channels=performance.channels,
            segments=performance.segments,
            scenario=scenario.as_table(),
            rig=self.rig.description(),
            dut=self.dut.description(),
            link=self.dut.link_name,
            line=self.dut.line,
            faults=scenario.caveats,
            real_time=self._real_time or 0.0,
        )
        collected = _Collected()
        try:
            with _undisturbed(pace):
                self._exchange(blocks, scenario.samples, collected)
            conditions = dataclasses.replace(conditions, line_s=self.dut.line_s, counters=self.dut.stop())
        except (DeviceError, LinkError, RigError) as error:
            conditions = dataclasses.replace(conditions, faults=(*conditions.faults, str(error)))
        except KeyboardInterrupt:
            conditions = dataclasses.replace(conditions, faults=(*conditions.faults, INTERRUPTED_BY_USER))
        if pace is not None and pace.overruns:
            late = f"{pace.overruns} of {pace.messages} messages of samples overran: late, or the window was full"
            conditions = dataclasses.replace(conditions, faults=(*conditions.faults, late))
        lit = {amplifier: sample for amplifier, sample in performance.lamps().items() if sample < collected.samples}
        conditions = dataclasses.replace(conditions, overloads=lit, link_counters=self.dut.link_counters)
        return collected.run(conditions, self.dut.parameters)

    def _paced(self, performance: Performance) -> tuple[Pace | None, Iterable[Block]]:
        """The pace of the samples, and what to send."""
        if self._real_time is None:
            return None, performance.blocks
        pace = self.pace(performance.sample_period_s * self._real_time)
        return pace, list(performance.blocks)

    def pace(self, period_s: float) -> Pace:
        """Of a run in real time; counts its overruns."""
        return self.dut.pace(period_s)

    def _exchange(self, blocks: Iterable[Block], samples: int, collected: _Collected) -> None:
        sent: deque[Block] = deque()

        def stretches() -> Iterator[Stretch]:
            for block in blocks:
                sent.append(block)
                yield (
                    block.first,
                    block.codes[:, _FORCE],
                    block.codes[:, _DISPLACEMENT],
                    missing_to_device(block.clipped),
                )

        for reply in self.dut.play(stretches()):
            collected.add(sent.popleft(), reply)
            if self._progress is not None:
                self._progress(collected.samples, samples)
