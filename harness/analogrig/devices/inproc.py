"""Devices of the kind ``inproc``: a shared library in this process."""

from __future__ import annotations

import dataclasses
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, Self

from analogrig.datasheet import Datasheet
from analogrig.devices.catalogue_device import CatalogueDescription
from analogrig.devices.device import KEEPS_MEMORY, CanRates, SerialRate
from analogrig.devices.library import MemoryWire, library_for
from analogrig.links.link import Wire
from analogrig.trust import Thing, absolute_path

if TYPE_CHECKING:
    from analogrig.links.can_bus import CanBus


@dataclass(frozen=True, kw_only=True)
class InprocDevice(SerialRate, CanRates, CatalogueDescription):
    """The device as a shared library in this process."""

    kind: ClassVar[str] = "inproc"
    place_key: ClassVar[str] = "library"
    usage: ClassVar[str] = "inproc[:LIBRARY]"
    summary: ClassVar[str] = "device as a shared library in this process"
    is_in_process: ClassVar[bool] = True
    link: Literal["serial", "can"] = "serial"
    """Bytes or CAN frames between the device and the harness."""
    library: str = ""
    """Shared library of your own device, built from estimator_c and your core; empty for the project's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_rates()
        if not self.is_on_can and (self.fd or self.bitrate is not None):
            raise ValueError("bitrate and fd are for a CAN bus: set link = 'can'")
        if self.is_on_can and self.baud is not None:
            raise ValueError("baud is for a serial line, and link is 'can': set bitrate")
        if self.library and self.is_on_can:
            raise ValueError("a library of your own has no CAN bus: set link = 'serial'")

    @property
    def is_on_can(self) -> bool:
        return self.link == "can"

    @property
    def program(self) -> Path:
        return Path(self.library).absolute() if self.library else library_for(self.estimator)

    def known_datasheet(self) -> Datasheet:
        sheet = super().known_datasheet()
        return sheet.with_untold(KEEPS_MEMORY) if self.library else sheet

    @property
    def estimator_library(self) -> Path:
        return self.program if self.library else super().estimator_library

    @property
    def can_run_in_blocks(self) -> bool:
        return not (self.is_on_can or self.wire_faults) and self.report_interval_n == 1

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("library", self.library, "the device loads the library"),) if self.library else ()

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, library=absolute_path(self.library, folder))

    def wire(self) -> Wire:
        return MemoryWire(boot_nonce=secrets.randbits(32), library=self.program)

    def bus(self) -> CanBus:
        from analogrig.devices.can_nodes import MemoryBus

        return MemoryBus(secrets.randbits(32), is_fd=self.fd, line=self.can_line(), library=self.program)
