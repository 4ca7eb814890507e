"""The serial framing of packets: ``0x00 | COBS(packet, CRC-32C) | 0x00``; estimator_c/device/frame.h is its twin.

The checksum starts from the hash of the message catalogue, except for the messages that must be understood without it.
"""

from __future__ import annotations

import anycrc
from cobs import cobs

from analogrig.protocol.catalogue import CATALOGUE_HASH, LAYOUTS, Message

_CRC_BYTES = 4
_LENGTHS = {layout.id: 1 + layout.length + _CRC_BYTES for layout in LAYOUTS.values()}
"""Size of the content before COBS, by identifier."""
_UNSEEDED = frozenset(layout.id for layout in LAYOUTS.values() if not layout.seeded)

MAX_ENCODED = max(_LENGTHS.values()) + 1
"""What may stand between two zeros, at most: COBS adds one byte to a content of less than 254."""

_RESIDUE = 0x48674BC7
"""The CRC-32C of any message followed by its own CRC-32C, whatever the seed."""

_crc = anycrc.Model("CRC32C").calc


def size(message_type: type[Message]) -> int:
    """Bytes of the frame of a message."""
    return _LENGTHS[LAYOUTS[message_type.__name__].id] + 3  # one byte of COBS, two zeros


def encode(packet: bytes, catalogue_hash: int = CATALOGUE_HASH) -> bytes:
    """The frame of a packet."""
    crc = _crc(packet, 0 if packet[0] in _UNSEEDED else catalogue_hash)
    content: bytes = packet + crc.to_bytes(_CRC_BYTES, "little")
    return b"".join((b"\0", cobs.encode(content), b"\0"))


class FrameDecoder:
    """Bytes in pieces of any size to packets.

    Whatever stands between two zeros and is not a good frame is dropped as a whole and counted once. Never more than
    one frame is kept.
    """

    def __init__(self, catalogue_hash: int = CATALOGUE_HASH) -> None:
        self.dropped = 0
        """How many frames were dropped."""
        self._hash = catalogue_hash
        self._begun = b""

    def feed(self, received: bytes) -> list[bytes]:
        """The packets that ``received`` completes, in their order."""
        chunks = (self._begun + received).split(b"\0")
        self._begun = chunks.pop()[: MAX_ENCODED + 1]  # one byte more is enough to know that it is too long
        packets = []
        for chunk in chunks:
            if not chunk:
                continue
            packet = self._decode(chunk)
            if packet is None:
                self.dropped += 1
            else:
                packets.append(packet)
        return packets

    def _decode(self, chunk: bytes) -> bytes | None:
        try:
            content = cobs.decode(chunk)
        except cobs.DecodeError:
            return None
        if not content or len(content) != _LENGTHS.get(content[0]):
            return None
        if _crc(content, 0 if content[0] in _UNSEEDED else self._hash) != _RESIDUE:
            return None
        return bytes(content[:-_CRC_BYTES])
