"""The kinds of devices: what each needs to be told, how the command line names it, and how it is reached.

A kind is one class, in the registry ``KINDS``; only the help of the command names them again.
"""

from __future__ import annotations

import dataclasses
import os
import secrets
import shutil
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from harness import config
from harness.child import Child, ChildWire
from harness.errors import ConfigurationError, LinkError
from harness.estimator_config import EstimatorConfig
from harness.link import FramedLink, Link
from harness.timed_wire import TimedWire
from harness.wire import DEFAULT_BAUD, DescriptorWire, MemoryWire, PortWire, Wire
from harness.wire_faults import FaultyWire, WireFaults

HOST_PROGRAM = Path(__file__).parent / "bin" / "analogrig-device"
FIRMWARE = Path(__file__).parents[1] / "build" / "firmware"

QEMU = "qemu-system-arm"
_NO_SCREEN = ("-display", "none", "-monitor", "none", "-nodefaults")

DEFAULT_TIMEOUT_S = 2.0
DEFAULT_WINDOW = 255
LONGEST_TIMEOUT_S = 3600.0
MOST_BAUD = 100_000_000


@dataclass(frozen=True, kw_only=True)
class DeviceDescription:
    """What every device is described by: a file of fixtures/devices, or as much as the command line says."""

    kind: ClassVar[str]
    starting_s: ClassVar[float] = 0.0
    """It may take so long to start, before it hears anything."""
    name: str
    exchange: Literal["sample", "block", "stream"] = "sample"
    """Samples go one at a time, in blocks, or in blocks before the last one is answered. The answers are the same."""
    window: int = DEFAULT_WINDOW
    """For stream: the most blocks that may be unanswered, if the device can hold them."""
    report_interval_n: int = 1
    """The device reports its estimate after every so many samples; alarms always."""
    baud: int | None = None
    """Bits per second of the line. Where there is no real line, the time that such a one would take is reported."""
    most_lost_n: int = 0
    """A run in which more samples were lost on the way to the device is INCONCLUSIVE."""
    timeout_s: float = DEFAULT_TIMEOUT_S
    """For the answers to one message."""
    wire_faults: str = ""
    """What shall go wrong on the line (``WireFaults.parse``)."""
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)

    def __post_init__(self) -> None:
        if not 0.0 < self.timeout_s <= LONGEST_TIMEOUT_S:
            raise ValueError(f"timeout_s must be more than 0 and at most {LONGEST_TIMEOUT_S:g}, not {self.timeout_s:g}")
        if self.baud is not None and not 0 < self.baud <= MOST_BAUD:
            raise ValueError(f"baud must be 1 to {MOST_BAUD}, not {self.baud}")
        try:
            WireFaults.parse(self.wire_faults)
        except ConfigurationError as error:
            raise ValueError(str(error)) from error
        for name, least, most in (("window", 1, 255), ("report_interval_n", 1, 65535), ("most_lost_n", 0, 2**31)):
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be {least} to {most}, not {getattr(self, name)}")

    @classmethod
    def named(cls, name: str, rest: str) -> Self:
        """The device that is called ``name`` on the command line; ``rest`` is what follows the kind and a colon.

        :raises ConfigurationError: ``rest`` makes no sense.
        """
        if rest:
            raise ConfigurationError(f"{name}: a device of the kind {cls.kind} has no {rest!r}")
        return cls(name=name)

    def open(self) -> Link:
        """Start it, or reach it.

        :raises LinkError: it cannot be reached.
        """
        wire = FaultyWire(self.wire, WireFaults.parse(self.wire_faults)) if self.wire_faults else self.wire()
        return FramedLink(wire if self.baud is None else TimedWire(wire, self.baud))

    def wire(self) -> Wire:
        """As ``open``, for a device that is reached by bytes."""
        raise NotImplementedError

    @property
    def line(self) -> str:
        """What to know about the line when nobody answers, if there is anything."""
        return ""

    @property
    def elsewhere(self) -> str:
        """As the command line names it, if it is not safe to open it on the word of a recording."""
        return ""

    def as_table(self) -> dict[str, Any]:
        """In plain values, from which the same can be made."""
        table = {"kind": self.kind, **dataclasses.asdict(self), "estimator": self.estimator.as_table()}
        return {key: value for key, value in table.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class HostDevice(DeviceDescription):
    """A process of this computer, on a pseudo-terminal."""

    kind: ClassVar[str] = "host"

    def wire(self) -> Wire:
        return host_wire()


def host_wire(arguments: Sequence[str] = (), program: Path = HOST_PROGRAM) -> ChildWire:
    """A new process of the host port.

    :raises LinkError: it cannot be started, or does not say where it listens.
    """
    if not program.is_file():
        raise LinkError(f"{program} is absent: run `make setup`")
    child = Child([program, *arguments], "the device process")
    try:
        return ChildWire(child, PortWire(child.first_line(), name="pty"))
    except BaseException:
        child.end()
        raise


@dataclass(frozen=True, kw_only=True)
class InprocDevice(DeviceDescription):
    """The same C within this process."""

    kind: ClassVar[str] = "inproc"

    def wire(self) -> Wire:
        return MemoryWire(boot_nonce=secrets.randbits(32))


@dataclass(frozen=True, kw_only=True)
class QemuDevice(DeviceDescription):
    """Cortex-M firmware on a board that QEMU emulates."""

    starting_s: ClassVar[float] = 5.0
    core: ClassVar[str]
    machine: ClassVar[str]
    firmware: str | None = None
    """An ELF file; by default the project's own, which `make firmware` builds."""

    @classmethod
    def named(cls, name: str, rest: str) -> Self:
        return cls(name=name, firmware=rest or None)

    def wire(self) -> Wire:
        qemu = shutil.which(QEMU)
        if qemu is None:
            raise LinkError(f"{QEMU} is not installed: apt-get install qemu-system-arm")
        # What the firmware may ask of its debugger: who it is, which differs after every boot.
        arguments = f"arg=analogrig,arg={secrets.randbits(32):08x}"
        command: list[str | Path] = [
            *_on_one_processor(),
            qemu,
            "-machine",
            self.machine,
            "-kernel",
            self._image(),
            *_NO_SCREEN,
        ]
        command += ["-semihosting-config", f"enable=on,target=native,{arguments}"]
        ours, theirs = socket.socketpair()
        with ours, theirs:
            line = theirs.fileno()
            command += ["-chardev", f"socket,id=line,fd={line}", "-serial", "chardev:line"]
            child = Child(command, f"QEMU ({self.machine})", inherited=[line])
            return ChildWire(child, DescriptorWire(ours.detach(), "qemu"))

    @property
    def elsewhere(self) -> str:
        """Firmware may ask its debugger for any file of this computer."""
        return f"{self.kind}:{self.firmware}" if self.firmware else ""

    def _image(self) -> Path:
        """:raises LinkError: it is not there."""
        folder = Path(os.environ.get("ANALOGRIG_FIRMWARE", FIRMWARE))
        path = Path(self.firmware) if self.firmware else folder / f"analogrig-{self.core}.elf"
        if not path.is_file():
            cure = "" if self.firmware else ": run `make firmware`, or say where it is in ANALOGRIG_FIRMWARE"
            raise LinkError(f"there is no firmware {path}{cure}")
        return path.absolute()


def _on_one_processor() -> list[str]:
    """QEMU's two threads wake each other for every byte, which takes twice as long from one processor to another."""
    taskset = shutil.which("taskset")
    if taskset is None:
        return []
    return [taskset, "--cpu-list", str(secrets.choice(sorted(os.sched_getaffinity(0))))]


class QemuM3(QemuDevice):
    """Cortex-M3, without a floating-point unit."""

    kind, core, machine = "qemu-m3", "m3", "mps2-an385"


class QemuM4(QemuDevice):
    """Cortex-M4F."""

    kind, core, machine = "qemu-m4", "m4", "mps2-an386"


class QemuM7(QemuDevice):
    """Cortex-M7."""

    kind, core, machine = "qemu-m7", "m7", "mps2-an500"


@dataclass(frozen=True, kw_only=True)
class SerialDevice(DeviceDescription):
    """Whoever speaks at a serial port, or at any URL that pyserial can open."""

    kind: ClassVar[str] = "serial"
    url: str
    baud: int | None = DEFAULT_BAUD

    @classmethod
    def named(cls, name: str, rest: str) -> Self:
        if not rest:
            raise ConfigurationError(f"{name}: say where it is: {cls.kind}:/dev/ttyACM0, or any URL of pyserial")
        return cls(name=name, url=rest)

    def wire(self) -> Wire:
        return PortWire(self.url, self.baud or DEFAULT_BAUD)

    @property
    def line(self) -> str:
        return f"the line was opened at {self.baud} baud"

    @property
    def elsewhere(self) -> str:
        return f"{self.kind}:{self.url}"


KINDS: Mapping[str, type[DeviceDescription]] = {
    cls.kind: cls for cls in (HostDevice, InprocDevice, QemuM3, QemuM4, QemuM7, SerialDevice)
}


def describe(name: str) -> DeviceDescription:
    """The device that ``name`` means: a shipped or own description, or a kind with what belongs to it after a colon.

    :raises ConfigurationError: there is none, or it is wrong.
    """
    kind, _, rest = name.partition(":")
    if kind in KINDS and name not in config.names("devices"):
        return KINDS[kind].named(name, rest)
    path = config.locate("devices", name)
    return from_table({"name": path.stem, **config.read_toml(path)}, str(path))


def from_table(table: Mapping[str, Any], where: str) -> DeviceDescription:
    """A description from plain values; ``where`` leads every error.

    :raises ConfigurationError: they describe no device.
    """
    described = KINDS.get(str(table.get("kind")))
    if described is None:
        known = ", ".join(map(repr, KINDS))
        raise ConfigurationError(f"{where}: kind: must be one of {known}, not {table.get('kind')!r}")
    return config.build(described, {key: value for key, value in table.items() if key != "kind"}, where)
