"""Devices with a protocol of their own on a line of bytes: one engine for lines of text and for binary records.

The description brings the form of a message, the framer and the transport. A sample is answered by one message. Without
an echo of the index, answers are assigned by their order, with one sample in flight: a time-out marks the sample as
lost, and an answer too many makes the record invalid.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig import DeviceError, LinkError, LinkTimeout
from analogrig.devices import Answers, Datasheet, Device, LinkClosed, Samples, SteppedFlag, TimeLimitReached
from analogrig.devices.device import MOST_TIMEOUTS
from analogrig.devices.pace import Pace
from analogrig.run import Channel
from analogrig.wording import number_of
from analogrig_lines.answer_form import INDEX, LOST_ON_THE_WAY, NO_ANSWER, AnswerAssembler, ToCodes
from analogrig_lines.framing import MOST_FRAME
from analogrig_lines.template_description import TemplateDescription
from analogrig_lines.templates import ChecksumError, SampleWriter, checksum_of, fitting_checksums, hexadecimal

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
_PROMPT_ENDS = (">", "#", "$", "%", ":", "?")
"""Last characters of usual prompts."""
_MOST_NAMES = 4
"""Checksums that a message names."""
_MOST_SHOWN = 80
"""Characters of a line in a message."""
_MOST_OVERHEAD = 64
"""Bytes of header, length and encoding of a frame, at most."""
_BATCH_BYTES = 2048
"""Most bytes in one write. A pseudo-terminal holds 4,096."""


class LineDevice(Device):
    """Device with a protocol of its own on a line of bytes."""

    def __init__(self, description: TemplateDescription) -> None:
        """Start the device, or connect to it."""
        super().__init__(description)
        self._description: TemplateDescription = description
        self._sheet = description.known_datasheet()
        self._form = description.form()
        self._send = description.writer()
        self._reader = description.reader()
        self._missing = description.missing_writer() if description.missing else None
        self._tells_missing = any(field.name == "valid" for field in self._send.fields)
        self._has_index = INDEX in [field.name for field in self._reader.fields]
        self._has_echo = bool(description.echo)
        self._modulus = description.index_modulus
        self._unit = "line" if description.is_lines else "frame"
        self._ignored = description.contents("ignore")
        self._start, self._reset_line, self._reset_answer, self._banner = (
            description.contents(key)[0] for key in ("start", "reset", "reset_answer", "banner")
        )
        self._prompt = description.prompt.strip().encode()
        self._to_codes: ToCodes | None = None
        self._counters: Counter[str] = Counter()
        self._until_s = math.inf
        self._open()
        self._begin_record()

    def _open(self) -> None:
        """Start the device, or connect to it."""
        self._wire = self._description.wire()
        self._framer = self._description.framer()
        self._link_name = self._wire.name
        self._evidence: dict[str, str] = {}
        """What came since the last answer and was none, with an example."""
        self._bad_checksums: list[ChecksumError] = []
        self._is_starting = self._is_fresh = True
        """True until the device has had the time to start, and until the first sample."""
        self._has_failed = False
        self._received_n = self._received_before_n = 0
        """Bytes that have come, and those until the last answer."""
        self._other = b""
        """Last message that was no answer."""
        self._unanswered_resets = 0
        """Reset lines whose answer may still come."""
        self._forget_input()

    def _forget_input(self) -> None:
        self._framer.forget()
        self._lines: deque[bytes] = deque()
        self._unanswered_bytes = 0

    def _begin_record(self) -> None:
        self._rows = AnswerAssembler(self._form, self.name, self._to_codes)
        self._flags: list[int] = []
        """Flags of the samples whose rows are complete, with NO_ANSWER for one without an answer."""
        self._words: list[Any] = []
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

    # -------------------------------------------------------------------------------------------------- what it is

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

    # ------------------------------------------------------------------------------------------ before and after a run

    def recover(self) -> None:
        """Start a program anew, connect to a closed port again, and reset the device.

        :raises LinkTimeout: no answer to the reset line came in time.
        """
        self._reach(anew=not (self._is_fresh or self._description.loses_lines), repeat_s=_AGAIN_S)

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        if not self._is_fresh:
            self._reach(anew=not (self._description.loses_lines or self._description.reset), repeat_s=math.inf)
        self._is_fresh = False
        self._begin_record()

    def _reach(self, *, anew: bool, repeat_s: float) -> None:
        """Bring the device to a defined state, after opening it again if it has failed or ``anew`` is true."""
        if self._has_failed or anew:
            self._wire.close()
            self._open()
        self._forget_input()
        starting_s = self._description.starting_s if self._is_starting else 0.0
        try:
            if starting_s and not self._reset_answer:
                self._discard(self._wire.clock() + starting_s)
            if self._is_starting and self._start:
                self._wire.write(self._framer.frame(self._start))
            self._is_starting = False
            self._reset(repeat_s=_AGAIN_S if starting_s else repeat_s, starting_s=starting_s)
        except LinkClosed as error:
            raise self._closed(error, 0) from error

    def stop(self) -> Mapping[str, int]:
        """:raises DeviceError: there were more answers than samples, or the device was reset."""
        try:
            if self._reset_answer:
                self._reset(is_record=True)
            else:
                deadline_s = self._wire.clock() + (self._description.timeout_s if self._timeouts else 0.0)
                while (line := self._next_line(deadline_s)) is not None:
                    self._accept(line)  # an answer is one too many
                if self._framer.tail and not (self._description.loses_lines or self._description.is_lines):
                    raise self._excess()
        except LinkClosed as error:
            raise self._closed(error, self._answered) from error
        return {}

    def _excess(self) -> DeviceError:
        text = f"sent more answers than samples, the first after sample {self._answered - 1}"
        late = f"; it may answer a sample that timed out before: raise timeout_s = {self._description.timeout_s:g}"
        return self._error(text + late * bool(self._timeouts))

    def _reset(self, *, repeat_s: float = math.inf, starting_s: float = 0.0, is_record: bool = False) -> None:
        """Send the reset line and await its answer; lines before it are discarded, or belong to the record."""
        if not self._reset_line:
            if self._description.loses_lines and not self._is_fresh:
                self._discard()
            return
        deadline_s = self._wire.clock() + self._description.timeout_s + starting_s
        self._unanswered_bytes = 0
        while True:
            self._wire.write(self._framer.frame(self._reset_line))
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
                raise self._silence(f"no answer {self._description.reset_answer!r} to the reset {self._unit}")

    def _discard(self, starting_s: float | None = None) -> None:
        """Discard what the device sends: until it is quiet, or else until its banner, its prompt or this time."""
        while self._read(self._wire.clock() + _QUIET_S if starting_s is None else starting_s):
            has_banner = self._banner and any(line.startswith(self._banner) for line in self._lines)
            self._lines.clear()
            has_started = has_banner or (self._prompt and self._framer.tail.strip() == self._prompt)
            if has_started and starting_s is not None:
                break
        self._forget_input()

    # ----------------------------------------------------------------------------------------------------------- a run

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        waiting: deque[tuple[int, int, bool]] = deque()
        try:
            for block in blocks:
                gap = Samples.missing(self._next_index, block.skipped_after(self._next_index))
                self._next_index = block.first + len(block)
                for samples in (gap, block) if len(gap) else (block,):
                    waiting.append((len(samples), samples.first, samples is gap))
                    self._feed(samples)
                    if not len(samples):
                        self._collect(0)
                    yield from self._take_complete(waiting)
            self._collect(0)
        except (LinkTimeout, TimeLimitReached):
            self._has_failed = True
            yield from self._take_complete(waiting, in_part=True)
            raise
        except LinkError as error:
            with contextlib.suppress(LinkError, DeviceError, TimeLimitReached):
                while (line := self._next_line(0.0)) is not None:  # came before the line failed
                    self._accept(line)
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
        """Message of each sample; None for a missing one that is left out."""
        columns, n = self._columns(block), len(block)
        try:
            lines: list[bytes | None] = [*self._frames(self._send, columns, n)]
            if self._tells_missing or bool(block.valid.all()):
                return lines
            missing: Sequence[bytes | None] = [None] * n
            if self._missing is not None:
                missing = self._frames(self._missing, columns, n)
        except ValueError as error:
            raise self._error(str(error)) from error
        return [line if valid else other for line, other, valid in zip(lines, missing, block.valid, strict=True)]

    def _frames(self, writer: SampleWriter, columns: Mapping[str, NDArray[Any]], n: int) -> list[bytes]:
        contents = writer.contents([columns[field.name] for field in writer.fields], n)
        return contents if self._framer.is_bare else list(map(self._framer.frame, contents))

    def _columns(self, block: Samples) -> dict[str, NDArray[Any]]:
        """Values of the fields that are sent."""
        u: NDArray[Any] = block.u
        y: NDArray[Any] = block.y
        if self._description.units == "volts":
            if self._to_codes is None:
                raise ValueError("volts need the scales of the channels: call prepare()")
            u, y = self._to_codes.u.volts(block.u), self._to_codes.y.volts(block.y)
        indices = np.arange(block.first, block.first + len(block))
        if self._modulus:
            indices %= self._modulus
        return {INDEX: indices, "u": u, "y": y, "valid": block.valid.astype(np.uint8)}

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
        self._received_n += len(received)
        self._unanswered_bytes += len(received)
        dropped_n = self._framer.dropped
        self._lines += self._framer.feed(received)
        if self._framer.dropped > dropped_n:
            self._counters[f"{self._unit}s_garbled"] += self._framer.dropped - dropped_n
            self._evidence[f"bytes came that are no {self._description.framing} frame"] = self._brief(received)
        tail_n = len(self._framer.tail)
        if tail_n > MOST_FRAME + _MOST_OVERHEAD:
            raise self._error(f"sent {tail_n} bytes without the end of a {self._unit} {self._place}")
        if self._unanswered_bytes > MOST_UNANSWERED:
            raise self._error(f"sent {self._unanswered_bytes} bytes without an answer {self._place}")
        return bool(received)

    @property
    def _place(self) -> str:
        return f"for sample {self._answered}, the last {self._unit} {self._brief(self._other)}"

    def _accept(self, line: bytes) -> None:
        """Accept an answer, or another message."""
        if self._prompt:  # it may be there several times, before and after the line
            line = line.strip(b" ")
            while line.startswith(self._prompt):
                line = line.removeprefix(self._prompt).lstrip(b" ")
            while line.endswith(self._prompt):
                line = line.removesuffix(self._prompt).rstrip(b" ")
        try:
            words = self._reader.read(line)
        except ChecksumError as error:
            self._counters[f"{self._unit}s_garbled"] += 1
            self._evidence["an answer came with a wrong checksum"] = self._brief(line)
            if not self._has_answered:
                self._bad_checksums.append(error)
            return
        if words is None:
            self._accept_other(line)
        elif self._has_echo:
            self._accept_echo(self._reader.index(words), words, line)
        elif not self._pending:
            raise self._excess()
        else:
            if self._has_index:
                self._check_count(self._reader.index(words))
            self._answer(words)

    def _accept_other(self, line: bytes) -> None:
        """Accept a line that is no answer.

        :raises DeviceError: it shows that the device was reset.
        """
        if line == self._reset_answer and self._unanswered_resets > 0:
            self._unanswered_resets -= 1
        elif line and (line == self._reset_answer or (self._banner and line.startswith(self._banner))):
            raise self._error(f"was reset before the answer to sample {self._answered}: it sent {self._brief(line)}")
        elif line and not line.startswith(self._ignored):
            self._counters[f"{self._unit}s_other"] += 1
            self._evidence[f"a {self._unit} came that does not match receive"] = self._brief(line)
            self._other = line

    def _accept_echo(self, echoed: int, words: Any, line: bytes) -> None:
        """Accept an answer with the index of its sample."""
        pending, modulus = self._pending, self._modulus
        position = next(
            (i for i, each in enumerate(pending) if each[2] and echoed == (each[0] % modulus if modulus else each[0])),
            None,
        )
        if position is not None:
            for _ in range(position):
                self._lose("a later sample was answered before it")
            self._recent[echoed] = line
            if len(self._recent) > self._description.window + _REMEMBERED_N:
                del self._recent[next(iter(self._recent))]
            self._answer(words)
        elif self._recent.get(echoed, line) != line:
            raise self._error(f"answered sample {echoed} twice, and differently: it received the sample twice")
        elif echoed in self._recent:
            self._counters[f"{self._unit}s_repeated"] += 1
        elif echoed in self._lost:
            self._counters[f"{self._unit}s_late"] += 1
            text = f"an answer came after its time-out of {self._description.timeout_s:g} s: raise timeout_s"
            self.causes.add(text, noun="answer", place=f"sample {self._answered}")
        else:
            self._counters[f"{self._unit}s_garbled"] += 1

    def _check_count(self, count: int) -> None:
        """:raises DeviceError: the device's own count has not gone on by one and the lost samples."""
        modulus = self._modulus
        before, self._count = self._count, count
        if before is None:
            return
        step = (count - before) % modulus if modulus else count - before
        if not 1 <= step <= 1 + self._lost_since:
            raise self._error(
                f"counted {count} after {before} at sample {self._answered}: it was reset, or an answer was lost"
            )

    def _answer(self, words: Any) -> None:
        """Assign an answer to the oldest sample."""
        index, flag, _ = self._pending.popleft()
        self._flags.append(flag)
        self._words.append(words)
        self._silent = self._lost_since = self._unanswered_bytes = 0
        self._has_answered = True
        self._received_before_n = self._received_n
        if self._evidence:
            self._evidence.clear()
        self._finish(index)

    def _lose(self, cause: str, detail: str = "") -> None:
        """Mark the oldest sample as lost by a cause, or as missing if it was left out."""
        index, flag, was_sent = self._pending.popleft()
        self._flags.append((LOST_ON_THE_WAY if was_sent else flag) | NO_ANSWER)
        self._lost_since += was_sent
        if was_sent:
            modulus = self._modulus
            self._lost.add(index % modulus if modulus else index)
            self.causes.add(cause, noun="sample", place=f"sample {index}", detail=detail, loses=True)
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
        causes, detail = f"no byte came within {self._description.timeout_s:g} s", ""
        if self._received_n > self._received_before_n:
            evidence = dict(self._evidence)
            if self._framer.tail:
                evidence[f"a {self._unit} came in part"] = self._brief(self._framer.tail)
            causes = " and ".join(evidence) or "no answer came, but other bytes"
            detail = ", ".join(evidence.values())
        while self._pending:
            self._lose(causes, detail)
        self._evidence.clear()
        self._received_before_n = self._received_n
        self._framer.forget()  # a frame of which bytes were lost never ends

    def _silence(self, problem: str) -> LinkTimeout:
        """Error for a device that does not answer, with what it sent instead."""
        self._has_failed = True
        description, tail = self._description, self._framer.tail
        text = f"device {self.name}: {problem} within {description.timeout_s:g} s"
        hint = description.hint(self.link_name)
        if self._has_answered:
            last = tail or self._other
            return LinkTimeout(f"{text}; its last {self._unit} was {self._brief(last)}" if last else text)
        if not self._received_n:
            causes = ["no byte came"]
        elif self._bad_checksums:
            causes = [self._wrong_checksum()]
        elif self._other and not tail:
            cause = f"its last {self._unit} {self._brief(self._other)} does not match receive = {description.receive!r}"
            return LinkTimeout(f"{text}; {cause}; correct receive in the device file{self._prompt_text()}")
        elif tail or self._other:
            causes = [f"its last {self._unit} was {self._brief(tail or self._other)}"]
        else:
            causes = [f"{self._received_n} bytes came, and no valid {self._unit}"]
        return LinkTimeout("; ".join([text, *causes, *([hint] if hint else [])]))

    def _prompt_text(self) -> str:
        """Cure of a last line that is an answer behind what looks like a prompt."""
        for at in range(1, len(self._other)):
            head, rest = self._other[:at].decode(errors="replace"), self._other[at:]
            if head.rstrip().endswith(_PROMPT_ENDS) and self._reader.read(rest) is not None:
                return f', or set prompt = "{head}"'
        return ""

    def _wrong_checksum(self) -> str:
        """Cause of a device all of whose answers have a wrong checksum, with the checksums that would be right."""
        errors, name = self._bad_checksums, self._description.checksum
        fitting = fitting_checksums(errors, checksum_of(name).bits)
        cure = "is it of other bytes, or another checksum?"
        if fitting:
            cure = f"they are right as {' or '.join(fitting[:_MOST_NAMES])}"
        return f"{number_of(len(errors), f'{self._unit} came', f'{self._unit}s came')} with a wrong {name}: {cure}"

    # --------------------------------------------------------------------------------------------------------- errors

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

    def _brief(self, content: bytes) -> str:
        """Content in a message."""
        if self._description.is_binary:
            return hexadecimal(content)
        text = content.decode(errors="replace")
        return repr(text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}...")
