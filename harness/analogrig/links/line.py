"""Line speeds: time that messages take on a serial line or a CAN bus.

Pseudo-terminals and virtual buses have no speed of their own. Here every message takes the time of its bits, and the
device answers at once after the last bit. Nothing is delayed, so the time is reproducible. It is exact for lock-step,
where nothing is sent before the answers have arrived.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from analogrig.catalogue import LAYOUTS, Message
from analogrig.links.frame_bits import CLASSIC_BYTES, frame_bits, longest_classic_bits, longest_fd_bits
from analogrig.links.link import frame_size

if TYPE_CHECKING:
    import can

BITS_PER_BYTE = 10
"""8N1: a start bit and a stop bit around each byte."""


@dataclass(frozen=True)
class SerialLine:
    """A serial line with one wire for each direction."""

    baud: int

    @property
    def speed(self) -> str:
        """Text for errors."""
        return f"{self.baud} baud"

    def rates(self) -> dict[str, int]:
        """Bit rates by name, for the record [bit/s]."""
        return {"baud": self.baud}

    def bytes_s(self, n: int) -> float:
        """Time of n bytes [s]."""
        return n * BITS_PER_BYTE / self.baud

    def message_s(self, kind: type[Message]) -> float:
        """Longest time of one message of this type [s]."""
        return self.bytes_s(frame_size(kind))

    def together_s(self, to_s: float, from_s: float) -> float:
        """Time for traffic of these durations to and from the device [s]."""
        return max(to_s, from_s)


@dataclass(frozen=True)
class CanLine:
    """A CAN bus, which carries both directions in turn. It has the methods of ``SerialLine``."""

    bitrate: int
    data_bitrate: int | None = None
    """Bit rate of the data phase of CAN FD; None if it is ``bitrate``."""

    @property
    def speed(self) -> str:
        data = "" if self.data_bitrate is None else f", data {self.data_bitrate} bit/s"
        return f"{self.bitrate} bit/s{data}"

    def rates(self) -> dict[str, int]:
        data = {} if self.data_bitrate is None else {"data_bitrate": self.data_bitrate}
        return {"bitrate": self.bitrate, **data}

    def frame_s(self, frame: can.Message) -> float:
        """Time of this very frame, with the interframe space after it [s]."""
        return frame_bits(frame).time_s(self.bitrate, self.data_bitrate)

    def message_s(self, kind: type[Message]) -> float:
        length = LAYOUTS[kind.__name__].length
        bits = longest_fd_bits(length) if length > CLASSIC_BYTES else longest_classic_bits(length)
        return bits.time_s(self.bitrate, self.data_bitrate)

    def together_s(self, to_s: float, from_s: float) -> float:
        return to_s + from_s


Line = SerialLine | CanLine
"""Speed of the line to a device."""
