"""Serial ports, or any URL of pyserial; and devices of the kind ``serial``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

from analogrig.config import suggest
from analogrig.devices.catalogue_device import CatalogueDescription
from analogrig.devices.device import SerialRate
from analogrig.errors import ConfigurationError, LinkError
from analogrig.links.link import DEFAULT_BAUD, PortWire, Wire
from analogrig.trust import Thing, absolute_port

__all__ = ["Port"]
"""Names for packages beside the core."""

_OF_PYSERIAL = frozenset({"timeout"})
"""Parameters of pyserial's URLs that look like a field of a device."""


@dataclass(frozen=True, kw_only=True)
class Port(SerialRate):
    """A serial port, or any URL of pyserial."""

    kind: ClassVar[str]
    place_key: ClassVar[str] = "url"
    no_place: ClassVar[str] = "{name}: no port: use {kind}:/dev/ttyACM0, any URL of pyserial, or a device file"
    name: str
    url: str
    baud: int | None = DEFAULT_BAUD

    @classmethod
    def _split_query(cls, name: str, place: str, query: str) -> tuple[str, str]:
        """URL with its own parameters, and the KEY=VALUE pairs that are fields of the device."""
        fields = [field.name for field in dataclasses.fields(cls)]
        words = query.split("&")
        of_url = [word for word in words if "://" in place and word and word.partition("=")[0] not in fields]
        for key in [word.partition("=")[0] for word in of_url]:
            if key not in _OF_PYSERIAL and (hint := suggest(key, fields, cutoff=0.8)):
                raise ConfigurationError(f"{name}: unknown key {key!r}{hint}")
        own = "&".join(word for word in words if word not in of_url)
        return (f"{place}?{'&'.join(of_url)}" if of_url else place), own

    def wire(self) -> Wire:
        """Open the port.

        :raises LinkError: names the device.
        """
        try:
            return PortWire(self.url, self.baud or DEFAULT_BAUD)
        except LinkError as error:
            cure = "; start the server, or correct url" if self._is_socket else ""
            raise LinkError(f"device {self.name}: {error}{cure}") from error

    def hint(self, link_name: str) -> str:  # noqa: ARG002
        if self._is_socket:
            return "the port may be serving another client"
        return f"the line was opened at {self.baud} baud"

    @property
    def _is_socket(self) -> bool:
        return self.url.startswith("socket:")

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("serial port", self.url, "the device opens the serial port"),)

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, url=absolute_port(self.url, folder))

    @property
    def only_one(self) -> str:
        return f"port:{self.url}"


@dataclass(frozen=True, kw_only=True)
class SerialDevice(Port, CatalogueDescription):
    """A board at a serial port, or at any URL of pyserial."""

    kind: ClassVar[str] = "serial"
    usage: ClassVar[str] = "serial:URL[?exchange=...&baud=...]"
    summary: ClassVar[str] = "board at a serial port, or at any URL of pyserial"
