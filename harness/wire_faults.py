"""A line with faults, from a seed: bytes and frames are spoilt on their way, or the device at its end is.

A fault happens at a numbered frame of one direction, or at any frame with a given probability; the frames are counted
from the opening of the line, from 0. harness/README.md says what becomes of a run with each of them.
"""

# ruff: noqa: S311 - the faults are drawn from a seed; they are no secret

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from random import Random
from typing import ClassVar, Literal

from harness import frame
from harness.catalogue import CATALOGUE_HASH, Hello, pack, unpack
from harness.errors import ConfigurationError, LinkClosed
from harness.timed_wire import BITS_PER_BYTE
from harness.wire import DEFAULT_BAUD, MemoryWire, VirtualClock, Wire

Direction = Literal["to", "from"]
"""To the device, or from it."""
DIRECTIONS: tuple[Direction, ...] = ("to", "from")

LONGEST_DELAY_S = 3.0
MOST_FRAMES_LATE = 40
MOST_FRAMES_OUT = 600
_BABBLE_BYTES = 1024
_STRANGERS_HASH = CATALOGUE_HASH ^ 0x5A5A5A5A

_FRAME = re.compile(rb"\0*[^\0]+\0")
_FAULT = re.compile(r"([a-z-]+)@(?:(to|from):([0-9]{1,12})|([0-9.]+(?:e-?[0-9]+)?))")
_SEED = re.compile(r"seed=([0-9]{1,18})")


@dataclass(frozen=True)
class WireFault:
    """Once, at one frame."""

    kind: str
    direction: Direction
    frame: int


@dataclass(frozen=True)
class WireFaults:
    """All that shall go wrong on a line."""

    at: tuple[WireFault, ...] = ()
    rates: Mapping[str, float] = field(default_factory=dict)
    """By kind: the probability at every frame of both directions."""
    seed: int = 0

    @classmethod
    def parse(cls, text: str) -> WireFaults:
        """From words between commas: ``flip@to:81``, ``delay@from:0``, ``lose@0.001``, ``seed=7``.

        :raises ConfigurationError: a word is none of these, or there is no such kind of fault.
        """
        at, rates, seed = [], {}, 0
        for word in filter(None, (word.strip() for word in text.split(","))):
            if match := _SEED.fullmatch(word):
                seed = int(match[1])
            elif (match := _FAULT.fullmatch(word)) and match[1] in KINDS:
                if match[2]:
                    at.append(WireFault(match[1], "to" if match[2] == "to" else "from", int(match[3])))
                    if len({(fault.direction, fault.frame) for fault in at}) < len(at):
                        raise ConfigurationError(f"wire faults: {word!r}: that frame has a fault already")
                elif match[1] in rates:
                    raise ConfigurationError(f"wire faults: {word!r}: {match[1]} has a probability already")
                else:
                    rates[match[1]] = _probability(match[4], word)
            else:
                raise ConfigurationError(
                    f"wire faults: {word!r} is not KIND@to:FRAME, KIND@from:FRAME, KIND@PROBABILITY or seed=N,"
                    f" where KIND is one of {', '.join(KINDS)}"
                )
        return cls(tuple(at), rates, seed)


def _probability(text: str, word: str) -> float:
    try:
        probability = float(text)
    except ValueError:
        probability = -1.0
    if not 0.0 <= probability <= 1.0:
        raise ConfigurationError(f"wire faults: {word!r}: the probability must be 0 to 1")
    return probability


# ---- one frame is spoilt


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
    "drop": lambda _sent, _rng: b"",
    "duplicate": lambda sent, _rng: sent + sent,
}
"""Up to four bits flipped, up to four bytes lost, up to sixteen inserted, the end lost, all lost, all of it twice."""


@dataclass
class _Lane:
    """One direction."""

    rng: Random
    """Its own: which of the two speaks first is a matter of timing."""
    frames: int = 0
    begun: bytes = b""
    """Of a frame that is not complete."""
    held: list[tuple[int, bytes]] = field(default_factory=list)
    """Frames that come after so many others."""
    queue: deque[tuple[float, bytes]] = field(default_factory=deque)
    """What is on its way, and when it comes."""
    stalled_s: float = 0.0
    """Until then nothing comes."""
    babbles: bool = False
    lost_n: int = 0
    """So many frames more are lost."""

    def split(self, sent: bytes) -> list[bytes]:
        """The frames that are complete."""
        self.begun += sent
        frames = _FRAME.findall(self.begun)
        self.begun = self.begun[sum(map(len, frames)) :][-frame.MAX_ENCODED :]
        return frames

    def put(self, sent: bytes, now_s: float) -> None:
        self.queue.append((max(now_s, self.stalled_s), sent))

    def release(self, now_s: float) -> None:
        """One frame has passed: those that waited for it come."""
        self.held = [(n - 1, sent) for n, sent in self.held]
        for n, sent in self.held:
            if n <= 0:
                self.put(sent, now_s)
        self.held = [(n, sent) for n, sent in self.held if n > 0]

    def due(self, now_s: float) -> bytes:
        """All that has come by now."""
        out = []
        while self.queue and self.queue[0][0] <= now_s:
            out.append(self.queue.popleft()[1])
        return b"".join(out)


class FaultyWire:
    """A wire that does to the bytes what ``faults`` say."""

    def __init__(self, open_wire: Callable[[], Wire], faults: WireFaults) -> None:
        """Open the wire; a device that is reset is one that is opened again."""
        self._open = open_wire
        self._wire = open_wire()
        self.name = self._wire.name
        self.clock = self._wire.clock
        self._at = {(fault.direction, fault.frame): fault.kind for fault in faults.at}
        self._rates = dict(faults.rates)
        self._lanes: dict[Direction, _Lane] = {
            direction: _Lane(Random(f"{faults.seed} {direction}")) for direction in DIRECTIONS
        }
        self._is_closed = self._is_silent = self._is_garbled = self._is_stranger = False

    @property
    def frames(self) -> Mapping[Direction, int]:
        """How many frames have come by in each direction."""
        return {direction: lane.frames for direction, lane in self._lanes.items()}

    def write(self, sent: bytes) -> None:
        self._enter("to", sent)
        self._deliver()

    def read(self, timeout_s: float) -> bytes:
        deadline_s, is_over = self.clock() + timeout_s, False
        while True:
            self._deliver()
            if self._lanes["from"].babbles:
                return self._babble()
            received = self._lanes["from"].due(self.clock())
            if received or is_over:
                return received
            left_s = max(0.0, deadline_s - self.clock())
            self._enter("from", self._wire.read(min(left_s, self._soon_s())))
            is_over = self.clock() >= deadline_s

    def close(self) -> None:
        self._wire.close()

    def _deliver(self) -> None:
        """To the device, what is due."""
        if self._is_closed:
            raise LinkClosed(f"{self.name}: the line is cut")
        sent = self._lanes["to"].due(self.clock())
        if self._lanes["to"].babbles:
            sent += self._lanes["to"].rng.randbytes(_BABBLE_BYTES)
        if sent and not self._is_silent:
            self._wire.write(sent)

    def _soon_s(self) -> float:
        """How long nothing will come of itself."""
        due_s = [lane.queue[0][0] for lane in self._lanes.values() if lane.queue]
        return max(0.0, min(due_s) - self.clock()) if due_s else LONGEST_DELAY_S

    def _babble(self) -> bytes:
        """Noise without end; what the line can carry, if time is virtual."""
        if isinstance(self.clock, VirtualClock):
            self.clock.advance(_BABBLE_BYTES * BITS_PER_BYTE / DEFAULT_BAUD)
        return self._lanes["from"].rng.randbytes(_BABBLE_BYTES)

    # ---- frame by frame

    def _enter(self, direction: Direction, sent: bytes) -> None:
        lane, wire = self._lanes[direction], self._wire
        for each in lane.split(sent):
            if direction == "from" and wire is not self._wire:
                break  # of a device that has been reset meanwhile
            kind = self._due_kind(direction, lane)
            lane.frames += 1
            passed = self._changed(lane, each)
            if kind is None or not passed:
                lane.put(passed, self.clock())
            elif kind in _SPOILT:
                lane.put(_SPOILT[kind](passed, lane.rng), self.clock())
            else:
                self.HAPPENS[kind](self, lane, passed)
            lane.release(self.clock())

    def _due_kind(self, direction: Direction, lane: _Lane) -> str | None:
        kind = self._at.get((direction, lane.frames))
        if kind is not None:
            return kind
        return next((kind for kind, rate in self._rates.items() if lane.rng.random() < rate), None)

    def _changed(self, lane: _Lane, sent: bytes) -> bytes:
        """By what lasts."""
        if self._is_silent:
            return b""
        if lane.lost_n:
            lane.lost_n -= 1
            return b""
        if self._is_garbled:
            return lane.rng.randbytes(lane.rng.randint(1, 2 * len(sent)))
        return _strange(sent) if self._is_stranger else sent

    def _lose_many(self, lane: _Lane, sent: bytes) -> None:  # noqa: ARG002 - it is lost
        lane.lost_n = int(MOST_FRAMES_OUT ** lane.rng.random())

    def _reorder(self, lane: _Lane, sent: bytes) -> None:
        lane.held.append((1 + lane.rng.randint(1, 3), sent))

    def _repeat(self, lane: _Lane, sent: bytes) -> None:
        lane.put(sent, self.clock())
        lane.held.append((1 + lane.rng.randint(1, MOST_FRAMES_LATE), sent))

    def _delay(self, lane: _Lane, sent: bytes) -> None:
        lane.stalled_s = self.clock() + lane.rng.random() * LONGEST_DELAY_S
        lane.put(sent, self.clock())

    def _start_babble(self, lane: _Lane, sent: bytes) -> None:
        lane.put(sent, self.clock())
        lane.babbles = True

    def _disconnect(self, lane: _Lane, sent: bytes) -> None:  # noqa: ARG002
        self._is_closed = True

    def _hang(self, lane: _Lane, sent: bytes) -> None:  # noqa: ARG002
        self._is_silent = True

    def _garble(self, lane: _Lane, sent: bytes) -> None:  # noqa: ARG002
        self._is_garbled = True

    def _replace_catalogue(self, lane: _Lane, sent: bytes) -> None:  # noqa: ARG002
        self._is_stranger = True

    def _reset(self, lane: _Lane, sent: bytes) -> None:
        """The device boots; what it was told and what it was saying is lost, but for what comes to it now."""
        self._wire.close()
        self._wire = self._open()
        if isinstance(self._wire, MemoryWire) and isinstance(self.clock, VirtualClock):
            self._wire.clock = self.clock
        self._lanes["from"].queue.clear()
        if lane is self._lanes["to"]:
            lane.put(sent, self.clock())

    HAPPENS: ClassVar[Mapping[str, Callable[[FaultyWire, _Lane, bytes], None]]] = {
        "outage": _lose_many,
        "reorder": _reorder,
        "repeat": _repeat,
        "delay": _delay,
        "babble": _start_babble,
        "disconnect": _disconnect,
        "hang": _hang,
        "wrong-baud": _garble,
        "stranger": _replace_catalogue,
        "reset": _reset,
    }


def _strange(sent: bytes) -> bytes:
    """As if the device had been built from another catalogue."""
    packets = frame.FrameDecoder().feed(sent)
    message = unpack(packets[0]) if packets else None
    if message is None:
        return sent
    if isinstance(message, Hello):
        message = message._replace(catalogue_hash=_STRANGERS_HASH)
    return frame.encode(pack(message), _STRANGERS_HASH)


PASSING = (*_SPOILT, "outage", "reorder", "repeat", "delay")
"""The kinds after which the line is as it was."""
KINDS = (*_SPOILT, *FaultyWire.HAPPENS)
