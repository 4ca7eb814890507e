"""Devices of the kind ``exec``: a program that reads samples from standard input and answers on standard output."""

from __future__ import annotations

import dataclasses
import os
import shutil
import tty
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

from analogrig.devices.answer_form import AnswerForm
from analogrig.devices.child import Child, ChildWire
from analogrig.devices.device import Device
from analogrig.devices.template_description import TemplateDescription
from analogrig.devices.templates import record
from analogrig.errors import ConfigurationError, LinkError
from analogrig.links.wire import DescriptorWire, Wire
from analogrig.trust import Thing, absolute_path

_BUFFERED = (
    "if it prints answers, its standard output may be buffered: call fflush(stdout) after each, start Python with -u,"
    " or set pty = true"
)

_INPUTS = ("index", "u", "y", "valid")


@dataclass(frozen=True, kw_only=True)
class ProgramDevice(TemplateDescription):
    """A program that reads samples from standard input and answers on standard output."""

    kind: ClassVar[str] = "exec"
    usage: ClassVar[str] = "exec:PROGRAM[?send=...&receive=...]"
    summary: ClassVar[str] = "program that reads samples from standard input and answers on standard output"
    loses_lines: ClassVar[bool] = False
    arguments: tuple[str, ...]
    """The program and its arguments. A program without a slash is searched on the PATH."""
    format: Literal["text", "binary"] = "text"
    """``binary``: ``send`` and ``receive`` are packed little-endian records, such as {u:f32}{y:f32}{valid:u8}."""
    pty: bool = False
    """True if standard input and output are a pseudo-terminal, on which C programs flush every line."""

    @classmethod
    def check_place(cls, name: str, place: str) -> None:
        """Accept any place: ``_place`` reports a missing program."""

    @classmethod
    def _place(cls, name: str, place: str) -> dict[str, Any]:
        if not place:
            raise ConfigurationError(f"{name}: no program: use {cls.kind}:./my_program, or a device file")
        return {"arguments": [place]}

    def __post_init__(self) -> None:
        if not self.arguments or not self.arguments[0]:
            raise ValueError("arguments must begin with the program")
        super().__post_init__()

    def check_templates(self) -> None:
        if self.format == "text":
            super().check_templates()
            return
        for key in ("missing", "start", "reset", "reset_answer", "banner", "ignore", "echo", "indices", "checksum"):
            if getattr(self, key):
                raise ValueError(f"{key}: a program with binary records has none; it is started for each record")
        if self.pty:
            raise ValueError("pty: a pseudo-terminal carries text only")
        for name in record("send", self.send).names or ():
            if name not in _INPUTS:
                raise ValueError(f"send: has no field {name} (known: {', '.join(_INPUTS)})")
        record("receive", self.receive)

    def form(self) -> AnswerForm:
        if self.format == "text":
            return super().form()
        return AnswerForm(record("receive", self.receive).names or (), self.theta)

    def open(self) -> Device:
        if self.format == "text":
            return super().open()
        from analogrig.devices.record_device import RecordDevice

        return RecordDevice(self)

    def wire(self) -> Wire:
        program, *rest = self.arguments
        found = shutil.which(program)
        if found is None:
            raise LinkError(f"device {self.name}: there is no program {program}")
        ends = _terminal() if self.pty else _pipes()
        try:
            child = Child([found, *rest], f"program {program}", stdio=ends.theirs)
        except BaseException:
            _close(ends.ours)
            raise
        finally:
            _close(ends.theirs)
        read_fd, write_fd = ends.ours
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


class _Ends(NamedTuple):
    """Descriptors of both ends of a line."""

    ours: tuple[int, int]
    """To read and to write."""
    theirs: tuple[int, int]


def _pipes() -> _Ends:
    """Two pipes. In lock-step they are half as fast again as a socket pair."""
    (read_fd, their_output), (their_input, write_fd) = os.pipe(), os.pipe()
    return _Ends((read_fd, write_fd), (their_input, their_output))


def _terminal() -> _Ends:
    """A pseudo-terminal that changes no byte."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    return _Ends((ours, ours), (theirs, theirs))


def _close(descriptors: Iterable[int]) -> None:
    for fd in set(descriptors):
        os.close(fd)
