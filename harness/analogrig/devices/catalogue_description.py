"""Descriptions of devices that exchange our catalogue's messages: common fields, and the two families of links."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeGuard

from analogrig.datasheet import Datasheet
from analogrig.devices.can_description import CanLineDescription
from analogrig.devices.description import Capability, DeviceDescription
from analogrig.devices.device import Device
from analogrig.devices.library import estimator_library_for
from analogrig.errors import ConfigurationError
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.line import SerialLine
from analogrig.links.link import FramedLink, Link
from analogrig.links.wire import Wire
from analogrig.links.wire_faults import FaultyWire, WireFaults

if TYPE_CHECKING:  # importing python-can takes longer than all other imports together
    from analogrig.links.can_bus import CanBus

MOST_BAUD = 100_000_000


@dataclass(frozen=True, kw_only=True)
class CatalogueDescription(DeviceDescription):
    """Description of a device with our estimator's settings, behind a link that carries our catalogue's messages."""

    starting_s: ClassVar[float] = 0.0
    """Longest start-up time, added to the time-out of the handshake."""
    is_in_process: ClassVar[bool] = False
    """True if the device runs in this process, on a virtual clock: time-outs cost nothing, a crash ends the process."""
    exchange: Literal["sample", "block", "stream"] = "sample"
    """Samples go one at a time, in blocks, or in blocks without waiting for the answers to earlier ones. The answers
    are the same. A line of 8-byte messages carries single samples even for ``stream``."""
    window: int = 255
    """For ``stream``: the largest number of unanswered sample messages, if the device can buffer them."""
    report_interval_n: int = 1
    """Samples between two reports of the estimate. Alarms are always reported."""
    wire_faults: str = ""
    """Faults of the line, in the notation of ``WireFaults.parse``."""
    computes: Literal["est", "own"] = "est"
    """The estimator that the device computes: that of estimator_c/core, which the shipped properties compare with their
    reference, or one of your own."""
    estimator: EstimatorConfig = field(default_factory=lambda: EstimatorConfig(orders="program"))

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, most in (("window", 255), ("report_interval_n", 65535)):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be 1 to {most}, not {getattr(self, name)}")
        try:
            self.faults()
        except ConfigurationError as error:
            raise ValueError(str(error)) from error

    @property
    def capabilities(self) -> frozenset[Capability]:
        always: frozenset[Capability] = frozenset({"configure", "faults", "identify", "pace"})
        in_process: frozenset[Capability] = frozenset({"in-process"} if self.is_in_process else ())
        blocks: frozenset[Capability] = frozenset({"blocks", "snapshot"} if self.can_run_in_blocks else ())
        return always | in_process | blocks

    def known_datasheet(self) -> Datasheet:
        return Datasheet.of_estimator(self.estimator.as_table())

    def open(self) -> Device:
        from analogrig.devices.catalogue_device import CatalogueDevice

        return CatalogueDevice(self.open_link(), self)

    def direct(self, *, alarms_only: bool = False) -> Device:
        from analogrig.devices.direct import DirectDevice

        return DirectDevice(self, alarms_only=alarms_only)

    @abstractmethod
    def open_link(self) -> Link:
        """Start the device, or connect to it.

        :raises LinkError: it cannot be reached.
        """

    @abstractmethod
    def fault_kinds(self) -> Collection[str]:
        """Kinds of faults that its line can have."""

    def faults(self) -> WireFaults | None:
        """Faults of its line; None if there are none.

        :raises ConfigurationError: the line has no such faults.
        """
        return WireFaults.parse(self.wire_faults, self.fault_kinds()) if self.wire_faults else None

    @property
    def estimator_library(self) -> Path:
        """Shared library with the device's estimator, to be run in this process."""
        return estimator_library_for(self.estimator)

    @property
    def can_run_in_blocks(self) -> bool:
        """True if ``estimator_library``, given whole blocks, yields what the device answers sample by sample."""
        return False

    def as_table(self) -> dict[str, Any]:
        return super().as_table() | {"estimator": self.estimator.as_table()}


def suited(description: CatalogueDescription, poles: Sequence[complex]) -> EstimatorConfig:
    """Settings of the device for a plant with these poles: chosen by them, or those given.

    :raises ConfigurationError: the estimator has no such order.
    """
    try:
        return description.estimator.suited(poles)
    except ValueError as error:
        cure = "give the device settings of its own: [estimator]"
        where = f"device {description.name}: a program of order {len(poles)}"
        raise ConfigurationError(f"{where}: {error}; {cure}") from error


def has_our_estimator(description: DeviceDescription) -> TypeGuard[CatalogueDescription]:
    """True if the device has the settings of ``EstimatorConfig``."""
    return hasattr(description, "estimator")


def has_snapshots(description: DeviceDescription) -> TypeGuard[CatalogueDescription]:
    """True if the state of the device's estimator can be saved and restored."""
    return has_our_estimator(description) and "snapshot" in description.capabilities


@dataclass(frozen=True, kw_only=True)
class ByteDevice(CatalogueDescription):
    """A device behind a line of bytes."""

    baud: int | None = None
    """Baud rate of the line [bit/s]. If there is no real line, the run reports the time that this one would take."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.baud is not None and not 0 < self.baud <= MOST_BAUD:
            raise ValueError(f"baud must be 1 to {MOST_BAUD}, not {self.baud}")

    def open_link(self) -> Link:
        faults = self.faults()
        line = None if self.baud is None else SerialLine(self.baud)
        return FramedLink(self.wire() if faults is None else FaultyWire(self.wire, faults), line)

    def wire(self) -> Wire:
        """Wire to the started device; errors as ``open_link``."""
        raise NotImplementedError

    def fault_kinds(self) -> Collection[str]:
        return FaultyWire.KINDS


@dataclass(frozen=True, kw_only=True)
class FrameDevice(CanLineDescription, CatalogueDescription):
    """A device on a CAN bus."""

    def open_link(self) -> Link:
        from analogrig.links.can_link import CanLink
        from analogrig.links.faulty_bus import FaultyBus

        faults = self.faults()
        return CanLink(self.bus() if faults is None else FaultyBus(self.bus, faults))

    def bus(self) -> CanBus:
        """Bus with the started device; errors as ``open_link``."""
        raise NotImplementedError

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

    def open_link(self) -> Link:
        return ByteDevice.open_link(self) if self.is_serial else FrameDevice.open_link(self)

    def fault_kinds(self) -> Collection[str]:
        return ByteDevice.fault_kinds(self) if self.is_serial else FrameDevice.fault_kinds(self)

    def slcan(self, port: str) -> dict[str, Any]:
        """Configuration of python-can for slcan on a terminal. The devices there need no time after opening."""
        rates = {"bitrate": self.bitrate, "data_bitrate": self.data_bitrate}
        known = {key: value for key, value in rates.items() if value is not None}
        return {"interface": "slcan", "channel": port, "fd": self.fd, "sleep_after_open": 0.0, **known}
