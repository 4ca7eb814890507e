"""CAN buses that python-can can open, and devices of the kind ``can``: a node there."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self
from urllib.parse import quote, urlencode

from analogrig.devices.catalogue_device import CatalogueDescription
from analogrig.devices.child import Child
from analogrig.devices.device import CanRates
from analogrig.devices.library import library_for
from analogrig.devices.processes import host_child, host_program_for
from analogrig.errors import ConfigurationError
from analogrig.trust import Thing

if TYPE_CHECKING:
    from analogrig.links.can_bus import CanBus

__all__ = ["CanPort"]
"""Names for packages beside the core."""


@dataclass(frozen=True, kw_only=True)
class CanPort(CanRates):
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
            # Shared with nobody else in this process. Writers of logs take digits at the end as a number of a channel.
            config["channel"] = f"analogrig-{secrets.token_hex(4)}-bus"
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


_ONE_CONNECTION = frozenset({"slcan", "serial", "robotell", "seeedstudio"})
"""Interfaces of python-can behind a serial port, which only one process can open."""


@dataclass(frozen=True, kw_only=True)
class CanDevice(CanPort, CatalogueDescription):
    """A node on a CAN bus that python-can can open."""

    kind: ClassVar[str] = "can"
    usage: ClassVar[str] = "can:INTERFACE[/CHANNEL][?KEY=VALUE&...]"
    summary: ClassVar[str] = "node on a CAN bus that python-can can open"
    collects: ClassVar[str] = "options"
    device: Literal["none", "inproc", "host"] | None = None
    """Device to start on the bus: none, the library in this process, or a process on the same SocketCAN channel. By
    default ``inproc`` on a virtual bus, where no other node can be, and otherwise ``none``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_rates()
        if self.interface:
            self._check_device_on(self.interface)

    def _check_device_on(self, interface: str) -> None:
        """:raises ValueError: the device cannot be started on a bus of this interface."""
        if self.device == "host" and interface != "socketcan":
            raise ValueError(f"device: a host process needs SocketCAN, not {interface}: use inproc")
        if self.device == "inproc" and interface in _ONE_CONNECTION:
            raise ValueError(
                f"device: inproc needs a connection of its own, and a {interface} adapter accepts only one"
            )

    @classmethod
    def from_name(cls, name: str, rest: str) -> Self:
        """Device with this name; ``can:`` alone is the bus of python-can's own configuration."""
        return super().from_name(name, rest.removeprefix(":"))

    @property
    def is_on_can(self) -> bool:
        return True

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:  # noqa: ARG003
        interface, _, channel = place.partition("/")
        return {key: value for key, value in (("interface", interface), ("channel", channel)) if value}

    def bus(self) -> CanBus:
        from analogrig.devices.can_nodes import ChildBus, InhabitedBus
        from analogrig.links.can_bus import PythonCanBus

        config = self.bus_config()
        interface = str(config["interface"])
        try:
            self._check_device_on(interface)
        except ValueError as error:
            raise ConfigurationError(f"device {self.name}: {error}") from error
        started = self._started_device(interface)
        if started == "inproc":
            return InhabitedBus(config, library_for(self.estimator))
        if started == "none":
            return PythonCanBus(config)

        def start(bus: PythonCanBus) -> Child:
            arguments = ["--can", str(bus.channel), *(["--fd"] if bus.is_fd else [])]
            child = host_child(arguments, host_program_for(self.estimator))
            return child.connect(lambda _: child)

        return ChildBus(config, start)

    @property
    def program(self) -> Path | None:
        started = self._started_device(self.interface)
        builds = {"inproc": library_for(self.estimator), "host": host_program_for(self.estimator)}
        return builds.get(started)

    def _started_device(self, interface: str) -> str:
        return self.device or ("inproc" if interface == "virtual" else "none")
