"""Interface of the bench instruments: a generator with one output, and inputs sampled at the same instant.

A driver is a subclass of ``Instrument`` and an entry point of ``analogrig.instruments``, named like the scheme of its
URLs. tests/harness/test_instruments.py tests the drivers of this repository.
Volts are those at the instrument's connectors. ``analogrig_instruments.rig_wiring`` describes the stages to the
computer.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, RigError
from analogrig.config import Kinds
from analogrig.entry_points import INSTRUMENTS
from analogrig.errors import RecordIncomplete
from analogrig_emulator import Excitation

if TYPE_CHECKING:
    from analogrig.links import Clock
    from analogrig_instruments.simulator.tcp_server import TcpServer

_ROUNDING_V = 1e-9
EARLY_N = 1e-4
"""Time from an edge to its first sample, in samples, so that rounding never puts the edge after the sample."""

_REMEMBERED = 64
"""Number of records among which a repetition is recognised."""


@dataclass(frozen=True)
class InstrumentDatasheet:
    """Properties that all instruments of a kind share, known without a connection."""

    rate_hz: float
    """Samples per second of each input."""
    record_n: int
    """Largest number of samples without a gap."""
    bits: int
    """Resolution of the converters."""
    inputs: tuple[int, ...]
    """Numbers of the inputs, as printed on the instrument."""
    output_v: tuple[float, float]
    """Lowest and highest voltage of the generator."""
    ranges_v: Mapping[str, tuple[float, float]]
    """Input ranges by the instrument's own names."""


class DialChange(NamedTuple):
    """Set one pot to ``dial`` (0 to 1), ``delay_s`` seconds after the first sample of a record."""

    delay_s: float
    pot: str
    dial: float


class Pots:
    """Pots that are set one after another. These need no setting: they are assumed to stand as wanted."""

    slow: bool = False
    """True if a hand turns them for many samples; otherwise each jumps."""

    def set(self, dials: Mapping[str, float], words: str, *, recording: bool) -> None:  # noqa: ARG002 - for an operator
        """Set pots by name, and return when they stand.

        :param words: the target values for the operator prompt: ``M 115 kg, K 24500 N/m``.
        :param recording: True if a record is being taken, so that they must move at once.
        :raises RigError: they could not be set.
        """
        for pot, dial in dials.items():
            self.set_one(pot, dial)

    def set_one(self, pot: str, dial: float) -> None:
        """Set a pot. :raises RigError: that failed."""

    def standing(self, dials: Mapping[str, float]) -> dict[str, float]:
        """Positions that pots take when they are set to these, as far as their resolution is known."""
        return dict(dials)

    def close(self) -> None:
        """Release the connection to the pots."""


class PotBox(Pots):
    """Pots that an instrument sets itself."""

    names: tuple[str, ...]

    def schedule(self, changes: Sequence[DialChange]) -> None:
        """Replace the changes that the box makes at exact instants within the next record, and in no later one."""
        raise NotImplementedError


@dataclass(frozen=True)
class InputRecord:
    """n consecutive samples of the requested inputs, without a gap."""

    volts: NDArray[np.float64]
    """(n, inputs): at the instrument, by its own calibration."""
    codes: NDArray[np.signedinteger]
    """(n, inputs): as the converters gave them, 0 in the middle of their range."""
    bits: int
    """Resolution of those converters."""
    repeats: bool = False
    """True if all codes equal those of an earlier record to the bit: a stale record, since noise never repeats."""

    @property
    def _ends(self) -> tuple[int, int]:
        return -(1 << (self.bits - 1)), (1 << (self.bits - 1)) - 1

    @property
    def clipped(self) -> NDArray[np.bool_]:
        """(n, inputs): the converter was at its end, and the volts are no measurement.

        Judged by codes: the volts of the ends depend on the calibration.
        """
        least, most = self._ends
        return np.asarray((self.codes == least) | (self.codes == most))

    def check(self, name: str) -> None:
        """Check the samples of the instrument ``name``.

        :raises RecordIncomplete: some volts are non-finite.
        :raises RigError: some codes exceed the resolution.
        """
        if not np.isfinite(self.volts).all():
            raise RecordIncomplete(f"{name}: returned non-finite samples")
        least, most = self._ends
        if (beyond := (self.codes < least) | (self.codes > most)).any():
            raise RigError(f"{name}: returned the code {self.codes[beyond][0]}, which exceeds its {self.bits} bits")


class Instrument(ABC):
    """Base class of the drivers. All methods may raise RigError, which names the instrument and what failed."""

    datasheet: ClassVar[InstrumentDatasheet]
    form: ClassVar[str]
    """Form of the addresses after ``scheme://``, for messages: ``HOST[:PORT]``."""
    served_port: ClassVar[int] = 0
    """Default TCP port of ``serve``; 0: there is no emulated instrument of this kind."""
    name: str
    """Name for error messages."""
    pots: PotBox | None = None
    """Pots of the instrument; None if it has none."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._ranges: tuple[tuple[int, str], ...] = ()
        self._excitation = Excitation()
        self._digests: deque[bytes] = deque(maxlen=_REMEMBERED)
        """Digests of the codes of earlier records."""

    def patch(self, program: str) -> None:  # noqa: B027 - most are no computer
        """Patch a program, where the instrument is the computer too; others are patched by hand.

        :raises ConfigurationError: it cannot be patched; names the term.
        """

    def remarks(self) -> tuple[str, ...]:
        """Properties that the patched instrument tells when asked, one line each."""
        return ()

    def find_pots(self, names: Iterable[str]) -> PotBox:
        """Pots of the instrument, which are to have these names.

        :raises RigError: some are missing.
        """
        missing = sorted(set(names) - set(self.pots.names if self.pots else ()))
        if self.pots is None or missing:
            raise RigError(f"{self.name}: lacks the pots {', '.join(missing)}")
        return self.pots

    @classmethod
    @abstractmethod
    def place(cls, address: str) -> str:
        """Value of ``--allow`` that permits ``open`` to connect to ``address``, which follows ``scheme://``.

        Empty if the address is malformed.
        """

    @classmethod
    @abstractmethod
    def open(cls, address: str, timeout_s: float) -> Instrument:
        """Connect to the instrument at a valid address; leave it in a known state, the generator off.

        :raises ConfigurationError: a package that the driver needs is not installed.
        """

    @classmethod
    def emulated(
        cls,
        rig: str | None,  # noqa: ARG003 - overridden
        program: str | None,  # noqa: ARG003
        seed: int,  # noqa: ARG003
        defects: Sequence[str],  # noqa: ARG003
        clock: Clock | None,  # noqa: ARG003
    ) -> tuple[TcpServer, Mapping[str, str]]:
        """Server of an emulated instrument, and the names of its rig and program.

        :param defects: ``KEY=VALUE``.
        :param clock: None: time passes in records alone.
        :raises ConfigurationError: a name or a defect is wrong, or there is no emulated instrument of this kind.
        """
        raise ConfigurationError("there is no emulated instrument of this kind")

    @classmethod
    def check(cls, excitation: Excitation) -> None:
        """Check that the generator can play a waveform, in volts at its output.

        :raises ConfigurationError: it cannot; the message says why.
        """
        least_v, most_v = cls.datasheet.output_v
        if excitation.low_v < least_v - _ROUNDING_V or excitation.high_v > most_v + _ROUNDING_V:
            raise ConfigurationError(
                f"the generator would have to give {excitation.low_v:g} V to {excitation.high_v:g} V, and has"
                f" {least_v:g} V to {most_v:g} V"
            )

    def set_inputs(self, ranges: Sequence[tuple[int, str]]) -> None:
        """Choose the inputs of the next records, in this order, each with the name of its range."""
        self._ranges = tuple(ranges)

    def set_excitation(self, excitation: Excitation) -> None:
        """Choose the checked waveform that starts with the first sample of each record. The generator stays off."""
        self._excitation = excitation

    def record(self, samples: int, while_recording: Callable[[], None] | None = None) -> InputRecord:
        """Switch the generator on, and start a record of ``samples`` samples, at most ``record_n``, at that instant.

        :param while_recording: called once the record has started; may take as long as the record.
        """
        taken = self._take(samples, while_recording)
        if len(taken.codes) < samples:
            raise RecordIncomplete(f"{self.name}: returned {len(taken.codes)} of {samples} samples")
        taken.check(self.name)
        repeats = self._repeats(taken.codes)
        return replace(taken, volts=taken.volts[:samples], codes=taken.codes[:samples], repeats=repeats)

    @abstractmethod
    def _take(self, samples: int, while_recording: Callable[[], None] | None) -> InputRecord:
        """Take a record as ``record`` describes; the result may have more samples than requested."""

    def _repeats(self, codes: NDArray[np.signedinteger]) -> bool:
        """Remember codes. Return True if they were remembered before."""
        digest = hashlib.blake2b(codes.tobytes(), digest_size=16).digest()
        known = digest in self._digests
        self._digests.append(digest)
        return known

    @abstractmethod
    def rest(self, settle_s: float) -> None:
        """Switch the generator off, and wait for ``settle_s`` seconds of machine time."""

    @abstractmethod
    def make_safe(self) -> None:
        """Switch the generator off, in any state of the instrument.

        :raises RigError: it may still be on.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the connection. Raises nothing."""


def check_edges(excitation: Excitation, rate_hz: float) -> None:
    """Check that a generator with a clock of its own can put edges on the samples, where that is asked for.

    :raises ConfigurationError: the edges are no whole samples apart.
    """
    period_n = rate_hz / excitation.frequency_hz
    high_n = period_n * (0.5 if excitation.shape == "square" else excitation.duty)
    if excitation.clock == "card" and not (_is_whole(high_n) and _is_whole(period_n)):
        raise ConfigurationError(
            f'{excitation.frequency_hz:g} Hz on the clock "card" needs edges that are whole samples apart, not'
            f' {high_n:g} and {period_n - high_n:g}: use another frequency, or clock = "free"'
        )


def first_phase(excitation: Excitation, rate_hz: float, early_n: float = EARLY_N) -> float:
    """Phase at the first sample, in periods; on the card's clock edges come ``early_n`` samples before samples."""
    if excitation.clock == "free":
        return excitation.phase
    period_n = round(rate_hz / excitation.frequency_hz)
    return (math.floor(excitation.phase * period_n) + early_n) / period_n


def _is_whole(samples: float) -> bool:
    return math.isclose(samples, round(samples), rel_tol=1e-12)


DRIVERS = Kinds(Instrument, INSTRUMENTS)  # type: ignore[type-abstract]
"""Driver class by the scheme of an instrument's URL: entry points, ours and those of other packages."""


def find_driver(url: str) -> tuple[type[Instrument], str]:
    """The driver class and the address that a URL ``scheme://address`` names.

    :raises ConfigurationError: no driver has this scheme, or the address is malformed.
    """
    scheme, _, rest = url.partition(":")
    kind = DRIVERS.get(scheme.lower())
    if kind is not None and rest.startswith("//") and kind.place(address := rest.removeprefix("//")):
        return kind, address
    known = {scheme: kind} if kind else dict(DRIVERS)
    written = " or ".join(f"{scheme}://{kind.form}" for scheme, kind in known.items())
    raise ConfigurationError(f"instrument {url!r}: give it as {written}")
