"""What a bench instrument is to a rig: a generator with one output, and inputs that are sampled at the same instant.

A driver for another instrument is a subclass of ``Instrument`` and a line in ``INSTRUMENTS``. Volts here are those at
the instrument's own connectors; the rig knows what is between them and the computer.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from urllib.parse import SplitResult, urlsplit

import numpy as np
from numpy.typing import NDArray

from emulator.excitation import Excitation
from harness.errors import ConfigurationError


class Turn(NamedTuple):
    """A pot that is to stand at ``dial`` (0 to 1) so long after a record's first sample."""

    delay_s: float
    pot: str
    dial: float


@dataclass(frozen=True)
class Recorded:
    """A gap-free record: n samples of the inputs that were asked for."""

    volts: NDArray[np.float64]
    """(n, inputs): at the instrument."""
    clipped: NDArray[np.bool_]
    """(n, inputs): the converter was at its end, and the volts are no measurement."""


class Instrument(ABC):
    """Every method may raise RigError, which names the instrument and what it did not do."""

    name: str
    """As a user would call it, for errors."""
    rate_hz: float
    """Samples per second of each input."""
    record_n: int
    """The most samples without a gap."""
    bits: int
    inputs: tuple[int, ...]
    """Numbers of its inputs, as printed on it."""
    output_v: tuple[float, float]
    """What its generator can give."""
    ranges_v: dict[str, tuple[float, float]]
    """Ranges of its inputs, by the instrument's own words."""
    pots: tuple[str, ...] = ()
    """Those it can turn itself, at exact instants within a record; () if none."""

    @classmethod
    @abstractmethod
    def open(cls, url: str, timeout_s: float) -> Instrument:
        """The one at ``url``, in a known state, the generator off.

        :raises ConfigurationError: what it needs is not installed.
        """

    @classmethod
    @abstractmethod
    def check(cls, excitation: Excitation) -> None:
        """That its generator has such a waveform, in volts at its output.

        :raises ConfigurationError: it has not; says why.
        """

    @abstractmethod
    def set_inputs(self, ranges: Sequence[tuple[int, str]]) -> None:
        """Which inputs are wanted, in this order, each with the word for its range."""

    @abstractmethod
    def set_excitation(self, excitation: Excitation) -> None:
        """What the generator gives from the first sample of each record on, checked before; it stays off."""

    def turn(self, pot: str, dial: float) -> None:
        """At once.

        :raises RigError: it has no pots.
        """
        raise NotImplementedError

    @abstractmethod
    def record(
        self, samples: int, turns: Sequence[Turn] = (), while_recording: Callable[[], None] | None = None
    ) -> Recorded:
        """Switch the generator on, and at that instant begin a record of so many samples, at most ``record_n``.

        ``while_recording`` is called when it has begun, and may take as long as it lasts.
        """

    @abstractmethod
    def rest(self, settle_s: float) -> None:
        """The generator off, for so long of the computer's time."""

    @abstractmethod
    def make_safe(self) -> None:
        """The generator off. Called whatever happened before; does what it can.

        :raises RigError: it cannot be made safe; the message says what to do by hand.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of it; raises nothing."""


INSTRUMENTS = {
    "redpitaya": ("harness.rigs.red_pitaya", "RedPitaya"),
    "nidaqmx": ("harness.rigs.ni_daqmx", "NiDaqmx"),
}
"""Scheme of an instrument's URL to its module and class, whose ``open(url, timeout_s)`` makes one."""


def parsed(url: str) -> SplitResult:
    """:raises ConfigurationError: it is no URL of an instrument that is known."""
    try:
        split = urlsplit(url)
        known = split.scheme in INSTRUMENTS and bool(split.hostname) and (split.port is None or split.port > 0)
        known &= not (split.path or split.query or split.fragment or split.username or " " in url)
    except ValueError:
        known = False
    if not known:
        raise ConfigurationError(
            f"instrument {url!r}: give it as {' or '.join(f'{scheme}://NAME' for scheme in INSTRUMENTS)}"
        )
    return split


def driver(url: str) -> type[Instrument]:
    """Its class, which says what the instrument has without there being one.

    :raises ConfigurationError: there is no driver for it.
    """
    module, name = INSTRUMENTS[parsed(url).scheme]
    found: type[Instrument] = getattr(importlib.import_module(module), name)
    return found
