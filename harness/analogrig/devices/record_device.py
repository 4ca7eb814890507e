"""Program that reads packed records of samples and writes packed records of answers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import Answers, Samples
from analogrig.catalogue import SteppedFlag
from analogrig.devices.answer_form import NO_ANSWER, AnswerAssembler
from analogrig.devices.line_device import TemplateDevice
from analogrig.devices.template_description import TemplateDescription
from analogrig.devices.templates import record
from analogrig.errors import DeviceError, LinkClosed, LinkError, LinkTimeout, TimeLimitReached
from analogrig.protocol.pace import Pace

_BUFFER_BYTES = 65_536
"""Bytes that a pipe holds at least; a window of more would wait for itself."""


class RecordDevice(TemplateDevice):
    """Program with packed records. It is started for each record of samples."""

    def __init__(self, description: TemplateDescription) -> None:
        super().__init__(description)
        self._sent = record("send", description.send)
        self._received = record("receive", description.receive)
        self._window = max(
            1, min(description.window, _BUFFER_BYTES // max(self._sent.itemsize, self._received.itemsize))
        )
        self._answered = 0
        self._input = bytearray()
        """Answers to the block."""
        self._rows = AnswerAssembler(self._form, self.name, self._to_codes)

    def recover(self) -> None:
        if self._has_failed or not self._is_fresh:
            self._reopen()

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        self.recover()
        self._is_fresh = False
        self._next_index = self._answered = 0
        self._rows = AnswerAssembler(self._form, self.name, self._to_codes)

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        for block, is_gap in self._with_gaps(blocks):
            self._input = bytearray()
            is_sent = np.ones(len(block), np.bool_) if "valid" in (self._sent.names or ()) else block.valid
            failure: LinkError | TimeLimitReached | None = None
            try:
                self._exchange(block, np.flatnonzero(is_sent))
            except LinkClosed as error:
                failure = self._closed(error, self._answered)
            except (LinkTimeout, TimeLimitReached) as error:
                self._has_failed = True
                failure = error
            answers = self._answers(block, is_sent)
            if not is_gap:
                yield answers
            if failure is not None:
                raise failure

    def stop(self) -> Mapping[str, int]:
        """:raises DeviceError: there are more answers than samples."""
        try:
            if self._wire.read(0.0):
                raise self._excess(self._answered - 1)
        except LinkClosed as error:
            raise self._closed(error, self._answered) from error
        return {}

    def _excess(self, last: int) -> DeviceError:
        return self._error(f"sent more answers than samples, the first after sample {last}")

    def _exchange(self, block: Samples, sent: NDArray[np.int64]) -> None:
        """Send the samples ``sent`` of a block, and receive their answers."""
        columns, out = self._columns(block), np.zeros(len(block), self._sent)
        for name in self._sent.names or ():
            out[name] = columns[name]
        for start in range(0, len(sent), self._window):
            chunk = sent[start : start + self._window]
            self._wire.write(out[chunk].tobytes())
            self._receive(block.first + chunk)
        self._answered = block.first + len(block)

    def _receive(self, indices: NDArray[np.int64]) -> None:
        """Receive the records of the answers to these samples.

        :raises LinkTimeout: nothing came within the time-out.
        :raises DeviceError: there is more than that.
        """
        size, before = self._received.itemsize, len(self._input)
        deadline_s = self._wire.clock() + self._description.timeout_s
        while (n := len(self._input) - before) < size * len(indices):
            self._answered = int(indices[n // size])
            received = self._wire.read(self._left_s(deadline_s))
            if received:
                deadline_s = self._wire.clock() + self._description.timeout_s
            elif self._wire.clock() >= deadline_s:
                raise self._silence(n % size)
            self._input += received
        if n > size * len(indices):
            raise self._excess(int(indices[-1]))

    def _answers(self, block: Samples, is_sent: NDArray[np.bool_]) -> Answers:
        """Answers to a block, as far as they have come."""
        answered_n = len(self._input) // self._received.itemsize
        answers = np.frombuffer(self._input, self._received, answered_n)
        values = np.empty((answered_n, len(self._form.columns)))
        for i, name in enumerate(self._form.columns):
            values[:, i] = answers[name]
        flags = ~block.valid * np.int64(SteppedFlag.MISSING) + ~is_sent * np.int64(NO_ANSWER)
        unanswered = np.flatnonzero(is_sent)[answered_n:]
        return self._rows.answers(values, flags[: unanswered[0]] if len(unanswered) else flags, block.first)

    def _silence(self, rest: int) -> LinkTimeout:
        self._has_failed = True
        part = f", {rest} of {self._received.itemsize} bytes of it" if rest else ""
        text = (
            f"device {self.name}: no answer to sample {self._answered} within {self._description.timeout_s:g} s{part}"
        )
        hint = self._description.hint(self.link_name)
        return LinkTimeout(f"{text}; {hint}" if hint and not self._answered else text)
