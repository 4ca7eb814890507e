"""The bench: a rig, a link and a device on one table, and the one thing that is done there: play a scenario."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from harness.dut import Dut, Replies
from harness.errors import DeviceError, LinkError, RigError
from harness.rig import Block, Rig
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


class Bench:
    """Joins a rig and a device; the device is configured and its handshake is done."""

    def __init__(self, rig: Rig, dut: Dut, progress: Progress | None = None) -> None:
        self.rig = rig
        self.dut = dut
        self._progress = progress

    def play(self, scenario: Scenario, seed: int) -> Run:
        """Play ``scenario`` and collect what the device answers, in lock-step: nothing is lost, nothing is late.

        A rig, link or device that fails once samples flow ends the run, it does not raise: the Run holds all complete
        blocks until then, and its conditions say what failed.

        :raises DeviceError, LinkError, RigError: before the first sample.
        """
        performance = self.rig.perform(scenario, seed)
        self.dut.set_force_zero(performance.channels["force"].zero)
        self.dut.start()
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
            faults=scenario.caveats,
        )
        collected = _Collected()
        try:
            self._exchange(performance.blocks, scenario.samples, collected)
            conditions = dataclasses.replace(conditions, counters=self.dut.stop())
        except (DeviceError, LinkError, RigError) as error:
            conditions = dataclasses.replace(conditions, faults=(*conditions.faults, str(error)))
        except KeyboardInterrupt:
            conditions = dataclasses.replace(conditions, faults=(*conditions.faults, INTERRUPTED_BY_USER))
        lit = {amplifier: sample for amplifier, sample in performance.lamps().items() if sample < collected.samples}
        return collected.run(dataclasses.replace(conditions, overloads=lit), self.dut.parameters)

    def _exchange(self, blocks: Iterable[Block], samples: int, collected: _Collected) -> None:
        for block in blocks:
            codes = block.codes[:, _FORCE], block.codes[:, _DISPLACEMENT]
            reply = self.dut.feed(block.first, *codes, missing_to_device(block.clipped))
            collected.add(block, reply)
            if self._progress is not None:
                self._progress(collected.samples, samples)
