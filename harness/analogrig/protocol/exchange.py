"""Exchange of one run: samples to the device, answers from it.

The device answers messages in order, and each sample completely. Answers to a later message therefore show that an
earlier one was lost on the way to the device. If no answer comes, a request for the identity shows whether the device
was reset and whether answers were lost. If neither, the unanswered messages were lost on the way there.

Lost samples are marked LOST here; the device sees a gap in the indices. A lost answer ends the run: it cannot be
requested again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from analogrig.answers import Answers, RaisedAlarm, ReportedDiagnosis, ReportedMisfit, Samples
from analogrig.catalogue import (
    BLOCK_SAMPLES,
    INDICES,
    RUN_SHIFT,
    RUNS,
    STEPPED_FLAGS,
    Alarm,
    Cause,
    Change,
    Diagnosis,
    Element,
    Estimate,
    Message,
    Misfit,
    Sample,
    SampleBlock,
    SampleFlag,
    Stepped,
    SteppedFlag,
    index_up_to,
    is_finite,
)
from analogrig.errors import DeviceError, LinkClosed, LinkTimeout, TimeLimitReached
from analogrig.protocol.answer_rows import AnswerRows
from analogrig.protocol.conversation import Conversation
from analogrig.protocol.pace import Pace
from analogrig.run import LOST, UNREPORTED

MOST_TIMEOUTS = 10
"""Largest number of time-outs in a run that goes on after each."""

_RUN_MASK = (RUNS - 1) << RUN_SHIFT
_NO_INDEX = -1
_NO_ELEMENT = -1

_DECIDED = frozenset(Change) - {Change.UNDECIDED}

_CAUSES = frozenset(Cause)

Codes = tuple[int, int, bool]
"""u, y, and False if they are missing."""


@dataclass(frozen=True)
class Packing:
    """Packing of samples into messages."""

    in_blocks: bool
    """True for up to BLOCK_SAMPLES in a message; False for one, which every line carries."""
    window: int
    """Largest number of unanswered messages."""

    @property
    def per_message(self) -> int:
        return BLOCK_SAMPLES if self.in_blocks else 1


def misfit_of(index: int, message: Misfit) -> ReportedMisfit:
    """Misfit that a message reports after the sample ``index``."""
    return ReportedMisfit(index, message.cause, message.frequency / 65536.0, message.strength / 256.0)


def most_answers(samples: int, parameters: int) -> int:
    """Largest number of answers to a message: estimates and Stepped for each sample, and one Alarm, Diagnosis and
    Misfit."""
    return samples * (parameters + 2) + 3


class Exchange:
    """Exchange of one run, from its first sample to its last."""

    def __init__(
        self,
        talk: Conversation,
        *,
        parameters: int,
        packing: Packing,
        run: int,
        report_interval_n: int,
        check_device: Callable[[], None],
        pace: Pace | None = None,
    ) -> None:
        """Prepare for a device that was started with the run id ``run``.

        :param check_device: raises if the device was reset, or if a message of it was lost.
        """
        self._talk = talk
        self._packing = packing
        self._run = (run % RUNS) << RUN_SHIFT
        self._is_thinned = report_interval_n > 1
        self._check_device = check_device
        self._pace = pace
        self._elements = (*range(parameters), int(Element.INNOVATION), _NO_ELEMENT)
        self._rows = AnswerRows(parameters + 1)
        self._pending: deque[tuple[int, int]] = deque()
        """First sample and number of samples of each message that is not completely answered."""
        self._deadline_s = 0.0
        """Deadline of the answers to the oldest of them."""
        self._next_element = 0
        """Position in ``_elements`` of the next estimate for a sample."""
        self._answered = 0
        """The oldest sample that is not completely answered."""
        self._wire_index = _NO_INDEX
        """Its index in messages, or _NO_INDEX if there is none."""
        self._diagnosis: Diagnosis | None = None
        """A diagnosis that waits for the next Stepped, which names its sample."""
        self._timeouts = 0
        self._next_index = 0

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        """Send consecutive blocks of samples, and yield the answers to each.

        The device takes skipped indices as missing samples.

        :raises LinkTimeout, LinkError, DeviceError: see ``CatalogueDevice.play``.
        :raises TimeLimitReached: after all answers that came in time.
        :raises ValueError: the arrays differ in length, or the samples have been sent before.
        """
        waiting: deque[tuple[int, int]] = deque()
        try:
            for block in blocks:
                waiting.append((len(block), block.first + len(block)))
                self._enter(
                    block.first, list(zip(block.u.tolist(), block.y.tolist(), block.valid.tolist(), strict=True))
                )
                if not len(block):
                    self._collect(0)
                while waiting and len(self._rows.flags) >= waiting[0][0]:
                    yield self._rows.take(*waiting.popleft())
            self._collect(0)
        except LinkClosed as error:
            place = f"after sample {self._answered - 1}" if self._answered > 0 else "before the first sample"
            raise LinkClosed(f"{error} {place}") from error
        except TimeLimitReached:
            yield from self._take_rest(waiting)
            raise
        yield from self._take_rest(waiting)

    def _take_rest(self, waiting: Iterable[tuple[int, int]]) -> Iterator[Answers]:
        """Answers to the waiting blocks (samples, end); the last may be answered in part."""
        for n, end in waiting:
            answered = min(n, len(self._rows.flags))
            yield self._rows.take(answered, end - n + answered)

    # ---- to the device

    def _enter(self, first: int, samples: Sequence[Codes]) -> None:
        if first < self._next_index:
            raise ValueError(f"sample {first} comes again: the next one is {self._next_index}")
        per_message = self._packing.per_message
        for start in range(0, len(samples), per_message):
            self._send(first + start, samples[start : start + per_message])
        self._next_index = first + len(samples)

    def _send(self, first: int, samples: Sequence[Codes]) -> None:
        if self._pace is not None:
            self._wait_for(self._pace.due_s(first + len(samples)))
            window = self._packing.window
            is_full = len(self._pending) >= window
            self._pace.sending(first + len(samples), window * self._packing.per_message, is_full=is_full)
        self._collect(self._packing.window - 1)
        deadline_s = self._talk.send(self._message(first, samples))
        if not self._pending:
            self._deadline_s = deadline_s
            self._await(first)
        self._pending.append((first, len(samples)))

    def _message(self, first: int, samples: Sequence[Codes]) -> Message:
        seq = self._talk.next_seq()
        if not self._packing.in_blocks:
            u, y, valid = samples[0]
            flags = self._run | (0 if valid else SampleFlag.MISSING)
            return Sample(seq, flags, first % INDICES, u, y)
        mask = sum(1 << i for i, (_, _, valid) in enumerate(samples) if not valid)
        codes = [code for u, y, _ in samples for code in (u, y)]
        codes += [0] * (2 * BLOCK_SAMPLES - len(codes))
        return SampleBlock(seq, self._run | len(samples), first % INDICES, mask, tuple(codes))

    # ---- from the device

    def _wait_for(self, due_s: float) -> None:
        """Accept messages until this time on the clock."""
        while self._talk.clock() < due_s:
            message = self._talk.receive(due_s)
            if message is not None:
                self._accept(message)

    def _collect(self, most: int) -> None:
        """Accept messages until at most ``most`` are not completely answered."""
        while len(self._pending) > most:
            message = self._talk.receive(self._deadline_s)
            if message is None:
                self._handle_timeout()
            else:
                self._accept(message)

    def _accept(self, message: Message) -> None:
        """Accept an answer about the oldest sample, or about one whose predecessors were lost."""
        if not is_finite(message):
            raise self._non_finite_error(message)
        if (
            isinstance(message, Estimate)
            and message.sample_index == self._wire_index
            and message.element == self._elements[self._next_element]
        ):
            self._rows.values.append(message.value)
            self._next_element += 1
        elif isinstance(message, Stepped) and message.sample_index == self._wire_index and self._ends(message):
            self._step(message)
        elif isinstance(message, Alarm) and message.sample_index == self._wire_index:
            self._rows.alarms.append(RaisedAlarm(self._answered, message.trigger, message.statistic))
        elif isinstance(message, Misfit) and message.sample_index == self._wire_index and message.cause in _CAUSES:
            self._rows.misfits.append(misfit_of(self._answered, message))
        elif isinstance(message, Diagnosis) and message.change in _DECIDED and self._pending:
            self._diagnosis = message
        elif lost := self._lost_before(message):
            self._lose(lost)
            self._accept(message)
        else:
            raise self._unexpected_error(message)

    def _ends(self, message: Stepped) -> bool:
        """True if the message completes a sample of this run."""
        is_whole = self._elements[self._next_element] == _NO_ELEMENT or (self._is_thinned and self._next_element == 0)
        return is_whole and message.flags & _RUN_MASK == self._run

    def _step(self, message: Stepped) -> None:
        flags = message.flags & STEPPED_FLAGS
        if self._diagnosis is not None:
            onset = index_up_to(self._answered, self._diagnosis.onset_index)
            stated = ReportedDiagnosis(self._answered, self._diagnosis.change, onset, self._diagnosis.extent)
            self._rows.diagnoses.append(stated)
            self._diagnosis = None
        if self._next_element:
            self._rows.finish(flags, message.statistic)
            self._next_element = 0
        else:
            self._rows.repeat(flags | UNREPORTED, message.statistic)
        first, n = self._pending[0]
        if self._answered + 1 < first + n:
            self._await(self._answered + 1)
        else:
            self._finish_message()

    def _await(self, index: int) -> None:
        self._answered = index
        self._wire_index = index % INDICES

    def _finish_message(self) -> None:
        """Remove the oldest message, and await the answers to the next one."""
        first, n = self._pending.popleft()
        self._deadline_s = self._talk.clock() + self._talk.timeout_s
        if self._pending:
            self._await(self._pending[0][0])
        else:
            self._answered = first + n
            self._wire_index = _NO_INDEX

    def _lost_before(self, message: Message) -> int:
        """Number of lost messages if this answers a later one; 0 if it does not."""
        index = getattr(message, "sample_index", None)
        if self._next_element or not self._pending or self._answered != self._pending[0][0]:
            return 0
        return next((i for i, (first, _) in enumerate(self._pending) if first % INDICES == index), 0)

    def _lose(self, messages: int) -> None:
        """Mark the samples of the oldest messages as lost on the way to the device."""
        for _ in range(messages):
            for _ in range(self._pending[0][1]):
                self._rows.repeat(LOST | SteppedFlag.MISSING)
            self._finish_message()

    def _handle_timeout(self) -> None:
        """Find the cause of a time-out, and mark samples as lost if their messages were.

        :raises LinkError, DeviceError: there is another cause, or there were too many time-outs.
        """
        problem = (
            f"device {self._talk.name}: no estimate for sample {self._answered} within {self._talk.timeout_s:g} s"
            f" ({self._talk.context})"
        )
        try:
            self._check_device()
        except LinkTimeout as error:
            raise LinkTimeout(f"{problem}; it does not answer any other request") from error
        if self._next_element:
            raise LinkTimeout(f"{problem}; it is alive, but does not finish its answer")
        self._timeouts += 1
        if self._timeouts > MOST_TIMEOUTS:
            raise LinkTimeout(
                f"{problem}; it is alive, but messages to it were lost {self._timeouts} times in this run"
            )
        self._lose(len(self._pending))

    def _non_finite_error(self, message: Message) -> DeviceError:
        """Error for an answer with a value that is NaN or infinite."""
        wire_index = getattr(message, "sample_index", self._answered % INDICES)
        index = index_up_to(sum(self._pending[-1]) - 1 if self._pending else self._answered, wire_index)
        names = {int(element): element.name for element in Element}
        field = names.get(message.element) if isinstance(message, Estimate) else message._fields[-1]
        return DeviceError(
            f"device {self._talk.name}: its {type(message).__name__} holds {field} = {message[-1]} for sample {index},"
            " which is not finite"
        )

    def _unexpected_error(self, message: Message) -> DeviceError:
        due = self._elements[self._next_element]
        wanted = "Stepped" if due == _NO_ELEMENT else f"Estimate of {Element(due).name}"
        return DeviceError(
            f"device {self._talk.name}: expected {wanted} for sample {self._answered}, received {message}"
        )
