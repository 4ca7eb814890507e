"""Descriptions of a CAN bus: its bit rates, and the bus that python-can opens."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote, urlencode

from analogrig.devices.description import DeviceDescription
from analogrig.links.line import CanLine
from analogrig.trust import Thing

MOST_BITRATE = 20_000_000


@dataclass(frozen=True, kw_only=True)
class CanLineDescription(DeviceDescription):
    """Bit rates of a CAN bus."""

    bitrate: int | None = None
    """Bit rate of the bus [bit/s]. If there is no real bus, the run reports the time that this one would take."""
    data_bitrate: int | None = None
    """Bit rate of the data phase of CAN FD [bit/s]; None if it is ``bitrate``."""
    fd: bool = False
    """True if bus and device support CAN FD, whose frames carry up to 64 bytes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bitrate", "data_bitrate"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= MOST_BITRATE:
                raise ValueError(f"{name} must be 1 to {MOST_BITRATE}, not {value}")
        if self.data_bitrate is not None and not (self.fd and self.bitrate is not None):
            raise ValueError("data_bitrate is for CAN FD: set fd = true and bitrate as well")

    def line(self) -> CanLine | None:
        """Bit rates, if they are stated."""
        return None if self.bitrate is None else CanLine(self.bitrate, self.data_bitrate)


@dataclass(frozen=True, kw_only=True)
class CanBusDescription(CanLineDescription):
    """CAN bus that python-can can open."""

    interface: str = ""
    """Interface in python-can's terms. Empty interface and channel come from python-can's own configuration."""
    channel: str = ""
    options: Mapping[str, bool | int | float | str] = field(default_factory=dict)
    """Further arguments of the interface in python-can."""

    def bus_config(self) -> dict[str, Any]:
        """Arguments for ``can.Bus``, completed from python-can's own configuration.

        :raises ConfigurationError: there is no such interface, or it has no such option.
        """
        from analogrig.links.can_bus import complete_config

        given = {**self.options, "fd": self.fd or None, "bitrate": self.bitrate, "data_bitrate": self.data_bitrate}
        given |= {"interface": self.interface or None, "channel": self.channel or None}
        config = complete_config({key: value for key, value in given.items() if value is not None})
        if config["interface"] == "virtual" and config["channel"] is None:
            config["channel"] = f"analogrig-{secrets.token_hex(4)}"  # shared with nobody else in this process
        return config

    def hint(self, link_name: str) -> str:
        """Advice for a device that does not answer on the bus of that name."""
        return f"the bus was opened as can:{link_name}: is the device on it, at the same bit rate?"

    @property
    def bus_name(self) -> str:
        """Name of the bus: ``can:INTERFACE/CHANNEL``."""
        return f"can:{self.interface}{'/' if self.channel else ''}{self.channel}"

    @property
    def only_one(self) -> str:
        return "" if self.interface == "virtual" else self.bus_name

    @property
    def things(self) -> tuple[Thing, ...]:
        """The bus. Options are part of its name: python-can takes hosts, ports and driver libraries as such."""
        if self.interface == "virtual":
            return ()
        texts = {key: str(value).lower() if isinstance(value, bool) else value for key, value in self.options.items()}
        options = urlencode(sorted(texts.items()), quote_via=quote)
        return (Thing("CAN bus", f"{self.bus_name}{'?' if options else ''}{options}", "the device opens the CAN bus"),)
