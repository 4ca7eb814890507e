"""Faults of a line, from a seed: how they are asked for, and what those do that befall any line, serial or CAN.

A fault happens at a numbered frame of one direction, or at any frame with a given probability; the frames are counted
from the opening of the line, from 0. harness/README.md says what becomes of a run with each of them.
"""

# ruff: noqa: S311 - the faults are drawn from a seed; they are no secret

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any, ClassVar, Generic, Literal, TypeVar

from analogrig.errors import ConfigurationError, LinkClosed
from analogrig.links.wire import Clock

Direction = Literal["to", "from"]
"""To the device, or from it."""
DIRECTIONS: tuple[Direction, ...] = ("to", "from")

LONGEST_DELAY_S = 3.0
MOST_FRAMES_LATE = 40
MOST_FRAMES_OUT = 600

_FAULT = re.compile(r"([a-z-]+)@(?:(to|from):([0-9]{1,12})|([0-9.]+(?:e-?[0-9]+)?))")
_SEED = re.compile(r"seed=([0-9]{1,18})")

T = TypeVar("T")


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
    def parse(cls, text: str, kinds: Collection[str]) -> WireFaults:
        """From words between commas: ``flip@to:81``, ``delay@from:0``, ``lose@0.001``, ``seed=7``.

        :raises ConfigurationError: a word is none of these, or the line has no such kind of fault.
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
    """One direction."""

    rng: Random
    """Its own: which of the two speaks first is a matter of timing."""
    frames: int = 0
    held: list[tuple[int, T]] = field(default_factory=list)
    """Frames that come after so many others."""
    queue: deque[tuple[float, T]] = field(default_factory=deque)
    """What is on its way, and when it comes."""
    stalled_s: float = 0.0
    """Until then nothing comes."""
    babbles: bool = False
    lost_n: int = 0
    """So many frames more are lost."""

    def put(self, sent: T, now_s: float) -> None:
        self.queue.append((max(now_s, self.stalled_s), sent))

    def release(self, now_s: float) -> None:
        """One frame has passed: those that waited for it come."""
        self.held = [(n - 1, sent) for n, sent in self.held]
        for n, sent in self.held:
            if n <= 0:
                self.put(sent, now_s)
        self.held = [(n, sent) for n, sent in self.held if n > 0]

    def due(self, now_s: float) -> list[T]:
        """All that has come by now."""
        out = []
        while self.queue and self.queue[0][0] <= now_s:
            out.append(self.queue.popleft()[1])
        return out


class FaultyLine(ABC, Generic[T]):
    """Does to the frames of a line, which are of the type T, what its faults say."""

    name: str
    clock: Clock

    def __init__(self, faults: WireFaults) -> None:
        """The line is open."""
        self._at = {(fault.direction, fault.frame): fault.kind for fault in faults.at}
        self._rates = dict(faults.rates)
        self._lanes: dict[Direction, Lane[T]] = {
            direction: Lane(Random(f"{faults.seed} {direction}")) for direction in DIRECTIONS
        }
        self._boots = 0
        self._is_closed = self._is_silent = self._is_stranger = False

    @property
    def frames(self) -> Mapping[Direction, int]:
        """How many frames have come by in each direction."""
        return {direction: lane.frames for direction, lane in self._lanes.items()}

    @property
    def waiting(self) -> int:
        """How many frames are kept."""
        return sum(len(lane.queue) + len(lane.held) for lane in self._lanes.values())

    # ---- what the line does

    @abstractmethod
    def _write(self, sent: Sequence[T]) -> None:
        """To the device."""

    @abstractmethod
    def _read(self, timeout_s: float) -> list[T]:
        """The frames that the device has completed."""

    @abstractmethod
    def _boot(self) -> None:
        """Open the device again."""

    @abstractmethod
    def _noise(self, direction: Direction, passed: list[T]) -> list[T]:
        """What comes when these would, and somebody babbles."""

    @abstractmethod
    def _stranger(self, sent: T) -> T:
        """As if the device had been built from another catalogue."""

    # ---- passing

    def _send(self, sent: Sequence[T]) -> None:
        self._enter("to", sent)
        self._deliver()

    def _receive(self, timeout_s: float) -> list[T]:
        """What has come, at least one frame unless the time is over."""
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
        """To the device, what is due."""
        if self._is_closed:
            raise LinkClosed(f"{self.name}: the line is cut")
        lane = self._lanes["to"]
        sent = lane.due(self.clock())
        if lane.babbles:
            sent = self._noise("to", sent)
        if sent and not self._is_silent:
            self._write(sent)

    def _soon_s(self) -> float:
        """How long nothing will come of itself."""
        due_s = [lane.queue[0][0] for lane in self._lanes.values() if lane.queue]
        return max(0.0, min(due_s) - self.clock()) if due_s else LONGEST_DELAY_S

    def _enter(self, direction: Direction, sent: Sequence[T]) -> None:
        lane, boots = self._lanes[direction], self._boots
        for each in sent:
            if direction == "from" and boots != self._boots:
                break  # of a device that has been reset meanwhile
            kind = self._due_kind(direction, lane)
            lane.frames += 1
            passed = self._changed(lane, each)
            if passed is not None:
                if kind is None:
                    lane.put(passed, self.clock())
                else:
                    self.HAPPENS[kind](self, lane, passed)
            lane.release(self.clock())

    def _due_kind(self, direction: Direction, lane: Lane[T]) -> str | None:
        kind = self._at.get((direction, lane.frames))
        if kind is not None:
            return kind
        return next((kind for kind, rate in self._rates.items() if lane.rng.random() < rate), None)

    def _changed(self, lane: Lane[T], sent: T) -> T | None:
        """By what lasts; None: it is lost."""
        if self._is_silent:
            return None
        if lane.lost_n:
            lane.lost_n -= 1
            return None
        return self._stranger(sent) if self._is_stranger else sent

    # ---- what happens to a frame

    def _drop(self, lane: Lane[T], sent: T) -> None:
        """It is lost."""

    def _duplicate(self, lane: Lane[T], sent: T) -> None:
        lane.put(sent, self.clock())
        lane.put(sent, self.clock())

    def _lose_many(self, lane: Lane[T], sent: T) -> None:  # noqa: ARG002 - it is lost
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
        """The device boots; what it was told and what it was saying is lost, but for what comes to it now."""
        self._boots += 1
        self._boot()
        self._lanes["from"].queue.clear()
        if lane is self._lanes["to"]:
            lane.put(sent, self.clock())

    PASSES: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        "drop": _drop,
        "duplicate": _duplicate,
        "outage": _lose_many,
        "reorder": _reorder,
        "repeat": _repeat,
        "delay": _delay,
    }
    """The kinds after which the line is as it was, of any line."""
    LASTS: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {
        "babble": _start_babble,
        "disconnect": _disconnect,
        "hang": _hang,
        "stranger": _replace_catalogue,
        "reset": _reset,
    }
    """The others of any line."""
    HAPPENS: ClassVar[Mapping[str, Callable[[Any, Lane[Any], Any], None]]] = {**PASSES, **LASTS}
    """All kinds of a line, by name."""
