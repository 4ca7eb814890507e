"""The serial framing of packets: ``0x00 | COBS(packet, CRC-32C) | 0x00``; see estimator_c/device/frame.h.

The checksum starts from the hash of the message catalogue. Messages that must be readable without it start from 0.
"""

from __future__ import annotations

import anycrc
from cobs import cobs

from analogrig.catalogue import CATALOGUE_HASH, LAYOUTS, Message

_CRC_BYTES = 4
_LENGTHS = {layout.id: 1 + layout.length + _CRC_BYTES for layout in LAYOUTS.values()}
"""Bytes of the content before COBS, by identifier."""
_UNSEEDED = frozenset(layout.id for layout in LAYOUTS.values() if not layout.seeded)

MAX_ENCODED = max(_LENGTHS.values()) + 1
"""Most bytes between two zeros: COBS adds one byte to a content of less than 254."""

_RESIDUE = 0x48674BC7
"""CRC-32C of any message followed by its own CRC-32C, for every seed."""

_crc = anycrc.Model("CRC32C").calc


def size(message_type: type[Message]) -> int:
    """Number of bytes in the frame of a message."""
    return _LENGTHS[LAYOUTS[message_type.__name__].id] + 3  # one byte of COBS, two zeros


def encode(packet: bytes, catalogue_hash: int = CATALOGUE_HASH) -> bytes:
    """Frame of a packet."""
    crc = _crc(packet, 0 if packet[0] in _UNSEEDED else catalogue_hash)
    content: bytes = packet + crc.to_bytes(_CRC_BYTES, "little")
    return b"".join((b"\0", cobs.encode(content), b"\0"))


class FrameDecoder:
    """Decoder of a byte stream, fed in pieces of any size.

    Bytes between two zeros that are no valid frame are dropped as a whole and counted once. The decoder buffers at most
    one frame.
    """

    def __init__(self, catalogue_hash: int = CATALOGUE_HASH) -> None:
        self.dropped = 0
        """Number of dropped frames."""
        self._hash = catalogue_hash
        self._begun = b""

    def feed(self, received: bytes) -> list[bytes]:
        """Packets that ``received`` completes, in order."""
        chunks = (self._begun + received).split(b"\0")
        self._begun = chunks.pop()[: MAX_ENCODED + 1]  # one byte more shows that it is too long
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
