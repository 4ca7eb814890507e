"""Lines: how long messages take on what lies between the harness and a device.

A pseudo-terminal takes any number of bytes at once, a virtual bus any number of frames. Here each takes its bits, the
device answers when the last bit of a message is there, and takes no time itself. Nothing is delayed, so that the figure
is the same every time; it is exact for lock-step, where nothing is sent before the answers have come.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from analogrig.links import frame
from analogrig.links.bus_load import CLASSIC_BYTES, frame_s, message_s
from analogrig.protocol.catalogue import LAYOUTS, Message

if TYPE_CHECKING:
    import can

BITS_PER_BYTE = 10
"""8N1: a start bit and a stop bit around each byte."""


class Line(Protocol):
    """What a user says about the line to a device."""

    @property
    def speed(self) -> str:
        """In words, for errors."""

    def rates(self) -> dict[str, int]:
        """By name, for the record [bit/s]."""

    def message_s(self, kind: type[Message]) -> float:
        """How long one message takes, at most [s]."""

    def together_s(self, to_s: float, from_s: float) -> float:
        """How long it takes when this much is said to the device and from it [s]."""


@dataclass(frozen=True)
class SerialLine:
    """A wire for each direction."""

    baud: int

    @property
    def speed(self) -> str:
        return f"{self.baud} baud"

    def rates(self) -> dict[str, int]:
        return {"baud": self.baud}

    def bytes_s(self, n: int) -> float:
        """How long so many bytes take [s]."""
        return n * BITS_PER_BYTE / self.baud

    def message_s(self, kind: type[Message]) -> float:
        return self.bytes_s(frame.size(kind))

    def together_s(self, to_s: float, from_s: float) -> float:
        return max(to_s, from_s)


@dataclass(frozen=True)
class CanLine:
    """A bus for both directions."""

    bitrate: int
    data_bitrate: int | None = None
    """Of the data of a frame of CAN FD; None: the same."""

    @property
    def speed(self) -> str:
        faster = "" if self.data_bitrate is None else f", data {self.data_bitrate} bit/s"
        return f"{self.bitrate} bit/s{faster}"

    def rates(self) -> dict[str, int]:
        faster = {} if self.data_bitrate is None else {"data_bitrate": self.data_bitrate}
        return {"bitrate": self.bitrate, **faster}

    def frame_s(self, frame: can.Message) -> float:
        """How long this very frame takes, with the space after it [s]."""
        return message_s(frame, self.bitrate, self.data_bitrate)

    def message_s(self, kind: type[Message]) -> float:
        length = LAYOUTS[kind.__name__].length
        return frame_s(length, fd=length > CLASSIC_BYTES, bitrate=self.bitrate, data_bitrate=self.data_bitrate)

    def together_s(self, to_s: float, from_s: float) -> float:
        return to_s + from_s
