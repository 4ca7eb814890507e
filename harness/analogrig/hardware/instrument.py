"""What a bench instrument is to a rig: a generator with one output, and inputs that are sampled at the same instant.

A driver for another instrument is a subclass of ``Instrument`` and a line in ``DRIVERS``; what all of them have to do
is in tests/harness/test_instruments.py. Volts here are those at the instrument's own connectors; the rig knows what is
between them and the computer.
"""

from __future__ import annotations

import hashlib
import importlib
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError, RecordIncomplete, RigError
from analogrig_emulator import Excitation

_ROUNDING_V = 1e-9
_REMEMBERED = 64
"""So many records back an old one is known again."""


@dataclass(frozen=True)
class Datasheet:
    """What every instrument of a kind has: known before one is spoken to."""

    rate_hz: float
    """Samples per second of each input."""
    record_n: int
    """The most samples without a gap."""
    bits: int
    """Of its converters."""
    inputs: tuple[int, ...]
    """Numbers of its inputs, as printed on it."""
    output_v: tuple[float, float]
    """What its generator can give."""
    ranges_v: Mapping[str, tuple[float, float]]
    """Ranges of its inputs, by the instrument's own words."""


class Turn(NamedTuple):
    """A pot that is to stand at ``dial`` (0 to 1) so long after a record's first sample."""

    delay_s: float
    pot: str
    dial: float


class PotBox(Protocol):
    """Pots that an instrument turns itself. All may raise RigError."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def turn(self, pot: str, dial: float) -> None:
        """At once."""

    def schedule(self, turns: Sequence[Turn]) -> None:
        """These and no others, at exact instants within the next record and no further one."""


@dataclass(frozen=True)
class Taken:
    """What a driver has got out of its instrument: m samples of the inputs that were asked for."""

    volts: NDArray[np.float64]
    """(m, inputs): at the instrument, by its own calibration."""
    codes: NDArray[np.signedinteger]
    """(m, inputs): as the converters gave them, 0 in the middle of their range."""
    bits: int
    """Of those converters."""


@dataclass(frozen=True)
class Record:
    """n samples of the inputs that were asked for, without a gap."""

    volts: NDArray[np.float64]
    """(n, inputs): at the instrument."""
    codes: NDArray[np.signedinteger]
    """(n, inputs): as the converters gave them."""
    clipped: NDArray[np.bool_]
    """(n, inputs): the converter was at its end, and the volts are no measurement."""
    repeats: bool
    """All codes that were taken have been taken before, to the bit. No noise makes such: it is an old record."""


class Instrument(ABC):
    """Every method may raise RigError, which names the instrument and what it did not do."""

    datasheet: ClassVar[Datasheet]
    name: str
    """As a user would call it, for errors."""
    pots: PotBox | None = None
    """None: it has none."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._taken: deque[bytes] = deque(maxlen=_REMEMBERED)
        """Digests of the codes that were taken."""

    @classmethod
    @abstractmethod
    def is_address(cls, address: str) -> bool:
        """Whether one could be found at what stands behind ``scheme://``."""

    @classmethod
    def place(cls, address: str) -> str:
        """Name of what ``open`` connects to, for the option ``--allow``."""
        return address

    @classmethod
    @abstractmethod
    def open(cls, address: str, timeout_s: float) -> Instrument:
        """The one at an address that is one, in a known state, the generator off.

        :raises ConfigurationError: what it needs is not installed.
        """

    @classmethod
    def check(cls, excitation: Excitation) -> None:
        """That its generator has such a waveform, in volts at its output.

        :raises ConfigurationError: it has not; says why.
        """
        least_v, most_v = cls.datasheet.output_v
        if excitation.low_v < least_v - _ROUNDING_V or excitation.high_v > most_v + _ROUNDING_V:
            raise ConfigurationError(
                f"the generator would have to give {excitation.low_v:g} V to {excitation.high_v:g} V, and has"
                f" {least_v:g} V to {most_v:g} V"
            )

    @abstractmethod
    def set_inputs(self, ranges: Sequence[tuple[int, str]]) -> None:
        """Which inputs are wanted, in this order, each with the word for its range."""

    @abstractmethod
    def set_excitation(self, excitation: Excitation) -> None:
        """What the generator gives from the first sample of each record on, checked before; it stays off."""

    def record(self, samples: int, while_recording: Callable[[], None] | None = None) -> Record:
        """Switch the generator on, and at that instant begin a record of so many samples, at most ``record_n``.

        ``while_recording`` is called when it has begun, and may take as long as it lasts.
        """
        taken = self._take(samples, while_recording)
        if len(taken.codes) < samples:
            raise RecordIncomplete(f"{self.name}: gave {len(taken.codes)} of {samples} samples")
        if not np.isfinite(taken.volts).all():
            raise RecordIncomplete(f"{self.name}: gave samples that are no numbers")
        repeats = self._repeats(taken.codes)
        clipped = self._clipped(taken)
        return Record(taken.volts[:samples], taken.codes[:samples], clipped[:samples], repeats)

    @abstractmethod
    def _take(self, samples: int, while_recording: Callable[[], None] | None) -> Taken:
        """As ``record``; more samples may be taken than were asked for."""

    def _repeats(self, codes: NDArray[np.signedinteger]) -> bool:
        """Whether they have been taken before; from now on they have."""
        digest = hashlib.blake2b(codes.tobytes(), digest_size=16).digest()
        known = digest in self._taken
        self._taken.append(digest)
        return known

    def _clipped(self, taken: Taken) -> NDArray[np.bool_]:
        """At the first and the last code: where those are in volts is a matter of calibration."""
        least, most = -(1 << (taken.bits - 1)), (1 << (taken.bits - 1)) - 1
        if (beyond := (taken.codes < least) | (taken.codes > most)).any():
            code = taken.codes[beyond][0]
            raise RigError(f"{self.name}: gave the code {code}, which its {taken.bits} bits do not have")
        return np.asarray((taken.codes == least) | (taken.codes == most))

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


class Driver(NamedTuple):
    module: str
    kind: str
    """A class in it."""
    address: str
    """How one is written."""


DRIVERS = {
    "redpitaya": Driver("analogrig.hardware.red_pitaya", "RedPitaya", "HOST[:PORT]"),
    "nidaqmx": Driver("analogrig.hardware.ni_daqmx", "NiDaqmx", "CARD"),
}
"""By the scheme of an instrument's URL."""


def located(url: str) -> tuple[type[Instrument], str]:
    """The kind of instrument that a URL ``scheme://address`` names, and its address, which the driver understands.

    :raises ConfigurationError: there is no driver for it, or it is no address.
    """
    scheme, _, rest = url.partition(":")
    known = DRIVERS.get(scheme.lower())
    if known is not None and rest.startswith("//"):
        kind: type[Instrument] = getattr(importlib.import_module(known.module), known.kind)
        if kind.is_address(address := rest.removeprefix("//")):
            return kind, address
    forms = DRIVERS if known is None else {scheme: known}
    written = " or ".join(f"{scheme}://{driver.address}" for scheme, driver in forms.items())
    raise ConfigurationError(f"instrument {url!r}: give it as {written}")
