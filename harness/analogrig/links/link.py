"""Links: what carries messages to a device and back, and nothing else."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Protocol

from analogrig.links import frame
from analogrig.links.line import Line, SerialLine
from analogrig.links.wire import Clock, Wire
from analogrig.protocol.catalogue import Message, pack, unpack_any

if TYPE_CHECKING:
    import can

CanListener = Callable[["can.Message"], object]
"""Is told every frame on a CAN bus as it comes or goes: ``is_rx`` is False if it is the harness's own, ``timestamp`` is
the clock of the link. python-can's writers of logs are such."""


class Link(Protocol):
    """A line to one device."""

    @property
    def name(self) -> str:
        """What it is, for errors and records."""

    @property
    def clock(self) -> Clock:
        """The time in which its time-outs are meant."""

    @property
    def counters(self) -> Mapping[str, int]:
        """What was seen on the line that was no message of the device, by name; ``frames_dropped``: was no good."""

    @property
    def trouble(self) -> str:
        """What the line itself has to say if nothing comes, or nothing."""

    @property
    def line(self) -> Line | None:
        """Its speed, if that is known."""

    @property
    def line_s(self) -> float:
        """How long a line of the described speed would have taken until now [s]; 0.0 if none is described."""

    @property
    def carries_blocks(self) -> bool:
        """Whether a SampleBlock fits into a message, or only what has 8 bytes."""

    @property
    def unread_n(self) -> int | None:
        """So many messages may come before one of them is read; None: as many as like to."""

    def listen(self, listener: CanListener) -> bool:
        """Tell the listener all that passes from now on; False: these are no CAN frames."""

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

    trouble = ""
    carries_blocks = True
    unread_n = None

    def __init__(self, wire: Wire, line: SerialLine | None = None) -> None:
        """Take over ``wire``; ``line`` is what it would be, or is, outside of this computer."""
        self.wire = wire
        self.name = wire.name
        self.clock = wire.clock
        self.line_s = 0.0
        self.line = line
        self._decoder = frame.FrameDecoder()
        self._messages: deque[Message] = deque()
        self._no_messages_n = 0

    @property
    def counters(self) -> Mapping[str, int]:
        return {"frames_dropped": self._decoder.dropped + self._no_messages_n}

    def listen(self, listener: CanListener) -> bool:  # noqa: ARG002 - there is nothing to tell it
        return False

    def send(self, messages: Iterable[Message]) -> None:
        sent = b"".join([frame.encode(pack(message)) for message in messages])
        self._time(sent)
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
        self._time(received)
        for packet in self._decoder.feed(received):
            message = unpack_any(packet)
            if message is not None:
                self._messages.append(message)
            self._no_messages_n += message is None

    def _time(self, passed: bytes) -> None:
        """One direction after the other."""
        if self.line is not None:
            self.line_s += self.line.bytes_s(len(passed))
