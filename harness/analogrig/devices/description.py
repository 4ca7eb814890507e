"""Base classes of device descriptions: common fields, command-line names, and the two families of links."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self
from urllib.parse import unquote

from analogrig import config
from analogrig.devices.library import LIBRARY
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.identity import DeviceFile
from analogrig.links.line import CanLine, SerialLine
from analogrig.links.link import FramedLink, Link
from analogrig.links.wire import Wire
from analogrig.links.wire_faults import FaultyWire, WireFaults
from analogrig.trust import Thing

if TYPE_CHECKING:  # importing python-can takes longer than all other imports together
    from analogrig.links.can_bus import CanBus

LONGEST_TIMEOUT_S = 3600.0
MOST_BAUD = 100_000_000
MOST_BITRATE = 20_000_000


@dataclass(frozen=True, kw_only=True)
class DeviceDescription:
    """Description of a device: the fields that all kinds share. Each kind is a subclass in ``registry.KINDS``."""

    kind: ClassVar[str]
    usage: ClassVar[str]
    """Name on the command line, with its parameters."""
    summary: ClassVar[str]
    """One line for `analogrig list`."""
    starting_s: ClassVar[float] = 0.0
    """Longest start-up time, added to the time-out of the handshake."""
    is_in_process: ClassVar[bool] = False
    """True if the device runs in this process, on a virtual clock: time-outs cost nothing, a crash ends the process."""
    name: str
    description: str = ""
    """One line for people."""
    exchange: Literal["sample", "block", "stream"] = "sample"
    """Samples go one at a time, in blocks, or in blocks without waiting for the answers to earlier ones. The answers
    are the same. A line of 8-byte messages carries single samples even for ``stream``."""
    window: int = 255
    """For ``stream``: the largest number of unanswered sample messages, if the device can buffer them."""
    report_interval_n: int = 1
    """Samples between two reports of the estimate. Alarms are always reported."""
    most_lost_n: int = 0
    """Largest number of samples lost on the way to the device. Beyond it the run is INCONCLUSIVE."""
    timeout_s: float = 2.0
    """Time-out of all answers to one message."""
    wire_faults: str = ""
    """Faults of the line, in the notation of ``WireFaults.parse``."""
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)

    def __post_init__(self) -> None:
        if not 0.0 < self.timeout_s <= LONGEST_TIMEOUT_S:
            raise ValueError(f"timeout_s must be more than 0 and at most {LONGEST_TIMEOUT_S:g}, not {self.timeout_s:g}")
        for name, least, most in (("window", 1, 255), ("report_interval_n", 1, 65535), ("most_lost_n", 0, 2**31)):
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be {least} to {most}, not {getattr(self, name)}")
        try:
            self.faults()
        except ConfigurationError as error:
            raise ValueError(str(error)) from error

    @classmethod
    def from_name(cls, name: str, rest: str) -> Self:
        """Device with the command-line name ``name``; ``rest`` is its part after the kind and the colon.

        :raises ConfigurationError: ``rest`` is not a place and KEY=VALUE pairs of this kind.
        """
        place, _, query = rest.partition("?")
        table = {"name": name, **cls._place(name, place)}
        for key, text in _pairs(name, query):
            if key in table:
                raise ConfigurationError(f"{name}: {key} is given twice")
            table[key] = _value(cls, key, text)
        return config.build(cls, cls._group_options(table), name)

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """:raises ConfigurationError: ``place`` is a colon alone, which would read as the default."""
        if place == ":":
            raise ConfigurationError(
                f"device {name!r}: nothing follows the colon: pass {cls.kind} for the default, or {cls.kind}:WHICH"
            )

    @classmethod
    def _group_options(cls, table: dict[str, Any]) -> dict[str, Any]:
        """The table with every key at its place in the description."""
        return table

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:
        """Fields given by the part of a name between the colon and the question mark."""
        if place:
            raise ConfigurationError(f"{name}: a device of the kind {cls.kind} has no {place!r}")
        return {}

    def open(self) -> Link:
        """Start the device, or connect to it.

        :raises LinkError: it cannot be reached.
        """
        raise NotImplementedError

    def fault_kinds(self) -> Collection[str]:
        """Kinds of faults that its line can have."""
        raise NotImplementedError

    def faults(self) -> WireFaults | None:
        """Faults of its line; None if there are none.

        :raises ConfigurationError: the line has no such faults.
        """
        return WireFaults.parse(self.wire_faults, self.fault_kinds()) if self.wire_faults else None

    def hint(self, link_name: str) -> str:  # noqa: ARG002
        """Advice for a device that does not answer on the link of that name; may be empty."""
        return ""

    @property
    def program(self) -> Path | None:
        """File with the device's code on this machine; None for a device elsewhere."""
        return None

    def files(self) -> tuple[DeviceFile, ...]:
        """Library, program or firmware that the device runs on this machine, if any."""
        return () if self.program is None else (DeviceFile.of(self.name, self.program),)

    @property
    def estimator_library(self) -> Path:
        """Shared library with the device's estimator, to be run in this process."""
        return LIBRARY

    @property
    def can_run_in_blocks(self) -> bool:
        """True if ``estimator_library``, given whole blocks, yields what the device answers sample by sample."""
        return False

    @property
    def things(self) -> tuple[Thing, ...]:
        """Things outside analogrig that opening the device would load, run or connect to."""
        return ()

    def placed(self, folder: Path) -> Self:  # noqa: ARG002
        """The same device with its paths, relative to ``folder``, made absolute."""
        return self

    @property
    def only_one(self) -> str:
        """Name of the port or bus that two processes cannot share; empty if each can start a device of its own."""
        return ""

    def as_table(self) -> dict[str, Any]:
        """Plain values; ``registry.from_table`` is the inverse."""
        table = {"kind": self.kind, **dataclasses.asdict(self), "estimator": self.estimator.as_table()}
        return {key: value for key, value in table.items() if value is not None}


def _pairs(name: str, query: str) -> list[tuple[str, str]]:
    """KEY=VALUE pairs separated by ampersands, with percent escapes decoded.

    :raises ConfigurationError: a word is not KEY=VALUE.
    """
    words = [word.partition("=") for word in query.split("&") if word]
    for key, equals, value in words:
        if not (key and equals):
            raise ConfigurationError(f"{name}: {key + equals + value!r} is not KEY=VALUE")
    return [(unquote(key), unquote(value)) for key, _, value in words]


def _value(cls: type[DeviceDescription], key: str, text: str) -> Any:
    """Text as a number or truth value where possible, as python-can reads it. Text fields of ``cls`` stay text."""
    if isinstance(getattr(cls, key, None), str):
        return text
    is_flag = isinstance(getattr(cls, key, None), bool)
    if text.lower() in {"true", "false"} or (is_flag and text in {"1", "0"}):
        return text.lower() in {"true", "1"}
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text


@dataclass(frozen=True, kw_only=True)
class ByteDevice(DeviceDescription):
    """A device behind a line of bytes."""

    baud: int | None = None
    """Baud rate of the line [bit/s]. If there is no real line, the run reports the time that this one would take."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.baud is not None and not 0 < self.baud <= MOST_BAUD:
            raise ValueError(f"baud must be 1 to {MOST_BAUD}, not {self.baud}")

    def open(self) -> Link:
        faults = self.faults()
        line = None if self.baud is None else SerialLine(self.baud)
        return FramedLink(self.wire() if faults is None else FaultyWire(self.wire, faults), line)

    def wire(self) -> Wire:
        """Wire to the started device; errors as ``open``."""
        raise NotImplementedError

    def fault_kinds(self) -> Collection[str]:
        return FaultyWire.KINDS


@dataclass(frozen=True, kw_only=True)
class FrameDevice(DeviceDescription):
    """A device on a CAN bus."""

    bitrate: int | None = None
    """Bit rate of the bus [bit/s]. If there is no real bus, the run reports the time that this one would take."""
    data_bitrate: int | None = None
    """Bit rate of the data phase of CAN FD [bit/s]; None if it is ``bitrate``."""
    fd: bool = False
    """True if bus and device support CAN FD, whose frames carry a block of samples."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bitrate", "data_bitrate"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= MOST_BITRATE:
                raise ValueError(f"{name} must be 1 to {MOST_BITRATE}, not {value}")
        if self.data_bitrate is not None and not (self.fd and self.bitrate is not None):
            raise ValueError("data_bitrate is for CAN FD: set fd = true and bitrate as well")

    def open(self) -> Link:
        from analogrig.links.can_link import CanLink
        from analogrig.links.faulty_bus import FaultyBus

        faults = self.faults()
        return CanLink(self.bus() if faults is None else FaultyBus(self.bus, faults))

    def bus(self) -> CanBus:
        """Bus with the started device; errors as ``open``."""
        raise NotImplementedError

    def line(self) -> CanLine | None:
        return None if self.bitrate is None else CanLine(self.bitrate, self.data_bitrate)

    def fault_kinds(self) -> Collection[str]:
        from analogrig.links.faulty_bus import FaultyBus

        return FaultyBus.KINDS


@dataclass(frozen=True, kw_only=True)
class EitherDevice(ByteDevice, FrameDevice):
    """A device on this machine, behind bytes or CAN frames. ``link`` selects one; each kind carries CAN in its way."""

    CAN: ClassVar[str] = "slcan"
    link: str = "serial"

    def __post_init__(self) -> None:
        if self.link not in {"serial", self.CAN}:
            raise ValueError(f"link must be 'serial' or {self.CAN!r}, not {self.link!r}")
        super().__post_init__()
        if self.is_serial and (self.fd or self.bitrate is not None):
            raise ValueError(f"bitrate and fd are for a CAN bus: set link = {self.CAN!r}")
        if not self.is_serial and self.baud is not None:
            raise ValueError(f"baud is for a serial line, and link is {self.link!r}: set bitrate")

    @property
    def is_serial(self) -> bool:
        return self.link == "serial"

    def open(self) -> Link:
        return ByteDevice.open(self) if self.is_serial else FrameDevice.open(self)

    def fault_kinds(self) -> Collection[str]:
        return ByteDevice.fault_kinds(self) if self.is_serial else FrameDevice.fault_kinds(self)

    def slcan(self, port: str) -> dict[str, Any]:
        """Configuration of python-can for slcan on a terminal. The devices there need no time after opening."""
        rates = {"bitrate": self.bitrate, "data_bitrate": self.data_bitrate}
        known = {key: value for key, value in rates.items() if value is not None}
        return {"interface": "slcan", "channel": port, "fd": self.fd, "sleep_after_open": 0.0, **known}
