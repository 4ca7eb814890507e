"""Devices of the kinds ``lines``, ``frames`` and ``exec``: a firmware or a program with a protocol of its own."""

from __future__ import annotations

import dataclasses
import os
import shutil
import tty
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from analogrig import LinkError
from analogrig.devices import Device, Thing
from analogrig.devices.child import Child, ChildWire
from analogrig.devices.port import Port
from analogrig.links import DEFAULT_BAUD
from analogrig.links.link import DescriptorWire, Wire
from analogrig.trust import absolute_path
from analogrig_lines.framing import Framing
from analogrig_lines.line_device import LineDevice
from analogrig_lines.template_description import TemplateDescription


@dataclass(frozen=True, kw_only=True)
class LinesDevice(Port, TemplateDescription):
    """A firmware that speaks lines of text at a serial port, or at any URL of pyserial."""

    kind: ClassVar[str] = "lines"
    usage: ClassVar[str] = "lines:URL[?send=...&receive=...]"
    summary: ClassVar[str] = "firmware that speaks lines of text at a serial port; its templates are in a device file"
    loses_lines: ClassVar[bool] = True
    baud: int = DEFAULT_BAUD

    def open(self) -> Device:
        return LineDevice(self)


@dataclass(frozen=True, kw_only=True)
class FramesDevice(Port, TemplateDescription):
    """A firmware that speaks binary records in frames at a serial port, or at any URL of pyserial."""

    kind: ClassVar[str] = "frames"
    usage: ClassVar[str] = "frames:URL[?framing=...&send=...&receive=...]"
    summary: ClassVar[str] = "firmware that speaks binary frames at a serial port: COBS, SLIP, length or delimiter"
    loses_lines: ClassVar[bool] = True
    baud: int = DEFAULT_BAUD
    format: Literal["text", "binary"] = "binary"
    framing: Framing | Literal[""] = "cobs"
    send: str = "{u:u16}{y:u16}"
    receive: str = "{alarm:u8}"

    def open(self) -> Device:
        return LineDevice(self)


_BUFFERED = (
    "if it prints answers, its standard output may be buffered: call fflush(stdout) after each, start Python with -u,"
    " or set pty = true"
)


@dataclass(frozen=True, kw_only=True)
class ProgramDevice(TemplateDescription):
    """A program that reads samples from standard input and answers on standard output."""

    kind: ClassVar[str] = "exec"
    no_place: ClassVar[str] = "{name}: no program: use {kind}:./my_program, or a device file"
    usage: ClassVar[str] = "exec:PROGRAM[?send=...&receive=...]"
    summary: ClassVar[str] = "program that reads samples from standard input and answers on standard output"
    loses_lines: ClassVar[bool] = False
    arguments: tuple[str, ...]
    """The program and its arguments. A program without a slash is searched on the PATH."""
    pty: bool = False
    """True if standard input and output are a pseudo-terminal, on which C programs flush every line."""

    def __post_init__(self) -> None:
        if not self.arguments or not self.arguments[0]:
            raise ValueError("arguments must begin with the program")
        super().__post_init__()
        if self.pty and self.is_binary:
            raise ValueError("pty: a pseudo-terminal carries text only")

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:
        return {"arguments": [place]} if place else super()._place(name, place)

    def open(self) -> Device:
        return LineDevice(self)

    def wire(self) -> Wire:
        program, *rest = self.arguments
        found = shutil.which(program)
        if found is None:
            raise LinkError(f"device {self.name}: there is no program {program}")
        if self.pty:
            read_fd, their_input = write_fd, their_output = os.openpty()
            tty.setraw(their_input)  # a terminal that changes no byte
        else:  # in lock-step, two pipes are half as fast again as a socket pair
            (read_fd, their_output), (their_input, write_fd) = os.pipe(), os.pipe()
        try:
            child = Child([found, *rest], f"program {program}", stdio=(their_input, their_output))
        except BaseException:
            for fd in {read_fd, write_fd}:
                os.close(fd)
            raise
        finally:
            for fd in {their_input, their_output}:
                os.close(fd)
        return ChildWire(child, DescriptorWire(read_fd, "pty" if self.pty else "pipe", write_fd=write_fd))

    def hint(self, link_name: str) -> str:  # noqa: ARG002
        return "" if self.pty else _BUFFERED

    @property
    def program(self) -> Path | None:
        found = shutil.which(self.arguments[0])
        return None if found is None else Path(found).absolute()

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("command", self.arguments[0], "the device runs the command", self.arguments[1:]),)

    def placed(self, folder: Path) -> Self:
        program, *rest = self.arguments
        return dataclasses.replace(
            self, arguments=(absolute_path(program, folder) if "/" in program else program, *rest)
        )
