"""Interface of a rig: it performs a scenario and yields blocks of samples.

A description is read from a file and opens the rig, which performs scenarios until it is closed. Callers do not depend
on the class of a rig or a description: both state what they are capable of.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import Samples
from analogrig.plant import Segment
from analogrig.run import INPUT, OUTPUT, Channel, missing_samples
from analogrig.scenario import Scenario
from analogrig.trust import Thing

BLOCK_SAMPLES = 256
"""Block length in samples from rig to device: long enough to be fast, short enough to show progress and lose little."""


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive samples, each taken on all channels at the same instant; one column for each of the program."""

    first: int
    """Index of the first sample."""
    volts: NDArray[np.float64]
    """(n, c): volts at the computer's outputs; NaN in channels that are not measured, whose codes are 0."""
    codes: NDArray[np.uint16]
    """(n, c): codes of the card."""
    clipped: NDArray[np.bool_]
    """(n, c): True if the code is the end of the range, not a measurement."""
    record: int = 0
    """Number of the gap-free record that holds the block; nothing was sampled between two records."""

    def samples(self, record_start: int = 0) -> Samples:
        """Samples as the device takes them; ``record_start`` is the first sample of the record."""
        u, y = self.codes[:, INPUT], self.codes[:, OUTPUT]
        return Samples(self.first - record_start, u, y, ~missing_samples(self.clipped))


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
    standing: Mapping[str, float] = field(default_factory=dict)
    """Values of the parameters at the first sample where the resolution of the pots moved them."""


@dataclass(frozen=True, eq=False)
class Performance:
    """A scenario being played: what is known beforehand, and the samples as they come."""

    sample_period_s: float
    time_scale: float
    channels: Mapping[str, Channel]
    """Channels that are measured, input and output first: these at least."""
    blocks: Iterator[Block]
    hindsight: Callable[[], Hindsight]
    """Function to call when the blocks have been taken, or no more of them come."""

    @property
    def of_device(self) -> dict[str, Channel]:
        """Channels of the samples that a device takes, ``u`` and ``y``."""
        return dict(zip(("u", "y"), self.channels.values(), strict=False))


class Rig(Protocol):
    """Instrument that plays scenarios and yields blocks of samples; a context manager.

    ``open_rig`` returns one, ``Bench.play`` uses it. Methods raise RigError if the instrument fails, ConfigurationError
    if it cannot play a scenario. Subclass it; the defaults suit a rig that plays any scenario and holds nothing.
    """

    capabilities: frozenset[str]
    """Capabilities beyond sampling, of ``analogrig.rigs.CAPABILITIES``."""
    computes_circuit: bool = False
    """True for ``EmulatorRig``, the only rig with a circuit, exact components and block sizes."""

    @property
    def recorded(self) -> tuple[Scenario, int] | None:
        """Scenario and seed of a recording, which plays no others; None for a rig that plays any."""
        return None

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        """Begin to play; blocks are produced on demand.

        :raises ConfigurationError: the scenario cannot be played on this rig.
        :raises RigError: the rig failed; also while the blocks are taken.
        """

    def description(self) -> Mapping[str, Any]:
        """Name and settings in plain values, for the record."""

    def remarks(self) -> tuple[str, ...]:
        """Properties that the rig tells when asked, one line each.

        :raises RigError: the rig failed.
        """
        return ()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the rig safe: outputs off, connections closed."""
        return


@dataclass(frozen=True)
class RigDescription:
    """Base of the dataclasses that describe a rig: a table of a file. ``analogrig.rigs.description.KINDS`` lists them.

    The defaults are those of a kind that names nothing outside analogrig.
    """

    @property
    def only_one(self) -> str:
        """Place that only one process at a time can use; "" if there is none."""
        return ""

    def as_table(self) -> Mapping[str, Any]:
        """Plain values that a run on the rig records."""
        return dataclasses.asdict(self)

    @property
    def things(self) -> tuple[Thing, ...]:
        """Things that playing on the rig would run or connect to.

        :raises ConfigurationError: the description names them wrongly.
        """
        return ()

    def placed(self, folder: Path) -> Self:  # noqa: ARG002 - overridden
        """The same with absolute paths, where its own are relative to ``folder``."""
        return self

    def check(self) -> None:
        """Check what can be known before anything is played. Call it for trusted descriptions: it may open files.

        :raises ConfigurationError: the rig cannot be played on.
        """

    def open(self, *, self_test: bool = True) -> Rig:
        """Rig of the description.

        :param self_test: False: skip the self-test that the description may ask for.
        :raises ConfigurationError: the description contradicts itself.
        """
        raise NotImplementedError
