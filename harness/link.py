"""Links: what carries messages to a device and back, and nothing else."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Protocol

from harness import frame
from harness.catalogue import Message, pack, unpack
from harness.timed_wire import TimedWire
from harness.wire import Clock, Wire


class Link(Protocol):
    """A line to one device."""

    @property
    def name(self) -> str:
        """What it is, for errors and records."""

    @property
    def clock(self) -> Clock:
        """The time in which its time-outs are meant."""

    @property
    def dropped(self) -> int:
        """How many frames from the device were no good."""

    @property
    def line_s(self) -> float:
        """How long a line of the described speed would have taken until now [s]; 0.0 if none is described."""

    def send(self, messages: Iterable[Message]) -> None:
        """Send the messages, in one go where the line can.

        :raises LinkError: they cannot be sent.
        """

    def receive(self, timeout_s: float) -> Message | None:
        """The next message, or None if none comes in time.

        :raises LinkClosed: the other end is gone.
        """

    def close(self) -> None:
        """Let go of the line. May be called twice."""


class FramedLink:
    """Messages as frames over a wire; they come in the order in which they were sent."""

    def __init__(self, wire: Wire) -> None:
        """Take over ``wire``."""
        self.wire = wire
        self.name = wire.name
        self.clock = wire.clock
        self._decoder = frame.FrameDecoder()
        self._messages: deque[Message] = deque()

    @property
    def dropped(self) -> int:
        return self._decoder.dropped

    @property
    def line_s(self) -> float:
        return self.wire.line_s if isinstance(self.wire, TimedWire) else 0.0

    def send(self, messages: Iterable[Message]) -> None:
        self.wire.write(b"".join([frame.encode(pack(message)) for message in messages]))

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
        for packet in self._decoder.feed(received):
            message = unpack(packet)
            if message is not None:
                self._messages.append(message)
