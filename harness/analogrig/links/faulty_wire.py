"""A serial line with faults: bytes and frames are spoilt on their way, or the device at its end is."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Any, ClassVar

from analogrig.links import frame
from analogrig.links.line import BITS_PER_BYTE
from analogrig.links.wire import DEFAULT_BAUD, MemoryWire, VirtualClock, Wire
from analogrig.links.wire_faults import DIRECTIONS, Direction, FaultyLine, Lane, WireFaults
from analogrig.protocol.catalogue import CATALOGUE_HASH, Hello, pack, unpack

STRANGERS_HASH = CATALOGUE_HASH ^ 0x5A5A5A5A

_BABBLE_BYTES = 1024

_FRAME = re.compile(rb"\0*[^\0]+\0")


def _flip(sent: bytes, rng: Random) -> bytes:
    out = bytearray(sent)
    for _ in range(rng.randint(1, 4)):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _lose(sent: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(sent))
    return sent[:at] + sent[at + rng.randint(1, 4) :]


def _insert(sent: bytes, rng: Random) -> bytes:
    at = rng.randint(0, len(sent))
    return sent[:at] + rng.randbytes(rng.randint(1, 16)) + sent[at:]


def _truncate(sent: bytes, rng: Random) -> bytes:
    return sent[: rng.randrange(len(sent))]


_SPOILT: Mapping[str, Callable[[bytes, Random], bytes]] = {
    "flip": _flip,
    "lose": _lose,
    "insert": _insert,
    "truncate": _truncate,
}
"""Up to four bits flipped, up to four bytes lost, up to sixteen inserted, the end lost."""


def _spoil(kind: str) -> Callable[[FaultyWire, Lane[bytes], bytes], None]:
    return lambda wire, lane, sent: lane.put(_SPOILT[kind](sent, lane.rng), wire.clock())


class FaultyWire(FaultyLine[bytes]):
    """A wire that does to the bytes what ``faults`` say."""

    def __init__(self, open_wire: Callable[[], Wire], faults: WireFaults) -> None:
        """Open the wire; a device that is reset is one that is opened again."""
        super().__init__(faults)
        self._open = open_wire
        self._wire = open_wire()
        self.name = self._wire.name
        self.clock = self._wire.clock
        self._begun: dict[Direction, bytes] = dict.fromkeys(DIRECTIONS, b"")
        """Of a frame that is not complete."""
        self._is_garbled = False

    def write(self, sent: bytes) -> None:
        self._send(self._split("to", sent))

    def read(self, timeout_s: float) -> bytes:
        return b"".join(self._receive(timeout_s))

    def close(self) -> None:
        self._wire.close()

    def _split(self, direction: Direction, sent: bytes) -> list[bytes]:
        """The frames that are complete."""
        begun = self._begun[direction] + sent
        frames = _FRAME.findall(begun)
        self._begun[direction] = begun[sum(map(len, frames)) :][-frame.MAX_ENCODED :]
        return frames

    def _write(self, sent: Sequence[bytes]) -> None:
        self._wire.write(b"".join(sent))

    def _read(self, timeout_s: float) -> list[bytes]:
        return self._split("from", self._wire.read(timeout_s))

    def _boot(self) -> None:
        self._wire.close()
        self._wire = self._open()
        if isinstance(self._wire, MemoryWire) and isinstance(self.clock, VirtualClock):
            self._wire.clock = self.clock

    def _noise(self, direction: Direction, passed: list[bytes]) -> list[bytes]:
        """Noise without end instead of the device, or between the messages to it."""
        noise = self._lanes[direction].rng.randbytes(_BABBLE_BYTES)
        if direction == "to":
            return [*passed, noise]
        if isinstance(self.clock, VirtualClock):  # what the line can carry
            self.clock.advance(_BABBLE_BYTES * BITS_PER_BYTE / DEFAULT_BAUD)
        return [noise]

    def _changed(self, lane: Lane[bytes], sent: bytes) -> bytes | None:
        passed = super()._changed(lane, sent)
        return (
            passed if passed is None or not self._is_garbled else lane.rng.randbytes(lane.rng.randint(1, 2 * len(sent)))
        )

    def _stranger(self, sent: bytes) -> bytes:
        packets = frame.FrameDecoder().feed(sent)
        message = unpack(packets[0]) if packets else None
        if message is None:
            return sent
        if isinstance(message, Hello):
            message = message._replace(catalogue_hash=STRANGERS_HASH)
        return frame.encode(pack(message), STRANGERS_HASH)

    def _garble(self, lane: Lane[bytes], sent: bytes) -> None:  # noqa: ARG002 - this one is lost
        self._is_garbled = True

    PASSES: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        **{kind: _spoil(kind) for kind in _SPOILT},
        **FaultyLine.PASSES,
    }
    HAPPENS: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        **PASSES,
        **FaultyLine.LASTS,
        "wrong-baud": _garble,
    }
