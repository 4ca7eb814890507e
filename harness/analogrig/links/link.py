"""Links: carry messages of the catalogue to a device and back."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from analogrig.catalogue import Message, pack, unpack_any
from analogrig.links import frame
from analogrig.links.line import Line, SerialLine
from analogrig.links.wire import Connection, Wire
from analogrig.links.wire_faults import FaultyLine

if TYPE_CHECKING:
    import can

CanListener = Callable[["can.Message"], object]
"""Callback for every frame on a CAN bus, such as a log writer of python-can. ``is_rx`` is False for frames of the
harness; ``timestamp`` is the link's clock."""


class Link(Connection, Protocol):
    """A line that carries messages to one device."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Counts, by name, of input that was no message of the device. ``frames_dropped`` counts damaged frames."""

    @property
    def trouble(self) -> str:
        """Known problems of the line, which may explain a silent device; may be empty."""

    @property
    def line(self) -> Line | None:
        """Speed of the line, if it is known."""

    @property
    def line_s(self) -> float:
        """Time that all traffic so far would take at that speed [s]; 0.0 if the speed is unknown."""

    @property
    def carries_blocks(self) -> bool:
        """True if a SampleBlock fits into a message; False if only messages of 8 bytes do."""

    @property
    def unread_n(self) -> int | None:
        """Largest number of received messages that the system buffers; None if it is unlimited."""

    @property
    def faulty(self) -> FaultyLine[Any, Any] | None:
        """Line that applies faults to its frames; None if it was opened without faults."""

    def listen(self, listener: CanListener) -> None:
        """Report all CAN frames to the listener from now on; a link without any ignores it."""

    def send(self, messages: Iterable[Message]) -> None:
        """Send the messages, in one write where the line allows it.

        :raises LinkError: they cannot be sent.
        """

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, or None after the time-out.

        :raises LinkClosed: the other end has hung up.
        """


class FramedLink:
    """Link that carries messages in frames over a wire, in order."""

    trouble = ""
    carries_blocks = True
    unread_n = None

    def __init__(self, wire: Wire, line: SerialLine | None = None) -> None:
        """Take over ``wire``; ``line`` is its speed, or that of the serial line that it stands for."""
        self.wire = wire
        self.name = wire.name
        self.clock = wire.clock
        self.line_s = 0.0
        self.line = line
        self._decoder = frame.FrameDecoder()
        self._messages: deque[Message] = deque()
        self._unknown_n = 0

    @property
    def counters(self) -> Mapping[str, int]:
        return {"frames_dropped": self._decoder.dropped + self._unknown_n}

    @property
    def faulty(self) -> FaultyLine[Any, Any] | None:
        return self.wire if isinstance(self.wire, FaultyLine) else None

    def listen(self, listener: CanListener) -> None:
        """Do nothing: a wire carries no CAN frames."""

    def send(self, messages: Iterable[Message]) -> None:
        sent = b"".join([frame.encode(pack(message)) for message in messages])
        self._add_time(sent)
        self.wire.write(sent)

    def receive(self, timeout_s: float) -> Message | None:
        if self._messages:
            return self._messages.popleft()
        deadline_s = self.clock() + timeout_s
        while True:
            self._enter(self.wire.read(max(0.0, deadline_s - self.clock())))
            if self._messages:
                return self._messages.popleft()
            if self.clock() >= deadline_s:
                return None

    def close(self) -> None:
        self.wire.close()

    def _enter(self, received: bytes) -> None:
        self._add_time(received)
        for packet in self._decoder.feed(received):
            message = unpack_any(packet)
            if message is not None:
                self._messages.append(message)
            self._unknown_n += message is None

    def _add_time(self, transferred: bytes) -> None:
        """Add the bytes' time. Both directions add up, since lock-step uses one at a time."""
        if self.line is not None:
            self.line_s += self.line.bytes_s(len(transferred))
