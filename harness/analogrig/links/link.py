"""Links: carry messages of the catalogue to a device and back."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from analogrig.catalogue import Message, pack, unpack_all
from analogrig.links import frame
from analogrig.links.line import Line, SerialLine
from analogrig.links.wire import Connection, Wire
from analogrig.links.wire_faults import FaultyLine
from analogrig.wording import number_of

if TYPE_CHECKING:
    import can

__all__ = ["CanListener", "Identifier", "identifier_text"]
"""Names for packages beside the core."""

CanListener = Callable[["can.Message"], object]
"""Callback for every frame on a CAN bus, such as a log writer of python-can. ``is_rx`` is False for frames of the
harness; ``timestamp`` is the link's clock."""

Identifier = tuple[int, bool]
"""Arbitration identifier, and True if it is one of 29 bits."""


def identifier_text(identifier: Identifier) -> str:
    """Identifier as candump writes it: three digits for one of 11 bits, eight for one of 29."""
    number, is_extended = identifier
    return f"{number:0{8 if is_extended else 3}X}"


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

    @property
    def unread(self) -> deque[Message]:
        """Messages that have come and are not yet received."""

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
        self.unread: deque[Message] = deque()
        self._unknown_n = self._received_n = self._valid_n = 0

    @property
    def trouble(self) -> str:
        if self._valid_n:
            return ""
        if not self._received_n:
            return "no byte came"
        return f"{number_of(self._received_n, 'byte')} came without a valid frame: another speed, or another protocol"

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
        if self.line is not None:  # both directions add up, since lock-step uses one at a time
            self.line_s += self.line.bytes_s(len(sent))
        self.wire.write(sent)

    def receive(self, timeout_s: float) -> Message | None:
        if self.unread:
            return self.unread.popleft()
        deadline_s, left_s = self.clock() + timeout_s, timeout_s
        while True:
            self._enter(self.wire.read(left_s))
            if self.unread:
                return self.unread.popleft()
            left_s = deadline_s - self.clock()
            if left_s <= 0.0:
                return None

    def close(self) -> None:
        self.wire.close()

    def _enter(self, received: bytes) -> None:
        if self.line is not None:
            self.line_s += self.line.bytes_s(len(received))
        self._received_n += len(received)
        packets = self._decoder.feed(received)
        messages = unpack_all(packets)
        self.unread += messages
        self._valid_n += len(messages)
        self._unknown_n += len(packets) - len(messages)
