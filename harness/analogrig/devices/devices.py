"""The kinds of devices: what each needs to be told, how the command line names it, and how it is reached.

A kind is one class, in the registry ``KINDS``; only the help of the command names them again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import re
import secrets
import shutil
import socket
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self
from urllib.parse import quote, unquote, urlencode

from analogrig import config, device_program
from analogrig.errors import ConfigurationError, LinkError
from analogrig.links.child import Child, ChildWire
from analogrig.links.faulty_wire import FaultyWire
from analogrig.links.line import CanLine, SerialLine
from analogrig.links.link import FramedLink, Link
from analogrig.links.wire import DEFAULT_BAUD, LIBRARY, DescriptorWire, MemoryWire, PortWire, Wire
from analogrig.links.wire_faults import WireFaults
from analogrig.protocol.estimator_config import EstimatorConfig
from analogrig.trust import Thing, Trust, file_of, folder_of, placed, placed_port

if TYPE_CHECKING:  # python-can takes longer to import than all the rest
    from analogrig.links.can_bus import CanBus, PythonCanBus

HOST_PROGRAM = device_program.PROGRAM
FIRMWARE = Path(__file__).parents[3] / "build" / "firmware"

QEMU = "qemu-system-arm"
_NO_SCREEN = ("-display", "none", "-monitor", "none", "-nodefaults")

_ELF = b"\x7fELF"
"""So begin libraries, programs and firmware."""

DEFAULT_TIMEOUT_S = 2.0
DEFAULT_WINDOW = 255
LONGEST_TIMEOUT_S = 3600.0
MOST_BAUD = 100_000_000
MOST_BITRATE = 20_000_000


@dataclass(frozen=True, kw_only=True)
class DeviceDescription:
    """What every device is described by: a file of fixtures/devices, or as much as the command line says."""

    kind: ClassVar[str]
    usage: ClassVar[str]
    """Spelling on the command line."""
    summary: ClassVar[str]
    """One line for `analogrig list`."""
    starting_s: ClassVar[float] = 0.0
    """It may take so long to start, before it hears anything."""
    name: str
    description: str = ""
    """One line for people."""
    exchange: Literal["sample", "block", "stream"] = "sample"
    """Samples go one at a time, in blocks, or before the last ones are answered; in blocks if the line carries them.
    The answers are the same."""
    window: int = DEFAULT_WINDOW
    """For stream: the most messages of samples that may be unanswered, if the device can hold them."""
    report_interval_n: int = 1
    """The device reports its estimate after every so many samples; alarms always."""
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
        for name, least, most in (("window", 1, 255), ("report_interval_n", 1, 65535), ("most_lost_n", 0, 2**31)):
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be {least} to {most}, not {getattr(self, name)}")
        try:
            self.faults()
        except ConfigurationError as error:
            raise ValueError(str(error)) from error

    @classmethod
    def named(cls, name: str, rest: str) -> Self:
        """The device that is called ``name`` on the command line; ``rest`` is what follows the kind and a colon, up to
        a question mark.

        :raises ConfigurationError: ``rest`` makes no sense.
        """
        where, _, query = rest.partition("?")
        table = {"name": name, **cls._located(name, where)}
        for key, text in _pairs(name, query):
            if key in table:
                raise ConfigurationError(f"{name}: {key} is said twice")
            table[key] = _value(cls, key, text)
        return config.build(cls, cls._sorted_out(table), name)

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """:raises ConfigurationError: a colon is the whole of ``place``, which would read as the default."""
        if place == ":":
            raise ConfigurationError(
                f"device {name!r}: nothing follows the colon: pass {cls.kind} for the default, or {cls.kind}:WHICH"
            )

    @classmethod
    def _sorted_out(cls, table: dict[str, Any]) -> dict[str, Any]:
        """Keys and values, each in its place."""
        return table

    @classmethod
    def _located(cls, name: str, where: str) -> dict[str, Any]:
        """What ``where`` says: keys and values."""
        if where:
            raise ConfigurationError(f"{name}: a device of the kind {cls.kind} has no {where!r}")
        return {}

    def open(self) -> Link:
        """Start it, or reach it.

        :raises LinkError: it cannot be reached.
        """
        raise NotImplementedError

    def fault_kinds(self) -> Collection[str]:
        """What can go wrong on its line."""
        raise NotImplementedError

    def faults(self) -> WireFaults | None:
        """What shall go wrong; None: nothing.

        :raises ConfigurationError: the line has no such faults.
        """
        return WireFaults.parse(self.wire_faults, self.fault_kinds()) if self.wire_faults else None

    def hint(self, link_name: str) -> str:  # noqa: ARG002
        """What to know when nobody answers on the link of that name, if there is anything."""
        return ""

    @property
    def program(self) -> Path | None:
        """The file that is run; None: what runs is not of this computer."""
        return None

    @property
    def things(self) -> tuple[Thing, ...]:
        """Things that opening it would load, run or connect to, except those of analogrig itself."""
        return ()

    def placed(self, folder: Path) -> Self:  # noqa: ARG002
        """The same with absolute paths, where its own are relative to ``folder``."""
        return self

    @property
    def only_one(self) -> str:
        """Its name on the command line if two processes cannot share it; empty if each can open one of its own."""
        return ""

    def as_table(self) -> dict[str, Any]:
        """In plain values, from which the same can be made."""
        table = {"kind": self.kind, **dataclasses.asdict(self), "estimator": self.estimator.as_table()}
        return {key: value for key, value in table.items() if value is not None}


def _pairs(name: str, query: str) -> list[tuple[str, str]]:
    """KEY=VALUE between ampersands; what stands for other characters (%20) does.

    :raises ConfigurationError: a word is something else.
    """
    words = [word.partition("=") for word in query.split("&") if word]
    for key, equals, value in words:
        if not (key and equals):
            raise ConfigurationError(f"{name}: {key + equals + value!r} is not KEY=VALUE")
    return [(unquote(key), unquote(value)) for key, _, value in words]


def _value(cls: type[DeviceDescription], key: str, text: str) -> Any:
    """A number or a truth if it looks like one, as python-can has it too, and the key is not one of ours for a text."""
    if isinstance(getattr(cls, key, None), str):
        return text
    is_flag = isinstance(getattr(cls, key, None), bool)
    if text.lower() in {"true", "false"} or (is_flag and text in {"1", "0"}):
        return text.lower() in {"true", "1"}
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text


@dataclass(frozen=True, kw_only=True)
class ByteDevice(DeviceDescription):
    """A device that is reached by bytes."""

    baud: int | None = None
    """Bits per second of the line. Where there is no real line, the time that such a one would take is reported."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.baud is not None and not 0 < self.baud <= MOST_BAUD:
            raise ValueError(f"baud must be 1 to {MOST_BAUD}, not {self.baud}")

    def open(self) -> Link:
        faults = self.faults()
        line = None if self.baud is None else SerialLine(self.baud)
        return FramedLink(self.wire() if faults is None else FaultyWire(self.wire, faults), line)

    def wire(self) -> Wire:
        """As ``open``, for the bytes."""
        raise NotImplementedError

    def fault_kinds(self) -> Collection[str]:
        return FaultyWire.HAPPENS


@dataclass(frozen=True, kw_only=True)
class FrameDevice(DeviceDescription):
    """A device that is reached by CAN frames."""

    bitrate: int | None = None
    """Of the bus. Where there is no real one, the time that such a one would take is reported."""
    data_bitrate: int | None = None
    """Of the data of CAN FD; none: no faster."""
    fd: bool = False
    """Whether the bus, and the device, understand CAN FD, whose frames carry a block of samples."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bitrate", "data_bitrate"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= MOST_BITRATE:
                raise ValueError(f"{name} must be 1 to {MOST_BITRATE}, not {value}")
        if self.data_bitrate is not None and not (self.fd and self.bitrate is not None):
            raise ValueError("data_bitrate is of CAN FD: say fd = true and the bitrate of the rest")

    def open(self) -> Link:
        from analogrig.links.can_link import CanLink
        from analogrig.links.faulty_bus import FaultyBus

        faults = self.faults()
        return CanLink(self.bus() if faults is None else FaultyBus(self.bus, faults))

    def bus(self) -> CanBus:
        """As ``open``, for the frames."""
        raise NotImplementedError

    def line(self) -> CanLine | None:
        return None if self.bitrate is None else CanLine(self.bitrate, self.data_bitrate)

    def fault_kinds(self) -> Collection[str]:
        from analogrig.links.faulty_bus import FaultyBus

        return FaultyBus.HAPPENS


@dataclass(frozen=True, kw_only=True)
class EitherDevice(ByteDevice, FrameDevice):
    """A device of this computer, which speaks what ``link`` says; each kind has its own way to carry CAN frames."""

    CAN: ClassVar[str] = "slcan"
    link: str = "serial"

    def __post_init__(self) -> None:
        if self.link not in {"serial", self.CAN}:
            raise ValueError(f"link must be 'serial' or {self.CAN!r}, not {self.link!r}")
        super().__post_init__()
        if self._is_serial and (self.fd or self.bitrate is not None):
            raise ValueError(f"bitrate and fd are of a CAN bus: say link = {self.CAN!r}")
        if not self._is_serial and self.baud is not None:
            raise ValueError(f"baud is of a serial line, and link is {self.link!r}: say bitrate")

    @property
    def _is_serial(self) -> bool:
        return self.link == "serial"

    def open(self) -> Link:
        return ByteDevice.open(self) if self._is_serial else FrameDevice.open(self)

    def fault_kinds(self) -> Collection[str]:
        return ByteDevice.fault_kinds(self) if self._is_serial else FrameDevice.fault_kinds(self)

    def _slcan(self, port: str) -> dict[str, Any]:
        """The bus on a terminal, in the words of python-can; what speaks there needs no time to start."""
        rates = {"bitrate": self.bitrate, "data_bitrate": self.data_bitrate}
        known = {key: value for key, value in rates.items() if value is not None}
        return {"interface": "slcan", "channel": port, "fd": self.fd, "sleep_after_open": 0.0, **known}


@dataclass(frozen=True, kw_only=True)
class HostDevice(EitherDevice):
    """A process of this computer, on a pseudo-terminal."""

    kind: ClassVar[str] = "host"
    usage: ClassVar[str] = "host[?link=slcan]"
    summary: ClassVar[str] = "device as a process of this computer, on a pseudo-terminal"

    @property
    def program(self) -> Path:
        return HOST_PROGRAM

    def wire(self) -> Wire:
        return host_wire()

    def bus(self) -> CanBus:
        from analogrig.links.can_bus import ChildBus, PythonCanBus

        child = host_child(["--slcan"])
        try:
            return ChildBus(child, PythonCanBus(self._slcan(child.first_line()), name="slcan"))
        except BaseException:
            child.end()
            raise


def host_child(arguments: Sequence[str] = (), program: Path = HOST_PROGRAM) -> Child:
    """A new process of the host port, which says in its first line where it listens.

    :raises LinkError: it cannot be started.
    """
    if not program.is_file():
        raise LinkError(f"{program} is absent: run `make setup`")
    return Child([program, *arguments], "the device process")


def host_wire(arguments: Sequence[str] = (), program: Path = HOST_PROGRAM) -> ChildWire:
    """A new process of the host port.

    :raises LinkError: it cannot be started, or does not say where it listens.
    """
    child = host_child(arguments, program)
    try:
        return ChildWire(child, PortWire(child.first_line(), name="pty"))
    except BaseException:
        child.end()
        raise


@dataclass(frozen=True, kw_only=True)
class InprocDevice(EitherDevice):
    """The same C within this process."""

    CAN: ClassVar[str] = "can"
    kind: ClassVar[str] = "inproc"
    usage: ClassVar[str] = "inproc[:LIBRARY]"
    summary: ClassVar[str] = "device as a shared library in this process"
    library: str = ""
    """A device of your own as a shared library, built from estimator_c and your core; empty: the project's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.library and not self._is_serial:
            raise ValueError("a library of your own has no CAN bus: say link = 'serial'")

    @classmethod
    def _located(cls, name: str, where: str) -> dict[str, Any]:  # noqa: ARG003
        return {"library": where} if where else {}

    @property
    def program(self) -> Path:
        return Path(self.library).absolute() if self.library else LIBRARY

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("library", self.library, "the device loads the library"),) if self.library else ()

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, library=placed(self.library, folder))

    def wire(self) -> Wire:
        return MemoryWire(boot_nonce=secrets.randbits(32), library=self.program)

    def bus(self) -> CanBus:
        from analogrig.links.can_device import MemoryBus

        return MemoryBus(boot_nonce=secrets.randbits(32), is_fd=self.fd, line=self.line())


@dataclass(frozen=True, kw_only=True)
class QemuDevice(EitherDevice):
    """Cortex-M firmware on a board that QEMU emulates."""

    starting_s: ClassVar[float] = 5.0
    core: ClassVar[str]
    machine: ClassVar[str]
    firmware: str | None = None
    """An ELF file; by default the project's own, which `make firmware` builds."""

    @classmethod
    def _located(cls, name: str, where: str) -> dict[str, Any]:  # noqa: ARG003
        return {"firmware": where} if where else {}

    def wire(self) -> Wire:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            line = theirs.fileno()
            child = self._boot(["-chardev", f"socket,id=line,fd={line}", "-serial", "chardev:line"], inherited=[line])
            return ChildWire(child, DescriptorWire(ours.detach(), "qemu"))

    def bus(self) -> CanBus:
        """On the second UART, as a terminal, since python-can's slcan opens nothing else as fast."""
        from analogrig.links.can_bus import ChildBus, PythonCanBus

        child = self._boot(["-serial", "null", "-chardev", "pty,id=line", "-serial", "chardev:line"])
        try:
            (terminal,) = re.findall(r"/dev/\S+", child.first_line()) or [""]
            return ChildBus(child, PythonCanBus(self._slcan(terminal), name="qemu slcan"))
        except BaseException:
            child.end()
            raise

    def _boot(self, line: Sequence[str], inherited: Sequence[int] = ()) -> Child:
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
        command += ["-semihosting-config", f"enable=on,target=native,{arguments}", *line]
        return Child(command, f"QEMU ({self.machine})", inherited=inherited)

    @property
    def things(self) -> tuple[Thing, ...]:
        """Firmware can open any file of this computer by semihosting."""
        return (Thing("firmware", self.firmware, "the device boots the firmware"),) if self.firmware else ()

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, firmware=placed(self.firmware, folder)) if self.firmware else self

    @property
    def program(self) -> Path:
        folder = Path(os.environ.get("ANALOGRIG_FIRMWARE", FIRMWARE))
        return (Path(self.firmware) if self.firmware else folder / f"analogrig-{self.core}.elf").absolute()

    def _image(self) -> Path:
        """:raises LinkError: it is not there."""
        if not self.program.is_file():
            cure = "" if self.firmware else ": run `make firmware`, or say where it is in ANALOGRIG_FIRMWARE"
            raise LinkError(f"there is no firmware {self.firmware or self.program}{cure}")
        return self.program


def _on_one_processor() -> list[str]:
    """QEMU's two threads wake each other for every byte, which takes twice as long from one processor to another."""
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


@dataclass(frozen=True, kw_only=True)
class SerialDevice(ByteDevice):
    """Whoever speaks at a serial port, or at any URL that pyserial can open."""

    kind: ClassVar[str] = "serial"
    usage: ClassVar[str] = "serial:URL"
    summary: ClassVar[str] = "board at a serial port, or at any URL of pyserial"
    url: str
    baud: int | None = DEFAULT_BAUD

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """``named`` does, whose message names a URL."""

    @classmethod
    def named(cls, name: str, rest: str) -> Self:
        """All of ``rest`` is the URL."""
        if not rest:
            raise ConfigurationError(f"{name}: say where it is: {cls.kind}:/dev/ttyACM0, or any URL of pyserial")
        return cls(name=name, url=rest)

    def wire(self) -> Wire:
        return PortWire(self.url, self.baud or DEFAULT_BAUD)

    def hint(self, link_name: str) -> str:  # noqa: ARG002
        return f"the line was opened at {self.baud} baud"

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("serial port", self.url, "the device opens the serial port"),)

    def placed(self, folder: Path) -> Self:
        return dataclasses.replace(self, url=placed_port(self.url, folder))

    @property
    def only_one(self) -> str:
        return f"{self.kind}:{self.url}"


_ONE_CONNECTION = frozenset({"slcan", "serial", "robotell", "seeedstudio"})
"""Interfaces of python-can that are behind a serial port."""


@dataclass(frozen=True, kw_only=True)
class CanDevice(FrameDevice):
    """Whoever answers on a CAN bus that python-can can open."""

    kind: ClassVar[str] = "can"
    usage: ClassVar[str] = "can:INTERFACE[/CHANNEL][?KEY=VALUE&...]"
    summary: ClassVar[str] = "node on a CAN bus that python-can can open"
    interface: str = ""
    """As python-can names it; empty: as its own configuration says, and so for the channel."""
    channel: str = ""
    device: Literal["none", "inproc", "host"] | None = None
    """Who answers: somebody else, the library in this process, or a process on the same SocketCAN channel. By default
    ``inproc`` on a virtual bus, where nobody else can be, and otherwise ``none``."""
    options: Mapping[str, bool | int | float | str] = field(default_factory=dict)
    """What else python-can is to be told."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.interface:
            self._check_answers_on(self.interface)

    def _check_answers_on(self, interface: str) -> None:
        """:raises ValueError: the device that shall answer cannot be on such a bus."""
        if self.device == "host" and interface != "socketcan":
            raise ValueError(f"device: a host process answers on SocketCAN, not on {interface}: say inproc")
        if self.device == "inproc" and interface in _ONE_CONNECTION:
            raise ValueError(
                f"device: inproc needs a connection of its own, and {interface} is an adapter that takes but one"
            )

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """``can:`` is the bus that python-can's own configuration describes."""

    @classmethod
    def _located(cls, name: str, where: str) -> dict[str, Any]:  # noqa: ARG003
        interface, _, channel = where.partition("/")
        return {key: value for key, value in (("interface", interface), ("channel", channel)) if value}

    @classmethod
    def _sorted_out(cls, table: dict[str, Any]) -> dict[str, Any]:
        """What is none of ours is for python-can."""
        own = {key: value for key, value in table.items() if key in cls.__dataclass_fields__}
        return {"options": {key: value for key, value in table.items() if key not in own}, **own}

    def bus(self) -> CanBus:
        from analogrig.links.can_bus import PythonCanBus, completed

        config = completed(self._asked())
        interface = str(config["interface"])
        try:
            self._check_answers_on(interface)
        except ValueError as error:
            raise ConfigurationError(f"device {self.name}: {error}") from error
        if interface == "virtual" and config["channel"] is None:
            config["channel"] = f"analogrig-{secrets.token_hex(4)}"  # which nobody else in this process has
        bus = PythonCanBus(config)
        try:
            return self._answered(bus, config)
        except BaseException:
            bus.close()
            raise

    def _asked(self) -> dict[str, Any]:
        """The bus in the words of python-can, as far as it is described."""
        asked = {**self.options, "fd": self.fd or None, "bitrate": self.bitrate, "data_bitrate": self.data_bitrate}
        asked |= {"interface": self.interface or None, "channel": self.channel or None}
        return {key: value for key, value in asked.items() if value is not None}

    def _answered(self, bus: PythonCanBus, config: Mapping[str, Any]) -> CanBus:
        """With the device that shall be on it."""
        from analogrig.links.can_bus import ChildBus, PythonCanBus
        from analogrig.links.can_device import InhabitedBus

        who = self._who(str(config["interface"]))
        if who == "inproc":
            return InhabitedBus(bus, PythonCanBus(config), boot_nonce=secrets.randbits(32))
        if who == "none":
            return bus
        child = host_child(["--can", str(bus.channel), *(["--fd"] if bus.is_fd else [])])
        try:
            child.first_line()
            return ChildBus(child, bus)
        except BaseException:
            child.end()
            raise

    @property
    def program(self) -> Path | None:
        return {"inproc": LIBRARY, "host": HOST_PROGRAM}.get(self._who(self.interface))

    def _who(self, interface: str) -> str:
        """Who answers on such a bus."""
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
        """Options are part of the name: python-can takes hosts, ports and driver libraries as such."""
        if not self.only_one:
            return ()
        texts = {key: str(value).lower() if isinstance(value, bool) else value for key, value in self.options.items()}
        options = urlencode(sorted(texts.items()), quote_via=quote)
        return (Thing("CAN bus", f"{self.only_one}{'?' if options else ''}{options}", "the device opens the CAN bus"),)


KINDS: Mapping[str, type[DeviceDescription]] = {
    cls.kind: cls for cls in (HostDevice, InprocDevice, QemuM3, QemuM4, QemuM7, SerialDevice, CanDevice)
}


def describe(name: str) -> DeviceDescription:
    """The device that ``name`` means: a shipped or own description, or a kind with what belongs to it after a colon.

    To look at it only: what a file names must not be opened unless ``trusted`` has checked it.

    :raises ConfigurationError: there is none, or it is wrong.
    """
    return _read(name)[0]


def trusted(name: str, trust: Trust) -> DeviceDescription:
    """As ``describe``, for a device that shall be opened.

    :raises ConfigurationError: as ``describe``; or a file orders a thing that is not trusted.
    """
    description, file = _read(name)
    trust.check(description.things, file or file_of(name))
    return description


def named_things(name: str) -> tuple[Thing, ...]:
    """Things that ``name`` itself states, not a file that it refers to; none if it means no device."""
    with contextlib.suppress(ConfigurationError):
        description, file = _read(name)
        return () if file else description.things
    return ()


def _read(name: str) -> tuple[DeviceDescription, str]:
    """The description, and the file that holds it; empty if the name says all."""
    kind = re.split("[:?]", name, maxsplit=1)[0]
    if kind in KINDS and name not in config.names("devices"):
        KINDS[kind].check_place(name, name[len(kind) :].partition("?")[0])
        return KINDS[kind].named(name, name[len(kind) :].removeprefix(":")).placed(folder_of(name)), ""
    _check_not_compiled(name)
    path = config.locate("devices", name)
    return from_table({"name": path.stem, **config.read_toml(path)}, str(path)).placed(path.parent), str(path)


def _check_not_compiled(name: str) -> None:
    """:raises ConfigurationError: it is what a device runs, and no description of one."""
    path = Path(name)
    try:
        with path.open("rb") if path.is_file() else io.BytesIO() as file:
            is_compiled = file.read(len(_ELF)) == _ELF
    except (OSError, ValueError):  # it is for those who read it to say
        is_compiled = False
    if is_compiled or path.suffix == ".so":
        raise ConfigurationError(
            f"{name}: is compiled, and describes no device: say inproc:{name} if it is a library of your own,"
            f" qemu-m4:{name} if it is firmware"
        )


def recorded(description: Mapping[str, Any]) -> DeviceDescription:
    """That of a record of ``Dut.description()``.

    :raises ConfigurationError: it describes no device.
    """
    return from_table({key: value for key, value in description.items() if key != "identity"}, "the recorded device")


def from_table(table: Mapping[str, Any], where: str) -> DeviceDescription:
    """A description from plain values; ``where`` leads every error.

    :raises ConfigurationError: they describe no device.
    """
    described = KINDS.get(str(table.get("kind")))
    if described is None:
        known = ", ".join(map(repr, KINDS))
        raise ConfigurationError(f"{where}: kind: must be one of {known}, not {table.get('kind')!r}")
    return config.build(described, {key: value for key, value in table.items() if key != "kind"}, where)
