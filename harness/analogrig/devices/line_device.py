"""Devices that speak lines of text, or packed records, of their own.

A sample is answered by one line. Without an echo of the index, answers are assigned by their order, with one sample in
flight: a time-out marks the sample as lost, and an answer too many makes the record invalid.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import Answers, Samples
from analogrig.catalogue import SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.devices.answer_form import INDEX, LOST_ON_THE_WAY, NO_ANSWER, AnswerAssembler, ToCodes
from analogrig.devices.device import Device
from analogrig.devices.template_description import TemplateDescription
from analogrig.devices.templates import ChecksumError
from analogrig.errors import DeviceError, LinkClosed, LinkError, LinkTimeout, TimeLimitReached
from analogrig.protocol.exchange import MOST_TIMEOUTS
from analogrig.protocol.pace import Pace
from analogrig.run import Channel

MOST_LINE = 4096
"""Bytes of a line of the device."""
MOST_UNANSWERED = 1 << 20
"""Bytes that the device may send without an answer among them."""

_MOST_SILENT = 2
"""Time-outs in a row after which the device counts as silent."""
_AGAIN_S = 0.25
"""Time after which the reset line is repeated: a board that starts when its port is opened misses the first."""
_QUIET_S = 0.1
"""Silence that ends what a device without an answer to the reset line sends."""
_REMEMBERED_N = 256
"""Answers beyond the window that are remembered, to recognise repetitions."""
_BATCH_BYTES = 2048
"""Most bytes in one write. A pseudo-terminal holds 4,096."""


class TemplateDevice(Device):
    """Common part of devices with templates: wire, time limit, restart."""

    def __init__(self, description: TemplateDescription) -> None:
        """Start the device, or connect to it."""
        super().__init__(description)
        self._description: TemplateDescription = description
        self._sheet = description.known_datasheet()
        self._form = description.form()
        self._wire = description.wire()
        self._link_name = self._wire.name
        self._until_s = math.inf
        self._is_fresh = True
        """True until the first sample."""
        self._has_failed = False
        self._to_codes: ToCodes | None = None
        self._counters: Counter[str] = Counter()
        self._next_index = 0

    @property
    def datasheet(self) -> Datasheet:
        return self._sheet

    @property
    def link_name(self) -> str:
        return self._link_name

    @property
    def link_counters(self) -> Mapping[str, int]:
        return dict(self._counters)

    def prepare(self, channels: Mapping[str, Channel], period_s: float) -> None:  # noqa: ARG002
        if self._description.units == "volts":
            self._to_codes = ToCodes(self._sheet, channels["u"], channels["y"])

    def limit(self, left_s: float) -> None:
        self._until_s = self._wire.clock() + left_s

    def close(self) -> None:
        self._wire.close()

    def _reopen(self) -> None:
        """Start the device anew, or connect to it again."""
        self._wire.close()
        self._wire = self._description.wire()
        self._is_fresh, self._has_failed = True, False

    def _columns(self, block: Samples) -> dict[str, NDArray[Any]]:
        """Values of the fields that are sent."""
        u: NDArray[Any] = block.u
        y: NDArray[Any] = block.y
        if self._description.units == "volts":
            if self._to_codes is None:
                raise ValueError("volts need the scales of the channels: call prepare()")
            u, y = self._to_codes.u.volts(block.u), self._to_codes.y.volts(block.y)
        indices = np.arange(block.first, block.first + len(block))
        if self._description.indices:
            indices %= self._description.indices
        return {INDEX: indices, "u": u, "y": y, "valid": block.valid.astype(np.uint8)}

    def _with_gaps(self, blocks: Iterable[Samples]) -> Iterator[tuple[Samples, bool]]:
        """Blocks, with True for one that stands for skipped indices, which are missing samples."""
        for block in blocks:
            skipped = block.skipped_after(self._next_index)
            if skipped:
                nothing = np.zeros(skipped, np.uint16)
                yield Samples(self._next_index, nothing, nothing, np.zeros(skipped, np.bool_)), True
            self._next_index = block.first + len(block)
            yield block, False

    @abstractmethod
    def recover(self) -> None:
        """Bring the device to a defined state."""

    def _error(self, text: str) -> DeviceError:
        self._has_failed = True
        return DeviceError(f"device {self.name}: {text}")

    def _left_s(self, deadline_s: float) -> float:
        """Time until the deadline, or the time limit if that is earlier.

        :raises TimeLimitReached: the time limit has passed.
        """
        now_s = self._wire.clock()
        if now_s >= self._until_s:
            raise TimeLimitReached("the time limit of the run is over")
        return max(0.0, min(deadline_s, self._until_s) - now_s)

    def _closed(self, error: LinkError, answered: int) -> LinkError:
        """The error of a failed line, with device and sample."""
        self._has_failed = True
        place = f"after sample {answered - 1}" if answered > 0 else "before the first answer"
        return type(error)(f"device {self.name}: {error} {place}")


class LineDevice(TemplateDevice):
    """Device that speaks lines of text."""

    def __init__(self, description: TemplateDescription) -> None:
        super().__init__(description)
        self._send = description.writer()
        self._reader = description.reader()
        self._missing = description.missing_writer() if description.missing else None
        self._tells_missing = any(field.name == "valid" for field in self._send.fields)
        self._fields = [field.name for field in self._reader.fields]
        self._index = self._fields.index(INDEX) if INDEX in self._fields else None
        self._base = 16 if self._index is not None and self._reader.fields[self._index].type == "x" else 10
        self._has_echo = bool(description.echo)
        self._ignored = tuple(text.encode() for text in description.ignore)
        self._reset_answer = description.reset_answer.encode()
        self._banner = description.banner.encode()
        self._other = b""
        """Last line that was no answer."""
        self._forget_input()
        self._unanswered_resets = 0
        """Reset lines whose answer may still come."""
        self._begin_record()

    def _forget_input(self) -> None:
        self._tail = b""
        """Beginning of a line that is not complete."""
        self._lines: deque[bytes] = deque()
        self._unanswered_bytes = 0

    def _begin_record(self) -> None:
        self._rows = AnswerAssembler(self._form, self.name, self._to_codes)
        self._flags: list[int] = []
        """Flags of the samples whose rows are complete, with NO_ANSWER for one without an answer."""
        self._words: list[tuple[bytes, ...]] = []
        """Their answers."""
        self._pending: deque[tuple[int, int, bool]] = deque()
        """Samples without an answer: index, flag MISSING or 0, and False if it was left out."""
        self._deadline_s = 0.0
        self._answered = 0
        """The oldest sample without an answer."""
        self._has_answered = False
        self._silent = self._timeouts = 0
        self._lost_since = 0
        """Samples lost since the last answer."""
        self._count: int | None = None
        """Last index of a device that counts by itself."""
        self._lost: set[int] = set()
        self._recent: dict[int, bytes] = {}
        """Recent answers by index."""
        self._next_index = 0

    # ------------------------------------------------------------------------------------------ before and after a run

    def recover(self) -> None:
        """Start a program anew, connect to a closed port again, and reset the device.

        :raises LinkTimeout: no answer to the reset line came in time.
        """
        if self._has_failed or not (self._is_fresh or self._description.loses_lines):
            self._reopen()
        self._forget_input()
        try:
            if self._description.start:
                self._wire.write(self._description.start.encode())
            self._reset(repeat_s=_AGAIN_S, starting_s=self._description.starting_s)
        except LinkClosed as error:
            raise self._closed(error, 0) from error

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        if not self._is_fresh:
            if self._has_failed or not (self._description.loses_lines or self._description.reset):
                self._reopen()
                self._forget_input()
            try:
                self._reset()
            except LinkClosed as error:
                raise self._closed(error, 0) from error
        self._is_fresh = False
        self._begin_record()

    def stop(self) -> Mapping[str, int]:
        """:raises DeviceError: there were more answers than samples, or the device was reset."""
        try:
            if self._description.reset_answer:
                self._reset(is_record=True)
            else:
                late_s = self._description.timeout_s if self._timeouts else 0.0
                self._read_rest(late_s)
        except LinkClosed as error:
            raise self._closed(error, self._answered) from error
        return {}

    def _reset(self, *, repeat_s: float = math.inf, starting_s: float = 0.0, is_record: bool = False) -> None:
        """Send the reset line and await its answer; lines before it are discarded, or belong to the record."""
        if not self._description.reset:
            if self._description.loses_lines and not self._is_fresh:
                self._discard()
            return
        deadline_s = self._wire.clock() + self._description.timeout_s + starting_s
        self._unanswered_bytes = 0
        while True:
            self._wire.write(self._description.reset.encode())
            if not self._reset_answer:
                self._discard()
                return
            self._unanswered_resets += 1
            again_s = min(deadline_s, self._wire.clock() + repeat_s)
            while (line := self._next_line(again_s)) is not None:
                if line == self._reset_answer:
                    self._unanswered_resets -= 1
                    return
                if is_record:
                    self._accept(line)
            if self._wire.clock() >= deadline_s:
                raise self._silence(f"no answer {self._description.reset_answer!r} to the reset line")

    def _discard(self) -> None:
        """Discard what the device sends, until it is quiet."""
        while self._read(self._wire.clock() + _QUIET_S):
            self._lines.clear()
        self._forget_input()

    def _read_rest(self, late_s: float) -> None:
        """Read what comes after the last answer within ``late_s``; an answer is one too many."""
        deadline_s = self._wire.clock() + late_s
        while (line := self._next_line(deadline_s)) is not None:
            self._accept(line)

    # ----------------------------------------------------------------------------------------------------------- a run

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        waiting: deque[tuple[int, int, bool]] = deque()
        try:
            for block, is_gap in self._with_gaps(blocks):
                waiting.append((len(block), block.first, is_gap))
                self._feed(block)
                if not len(block):
                    self._collect(0)
                yield from self._take_complete(waiting)
            self._collect(0)
        except (LinkTimeout, TimeLimitReached):
            self._has_failed = True
            yield from self._take_complete(waiting, in_part=True)
            raise
        except LinkError as error:
            self._accept_rest()
            yield from self._take_complete(waiting, in_part=True)
            raise self._closed(error, self._answered) from error
        yield from self._take_complete(waiting)

    def _take_complete(self, waiting: deque[tuple[int, int, bool]], *, in_part: bool = False) -> Iterator[Answers]:
        """Answers to the blocks (samples, first, gap) that are complete; the last in part if asked for."""
        while waiting and (len(self._flags) >= waiting[0][0] or in_part):
            n, first, is_gap = waiting.popleft()
            flags = np.array(self._flags[:n], np.int64)
            answered = int(np.count_nonzero((flags & NO_ANSWER) == 0))
            values = self._reader.values(self._words[:answered], self._form.columns)
            del self._flags[:n], self._words[:answered]
            answers = self._rows.answers(values, flags, first)
            if not is_gap:
                yield answers

    def _feed(self, block: Samples) -> None:
        """Send the samples of a block, each when the window has room for it."""
        lines = self._written(block)
        flags = np.where(block.valid, 0, SteppedFlag.MISSING).tolist()
        window, pending = self._description.window, self._pending
        at, n = 0, len(lines)
        while at < n:
            if len(pending) >= window:
                self._collect(window // 2)
            if self._lines:  # before the next sample is sent: it is an answer too many, or another line
                self._accept(self._lines.popleft())
                continue
            batch, size = [], 0
            while at < n and len(pending) < window and size < _BATCH_BYTES:
                line = lines[at]
                if line is None and not pending:
                    self._flags.append(flags[at] | NO_ANSWER)
                    self._answered = block.first + at + 1
                else:
                    if not pending:
                        self._deadline_s = 0.0
                    pending.append((block.first + at, flags[at], line is not None))
                if line is not None:
                    batch.append(line)
                    size += len(line)
                at += 1
            if batch:
                self._write(batch)

    def _write(self, batch: Sequence[bytes]) -> None:
        if self._description.window > 1:
            self._read(0.0)  # a device that waits for room for its answers takes no samples
        self._wire.write(batch[0] if len(batch) == 1 else b"".join(batch))
        if not self._deadline_s:
            self._deadline_s = self._wire.clock() + self._description.timeout_s

    def _written(self, block: Samples) -> list[bytes | None]:
        """Line of each sample; None for a missing one that is left out."""
        columns = self._columns(block)
        n = len(block)
        lines: list[bytes | None] = list(
            self._send.lines([columns[each.name].tolist() for each in self._send.fields], n)
        )
        if self._tells_missing or bool(block.valid.all()):
            return lines
        missing: Sequence[bytes | None] = [None] * n
        if self._missing is not None:
            missing = self._missing.lines([columns[each.name].tolist() for each in self._missing.fields], n)
        return [line if valid else other for line, other, valid in zip(lines, missing, block.valid, strict=True)]

    def _collect(self, most: int) -> None:
        """Accept lines until at most ``most`` samples have no answer."""
        while len(self._pending) > most:
            line = self._next_line(self._deadline_s)
            if line is None:
                self._handle_timeout()
            else:
                self._accept(line)

    def _next_line(self, deadline_s: float) -> bytes | None:
        """Next line without its end; None if none comes in time."""
        while not self._lines:
            if not self._read(deadline_s):
                return None
        return self._lines.popleft()

    def _read(self, deadline_s: float) -> bool:
        """Receive once; False if nothing came before the deadline.

        :raises DeviceError: a line is too long, or there is no answer among many.
        """
        received = self._wire.read(self._left_s(deadline_s))
        while not received and self._wire.clock() < deadline_s:
            received = self._wire.read(self._left_s(deadline_s))
        self._unanswered_bytes += len(received)
        *lines, self._tail = (self._tail + received).split(b"\n")
        self._lines += [line.removesuffix(b"\r") for line in lines] if b"\r" in received else lines
        if len(self._tail) > MOST_LINE:
            raise self._error(f"sent {len(self._tail)} bytes without the end of a line {self._place}")
        if self._unanswered_bytes > MOST_UNANSWERED:
            raise self._error(f"sent {self._unanswered_bytes} bytes without an answer {self._place}")
        return bool(received)

    @property
    def _place(self) -> str:
        return f"for sample {self._answered}, the last line {_brief(self._other)}"

    def _accept(self, line: bytes) -> None:
        """Accept an answer, or another line."""
        try:
            words = self._reader.read(line)
        except ChecksumError:
            self._counters["lines_garbled"] += 1
            return
        if words is None:
            self._accept_other(line)
        elif self._has_echo:
            self._accept_echo(self._number(words), words, line)
        elif not self._pending:
            raise self._error(f"sent more answers than samples, the first after sample {self._answered - 1}")
        else:
            if self._index is not None:
                self._check_count(self._number(words))
            self._answer(words)

    def _number(self, words: tuple[bytes, ...]) -> int:
        """Index in an answer."""
        return int(words[self._index], self._base) if self._index is not None else self._answered

    def _accept_other(self, line: bytes) -> None:
        """Accept a line that is no answer.

        :raises DeviceError: it shows that the device was reset.
        """
        if line == self._reset_answer and self._unanswered_resets > 0:
            self._unanswered_resets -= 1
        elif line and (line == self._reset_answer or (self._banner and line.startswith(self._banner))):
            raise self._error(f"was reset before the answer to sample {self._answered}: it sent {_brief(line)}")
        elif not line.startswith(self._ignored):
            self._counters["lines_other"] += 1
            self._other = line

    def _accept_echo(self, echoed: int, words: tuple[bytes, ...], line: bytes) -> None:
        """Accept an answer with the index of its sample."""
        pending, modulus = self._pending, self._description.indices
        position = next(
            (i for i, each in enumerate(pending) if each[2] and echoed == (each[0] % modulus if modulus else each[0])),
            None,
        )
        if position is not None:
            for _ in range(position):
                self._lose()
            self._recent[echoed] = line
            if len(self._recent) > self._description.window + _REMEMBERED_N:
                del self._recent[next(iter(self._recent))]
            self._answer(words)
        elif self._recent.get(echoed, line) != line:
            raise self._error(f"answered sample {echoed} twice, and differently: it received the sample twice")
        elif echoed in self._recent:
            self._counters["lines_repeated"] += 1
        elif echoed in self._lost:
            self._counters["lines_late"] += 1
        else:
            self._counters["lines_garbled"] += 1

    def _check_count(self, count: int) -> None:
        """:raises DeviceError: the device's own count has not gone on by one and the lost samples."""
        modulus = self._description.indices
        before, self._count = self._count, count
        if before is None:
            return
        step = (count - before) % modulus if modulus else count - before
        if not 1 <= step <= 1 + self._lost_since:
            raise self._error(
                f"counted {count} after {before} at sample {self._answered}: it was reset, or an answer was lost"
            )

    def _answer(self, words: tuple[bytes, ...]) -> None:
        """Assign an answer to the oldest sample."""
        index, flag, _ = self._pending.popleft()
        self._flags.append(flag)
        self._words.append(words)
        self._silent = self._lost_since = self._unanswered_bytes = 0
        self._has_answered = True
        self._finish(index)

    def _lose(self) -> None:
        """Mark the oldest sample as lost, or as missing if it was left out."""
        index, flag, was_sent = self._pending.popleft()
        self._flags.append((LOST_ON_THE_WAY if was_sent else flag) | NO_ANSWER)
        self._lost_since += was_sent
        if was_sent:
            modulus = self._description.indices
            self._lost.add(index % modulus if modulus else index)
        self._finish(index)

    def _finish(self, index: int) -> None:
        """Go on to the next sample after ``index``, past those that were left out."""
        pending = self._pending
        while pending and not pending[0][2]:
            index, flag, _ = pending.popleft()
            self._flags.append(flag | NO_ANSWER)
        self._answered = index + 1
        if pending:
            self._deadline_s = self._wire.clock() + self._description.timeout_s

    def _handle_timeout(self) -> None:
        """Mark the samples without an answer as lost.

        :raises LinkTimeout: the line cannot lose samples, or the device is silent.
        """
        self._silent += 1
        self._timeouts += 1
        if not self._description.loses_lines or self._silent >= _MOST_SILENT or self._timeouts > MOST_TIMEOUTS:
            raise self._silence(f"no answer to sample {self._answered - self._lost_since}")
        while self._pending:
            self._lose()

    def _silence(self, problem: str) -> LinkTimeout:
        """Error for a device that does not answer, with what it sent instead."""
        self._has_failed = True
        text = f"device {self.name}: {problem} within {self._description.timeout_s:g} s"
        if self._other and not (self._tail or self._has_answered):
            problem = f"its last line {_brief(self._other)} does not match receive = {self._description.receive!r}"
            return LinkTimeout(f"{text}; {problem}; correct receive in the device file")
        if self._tail or self._other:
            text += f"; its last line was {_brief(self._tail or self._other)}"
        hint = self._description.hint(self.link_name)
        return LinkTimeout(f"{text}; {hint}" if hint and not self._has_answered else text)

    def _accept_rest(self) -> None:
        """Accept the answers that came before the line failed."""
        try:
            while (line := self._next_line(0.0)) is not None:
                self._accept(line)
        except (LinkError, DeviceError, TimeLimitReached):
            return


def _brief(line: bytes) -> str:
    text = line.decode(errors="replace")
    return repr(text if len(text) <= 80 else f"{text[:80]}...")
