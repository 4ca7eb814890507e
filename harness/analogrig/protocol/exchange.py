"""Samples out, answers in: the part of the talk with a device that is one run.

The device answers its messages in their order, and each sample with all that is about it. So the answers tell by
themselves which message of samples was lost on the way there: those of a later one come. When nothing comes, the device
is asked whether it is still the same and has said nothing since; then, too, the messages were lost. Their samples are
missing to the device, which sees the gap in the indices, and are marked as lost here. An answer that was lost on the
way back cannot be had again, and ends the run.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import DeviceError, LinkClosed, LinkError, LinkTimeout
from analogrig.protocol.catalogue import (
    BLOCK_SAMPLES,
    INDICES,
    RUN_SHIFT,
    RUNS,
    STEPPED_FLAGS,
    Alarm,
    Change,
    Diagnosis,
    Element,
    Estimate,
    Message,
    Sample,
    SampleBlock,
    SampleFlag,
    Stepped,
    SteppedFlag,
    index_up_to,
    is_number,
)
from analogrig.protocol.conversation import Conversation
from analogrig.protocol.pace import Pace
from analogrig.run import LOST, UNREPORTED

MOST_SILENCES = 10
"""So often a run goes on after it waited in vain for answers; each time costs a time-out."""

_RUN_MASK = (RUNS - 1) << RUN_SHIFT
_NO_INDEX = -1
_NO_ELEMENT = -1

_SAID = frozenset(Change) - {Change.UNDECIDED}

Codes = tuple[int, int, bool]
"""Force, displacement, and whether they are missing."""


@dataclass(frozen=True)
class RaisedAlarm:
    """An alarm of the device."""

    index: int
    """The sample, counted from the start, not modulo anything."""
    kind: int
    """The trigger that raised it."""
    statistic: float


@dataclass(frozen=True)
class StatedDiagnosis:
    """What the device says has changed."""

    index: int
    """The sample after which it was said; this and ``onset`` are counted from the start, not modulo anything."""
    change: int
    """As Change of the catalogue."""
    onset: int
    """The likeliest sample of the change; that of the alarm if several parameters have changed."""
    extent: float
    """Of the parameter, new over old; 1 if several have changed."""


@dataclass(frozen=True, eq=False)
class Replies:
    """What the device said to n samples; p parameters."""

    theta: NDArray[np.float32]
    """(n, p): the estimate after each sample, in the order of est.h, in codes."""
    innovation: NDArray[np.float32]
    """(n,) codes"""
    statistic: NDArray[np.float32]
    """(n,): of the trigger."""
    flags: NDArray[np.uint8]
    """(n,): SteppedFlag, LOST, UNREPORTED."""
    alarms: tuple[RaisedAlarm, ...]
    diagnoses: tuple[StatedDiagnosis, ...]


@dataclass(frozen=True)
class Packing:
    """How samples travel."""

    in_blocks: bool
    """Up to BLOCK_SAMPLES in a message, or one, which any line carries."""
    window: int
    """The most messages that may be unanswered."""

    @property
    def per_message(self) -> int:
        return BLOCK_SAMPLES if self.in_blocks else 1


def most_answers(in_blocks: bool, parameters: int) -> int:  # noqa: FBT001 - as in Packing
    """To one message of samples: each has its estimates and Stepped; and there may be an alarm and a diagnosis."""
    return (BLOCK_SAMPLES if in_blocks else 1) * (parameters + 2) + 2


class _Rows:
    """Answers as they come, in plain lists, since numpy takes as long for one number as for a hundred."""

    def __init__(self, width: int) -> None:
        self.width = width
        """Elements of theta, and the innovation."""
        self.values: list[float] = []
        self.statistics: list[float] = []
        self.flags: list[int] = []
        self.alarms: list[RaisedAlarm] = []
        self.diagnoses: list[StatedDiagnosis] = []
        self._last_taken = (width * [0.0], 0.0)

    def repeat(self, flags: int, statistic: float | None = None) -> None:
        """A sample without an estimate of its own: that of the row before, and no innovation."""
        row = self.values[-self.width :] or self._last_taken[0]
        self.values += [*row[:-1], 0.0]
        self.finish(flags, (self.statistics or self._last_taken[1:])[-1] if statistic is None else statistic)

    def finish(self, flags: int, statistic: float) -> None:
        self.flags.append(flags)
        self.statistics.append(statistic)

    def take(self, n: int, before: int) -> Replies:
        """The first n samples, and the alarms and diagnoses ``before`` an index."""
        cut = n * self.width
        values = np.array(self.values[:cut], dtype=np.float32).reshape(n, self.width)
        out = Replies(
            theta=values[:, :-1],
            innovation=values[:, -1],
            statistic=np.array(self.statistics[:n], dtype=np.float32),
            flags=np.array(self.flags[:n], dtype=np.uint8),
            alarms=tuple(alarm for alarm in self.alarms if alarm.index < before),
            diagnoses=tuple(diagnosis for diagnosis in self.diagnoses if diagnosis.index < before),
        )
        if n:
            self._last_taken = (self.values[cut - self.width : cut], self.statistics[n - 1])
        del self.values[:cut], self.statistics[:n], self.flags[:n], self.alarms[: len(out.alarms)]
        del self.diagnoses[: len(out.diagnoses)]
        return out


class Exchange:
    """One run of a device, from its first sample to its last."""

    def __init__(
        self,
        talk: Conversation,
        *,
        parameters: int,
        packing: Packing,
        run: int,
        report_interval_n: int,
        is_there: Callable[[], None],
        pace: Pace | None = None,
    ) -> None:
        """The device has been started with the run id ``run``.

        ``is_there`` raises if the device is not the one that was started, or has said something that was not heard.
        """
        self._talk = talk
        self._packing = packing
        self._run = (run % RUNS) << RUN_SHIFT
        self._is_thinned = report_interval_n > 1
        self._is_there = is_there
        self._pace = pace
        self._elements = (*range(parameters), int(Element.INNOVATION), _NO_ELEMENT)
        self._rows = _Rows(parameters + 1)
        self._pending: deque[tuple[int, int]] = deque()
        """Of each message without all its answers: the first sample, and how many."""
        self._deadline_s = 0.0
        """When the answers to the oldest of them are due."""
        self._at = 0
        """Of the elements that are due for a sample, the next."""
        self._answered = 0
        """The oldest sample without all its answers; all before are rows."""
        self._wire_index = _NO_INDEX
        """The same as the line has it, if there is one."""
        self._diagnosis: Diagnosis | None = None
        """It names no sample: the next Stepped does."""
        self._silences = 0
        self.next_index = 0

    def enter(
        self,
        first: int,
        force: NDArray[np.uint16],
        displacement: NDArray[np.uint16],
        missing: NDArray[np.bool_],
    ) -> None:
        """Send consecutive samples; skipped indices are missing samples to the device.

        :raises LinkTimeout, LinkError, DeviceError: see ``Dut.feed``.
        :raises ValueError: the arrays differ in length, or the samples have been entered before.
        """
        if first < self.next_index:
            raise ValueError(f"sample {first} comes again: the next one is {self.next_index}")
        samples = list(zip(force.tolist(), displacement.tolist(), missing.tolist(), strict=True))
        per_message = self._packing.per_message
        for start in range(0, len(samples), per_message):
            self._send(first + start, samples[start : start + per_message])
        self.next_index = first + len(samples)

    def finish(self) -> None:
        """Wait for all answers; errors as ``enter``."""
        self._collect(0)

    @property
    def ready(self) -> int:
        """Rows that can be taken."""
        return len(self._rows.flags)

    def take(self, n: int, before: int) -> Replies:
        """The oldest n rows, with the alarms and diagnoses ``before`` a sample."""
        return self._rows.take(n, before)

    # ---- to the device

    def _send(self, first: int, samples: Sequence[Codes]) -> None:
        if self._pace is not None:
            self._wait_for(self._pace.due_s(first + len(samples)))
            window = self._packing.window
            is_full = len(self._pending) >= window
            self._pace.sending(first + len(samples), window * self._packing.per_message, is_full=is_full)
        self._collect(self._packing.window - 1)
        try:
            deadline_s = self._talk.send(self._message(first, samples))
        except LinkClosed as error:
            raise self._placed(error) from error
        if not self._pending:
            self._deadline_s = deadline_s
            self._await(first)
        self._pending.append((first, len(samples)))

    def _message(self, first: int, samples: Sequence[Codes]) -> Message:
        seq = self._talk.next_seq()
        if not self._packing.in_blocks:
            force, displacement, missing = samples[0]
            flags = self._run | (SampleFlag.MISSING if missing else 0)
            return Sample(seq, flags, first % INDICES, force, displacement)
        mask = sum(1 << i for i, (_, _, missing) in enumerate(samples) if missing)
        codes = [code for force, displacement, _ in samples for code in (force, displacement)]
        codes += [0] * (2 * BLOCK_SAMPLES - len(codes))
        return SampleBlock(seq, self._run | len(samples), first % INDICES, mask, tuple(codes))

    # ---- from the device

    def _wait_for(self, due_s: float) -> None:
        """Take what comes until then."""
        try:
            while self._talk.clock() < due_s:
                message = self._talk.receive(due_s)
                if message is not None:
                    self._accept(message)
        except LinkClosed as error:
            raise self._placed(error) from error

    def _collect(self, most: int) -> None:
        """Take what comes until at most so many messages are without all their answers."""
        try:
            while len(self._pending) > most:
                message = self._talk.receive(self._deadline_s)
                if message is None:
                    self._silence()
                else:
                    self._accept(message)
        except LinkClosed as error:
            raise self._placed(error) from error

    def _accept(self, message: Message) -> None:
        """An answer about the oldest sample, or about one whose predecessors were lost."""
        if not is_number(message):
            raise self._no_number(message)
        if (
            isinstance(message, Estimate)
            and message.sample_index == self._wire_index
            and message.element == self._elements[self._at]
        ):
            self._rows.values.append(message.value)
            self._at += 1
        elif isinstance(message, Stepped) and message.sample_index == self._wire_index and self._ends(message):
            self._step(message)
        elif isinstance(message, Alarm) and message.sample_index == self._wire_index:
            self._rows.alarms.append(RaisedAlarm(self._answered, message.trigger, message.statistic))
        elif isinstance(message, Diagnosis) and message.change in _SAID and self._pending:
            self._diagnosis = message
        elif lost := self._predecessors(message):
            self._lose(lost)
            self._accept(message)
        else:
            raise self._wrong(message)

    def _ends(self, message: Stepped) -> bool:
        """Whether it is the last word about a sample of this run."""
        is_whole = self._elements[self._at] == _NO_ELEMENT or (self._is_thinned and self._at == 0)
        return is_whole and message.flags & _RUN_MASK == self._run

    def _step(self, message: Stepped) -> None:
        flags = message.flags & STEPPED_FLAGS
        if self._diagnosis is not None:
            onset = index_up_to(self._answered, self._diagnosis.onset_index)
            stated = StatedDiagnosis(self._answered, self._diagnosis.change, onset, self._diagnosis.extent)
            self._rows.diagnoses.append(stated)
            self._diagnosis = None
        if self._at:
            self._rows.finish(flags, message.statistic)
            self._at = 0
        else:
            self._rows.repeat(flags | UNREPORTED, message.statistic)
        first, n = self._pending[0]
        if self._answered + 1 < first + n:
            self._await(self._answered + 1)
        else:
            self._pass_on()

    def _await(self, index: int) -> None:
        self._answered = index
        self._wire_index = index % INDICES

    def _pass_on(self) -> None:
        """The oldest message is done with; the next one is the oldest."""
        first, n = self._pending.popleft()
        self._deadline_s = self._talk.clock() + self._talk.timeout_s
        if self._pending:
            self._await(self._pending[0][0])
        else:
            self._answered = first + n
            self._wire_index = _NO_INDEX

    def _predecessors(self, message: Message) -> int:
        """How many messages were lost if the answer is to the one after them; 0 if it is not."""
        index = getattr(message, "sample_index", None)
        if self._at or not self._pending or self._answered != self._pending[0][0]:
            return 0
        return next((i for i, (first, _) in enumerate(self._pending) if first % INDICES == index), 0)

    def _lose(self, messages: int) -> None:
        """The oldest so many never came to the device."""
        for _ in range(messages):
            for _ in range(self._pending[0][1]):
                self._rows.repeat(LOST | SteppedFlag.MISSING)
            self._pass_on()

    def _silence(self) -> None:
        """Find out why nothing has come in time.

        :raises LinkError, DeviceError: not because messages were lost, or it goes on too long.
        """
        heard = (
            f"device {self._talk.name}: no estimate for sample {self._answered} within {self._talk.timeout_s:g} s"
            f" ({self._talk.so_far})"
        )
        try:
            self._is_there()
        except LinkTimeout as error:
            raise LinkTimeout(f"{heard}; it answers nothing else either") from error
        if self._at:
            raise LinkTimeout(f"{heard}; it is alive, but does not finish its answer")
        self._silences += 1
        if self._silences > MOST_SILENCES:
            raise LinkTimeout(f"{heard}; it is alive, but messages to it were lost {self._silences} times in this run")
        self._lose(len(self._pending))

    def _no_number(self, message: Message) -> DeviceError:
        """What the device has computed, and of which sample."""
        wire_index = getattr(message, "sample_index", self._answered % INDICES)
        index = index_up_to(sum(self._pending[-1]) - 1 if self._pending else self._answered, wire_index)
        names = {int(element): element.name for element in Element}
        what = names.get(message.element) if isinstance(message, Estimate) else message._fields[-1]
        return DeviceError(
            f"device {self._talk.name}: its {type(message).__name__} holds {what} = {message[-1]} for sample {index},"
            " which is no number"
        )

    def _wrong(self, message: Message) -> DeviceError:
        due = self._elements[self._at]
        wanted = "Stepped" if due == _NO_ELEMENT else f"Estimate of {Element(due).name}"
        return DeviceError(f"device {self._talk.name}: {wanted} for sample {self._answered} was due, {message} came")

    def _placed(self, error: LinkError) -> LinkClosed:
        place = f"after sample {self._answered - 1}" if self._answered > 0 else "before the first sample"
        return LinkClosed(f"{error} {place}")
