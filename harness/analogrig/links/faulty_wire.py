"""A serial line with faults of its bytes, its frames, or the device."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Any, ClassVar

from analogrig.catalogue import CATALOGUE_HASH, Hello, pack, unpack
from analogrig.links import frame
from analogrig.links.line import BITS_PER_BYTE
from analogrig.links.wire import DEFAULT_BAUD, Wire
from analogrig.links.wire_faults import DIRECTIONS, Direction, FaultyLine, Lane, WireFaults

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


_DAMAGES: Mapping[str, Callable[[bytes, Random], bytes]] = {
    "flip": _flip,
    "lose": _lose,
    "insert": _insert,
    "truncate": _truncate,
}
"""Flip up to four bits, lose up to four bytes, insert up to sixteen, lose the end."""


def _damage(kind: str) -> Callable[[FaultyWire, Lane[bytes], bytes], None]:
    return lambda wire, lane, sent: lane.put(_DAMAGES[kind](sent, lane.rng), wire.clock())


class FaultyWire(FaultyLine[Wire, bytes]):
    """A wire that applies faults to its bytes and frames."""

    def __init__(self, open_wire: Callable[[], Wire], faults: WireFaults) -> None:
        """Open the wire. A reset of the device opens it again."""
        super().__init__(open_wire, faults)
        self._begun: dict[Direction, bytes] = dict.fromkeys(DIRECTIONS, b"")
        """Bytes of the incomplete frame, by direction."""
        self._is_garbled = False

    def write(self, sent: bytes) -> None:
        self._send(self._split("to", sent))

    def read(self, timeout_s: float) -> bytes:
        return b"".join(self._receive(timeout_s))

    def _split(self, direction: Direction, sent: bytes) -> list[bytes]:
        """Complete frames."""
        begun = self._begun[direction] + sent
        frames = _FRAME.findall(begun)
        self._begun[direction] = begun[sum(map(len, frames)) :][-frame.MAX_ENCODED :]
        return frames

    def _write(self, sent: Sequence[bytes]) -> None:
        self._line.write(b"".join(sent))

    def _read(self, timeout_s: float) -> list[bytes]:
        return self._split("from", self._line.read(timeout_s))

    def _noise(self, direction: Direction, passed: list[bytes]) -> list[bytes]:
        """Random bytes: instead of the device, or after each message to it."""
        noise = self._lanes[direction].rng.randbytes(_BABBLE_BYTES)
        if direction == "to":
            return [*passed, noise]
        self._advance(_BABBLE_BYTES * BITS_PER_BYTE / DEFAULT_BAUD)
        return [noise]

    def _apply_lasting(self, lane: Lane[bytes], sent: bytes) -> bytes | None:
        passed = super()._apply_lasting(lane, sent)
        if passed is None or not self._is_garbled:
            return passed
        return lane.rng.randbytes(lane.rng.randint(1, 2 * len(sent)))

    def _stranger(self, sent: bytes) -> bytes:
        packets = frame.FrameDecoder().feed(sent)
        message = unpack(packets[0]) if packets else None
        if message is None:
            return sent
        if isinstance(message, Hello):
            message = message._replace(catalogue_hash=STRANGERS_HASH)
        return frame.encode(pack(message), STRANGERS_HASH)

    def _garble(self, lane: Lane[bytes], sent: bytes) -> None:  # noqa: ARG002 - the frame is lost
        self._is_garbled = True

    TRANSIENT: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        **{kind: _damage(kind) for kind in _DAMAGES},
        **FaultyLine.TRANSIENT,
    }
    KINDS: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        **TRANSIENT,
        **FaultyLine.LASTING,
        "wrong-baud": _garble,
    }
