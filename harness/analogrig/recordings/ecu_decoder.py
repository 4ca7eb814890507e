"""Decoder of captured traffic of an ECU with messages of its own: frames to the runs of the device."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.answers import Answers
from analogrig.devices.can_dbc import CanDbcDevice
from analogrig.devices.ecu_answers import MISSING, EcuAnswers
from analogrig.devices.ecu_messages import EcuMessages, SamplePart
from analogrig.errors import DeviceError
from analogrig.recordings.captured import CapturedRun
from analogrig.run import LOST, Channel

if TYPE_CHECKING:
    import can


class EcuRun(CapturedRun):
    """Run of an ECU, from its [start] to the next, or all samples of the log."""

    def __init__(self, description: CanDbcDevice, messages: EcuMessages) -> None:
        super().__init__()
        self._description = description
        self.collected = EcuAnswers(description.name, description.receive, messages)
        self.next_index = 0
        """Index of the next sample if none is missing from the log."""

    @property
    def extent(self) -> int:
        return self.next_index

    def device(self, path: Path) -> Mapping[str, Any]:  # noqa: ARG002
        return {**self._description.as_table(), "datasheet": self._description.known_datasheet().as_table()}

    def answers(self, path: Path) -> Answers:  # noqa: ARG002
        self.collected.end()
        return self.collected.rows.take(self.extent, self.extent)

    def capture_faults(self, path: Path) -> Iterator[str]:  # noqa: ARG002
        """No reasons: such a device has no counters of its own, and its data sheet lists what cannot be noticed."""
        return iter(())


class EcuDecoder:
    """Decoder of a capture: assembles samples from the harness's frames, and their answers from the device's."""

    def __init__(
        self, description: CanDbcDevice, channels: Mapping[str, Channel], frames: Iterable[can.Message], *, most_n: int
    ) -> None:
        """Decode ``frames``; a run ends after more than ``most_n`` samples."""
        self._description = description
        self._messages = description.messages()
        self._decode = self._messages.decoder(channels)
        self._most_n = most_n
        self.runs: list[EcuRun] = []
        self._traffic: Counter[str] = Counter()
        self._parts: dict[str, SamplePart] = {}
        """Parts of the sample that is being sent, by message."""
        self._last_counter: int | None = None
        for frame in frames:
            self._take(frame)
        self._end_sample()

    @property
    def line(self) -> Counter[str]:
        return sum((run.collected.counted for run in self.runs), self._traffic.copy())

    def _take(self, frame: can.Message) -> None:
        identifier = frame.arbitration_id, frame.is_extended_id
        if frame.is_error_frame:
            self._traffic["error_frames"] += 1
        elif frame.is_remote_frame or identifier not in self._messages.own | self._messages.of_device:
            self._traffic["frames_foreign"] += 1
        elif self._messages.is_start(frame):
            self._end_sample()
            self._begin_run()
        elif (part := self._messages.sample_part(frame)) is not None:
            self._take_part(part)
        elif (answer := self._messages.answer(frame)) is not None:
            if self.runs:
                try:
                    self.runs[-1].collected.add(answer)
                except DeviceError as error:
                    self._add_fault(str(error))
        elif self._messages.is_of_sample(frame) or self._messages.is_of_answer(frame):
            self._traffic["frames_dropped"] += 1

    def _add_fault(self, fault: str) -> None:
        """Record the first fault of a run."""
        if not self.runs[-1].faults:
            self.runs[-1].faults.append(fault)

    def _begin_run(self) -> EcuRun:
        if self.runs and not self.runs[-1].samples:
            self.runs.pop()
        self.runs.append(EcuRun(self._description, self._messages))
        self._last_counter = None
        return self.runs[-1]

    # ---- samples

    def _take_part(self, part: SamplePart) -> None:
        order = self._messages.order
        if part.message == order[0] or part.message in self._parts:
            self._end_sample()
        self._parts[part.message] = part
        if part.message == order[-1]:
            self._end_sample()

    def _end_sample(self) -> None:
        """Enter the sample whose parts have come, if any."""
        parts, self._parts = self._parts, {}
        if not parts:
            return
        run = self.runs[-1] if self.runs else self._begin_run()
        counters = {part.counter for part in parts.values() if part.counter is not None}
        index = self._index(run, min(counters)) if counters else run.next_index
        if index < run.next_index:
            self._traffic["samples_repeated"] += 1
            return
        run.collected.end()
        values: dict[str, float] = {}
        for part in parts.values():
            values |= part.values
        is_whole = len(parts) == len(self._messages.order) and len(counters) < 2
        sample = self._decode(values) if is_whole else None
        for lacking in range(run.next_index, min(index, self._most_n)):
            run.collected.skip(lacking, LOST | MISSING)
        run.next_index = index + 1
        if run.next_index > self._most_n:
            return
        if sample is None:
            self._traffic["samples_lacking"] += 1
            run.collected.skip(index, LOST | MISSING)
            return
        u, y, valid = sample
        run.samples[index] = (u, y, not valid)
        run.collected.begin(index, missing=not valid)

    def _index(self, run: EcuRun, counter: int) -> int:
        """Index of the sample with this counter: the next one that has it, or the last if it is repeated."""
        modulus = self._messages.sample_modulus or 1
        before, self._last_counter = self._last_counter, counter
        if before is None:
            return counter
        step = (counter - before) % modulus
        return run.next_index - 1 + step
