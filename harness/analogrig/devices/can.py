"""Devices of the kind ``can``: a node on a CAN bus that python-can can open."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal
from urllib.parse import quote, urlencode

from analogrig.devices.catalogue_description import FrameDevice
from analogrig.devices.child import Child
from analogrig.devices.host import HOST_PROGRAM, host_child
from analogrig.devices.library import LIBRARY
from analogrig.errors import ConfigurationError
from analogrig.trust import Thing

if TYPE_CHECKING:
    from analogrig.links.can_bus import CanBus, PythonCanBus

_ONE_CONNECTION = frozenset({"slcan", "serial", "robotell", "seeedstudio"})
"""Interfaces of python-can behind a serial port, which only one process can open."""


def _start_host(bus: PythonCanBus) -> Child:
    """Start the device's process on the bus."""
    child = host_child(["--can", str(bus.channel), *(["--fd"] if bus.is_fd else [])])
    return child.connect(lambda _: child)


@dataclass(frozen=True, kw_only=True)
class CanDevice(FrameDevice):
    """A node on a CAN bus that python-can can open."""

    kind: ClassVar[str] = "can"
    usage: ClassVar[str] = "can:INTERFACE[/CHANNEL][?KEY=VALUE&...]"
    summary: ClassVar[str] = "node on a CAN bus that python-can can open"
    collects: ClassVar[str] = "options"
    interface: str = ""
    """Interface in python-can's terms. Empty interface and channel come from python-can's own configuration."""
    channel: str = ""
    device: Literal["none", "inproc", "host"] | None = None
    """Device to start on the bus: none, the library in this process, or a process on the same SocketCAN channel. By
    default ``inproc`` on a virtual bus, where no other node can be, and otherwise ``none``."""
    options: Mapping[str, bool | int | float | str] = field(default_factory=dict)
    """Further arguments of the interface in python-can."""

    def __post_init__(self) -> None:
        super().__post_init__()
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
    def check_place(cls, name: str, place: str) -> None:
        """Accept any place: ``can:`` is the bus of python-can's own configuration."""

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:  # noqa: ARG003
        interface, _, channel = place.partition("/")
        return {key: value for key, value in (("interface", interface), ("channel", channel)) if value}

    def bus(self) -> CanBus:
        from analogrig.devices.can_nodes import ChildBus, InhabitedBus
        from analogrig.links.can_bus import PythonCanBus, complete_config

        config = complete_config(self._described_bus())
        interface = str(config["interface"])
        try:
            self._check_device_on(interface)
        except ValueError as error:
            raise ConfigurationError(f"device {self.name}: {error}") from error
        if interface == "virtual" and config["channel"] is None:
            config["channel"] = f"analogrig-{secrets.token_hex(4)}"  # shared with nobody else in this process
        started = self._started_device(interface)
        if started == "inproc":
            return InhabitedBus(config)
        return ChildBus(config, _start_host) if started == "host" else PythonCanBus(config)

    def _described_bus(self) -> dict[str, Any]:
        """Arguments of the bus in python-can's terms, as far as they are described."""
        given = {**self.options, "fd": self.fd or None, "bitrate": self.bitrate, "data_bitrate": self.data_bitrate}
        given |= {"interface": self.interface or None, "channel": self.channel or None}
        return {key: value for key, value in given.items() if value is not None}

    @property
    def program(self) -> Path | None:
        return {"inproc": LIBRARY, "host": HOST_PROGRAM}.get(self._started_device(self.interface))

    def _started_device(self, interface: str) -> str:
        return self.device or ("inproc" if interface == "virtual" else "none")

    def hint(self, link_name: str) -> str:
        return f"the bus was opened as {self.kind}:{link_name}: is the device on it, at the same bit rate?"

    @property
    def only_one(self) -> str:
        if self.interface == "virtual":
            return ""
        return f"{self.kind}:{self.interface}{'/' if self.channel else ''}{self.channel}"

    @property
    def things(self) -> tuple[Thing, ...]:
        """The bus. Options are part of its name: python-can takes hosts, ports and driver libraries as such."""
        if not self.only_one:
            return ()
        texts = {key: str(value).lower() if isinstance(value, bool) else value for key, value in self.options.items()}
        options = urlencode(sorted(texts.items()), quote_via=quote)
        return (Thing("CAN bus", f"{self.only_one}{'?' if options else ''}{options}", "the device opens the CAN bus"),)
