"""Our catalogue's messages over a link: requests, and the exchange of one run.

Both sides number their messages, which reveals lost and repeated ones. Each answer holds the number of its request.

The device answers messages in order, and each sample completely. Answers to a later message therefore show that an
earlier one was lost on the way to the device. If no answer comes, a request for the identity shows whether the device
was reset and whether answers were lost. If neither, the unanswered messages were lost on the way there.

Lost samples are marked LOST here; the device sees a gap in the indices. A lost answer ends the run: it cannot be
requested again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeVar

from analogrig.answers import AnswerRows, Answers, RaisedAlarm, ReportedDiagnosis, ReportedMisfit, Samples
from analogrig.catalogue import (
    BLOCK_SAMPLES,
    INDICES,
    RUN_SHIFT,
    RUNS,
    SEQS,
    STEPPED_FLAGS,
    Alarm,
    Cause,
    Change,
    Configured,
    Controlled,
    Diagnosis,
    Element,
    Estimate,
    Firmware,
    Hello,
    Message,
    Misfit,
    Sample,
    SampleBlock,
    SampleFlag,
    Status,
    Stepped,
    SteppedFlag,
    brief,
    index_up_to,
    pack,
)
from analogrig.devices.device import MOST_TIMEOUTS
from analogrig.devices.pace import Pace
from analogrig.errors import DeviceError, LinkClosed, LinkError, LinkTimeout, TimeLimitReached
from analogrig.links.link import Link
from analogrig.run import LOST, UNREPORTED
from analogrig.wording import number_of

LATEST = 32
"""Messages within this distance behind the expected number are repetitions; others follow a loss."""

Answer = TypeVar("Answer", Hello, Firmware, Controlled, Configured, Status)

_RUN_MASK = (RUNS - 1) << RUN_SHIFT
_NO_INDEX = _NO_ELEMENT = -1

_DECIDED = frozenset(Change) - {Change.UNDECIDED}

_CAUSES = frozenset(Cause)


class Packing(NamedTuple):
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


class Conversation:
    """Dialogue of the harness with one device. Errors begin with the device's name."""

    def __init__(self, link: Link, name: str, timeout_s: float) -> None:
        """Use ``link`` to the device ``name``; ``timeout_s`` applies to all answers to one message."""
        self.link = link
        self.name = name
        self.timeout_s = timeout_s
        self.clock = link.clock
        self.limit_s = math.inf
        """End of the run's time limit on the clock [s]."""
        self._seq = 0
        self._expected: int | None = None
        self._heard: dict[int, Message] = {}
        """Latest message, by number."""
        self._last: Message | None = None
        self._damaged_before_n = 0
        """Damaged frames before the last run began."""

    @property
    def last(self) -> str:
        """Short form of the device's last message."""
        return "none" if self._last is None else brief(self._last)

    @property
    def context(self) -> str:
        """Last message and known trouble of the line, for errors about a silent device."""
        trouble = self.link.trouble
        return f"last message: {self.last}{'; ' if trouble else ''}{trouble}"

    def begin(self) -> None:
        """Accept any number in the device's next message."""
        self._expected = None
        self._heard.clear()

    def begin_run(self) -> None:
        """Begin to count the damaged frames of a run."""
        self._damaged_before_n = self.link.counters["frames_dropped"]

    def next_seq(self) -> int:
        """Number for the next message to the device."""
        seq = self._seq
        self._seq = (seq + 1) % SEQS
        return seq

    def send(self, message: Message) -> float:
        """Send a message, and return the deadline of its answers on the clock [s]."""
        try:
            self.link.send([message])
        except LinkError as error:
            raise self._with_name(error) from error
        return self.clock() + self.timeout_s

    def receive(self, deadline_s: float) -> Message | None:
        """The next message of the device, or None at the deadline. Repeated messages are skipped.

        :raises LinkError: messages before it were lost, another node sends as the device, or the line failed.
        :raises TimeLimitReached: none came before the time limit of the run.
        """
        until_s, unread = min(self.limit_s, deadline_s), self.link.unread
        while unread or (left_s := until_s - self.clock()) >= 0.0:  # also ends if messages never cease
            try:
                message = unread.popleft() if unread else self.link.receive(left_s)
            except LinkError as error:
                raise self._with_name(error) from error
            if message is None:
                break
            if self._expected is None or message.seq == self._expected:
                self._expected = (message.seq + 1) % SEQS
                self._heard[message.seq] = self._last = message
                return message
            if (self._expected - message.seq) % SEQS > LATEST:
                lost = (message.seq - self._expected) % SEQS
                damaged = self.link.counters["frames_dropped"] - self._damaged_before_n
                raise LinkError(
                    f"device {self.name}: {number_of(lost, 'message was', 'messages were')} lost"
                    f" between {self.last} and {brief(message)}, or"
                    f" another node sends as the device ({damaged} frames were damaged in this run)"
                )
            before = self._heard.get(message.seq)
            if before is not None and pack(before) != pack(message):
                raise LinkError(
                    f"device {self.name}: {brief(before)} and {brief(message)} have the same number, {message.seq}:"
                    " the device was reset, or two nodes send as this device"
                )
        if self.limit_s <= deadline_s:
            raise TimeLimitReached(f"device {self.name}: time limit reached ({self.context})")
        return None

    def ask(self, request: Message, kind: type[Answer]) -> Answer:
        """Send ``request`` and return its answer.

        :raises LinkTimeout: it did not come in time.
        """
        return self.answer(request, kind, self.send(request))

    def answer(
        self, request: Message, kind: type[Answer], deadline_s: float, *, after_anything: bool = False
    ) -> Answer:
        """The next answer to ``request``.

        :param after_anything: skip any other message, such as those of an earlier run. Otherwise only answers to
            repeated questions for the identity are skipped.
        :raises LinkTimeout: none came in time.
        :raises DeviceError: another message came first, which no request of now explains.
        """
        while True:
            message = self.receive(deadline_s)
            if message is None:
                raise LinkTimeout(
                    f"device {self.name}: no {kind.__name__} in answer to {type(request).__name__}"
                    f" within {self.timeout_s:g} s ({self.context})"
                )
            if isinstance(message, kind) and message.answers == request.seq:
                return message
            if not after_anything and not isinstance(message, Hello | Firmware):
                raise DeviceError(f"device {self.name}: {brief(message)} came too late")

    def _with_name(self, error: LinkError) -> LinkError:
        return type(error)(f"device {self.name}: {error}")


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
                block.skipped_after(self._next_index)
                self._next_index = block.first + len(block)
                waiting.append((len(block), self._next_index))
                codes = list(zip(block.u.tolist(), block.y.tolist(), block.valid.tolist(), strict=True))
                for start in range(0, len(codes), self._packing.per_message):
                    self._send(block.first + start, codes[start : start + self._packing.per_message])
                if not codes:
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

    def _send(self, first: int, samples: Sequence[tuple[int, int, bool]]) -> None:
        """Send samples (u, y, valid) in one message, once they are due and the window has room for it."""
        end, window = first + len(samples), self._packing.window
        if self._pace is not None:
            due_s = self._pace.due_s(end)
            while self._talk.clock() < due_s:
                if (message := self._talk.receive(due_s)) is not None:
                    self._accept(message)
            self._pace.sending(end, window * self._packing.per_message, is_full=len(self._pending) >= window)
        self._collect(window - 1)
        deadline_s = self._talk.send(self._message(first, samples))
        if not self._pending:
            self._deadline_s = deadline_s
            self._await(first)
        self._pending.append((first, len(samples)))

    def _message(self, first: int, samples: Sequence[tuple[int, int, bool]]) -> Message:
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

    def _collect(self, most: int) -> None:
        """Accept messages until at most ``most`` are not completely answered."""
        while len(self._pending) > most:
            message = self._talk.receive(self._deadline_s)
            if message is None:
                self._handle_timeout()
            else:
                self._accept(message)

    def _accept(self, message: Message) -> None:
        """Accept an answer about the oldest sample, or about one whose predecessors were lost.

        :raises DeviceError: it is another message, or its value is not finite.
        """
        value = message[-1]  # of all messages, only the last field may be a float
        if type(value) is float and not math.isfinite(value):
            raise self._non_finite_error(message)
        index = getattr(message, "sample_index", None)
        if index == self._wire_index:
            if isinstance(message, Estimate) and message.element == self._elements[self._next_element]:
                self._rows.values.append(message.value)
                self._next_element += 1
                return
            if isinstance(message, Stepped) and message.flags & _RUN_MASK == self._run and self._is_whole:
                self._step(message)
                return
            if isinstance(message, Alarm):
                self._rows.alarms.append(RaisedAlarm(self._answered, message.trigger, message.statistic))
                return
            if isinstance(message, Misfit) and message.cause in _CAUSES:
                self._rows.misfits.append(misfit_of(self._answered, message))
                return
        if isinstance(message, Diagnosis) and message.change in _DECIDED and self._pending:
            self._diagnosis = message
        elif lost_n := self._lost_before(index):
            self._lose(lost_n)
            self._accept(message)
        else:
            due = self._elements[self._next_element]
            wanted = "Stepped" if due == _NO_ELEMENT else f"Estimate of {Element(due).name}"
            raise self._error(f"expected {wanted} for sample {self._answered}, received {message}")

    @property
    def _is_whole(self) -> bool:
        """True if the oldest sample has all its estimates, or none where reports are thinned."""
        return self._elements[self._next_element] == _NO_ELEMENT or (self._is_thinned and self._next_element == 0)

    def _step(self, message: Stepped) -> None:
        flags = message.flags & STEPPED_FLAGS
        if self._diagnosis is not None:
            onset = index_up_to(self._answered, self._diagnosis.onset_index)
            self._rows.diagnoses.append(
                ReportedDiagnosis(self._answered, self._diagnosis.change, onset, self._diagnosis.extent)
            )
            self._diagnosis = None
        if self._next_element:
            self._rows.flags.append(flags)
            self._rows.statistics.append(message.statistic)
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
        if self._pending:
            self._deadline_s = self._talk.clock() + self._talk.timeout_s
            self._await(self._pending[0][0])
        else:
            self._answered, self._wire_index = first + n, _NO_INDEX

    def _lost_before(self, index: int | None) -> int:
        """Number of lost messages if ``index`` is that of a later one; 0 if it is not."""
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
        kind = type(message).__name__
        return self._error(f"its {kind} holds {field} = {message[-1]} for sample {index}, which is not finite")

    def _error(self, text: str) -> DeviceError:
        return DeviceError(f"device {self._talk.name}: {text}")
