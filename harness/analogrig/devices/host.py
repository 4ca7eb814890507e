"""Devices of the kind ``host``: a process on this machine behind a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from analogrig.devices.catalogue_description import EitherDevice
from analogrig.devices.child import PROGRAMS, Child, ChildWire
from analogrig.errors import LinkError
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.wire import PortWire

if TYPE_CHECKING:
    from analogrig.links.can_bus import CanBus

HOST_PROGRAM = PROGRAMS / "analogrig-device"
WIDE_HOST_PROGRAM = PROGRAMS / "analogrig-device-wide"
"""The same with room for plants of higher order."""


@dataclass(frozen=True, kw_only=True)
class HostDevice(EitherDevice):
    """The device as a process on this machine, behind a pseudo-terminal."""

    kind: ClassVar[str] = "host"
    usage: ClassVar[str] = "host[?link=slcan]"
    summary: ClassVar[str] = "device as a process of this computer, on a pseudo-terminal"

    @property
    def program(self) -> Path:
        return host_program_for(self.estimator)

    def wire(self) -> ChildWire:
        return host_wire(program=self.program)

    def bus(self) -> CanBus:
        from analogrig.devices.can_nodes import ChildBus

        child = host_child(["--slcan"], self.program)
        return child.connect(lambda port: ChildBus(self.slcan(port), lambda _: child, name="slcan"))


def host_program_for(estimator: EstimatorConfig) -> Path:
    """Program of the device with room for these settings."""
    return WIDE_HOST_PROGRAM if estimator.is_wide else HOST_PROGRAM


def host_child(arguments: Sequence[str] = (), program: Path = HOST_PROGRAM) -> Child:
    """New process of the host port. Its first line of output names the terminal or bus it serves.

    :raises LinkError: it cannot be started.
    """
    if not program.is_file():
        raise LinkError(f"{program} is absent: run `make setup`")
    return Child([program, *arguments], "the device process")


def host_wire(arguments: Sequence[str] = (), program: Path = HOST_PROGRAM) -> ChildWire:
    """Wire to a new process of the host port.

    :raises LinkError: it cannot be started, or does not print its terminal.
    """
    child = host_child(arguments, program)
    return child.connect(lambda port: ChildWire(child, PortWire(port, name="pty")))
