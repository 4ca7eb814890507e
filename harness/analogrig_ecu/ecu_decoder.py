"""Decoder of captured traffic of an ECU with messages of its own: frames to the runs of the device."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig import DeviceError
from analogrig.answers import AlarmLevel
from analogrig.devices import LOST, Answers, CapturedRun
from analogrig.links.link import Identifier
from analogrig.run import Channel
from analogrig_ecu.ecu_device import MISSING, EcuAnswers
from analogrig_ecu.ecu_messages import EcuMessages, SamplePart

if TYPE_CHECKING:
    import can

    from analogrig_ecu.can_dbc import CanDbcDevice


class EcuRun(CapturedRun):
    """Run of an ECU, from its [start] to the next, or all samples of the log."""

    def __init__(self, description: CanDbcDevice, messages: EcuMessages) -> None:
        super().__init__()
        self._description, self._messages = description, messages
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
        answers = self.collected.rows.take(self.extent, self.extent)
        return answers if self._description.alarm_is == "event" else AlarmLevel().rises(answers, 0)

    def capture_faults(self, path: Path) -> Iterator[str]:  # noqa: ARG002
        """Messages that never came. Such a device has no counters; its data sheet lists what cannot be noticed."""
        return iter(self._messages.never_came)


class EcuDecoder:
    """Decoder of a capture: assembles samples from the harness's frames, and their answers from the device's."""

    def __init__(
        self, description: CanDbcDevice, channels: Mapping[str, Channel], frames: Iterable[can.Message], *, most_n: int
    ) -> None:
        """Decode ``frames``; a run ends after more than ``most_n`` samples."""
        self._description = description
        self._messages = description.messages()
        self._decode = self._messages.decoder(channels)
        self._missing = (channels["u"].codes // 2, channels["y"].codes // 2)
        """Codes of a missing sample, which stand for nothing."""
        self._most_n = most_n
        self.runs: list[EcuRun] = []
        self._traffic: Counter[str] = Counter()
        self._parts: dict[str, SamplePart] = {}
        """Parts of the sample that is being sent, by message."""
        self._place = ""
        self.causes = self._messages.causes
        self.causes.place = lambda: self._place
        for number, frame in enumerate(frames, 1):
            self._place = f"frame {number} at {frame.timestamp:.6f} s"
            self._take(frame)
        self._end_sample()
        for run in self.runs:
            run.collected.end()
        self._messages.conclude(in_log=True)

    @property
    def known(self) -> Collection[Identifier]:
        return self._messages.own | self._messages.of_device

    @property
    def carriers(self) -> Mapping[str, str]:
        return self._messages.carriers

    @property
    def line(self) -> Counter[str]:
        return sum((run.collected.counted for run in self.runs), self._traffic.copy())

    def _take(self, frame: can.Message) -> None:
        if self._messages.traffic.take(frame) is None:
            self._traffic["error_frames" if frame.is_error_frame else "frames_foreign"] += 1
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
                    self.runs[-1].faults = self.runs[-1].faults or [str(error)]  # the first of a run
        elif self._messages.is_of_sample(frame) or self._messages.is_of_answer(frame):
            self._traffic["frames_dropped"] += 1

    def _begin_run(self) -> EcuRun:
        if self.runs and not self.runs[-1].samples:
            self.runs.pop()
        self.runs.append(EcuRun(self._description, self._messages))
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
        index, is_agreed = self._index(run, parts)
        if index < run.next_index:
            self._traffic["samples_repeated"] += 1
            self.causes.add(
                "the same sample came again, with the same counters", noun="sample", place=f"sample {index}"
            )
            return
        run.collected.end()
        place = f"sample {index}"
        codes = self._codes(parts, place) if is_agreed else None
        self._skip_missing(run, index)
        run.next_index = index + 1
        if run.next_index > self._most_n:
            return
        if codes is None:
            self._traffic["samples_missing"] += 1
            run.collected.skip(index, LOST | MISSING)
            return
        is_missing = any(part.is_missing for part in parts.values())
        run.samples[index] = (*codes, is_missing)
        run.collected.begin(index, missing=is_missing)

    def _codes(self, parts: Mapping[str, SamplePart], place: str) -> tuple[int, int] | None:
        """Codes of u and y in the parts of a sample; None if one is absent or out of range."""
        if gone := [name for name in self._messages.order if name not in parts]:
            self.causes.add(f"a sample without {', '.join(gone)}", noun="sample", place=place, loses=True)
            return None
        values: dict[str, float] = {}
        for part in parts.values():
            values |= part.values
        if any(part.is_missing for part in parts.values()):
            return self._decode(values, "") or self._missing
        return self._decode(values, place)

    def _skip_missing(self, run: EcuRun, index: int) -> None:
        """Enter the samples before ``index`` that the log lacks."""
        missing = range(run.next_index, min(index, self._most_n))
        for k in missing:
            run.collected.skip(k, LOST | MISSING)
        if missing:
            text, place = "by the counters, samples are not in the log", f"sample {missing[0]}"
            if not run.next_index:
                detail = f"the log begins with sample {index}"
            else:
                detail = f"sample {run.next_index - 1} is followed by {index}; a second run? [start] tells them apart"
            self.causes.add(text, noun="sample", place=place, detail=detail, loses=True, n=len(missing))

    def _index(self, run: EcuRun, parts: Mapping[str, SamplePart]) -> tuple[int, bool]:
        """Index of the sample with the counters of these parts, and True if they agree.

        It is the next one that has them, or the last if they are repeated.
        """
        moduli = self._messages.sent_moduli
        counters = {name: part.counter for name, part in parts.items() if part.counter is not None}
        if not counters:
            return run.next_index, True
        longest = max(counters, key=lambda name: (moduli[name], -counters[name]))
        last = run.next_index - 1
        first = counters[longest] if last < 0 else last + (counters[longest] - last) % moduli[longest]
        is_agreed = all(first % moduli[name] == counter for name, counter in counters.items())
        if not is_agreed:
            shown = ", ".join(f"{self._messages.sent_counters[name]} {counter}" for name, counter in counters.items())
            self.causes.add("the parts of a sample have different counters", noun="sample", detail=shown, loses=True)
        return first, is_agreed
