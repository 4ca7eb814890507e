"""Devices of the kind ``can``: a node on a CAN bus that python-can can open."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from analogrig.devices.can_description import CanBusDescription
from analogrig.devices.catalogue_description import FrameDevice
from analogrig.devices.child import Child
from analogrig.devices.host import host_child, host_program_for
from analogrig.devices.library import library_for
from analogrig.errors import ConfigurationError

if TYPE_CHECKING:
    from analogrig.links.can_bus import CanBus, PythonCanBus

_ONE_CONNECTION = frozenset({"slcan", "serial", "robotell", "seeedstudio"})
"""Interfaces of python-can behind a serial port, which only one process can open."""


def _start_host(program: Path, bus: PythonCanBus) -> Child:
    """Start the device's process on the bus."""
    child = host_child(["--can", str(bus.channel), *(["--fd"] if bus.is_fd else [])], program)
    return child.connect(lambda _: child)


@dataclass(frozen=True, kw_only=True)
class CanDevice(CanBusDescription, FrameDevice):
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
        start = functools.partial(_start_host, host_program_for(self.estimator))
        return ChildBus(config, start) if started == "host" else PythonCanBus(config)

    @property
    def program(self) -> Path | None:
        started = self._started_device(self.interface)
        builds = {"inproc": library_for(self.estimator), "host": host_program_for(self.estimator)}
        return builds.get(started)

    def _started_device(self, interface: str) -> str:
        return self.device or ("inproc" if interface == "virtual" else "none")
