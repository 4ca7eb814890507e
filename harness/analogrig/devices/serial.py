"""Devices of the kind ``serial``: a board at a serial port, or at any URL of pyserial."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

from analogrig.devices.catalogue_description import ByteDevice
from analogrig.errors import ConfigurationError
from analogrig.links.wire import DEFAULT_BAUD, PortWire, Wire
from analogrig.trust import Thing, absolute_port


@dataclass(frozen=True, kw_only=True)
class SerialDevice(ByteDevice):
    """A board at a serial port, or at any URL of pyserial."""

    kind: ClassVar[str] = "serial"
    usage: ClassVar[str] = "serial:URL"
    summary: ClassVar[str] = "board at a serial port, or at any URL of pyserial"
    url: str
    baud: int | None = DEFAULT_BAUD

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """Accept any place: ``from_name`` reports a missing URL."""

    @classmethod
    def from_name(cls, name: str, rest: str) -> Self:
        """Device at the URL ``rest``, which may hold question marks of its own."""
        if not rest:
            raise ConfigurationError(f"{name}: no port: use {cls.kind}:/dev/ttyACM0, or any URL of pyserial")
        return cls(name=name, url=rest)

    def wire(self) -> Wire:
        return PortWire(self.url, self.baud or DEFAULT_BAUD)

    def hint(self, link_name: str) -> str:  # noqa: ARG002
        if self.url.startswith("socket:"):
            return "the port may be serving another client"
        return f"the line was opened at {self.baud} baud"

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("serial port", self.url, "the device opens the serial port"),)

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, url=absolute_port(self.url, folder))

    @property
    def only_one(self) -> str:
        return f"{self.kind}:{self.url}"
