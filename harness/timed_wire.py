"""How long a line of a given speed would have taken: a wire around a wire, with a clock of its own for each direction.

A pseudo-terminal takes any number of bytes at once. Here every byte takes its ten bits (8N1), the device answers when
the last byte of a message is there, and takes no time itself. Nothing is delayed, so that the figure is the same every
time; it is exact for lock-step, where nothing is sent before the answers have come.
"""

from __future__ import annotations

from harness.wire import Wire

BITS_PER_BYTE = 10
"""8N1: a start bit and a stop bit around each byte."""


class TimedWire:
    """Passes bytes through, and counts the time of a line of ``baud``."""

    def __init__(self, wire: Wire, baud: int) -> None:
        """Take over ``wire``."""
        self.name = wire.name
        self.clock = wire.clock
        self._wire = wire
        self._byte_s = BITS_PER_BYTE / baud
        self._written_s = 0.0
        """When the last byte to the device is over."""
        self._read_s = 0.0
        """When the last byte from the device is over."""

    @property
    def line_s(self) -> float:
        """The time that the line has taken until now [s]."""
        return max(self._written_s, self._read_s)

    def write(self, sent: bytes) -> None:
        self._written_s = self.line_s + len(sent) * self._byte_s
        self._wire.write(sent)

    def read(self, timeout_s: float) -> bytes:
        received = self._wire.read(timeout_s)
        if received:
            self._read_s = self.line_s + len(received) * self._byte_s
        return received

    def close(self) -> None:
        self._wire.close()
