"""Devices of the kinds ``qemu-m3``, ``-m4``, ``-m7``, ``-f405``: Cortex-M firmware on a board emulated by QEMU."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import secrets
import select
import shutil
import socket
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from analogrig.devices.catalogue_description import EitherDevice
from analogrig.devices.child import Child, ChildWire
from analogrig.errors import LinkError
from analogrig.links.wire import DescriptorWire, Wire
from analogrig.trust import Thing, absolute_path

if TYPE_CHECKING:
    from analogrig.links.can_bus import CanBus

FIRMWARE = Path(__file__).parents[3] / "build" / "firmware"

QEMU = "qemu-system-arm"
_ASK_AGAIN_S = 0.05
_NO_SCREEN = ("-display", "none", "-monitor", "none", "-nodefaults")


@dataclass(frozen=True, kw_only=True)
class QemuDevice(EitherDevice):
    """Cortex-M firmware on a board emulated by QEMU. Each core is a subclass."""

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

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:  # noqa: ARG003
        return {"firmware": place} if place else {}

    def wire(self) -> Wire:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            line = theirs.fileno()
            child = self._boot(["-chardev", f"socket,id=line,fd={line}", "-serial", "chardev:line"], inherited=[line])
            return ChildWire(child, DescriptorWire(ours.detach(), "qemu"))

    def bus(self) -> CanBus:
        """Bus on the second UART. It is a terminal because python-can's slcan opens nothing else as fast."""
        from analogrig.devices.can_nodes import ChildBus

        def open_bus(first_line: str) -> ChildBus:
            (terminal,) = re.findall(r"/dev/\S+", first_line) or [""]
            with _listening(terminal, self.starting_s + self.timeout_s):
                return ChildBus(self.slcan(terminal), lambda _: child, name="qemu slcan")

        child = self._boot(["-serial", "null", "-chardev", "pty,id=line", "-serial", "chardev:line"])
        return child.connect(open_bus)

    def _boot(self, line: Sequence[str], inherited: Sequence[int] = ()) -> Child:
        qemu = shutil.which(QEMU)
        if qemu is None:
            raise LinkError(f"{QEMU} is not installed: apt-get install qemu-system-arm")
        command: list[str | Path] = [*_on_one_processor(), qemu, "-machine", self.machine, "-kernel", self._image()]
        command += [*_NO_SCREEN, *line]
        if self.semihosting:
            nonce = f"arg=analogrig,arg={secrets.randbits(32):08x}"
            command += ["-semihosting-config", f"enable=on,target=native,{nonce}"]
        return Child(command, f"QEMU ({self.machine})", inherited=inherited)

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

    def _image(self) -> Path:
        """Path of the firmware.

        :raises LinkError: there is no such file.
        """
        if not self.program.is_file():
            cure = "" if self.firmware else f": run `make firmware` in a clone, or name one: qemu-{self.core}:ELF"
            raise LinkError(f"there is no firmware {self.firmware or self.program}{cure}")
        return self.program


@contextlib.contextmanager
def _listening(terminal: str, within_s: float) -> Iterator[None]:
    """Keep the terminal open after the adapter there has answered: before the firmware has started, a UART may drop
    what it receives, and python-can opens the channel only once.

    If nothing answers in time, the handshake reports it.
    """
    descriptor = os.open(terminal, os.O_RDWR | os.O_NOCTTY)
    try:
        tty.setraw(descriptor)
        deadline_s = time.monotonic() + within_s
        answer = False
        while not answer and time.monotonic() < deadline_s:
            os.write(descriptor, b"V\r")
            answer = bool(select.select([descriptor], [], [], _ASK_AGAIN_S)[0])
        termios.tcflush(descriptor, termios.TCIFLUSH)
        yield
    finally:
        os.close(descriptor)


def _on_one_processor() -> list[str]:
    """Prefix that pins a command to one processor: QEMU's two threads wake each other at every byte, and a wake-up
    across processors takes twice as long."""
    taskset = shutil.which("taskset")
    if taskset is None:
        return []
    return [taskset, "--cpu-list", str(secrets.choice(sorted(os.sched_getaffinity(0))))]


class QemuM3(QemuDevice):
    """Cortex-M3, without a floating-point unit."""

    kind, core, machine = "qemu-m3", "m3", "mps2-an385"
    usage: ClassVar[str] = "qemu-m3[:ELF]"
    summary: ClassVar[str] = "Cortex-M3 firmware on a board that QEMU emulates"


class QemuM4(QemuDevice):
    """Cortex-M4F."""

    kind, core, machine = "qemu-m4", "m4", "mps2-an386"
    usage: ClassVar[str] = "qemu-m4[:ELF]"
    summary: ClassVar[str] = "Cortex-M4F firmware on a board that QEMU emulates"


class QemuM7(QemuDevice):
    """Cortex-M7."""

    kind, core, machine = "qemu-m7", "m7", "mps2-an500"
    usage: ClassVar[str] = "qemu-m7[:ELF]"
    summary: ClassVar[str] = "Cortex-M7 firmware on a board that QEMU emulates"


class QemuF405(QemuDevice):
    """STM32F405: the image for the real board, which needs nothing of QEMU."""

    kind, core, machine = "qemu-f405", "f405", "netduinoplus2"
    usage: ClassVar[str] = "qemu-f405[:ELF]"
    summary: ClassVar[str] = "STM32F405 firmware on a board that QEMU emulates"
    semihosting: ClassVar[bool] = False
