"""Descriptions of a port: a serial port, or any URL of pyserial."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from analogrig.devices.description import DeviceDescription
from analogrig.errors import LinkError
from analogrig.links.wire import DEFAULT_BAUD, PortWire, Wire
from analogrig.trust import Thing, absolute_port


@dataclass(frozen=True, kw_only=True)
class PortDescription(DeviceDescription):
    """A serial port, or any URL of pyserial."""

    url: str
    baud: int | None = DEFAULT_BAUD

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
