"""Devices of the kind ``serial``: a board at a serial port, or at any URL of pyserial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

from analogrig.devices.catalogue_description import ByteDevice
from analogrig.devices.port_description import PortDescription
from analogrig.errors import ConfigurationError


@dataclass(frozen=True, kw_only=True)
class SerialDevice(PortDescription, ByteDevice):
    """A board at a serial port, or at any URL of pyserial."""

    kind: ClassVar[str] = "serial"
    usage: ClassVar[str] = "serial:URL"
    summary: ClassVar[str] = "board at a serial port, or at any URL of pyserial"

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """Accept any place: ``from_name`` reports a missing URL."""

    @classmethod
    def from_name(cls, name: str, rest: str) -> Self:
        """Device at the URL ``rest``, which may hold question marks of its own."""
        if not rest:
            raise ConfigurationError(f"{name}: no port: use {cls.kind}:/dev/ttyACM0, or any URL of pyserial")
        return cls(name=name, url=rest)
