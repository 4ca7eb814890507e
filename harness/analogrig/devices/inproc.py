"""Devices of the kind ``inproc``: a shared library in this process."""

from __future__ import annotations

import dataclasses
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from analogrig.devices.catalogue_description import EitherDevice
from analogrig.devices.library import MemoryWire, library_for
from analogrig.links.wire import Wire
from analogrig.trust import Thing, absolute_path

if TYPE_CHECKING:
    from analogrig.links.can_bus import CanBus


@dataclass(frozen=True, kw_only=True)
class InprocDevice(EitherDevice):
    """The device as a shared library in this process."""

    CAN: ClassVar[str] = "can"
    kind: ClassVar[str] = "inproc"
    usage: ClassVar[str] = "inproc[:LIBRARY]"
    summary: ClassVar[str] = "device as a shared library in this process"
    is_in_process: ClassVar[bool] = True
    library: str = ""
    """Shared library of your own device, built from estimator_c and your core; empty for the project's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.library and not self.is_serial:
            raise ValueError("a library of your own has no CAN bus: set link = 'serial'")

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:  # noqa: ARG003
        return {"library": place} if place else {}

    @property
    def program(self) -> Path:
        return Path(self.library).absolute() if self.library else library_for(self.estimator)

    @property
    def estimator_library(self) -> Path:
        return self.program if self.library else super().estimator_library

    @property
    def can_run_in_blocks(self) -> bool:
        return self.is_serial and not self.wire_faults and self.report_interval_n == 1

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("library", self.library, "the device loads the library"),) if self.library else ()

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, library=absolute_path(self.library, folder))

    def wire(self) -> Wire:
        return MemoryWire(boot_nonce=secrets.randbits(32), library=self.program)

    def bus(self) -> CanBus:
        from analogrig.devices.can_nodes import MemoryBus

        return MemoryBus(secrets.randbits(32), is_fd=self.fd, line=self.line(), library=self.program)
