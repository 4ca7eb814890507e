"""Devices of the kinds ``host`` and ``qemu-*``: a process on this machine, and firmware on a board emulated by QEMU."""

from __future__ import annotations

import dataclasses
import os
import secrets
import shutil
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

from analogrig.devices.catalogue_device import CatalogueDescription
from analogrig.devices.child import PROGRAMS, Child, ChildWire
from analogrig.devices.device import SerialRate
from analogrig.errors import LinkError
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.link import DescriptorWire, PortWire, Wire
from analogrig.trust import Thing, absolute_path

HOST_PROGRAM = PROGRAMS / "analogrig-device"
WIDE_HOST_PROGRAM = PROGRAMS / "analogrig-device-wide"
"""The same with room for plants of higher order."""


@dataclass(frozen=True, kw_only=True)
class HostDevice(SerialRate, CatalogueDescription):
    """The device as a process on this machine, behind a pseudo-terminal."""

    kind: ClassVar[str] = "host"
    usage: ClassVar[str] = "host[?baud=...]"
    summary: ClassVar[str] = "device as a process of this computer, on a pseudo-terminal"

    @property
    def program(self) -> Path:
        return host_program_for(self.estimator)

    def wire(self) -> ChildWire:
        return host_wire(program=self.program)


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


FIRMWARE = Path(__file__).parents[3] / "build" / "firmware"

QEMU = "qemu-system-arm"
_NO_SCREEN = ("-display", "none", "-monitor", "none", "-nodefaults")


@dataclass(frozen=True, kw_only=True)
class QemuDevice(SerialRate, CatalogueDescription):
    """Cortex-M firmware on a board emulated by QEMU. ``_board`` makes the kind of each board."""

    place_key: ClassVar[str] = "firmware"
    starting_s: ClassVar[float] = 5.0
    core: ClassVar[str]
    machine: ClassVar[str]
    semihosting: ClassVar[bool] = True
    """True if the firmware reads its boot nonce by semihosting; otherwise it has one of its own."""
    timeout_s: float = 60.0
    """Time-out of all answers to one message. On a loaded machine an emulated board stands still for seconds; one that
    has crashed closes its line at once."""
    firmware: str | None = None
    """An ELF file; None for the project's firmware, which `make firmware` builds."""

    def wire(self) -> Wire:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            line = theirs.fileno()
            child = self._boot(line)
            return ChildWire(child, DescriptorWire(ours.detach(), "qemu"))

    def _boot(self, line: int) -> Child:
        """Start the board with its UART on the socket of this descriptor."""
        qemu = shutil.which(QEMU)
        if qemu is None:
            raise LinkError(f"{QEMU} is not installed: apt-get install qemu-system-arm")
        if not self.program.is_file():
            cure = "" if self.firmware else f": run `make firmware` in a clone, or name one: qemu-{self.core}:ELF"
            raise LinkError(f"there is no firmware {self.firmware or self.program}{cure}")
        command: list[str | Path] = [qemu, "-machine", self.machine, "-kernel", self.program]
        if (taskset := shutil.which("taskset")) is not None:
            # QEMU's two threads wake each other at every byte; across processors a wake-up takes twice as long.
            command[:0] = [taskset, "--cpu-list", str(secrets.choice(sorted(os.sched_getaffinity(0))))]
        command += [*_NO_SCREEN, "-chardev", f"socket,id=line,fd={line}", "-serial", "chardev:line"]
        if self.semihosting:
            nonce = f"arg=analogrig,arg={secrets.randbits(32):08x}"
            command += ["-semihosting-config", f"enable=on,target=native,{nonce}"]
        return Child(command, f"QEMU ({self.machine})", inherited=[line])

    @property
    def things(self) -> tuple[Thing, ...]:
        """The firmware: by semihosting it could open any file of this machine."""
        return (Thing("firmware", self.firmware, "the device boots the firmware"),) if self.firmware else ()

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, firmware=absolute_path(self.firmware, folder)) if self.firmware else self

    @property
    def program(self) -> Path:
        folder = Path(os.environ.get("ANALOGRIG_FIRMWARE", FIRMWARE))
        return (Path(self.firmware) if self.firmware else folder / f"analogrig-{self.core}.elf").absolute()


def _board(core: str, machine: str, name: str, *, semihosting: bool = True) -> type[QemuDevice]:
    """Kind of device for a board."""
    kind = f"qemu-{core}"
    stated = {"kind": kind, "core": core, "machine": machine, "semihosting": semihosting}
    texts = {"usage": f"{kind}[:ELF]", "summary": f"{name} firmware on a board that QEMU emulates"}
    return type(f"Qemu{core.title()}", (QemuDevice,), {"__module__": __name__, **stated, **texts})


QemuM3 = _board("m3", "mps2-an385", "Cortex-M3")
QemuM4 = _board("m4", "mps2-an386", "Cortex-M4F")
QemuM7 = _board("m7", "mps2-an500", "Cortex-M7")
QemuF405 = _board("f405", "netduinoplus2", "STM32F405", semihosting=False)
"""The image is that of the real board, which needs nothing of QEMU."""
