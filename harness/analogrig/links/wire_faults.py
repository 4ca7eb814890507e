"""Faults of a line: their notation, and the faults that serial lines and CAN buses share.

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

from analogrig.errors import ConfigurationError, LinkClosed
from analogrig.links.wire import Connection, VirtualClock

Direction = Literal["to", "from"]
"""Direction to the device or from it."""
DIRECTIONS: tuple[Direction, ...] = ("to", "from")

LONGEST_DELAY_S = 3.0
MOST_FRAMES_LATE = 40
MOST_FRAMES_OUT = 600

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
    frames: int = 0
    held: list[tuple[int, T]] = field(default_factory=list)
    """Delayed frames, each with the number of frames that pass before it."""
    queue: deque[tuple[float, T]] = field(default_factory=deque)
    """Frames on their way, each with its arrival time."""
    stalled_s: float = 0.0
    """Time before which nothing arrives."""
    babbles: bool = False
    lost_n: int = 0
    """Number of further frames to be lost."""

    def put(self, sent: T, now_s: float) -> None:
        self.queue.append((max(now_s, self.stalled_s), sent))

    def release(self, now_s: float) -> None:
        """Count one frame that has passed, and queue the frames that waited for it."""
        self.held = [(n - 1, sent) for n, sent in self.held]
        for n, sent in self.held:
            if n <= 0:
                self.put(sent, now_s)
        self.held = [(n, sent) for n, sent in self.held if n > 0]

    def due(self, now_s: float) -> list[T]:
        """Frames that have arrived by now."""
        out = []
        while self.queue and self.queue[0][0] <= now_s:
            out.append(self.queue.popleft()[1])
        return out


class FaultyLine(ABC, Generic[L, T]):
    """A line of type L that applies faults to its frames, of type T."""

    def __init__(self, open_line: Callable[[], L], faults: WireFaults) -> None:
        """Open the line. A reset of the device opens it again."""
        self._open = open_line
        self._line = open_line()
        self.name = self._line.name
        self.clock = self._line.clock
        self._at = {(fault.direction, fault.frame): fault.kind for fault in faults.at}
        self._rates = dict(faults.rates)
        self._lanes: dict[Direction, Lane[T]] = {
            direction: Lane(Random(f"{faults.seed} {direction}")) for direction in DIRECTIONS
        }
        self._boots = 0
        self._is_closed = self._is_silent = self._is_stranger = False

    @property
    def frames(self) -> Mapping[Direction, int]:
        """Number of frames so far, by direction."""
        return {direction: lane.frames for direction, lane in self._lanes.items()}

    @property
    def waiting(self) -> int:
        """Number of frames that are held back."""
        return sum(len(lane.queue) + len(lane.held) for lane in self._lanes.values())

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
        self._line.close()
        self._line = self._open()
        if isinstance(self.clock, VirtualClock):
            line: Any = self._line
            line.clock = self.clock

    def _advance(self, by_s: float) -> None:
        """Let virtual time pass; real time passes by itself."""
        if isinstance(self.clock, VirtualClock):
            self.clock.advance(by_s)

    def _send(self, sent: Sequence[T]) -> None:
        self._enter("to", sent)
        self._deliver()

    def _receive(self, timeout_s: float) -> list[T]:
        """Frames that have arrived; at least one, unless the time-out has passed."""
        deadline_s, is_over = self.clock() + timeout_s, False
        lane = self._lanes["from"]
        while True:
            self._deliver()
            if lane.babbles:
                self._enter("from", self._read(0.0))
                return self._noise("from", lane.due(self.clock()))
            received = lane.due(self.clock())
            if received or is_over:
                return received
            left_s = max(0.0, deadline_s - self.clock())
            self._enter("from", self._read(min(left_s, self._soon_s())))
            is_over = self.clock() >= deadline_s

    def _deliver(self) -> None:
        """Pass on to the device what is due."""
        if self._is_closed:
            raise LinkClosed(f"{self.name}: the line is cut")
        lane = self._lanes["to"]
        sent = lane.due(self.clock())
        if lane.babbles:
            sent = self._noise("to", sent)
        if sent and not self._is_silent:
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
            kind = self._due_kind(direction, lane)
            lane.frames += 1
            passed = self._apply_lasting(lane, each)
            if passed is not None:
                if kind is None:
                    lane.put(passed, self.clock())
                else:
                    self.KINDS[kind](self, lane, passed)
            lane.release(self.clock())

    def _due_kind(self, direction: Direction, lane: Lane[T]) -> str | None:
        kind = self._at.get((direction, lane.frames))
        if kind is not None:
            return kind
        return next((kind for kind, rate in self._rates.items() if lane.rng.random() < rate), None)

    def _apply_lasting(self, lane: Lane[T], sent: T) -> T | None:
        """The frame after faults that last; None if it is lost."""
        if self._is_silent:
            return None
        if lane.lost_n:
            lane.lost_n -= 1
            return None
        return self._stranger(sent) if self._is_stranger else sent

    # ---- faults of one frame

    def _drop(self, lane: Lane[T], sent: T) -> None:
        """Lose the frame."""

    def _duplicate(self, lane: Lane[T], sent: T) -> None:
        lane.put(sent, self.clock())
        lane.put(sent, self.clock())

    def _lose_many(self, lane: Lane[T], sent: T) -> None:  # noqa: ARG002 - the frame is lost
        lane.lost_n = int(MOST_FRAMES_OUT ** lane.rng.random())

    def _reorder(self, lane: Lane[T], sent: T) -> None:
        lane.held.append((1 + lane.rng.randint(1, 3), sent))

    def _repeat(self, lane: Lane[T], sent: T) -> None:
        lane.put(sent, self.clock())
        lane.held.append((1 + lane.rng.randint(1, MOST_FRAMES_LATE), sent))

    def _delay(self, lane: Lane[T], sent: T) -> None:
        lane.stalled_s = self.clock() + lane.rng.random() * LONGEST_DELAY_S
        lane.put(sent, self.clock())

    def _start_babble(self, lane: Lane[T], sent: T) -> None:
        lane.put(sent, self.clock())
        lane.babbles = True

    def _disconnect(self, lane: Lane[T], sent: T) -> None:  # noqa: ARG002
        self._is_closed = True

    def _hang(self, lane: Lane[T], sent: T) -> None:  # noqa: ARG002
        self._is_silent = True

    def _replace_catalogue(self, lane: Lane[T], sent: T) -> None:  # noqa: ARG002
        self._is_stranger = True

    def _reset(self, lane: Lane[T], sent: T) -> None:
        """Boot the device. Everything on the way is lost, except the frame that reaches it now."""
        self._boots += 1
        self._boot()
        self._lanes["from"].queue.clear()
        if lane is self._lanes["to"]:
            lane.put(sent, self.clock())

    TRANSIENT: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        "drop": _drop,
        "duplicate": _duplicate,
        "outage": _lose_many,
        "reorder": _reorder,
        "repeat": _repeat,
        "delay": _delay,
    }
    """Faults of any line after which the line is intact."""
    LASTING: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        "babble": _start_babble,
        "disconnect": _disconnect,
        "hang": _hang,
        "stranger": _replace_catalogue,
        "reset": _reset,
    }
    """Faults of any line that last."""
    KINDS: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {**TRANSIENT, **LASTING}
    """All faults of this line, by kind."""
