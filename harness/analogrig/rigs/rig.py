"""What a rig is to everything behind it: it performs a scenario and yields blocks of samples.

A rig is opened by name, performs scenarios, and is closed. The emulated computer, a recording and a real one are
classes with these methods. Whoever plays on a rig needs no more, and asks not which one it has; who wants what only one
of them has, the circuit of the emulated computer or the file of a recording, asks for that class.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.run import Channel, Segment
from analogrig.scenario import Scenario

BLOCK_SAMPLES = 256
"""Samples that pass from rig to device at a time: enough to be fast, few enough to show progress and to lose little."""

CHANNEL_UNITS = {"force": "N", "displacement": "m", "velocity": "m/s", "net_force": "N"}


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive samples, each taken on all channels at the same instant; columns as ``CHANNELS``."""

    first: int
    """Index of the first sample."""
    volts: NDArray[np.float64]
    """(n, 4): at the computer's outputs; NaN in channels that are not measured, whose codes are 0."""
    codes: NDArray[np.uint16]
    """(n, 4)"""
    clipped: NDArray[np.bool_]
    """(n, 4): the code is the end of the range, not a measurement."""
    record: int = 0
    """Number of the gap-free record that it is of: between two of them there was time in which nobody looked."""


@dataclass(frozen=True)
class Hindsight:
    """What is known of a performance when its blocks have been taken."""

    segments: tuple[Segment, ...]
    """The truth; empty if the rig does not know it."""
    lamps: Mapping[str, int] = field(default_factory=dict)
    """Of each amplifier whose overload lamp is lit, the first sample that was taken with it lit."""
    caveats: tuple[str, ...] = ()
    """Why what was played cannot be judged; none if it can."""
    noise_lsb: Mapping[str, float] = field(default_factory=dict)
    """rms on a channel before quantisation, by its name, where it was measured."""


@dataclass(frozen=True, eq=False)
class Performance:
    """A scenario being played: what is known beforehand, and the samples as they come."""

    sample_period_s: float
    time_scale: float
    channels: Mapping[str, Channel]
    """Those that are measured: force and displacement at least."""
    blocks: Iterator[Block]
    hindsight: Callable[[], Hindsight]
    """Asked when the blocks have been taken, or no more of them come."""


class Rig(Protocol):
    """Instrument that plays scenarios and yields blocks of samples; a context manager.

    ``open_rig`` returns one, ``Bench.play`` uses it. Methods raise RigError if the instrument fails, ConfigurationError
    if it cannot play a scenario.
    """

    capabilities: frozenset[str]
    """What it can do beyond sampling, of ``analogrig.rigs.CAPABILITIES``."""

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        """Begin to play; the blocks are produced as they are asked for.

        :raises ConfigurationError: the scenario cannot be played on this rig.
        :raises RigError: the rig failed; also while the blocks are taken.
        """

    def description(self) -> Mapping[str, Any]:
        """Its name and settings in plain values, for the record."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave it safe: outputs off, connections closed."""
