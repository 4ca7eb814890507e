"""Faults of a line: their notation, those that serial lines and CAN buses share, and those of a serial line.

A fault happens at a numbered frame of one direction, or at any frame with a given probability. Frames are counted from
the opening of the line, from 0. Everything random comes from a seed.
"""

# ruff: noqa: S311 - faults need a reproducible generator, not a secure one

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any, ClassVar, Generic, Literal, TypeVar

from analogrig.catalogue import CATALOGUE_HASH, Hello, pack, unpack
from analogrig.errors import ConfigurationError, LinkClosed
from analogrig.links.line import BITS_PER_BYTE
from analogrig.links.link import (
    DEFAULT_BAUD,
    MAX_ENCODED,
    Clock,
    Connection,
    FrameDecoder,
    VirtualClock,
    Wire,
    encode_frame,
)

Direction = Literal["to", "from"]
"""Direction to the device or from it."""
DIRECTIONS: tuple[Direction, ...] = ("to", "from")

LONGEST_DELAY_S = 3.0
MOST_FRAMES_LATE = 40
MOST_FRAMES_OUT = 600
STRANGERS_HASH = CATALOGUE_HASH ^ 0x5A5A5A5A

_FAULT = re.compile(r"([a-z-]+)@(?:(to|from):([0-9]{1,12})|([0-9.]+(?:e-?[0-9]+)?))")
_SEED = re.compile(r"seed=([0-9]{1,18})")

T = TypeVar("T")
"""A frame."""
L = TypeVar("L", bound=Connection)
"""A wire or a CAN bus."""


@dataclass(frozen=True)
class WireFault:
    """A fault that happens once, at one frame."""

    kind: str
    direction: Direction
    frame: int


@dataclass(frozen=True)
class WireFaults:
    """All faults of a line."""

    at: tuple[WireFault, ...] = ()
    rates: Mapping[str, float] = field(default_factory=dict)
    """Probability at every frame of both directions, by kind."""
    seed: int = 0

    @classmethod
    def parse(cls, text: str, kinds: Collection[str]) -> WireFaults:
        """Faults from comma-separated words: ``flip@to:81``, ``delay@from:0``, ``lose@0.001``, ``seed=7``.

        :raises ConfigurationError: a word is not one of these, or the line has no such kind of fault.
        """
        at, rates, seed = [], {}, 0
        for word in filter(None, (word.strip() for word in text.split(","))):
            if match := _SEED.fullmatch(word):
                seed = int(match[1])
            elif (match := _FAULT.fullmatch(word)) and match[1] in kinds:
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
                    f" where KIND is one of {', '.join(kinds)}"
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


@dataclass
class Lane(Generic[T]):
    """State of one direction."""

    rng: Random
    """Generator of this direction alone: the order of frames of both directions depends on timing."""
    clock: Clock
    frames: int = 0
    held: list[tuple[int, T]] = field(default_factory=list)
    """Delayed frames, each with the number of frames that pass before it."""
    queue: deque[tuple[float, T]] = field(default_factory=deque)
    """Frames on their way, each with its arrival time."""
    stalled_s: float = 0.0
    """Time before which nothing arrives."""
    babble: str = ""
    """Fault for which noise arrives; empty without noise."""
    lost_n: int = 0
    """Number of further frames to be lost."""

    def put(self, *sent: T) -> None:
        """Queue frames."""
        self.queue.extend((max(self.clock(), self.stalled_s), each) for each in sent)

    def release(self) -> None:
        """Count one frame that has passed, and queue the frames that waited for it."""
        if self.held:
            self.put(*(sent for n, sent in self.held if n <= 1))
            self.held = [(n - 1, sent) for n, sent in self.held if n > 1]

    @property
    def is_altered(self) -> bool:
        """True if not every frame passes at once."""
        return bool(self.held or self.queue or self.babble or self.lost_n or self.stalled_s > self.clock())

    def mend(self) -> None:
        """End outage, stall and noise, and lose the frames that are held back."""
        self.held.clear()
        self.queue.clear()
        self.stalled_s, self.babble, self.lost_n = 0.0, "", 0

    def due(self) -> list[T]:
        """Frames that have arrived by now."""
        out = []
        while self.queue and self.queue[0][0] <= self.clock():
            out.append(self.queue.popleft()[1])
        return out


class FaultyLine(ABC, Generic[L, T]):
    """A line of type L that applies faults to its frames, of type T."""

    TRANSIENT: ClassVar[tuple[str, ...]] = ("drop", "duplicate", "outage", "reorder", "repeat", "delay")
    """Kinds of faults after which the line is intact."""
    LASTING: ClassVar[tuple[str, ...]] = ("babble", "disconnect", "hang", "stranger", "reset")
    KINDS: ClassVar[tuple[str, ...]] = (*TRANSIENT, *LASTING)

    def __init__(self, open_line: Callable[[], L], faults: WireFaults) -> None:
        """Open the line. A reset of the device opens it again."""
        self._open = open_line
        self._line = open_line()
        self.name = self._line.name
        self.clock = self._line.clock
        self._at = {(fault.direction, fault.frame): fault.kind for fault in faults.at}
        self._rates = dict(faults.rates)
        self._lanes: dict[Direction, Lane[T]] = {
            direction: Lane(Random(f"{faults.seed} {direction}"), self.clock) for direction in DIRECTIONS
        }
        self._boots = 0
        self._lasting: set[str] = set()
        """Lasting faults that have happened."""

    @property
    def frames(self) -> Mapping[Direction, int]:
        """Number of frames so far, by direction."""
        return {direction: lane.frames for direction, lane in self._lanes.items()}

    @property
    def waiting(self) -> int:
        """Number of frames that are held back."""
        return sum(len(lane.queue) + len(lane.held) for lane in self._lanes.values())

    @property
    def lasting(self) -> Sequence[str]:
        """Kinds of the faults in force."""
        return sorted(self._lasting | {lane.babble for lane in self._lanes.values() if lane.babble})

    def inject(self, kind: str, direction: Direction) -> None:
        """Apply a fault at the next frame of this direction.

        :raises ConfigurationError: the line has no such fault.
        """
        if kind not in self.KINDS:
            raise ConfigurationError(f"the line has no fault {kind!r}: it has {', '.join(self.KINDS)}")
        self._at[direction, self._lanes[direction].frames] = kind

    def mend(self) -> None:
        """End the faults in force; frames that are held back are lost."""
        self._lasting.clear()
        for lane in self._lanes.values():
            lane.mend()

    def close(self) -> None:
        self._line.close()

    # ---- differences between lines

    @abstractmethod
    def _write(self, sent: Sequence[T]) -> None:
        """Pass frames on to the device."""

    @abstractmethod
    def _read(self, timeout_s: float) -> list[T]:
        """Complete frames from the device."""

    @abstractmethod
    def _noise(self, direction: Direction, passed: list[T]) -> list[T]:
        """Frames that arrive instead of ``passed`` while another node babbles."""

    @abstractmethod
    def _stranger(self, sent: T) -> T:
        """The frame as a device built from another catalogue would send it."""

    # ---- transport

    def _boot(self) -> None:
        """Open the device again; virtual time goes on."""
        self._boots += 1
        self._line.close()
        self._line = self._open()
        if isinstance(self.clock, VirtualClock):
            line: Any = self._line
            line.clock = self.clock

    def _advance(self, by_s: float) -> None:
        """Let virtual time pass; real time passes by itself."""
        if isinstance(self.clock, VirtualClock):
            self.clock.advance(by_s)

    @property
    def _is_intact(self) -> bool:
        """True if no frame can have a fault before another one is injected, and none is held back."""
        lanes = self._lanes.values()
        return not (self._at or self._rates or self._lasting or any(lane.is_altered for lane in lanes))

    def _send(self, sent: Sequence[T]) -> None:
        if self._is_intact:
            self._lanes["to"].frames += len(sent)
            self._write(sent)
            return
        self._enter("to", sent)
        self._deliver()

    def _receive(self, timeout_s: float) -> list[T]:
        """Frames that have arrived; at least one, unless the time-out has passed."""
        deadline_s, is_over = self.clock() + timeout_s, False
        lane = self._lanes["from"]
        while True:
            self._deliver()
            if lane.babble:
                self._enter("from", self._read(0.0))
                return self._noise("from", lane.due())
            received = lane.due()
            if received or is_over:
                return received
            left_s = max(0.0, deadline_s - self.clock())
            passed = self._read(min(left_s, self._soon_s()))
            if passed and self._is_intact:
                lane.frames += len(passed)
                return passed
            self._enter("from", passed)
            is_over = self.clock() >= deadline_s

    def _deliver(self) -> None:
        """Pass on to the device what is due."""
        if "disconnect" in self._lasting:
            raise LinkClosed(f"{self.name}: the line is cut")
        lane = self._lanes["to"]
        sent = lane.due()
        if lane.babble:
            sent = self._noise("to", sent)
        if sent and "hang" not in self._lasting:
            self._write(sent)

    def _soon_s(self) -> float:
        """Time until the next held frame is due [s]."""
        due_s = [lane.queue[0][0] for lane in self._lanes.values() if lane.queue]
        return max(0.0, min(due_s) - self.clock()) if due_s else LONGEST_DELAY_S

    def _enter(self, direction: Direction, sent: Sequence[T]) -> None:
        lane, boots = self._lanes[direction], self._boots
        for each in sent:
            if direction == "from" and boots != self._boots:
                break  # the device was reset meanwhile: its earlier frames are lost
            kind = self._at.pop((direction, lane.frames), None)
            if kind is None:
                kind = next((kind for kind, rate in self._rates.items() if lane.rng.random() < rate), None)
            lane.frames += 1
            passed = self._apply_lasting(lane, each)
            if passed is not None:
                lane.put(*([passed] if kind is None else self._apply(kind, lane, passed)))
            lane.release()

    # ---- faults

    def _apply_lasting(self, lane: Lane[T], sent: T) -> T | None:
        """The frame after faults that last; None if it is lost."""
        if "hang" in self._lasting:
            return None
        if lane.lost_n:
            lane.lost_n -= 1
            return None
        return self._stranger(sent) if "stranger" in self._lasting else sent

    def _apply(self, kind: str, lane: Lane[T], sent: T) -> Sequence[T]:
        """Begin a fault at a frame; return the frames that follow at once in its place."""
        match kind:
            case "duplicate":
                return sent, sent
            case "outage":
                lane.lost_n = int(MOST_FRAMES_OUT ** lane.rng.random())
            case "reorder":
                lane.held.append((1 + lane.rng.randint(1, 3), sent))
            case "repeat":
                lane.held.append((1 + lane.rng.randint(1, MOST_FRAMES_LATE), sent))
                return (sent,)
            case "delay":
                lane.stalled_s = self.clock() + lane.rng.random() * LONGEST_DELAY_S
                return (sent,)
            case "babble" | "jam":
                lane.babble = kind
                return (sent,)
            case "reset":  # everything on the way is lost, except the frame that reaches the device now
                self._boot()
                self._lanes["from"].queue.clear()
                return (sent,) if lane is self._lanes["to"] else ()
            case _ if kind not in self.TRANSIENT:
                self._lasting.add(kind)
        return ()


_BABBLE_BYTES = 1024

_FRAME = re.compile(rb"\0*[^\0]+\0")


def _damage(kind: str, sent: bytes, rng: Random) -> bytes:
    """Flip up to four bits, lose up to four bytes, insert up to sixteen, or truncate."""
    out = bytearray(sent)
    if kind == "flip":
        for _ in range(rng.randint(1, 4)):
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    elif kind == "insert":
        at = rng.randint(0, len(out))
        out[at:at] = rng.randbytes(rng.randint(1, 16))
    else:
        at = rng.randrange(len(out))
        end = at + rng.randint(1, 4) if kind == "lose" else len(out)
        del out[at:end]
    return bytes(out)


class FaultyWire(FaultyLine[Wire, bytes]):
    """A wire that applies faults to its bytes and frames."""

    DAMAGES = ("flip", "lose", "insert", "truncate")
    TRANSIENT = (*DAMAGES, *FaultyLine.TRANSIENT)
    KINDS = (*TRANSIENT, *FaultyLine.LASTING, "wrong-baud")

    def __init__(self, open_wire: Callable[[], Wire], faults: WireFaults) -> None:
        """Open the wire. A reset of the device opens it again."""
        super().__init__(open_wire, faults)
        self._begun: dict[Direction, bytes] = dict.fromkeys(DIRECTIONS, b"")
        """Bytes of the incomplete frame, by direction."""

    def write(self, sent: bytes) -> None:
        self._send(self._split("to", sent))

    def read(self, timeout_s: float) -> bytes:
        return b"".join(self._receive(timeout_s))

    def _split(self, direction: Direction, sent: bytes) -> list[bytes]:
        """Complete frames."""
        begun = self._begun[direction] + sent
        frames = _FRAME.findall(begun)
        self._begun[direction] = begun[sum(map(len, frames)) :][-MAX_ENCODED:]
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
        if passed is None or "wrong-baud" not in self._lasting:
            return passed
        return lane.rng.randbytes(lane.rng.randint(1, 2 * len(sent)))

    def _apply(self, kind: str, lane: Lane[bytes], sent: bytes) -> Sequence[bytes]:
        if kind in self.DAMAGES:
            return (_damage(kind, sent, lane.rng),)
        return super()._apply(kind, lane, sent)

    def _stranger(self, sent: bytes) -> bytes:
        packets = FrameDecoder().feed(sent)
        message = unpack(packets[0]) if packets else None
        if message is None:
            return sent
        if isinstance(message, Hello):
            message = message._replace(catalogue_hash=STRANGERS_HASH)
        return encode_frame(pack(message), STRANGERS_HASH)
