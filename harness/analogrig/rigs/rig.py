"""Interface of a rig: it performs a scenario and yields blocks of samples.

A rig is opened by name, performs scenarios, and is closed. The emulated computer, a recording and a real computer are
classes with these methods. Callers do not depend on the class of a rig. Code that needs a particular one, such as the
emulator's circuit or the file of a recording, asks for that class.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.plant import Segment
from analogrig.run import Channel
from analogrig.scenario import Scenario

BLOCK_SAMPLES = 256
"""Block length in samples from rig to device: long enough to be fast, short enough to show progress and lose little."""

CHANNEL_UNITS = {"force": "N", "displacement": "m", "velocity": "m/s", "net_force": "N"}


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive samples, each taken on all channels at the same instant; columns as ``CHANNELS``."""

    first: int
    """Index of the first sample."""
    volts: NDArray[np.float64]
    """(n, 4): volts at the computer's outputs; NaN in channels that are not measured, whose codes are 0."""
    codes: NDArray[np.uint16]
    """(n, 4): codes of the card."""
    clipped: NDArray[np.bool_]
    """(n, 4): True if the code is the end of the range, not a measurement."""
    record: int = 0
    """Number of the gap-free record that holds the block; nothing was sampled between two records."""


@dataclass(frozen=True)
class Hindsight:
    """Facts about a performance that are known once its blocks have been taken."""

    segments: tuple[Segment, ...]
    """True parameters; empty if the rig does not know them."""
    lamps: Mapping[str, int] = field(default_factory=dict)
    """First sample with the overload lamp lit, for each amplifier whose lamp was lit."""
    caveats: tuple[str, ...] = ()
    """Reasons why the performance cannot be judged; empty if it can."""
    noise_lsb: Mapping[str, float] = field(default_factory=dict)
    """Noise before quantisation, rms, by channel name, where it was measured."""


@dataclass(frozen=True, eq=False)
class Performance:
    """A scenario being played: what is known beforehand, and the samples as they come."""

    sample_period_s: float
    time_scale: float
    channels: Mapping[str, Channel]
    """Channels that are measured: force and displacement at least."""
    blocks: Iterator[Block]
    hindsight: Callable[[], Hindsight]
    """Function to call when the blocks have been taken, or no more of them come."""


class Rig(Protocol):
    """Instrument that plays scenarios and yields blocks of samples; a context manager.

    ``open_rig`` returns one, ``Bench.play`` uses it. Methods raise RigError if the instrument fails, ConfigurationError
    if it cannot play a scenario.
    """

    capabilities: frozenset[str]
    """Capabilities beyond sampling, of ``analogrig.rigs.CAPABILITIES``."""

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        """Begin to play; blocks are produced on demand.

        :raises ConfigurationError: the scenario cannot be played on this rig.
        :raises RigError: the rig failed; also while the blocks are taken.
        """

    def description(self) -> Mapping[str, Any]:
        """Name and settings in plain values, for the record."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the rig safe: outputs off, connections closed."""
