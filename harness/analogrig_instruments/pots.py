"""Pots of a real rig: set by its instrument, a command, a box on a serial line, or an operator.

Only an instrument knows the sample at which a pot moved. For the others ``analogrig_instruments.dating`` estimates it.
Dials go from 0 to 1. The caller checks the limits of each pot before anything moves.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import select
import shlex
import signal
import subprocess
import termios
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal, Self

import serial

from analogrig import ConfigurationError, LinkError, RigError
from analogrig.config import check_range
from analogrig.links import DEFAULT_BAUD, PortWire
from analogrig.trust import Thing, absolute_path, absolute_port
from analogrig_instruments.instrument import Pots

TERMINAL = Path("/dev/tty")
"""Terminal of the operator, also if standard input and output are redirected."""

DECIMALS = 4
"""Decimals of a dial in text: ten-turn pots are set to 1e-3."""

_MOST_TIMEOUT_S = 3600.0
_MOST_STEPS = 1 << 24
_MOST_BAUD = 100_000_000
_MOST_SHOWN = 300
"""Characters of a reply that an error message repeats."""
_MOST_REPLY_BYTES = 4096
_PLACEHOLDER = re.compile(r"\{(\w*)\}")
_PLACEHOLDERS = ("pot", "dial", "step")


class PotsKind:
    """Base of the descriptions of pots, with the defaults of a kind that names nothing outside analogrig."""

    changeable: ClassVar[bool] = True
    """True if the pots can be set while a scenario is played."""
    exact: ClassVar[bool] = False
    """True if the instrument sets them at the scheduled instants."""

    @property
    def things(self) -> tuple[Thing, ...]:
        """Things that ``open`` would run or connect to."""
        return ()

    def placed(self, folder: Path) -> Self:  # noqa: ARG002 - overridden
        """The same with absolute paths, where its own are relative to ``folder``."""
        return self

    def check(self) -> None:
        """Check before anything is played what can be known then.

        :raises ConfigurationError: the pots cannot be opened.
        """

    def open(self) -> Pots:
        """Connect to the pots. Those of kind ``instrument`` come with the instrument.

        :raises RigError: the connection failed.
        :raises ConfigurationError: a prerequisite is missing.
        """
        return Pots()


@dataclass(frozen=True)
class InstrumentPots(PotsKind):
    """The instrument turns the pots itself, at exact instants."""

    exact = True
    kind: Literal["instrument"]


@dataclass(frozen=True, kw_only=True)
class _SteppedPots(PotsKind):
    """Settings of pots that have their own names and count positions in steps."""

    steps: int = 256
    """Positions of a pot: ``{step}`` goes from 0 to one less."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Value of ``{pot}`` by the rig's name of a pot; default: that name."""
    timeout_s: float = 5.0

    def __post_init__(self) -> None:
        check_range(self, "steps", 2, _MOST_STEPS)
        if not 0.0 < self.timeout_s <= _MOST_TIMEOUT_S:
            raise ValueError(f"timeout_s must be more than 0 and at most {_MOST_TIMEOUT_S:g}, not {self.timeout_s:g}")

    def fill(self, template: str, pot: str, dial: float) -> str:
        """The template with the pot's name, its dial and its step in place of the placeholders."""
        values = {
            "pot": self.names.get(pot, pot),
            "dial": f"{dial:.{DECIMALS}f}",
            "step": str(round(dial * (self.steps - 1))),
        }
        return _PLACEHOLDER.sub(lambda found: values[found.group(1)], template)

    def rounded(self, template: str, dials: Mapping[str, float]) -> dict[str, float]:
        """Positions that the text of a template sets."""
        if "step" in _PLACEHOLDER.findall(template):
            return {pot: round(dial * (self.steps - 1)) / (self.steps - 1) for pot, dial in dials.items()}
        return {pot: round(dial, DECIMALS) for pot, dial in dials.items()}


@dataclass(frozen=True, kw_only=True)
class CommandPots(_SteppedPots, Pots):
    """A program of the user that sets one pot, and ends with status 0 when it stands."""

    kind: Literal["command"]
    arguments: tuple[str, ...]
    """The program and its arguments, with {pot}, {dial} (0 to 1) or {step} in them. No shell interprets them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.arguments or not self.arguments[0]:
            raise ValueError("arguments must begin with the program")
        if _PLACEHOLDER.search(self.arguments[0]):  # --allow permits one program, not a family of names
            raise ValueError(f"arguments must begin with the program, without placeholders, not {self.arguments[0]!r}")
        _check_placeholders("arguments", " ".join(self.arguments))

    @property
    def things(self) -> tuple[Thing, ...]:
        """Its program; a name without a slash is searched on the PATH."""
        return (Thing("command", self.arguments[0], "pots run the command", self.arguments[1:]),)

    def placed(self, folder: Path) -> Self:
        """The same with an absolute program path, where its own is relative to ``folder``."""
        program, *rest = self.arguments
        return dataclasses.replace(
            self, arguments=(absolute_path(program, folder) if "/" in program else program, *rest)
        )

    def open(self) -> Pots:
        return self

    def set_one(self, pot: str, dial: float) -> None:
        arguments = [self.fill(each, pot, dial) for each in self.arguments]
        where = f"pot {pot} to {dial:.{DECIMALS}f}: {shlex.join(arguments)}"
        status, output = _run(arguments, self.timeout_s, where)
        if status:
            how = f"status {status}" if status > 0 else f"signal {-status}"
            raise RigError(f"{where}: ended with {how}{_quote(output)}")

    def standing(self, dials: Mapping[str, float]) -> dict[str, float]:
        return self.rounded(" ".join(self.arguments), dials)


@dataclass(frozen=True, kw_only=True)
class SerialPots(_SteppedPots):
    """A box of digital pots on a serial line, or any URL of pyserial, that takes a line of text for each pot."""

    kind: Literal["serial"]
    url: str
    baud: int = DEFAULT_BAUD
    line: str
    r"""Text to send, its end included, with {pot}, {dial} (0 to 1) or {step} in it: ``"W {pot} {step}\n"``."""
    reply: str = ""
    """Line that the box answers when the pot stands, without its end; placeholders as in ``line``. Empty: no reply."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.url:
            raise ValueError("url must name the line of the box: a serial port, or any URL of pyserial")
        check_range(self, "baud", 1, _MOST_BAUD)
        _check_placeholders("line", self.line)
        _check_placeholders("reply", self.reply, needed=False)

    @property
    def things(self) -> tuple[Thing, ...]:
        """Its serial line."""
        return (Thing("serial port", self.url, "pots open the serial port"),)

    def placed(self, folder: Path) -> Self:
        """The same with an absolute port, where its own is relative to ``folder``."""
        return dataclasses.replace(self, url=absolute_port(self.url, folder))

    def check(self) -> None:
        """Check that pyserial knows the URL. Even this may open files (``spy://``).

        :raises ConfigurationError: it does not.
        """
        try:
            serial.serial_for_url(self.url, do_not_open=True)
        except OSError:  # a port that is missing now may be there when it is opened
            pass
        except Exception as error:  # as PortWire
            raise ConfigurationError(f"pots: url {self.url}: {error}") from error

    def open(self) -> Pots:
        return _Box(self)


@dataclass(frozen=True, kw_only=True)
class OperatorPots(PotsKind):
    """An operator at the terminal."""

    kind: Literal["operator"]

    def open(self, terminal: Path = TERMINAL) -> Pots:
        """:raises ConfigurationError: there is no terminal."""
        return _Operator(terminal)


@dataclass(frozen=True, kw_only=True)
class NoPots(PotsKind):
    """Pots that stay where they stand."""

    changeable = False
    kind: Literal["none"]


PotsDescription = InstrumentPots | CommandPots | SerialPots | OperatorPots | NoPots
"""Table ``[rig.NAME.pots]``, by its ``kind``."""


def _check_placeholders(key: str, template: str, *, needed: bool = True) -> None:
    """:raises ValueError: a placeholder is unknown, or the pot or its position is missing."""
    found = _PLACEHOLDER.findall(template)
    for name in found:
        if name not in _PLACEHOLDERS:
            known = ", ".join(f"{{{each}}}" for each in _PLACEHOLDERS)
            raise ValueError(f"{key}: unknown placeholder {{{name}}} (known: {known})")
    if needed and not ("pot" in found and {"dial", "step"} & set(found)):
        raise ValueError(f"{key} must have {{pot}}, and {{dial}} or {{step}}, in it")


def _run(arguments: list[str], timeout_s: float, where: str) -> tuple[int, bytes]:
    """Run a command to its end, in a process group of its own. Return its status and the beginning of its output.

    :raises RigError: it cannot be started, or does not end in time; then the group is killed.
    """
    try:
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise RigError(f"{where}: cannot be started: {reason}") from error
    output, deadline_s = b"", time.monotonic() + timeout_s
    with process, contextlib.suppress(subprocess.TimeoutExpired):
        assert process.stdout is not None  # noqa: S101 - asked for above
        stdout = process.stdout.fileno()
        try:
            while (left_s := deadline_s - time.monotonic()) > 0.0 and select.select([stdout], [], [], left_s)[0]:
                if not (received := os.read(stdout, _MOST_REPLY_BYTES)):
                    return process.wait(left_s), output
                output = (output + received)[:_MOST_REPLY_BYTES]
        finally:
            if process.returncode is None:
                os.killpg(process.pid, signal.SIGKILL)
    raise RigError(f"{where}: not done within {timeout_s:g} s, killed")


class _Box(Pots):
    def __init__(self, description: SerialPots) -> None:
        self._description = description
        try:
            self._wire = PortWire(description.url, description.baud)
        except LinkError as error:
            raise RigError(f"pots: {error}") from error

    def set_one(self, pot: str, dial: float) -> None:
        description = self._description
        where = f"pot {pot} to {dial:.{DECIMALS}f}: {description.url}"
        wanted = description.fill(description.reply, pot, dial)
        try:
            while wanted and self._wire.read(0.0):
                pass  # discard a greeting, or a reply that came too late
            self._wire.write(description.fill(description.line, pot, dial).encode())
            if wanted:
                self._expect(wanted, where)
        except LinkError as error:
            raise RigError(f"{where}: {str(error).removeprefix(f'{description.url}: ')}") from error

    def standing(self, dials: Mapping[str, float]) -> dict[str, float]:
        return self._description.rounded(self._description.line, dials)

    def _expect(self, wanted: str, where: str) -> None:
        """Await a reply.

        :raises RigError: another line comes, or none in time.
        """
        deadline_s = self._wire.clock() + self._description.timeout_s
        reply = b""
        while b"\n" not in reply and len(reply) < _MOST_REPLY_BYTES:
            left_s = deadline_s - self._wire.clock()
            if left_s <= 0.0:
                timeout_s = self._description.timeout_s
                raise RigError(f"{where}: no answer {wanted!r} within {timeout_s:g} s{_quote(reply)}")
            reply += self._wire.read(left_s)
        line = reply.partition(b"\n")[0].strip(b"\r\n ")
        if line != wanted.strip().encode():
            raise RigError(f"{where}: answered {_shorten(line)!r}, not {wanted!r}")

    def close(self) -> None:
        self._wire.close()


class _Operator(Pots):
    slow = True

    def __init__(self, terminal: Path) -> None:
        self._name = str(terminal)
        try:
            self._fd = os.open(terminal, os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC)
        except OSError as error:
            raise ConfigurationError(
                f'pots: kind "operator" needs a terminal, {self._name}: {error.strerror}'
            ) from error
        if not os.isatty(self._fd):
            self.close()
            raise ConfigurationError(f'pots: kind "operator" needs a terminal: {self._name} is no terminal')

    def set(self, dials: Mapping[str, float], words: str, *, recording: bool) -> None:
        order = "NOW turn to" if recording else "Set the pots to"
        targets = ", ".join(f"{pot} {dial:.{DECIMALS}f}" for pot, dial in dials.items())
        prompt = f"{order} {targets} ({words}), then press Enter: "
        if self._fd < 0:
            raise RigError(f"pots: {self._name} was closed")
        try:
            termios.tcflush(self._fd, termios.TCIFLUSH)  # an Enter typed before the prompt does not count
            os.write(self._fd, prompt.encode())
            answer = b""
            while not answer.endswith(b"\n"):
                answer = os.read(self._fd, 1024)
                if not answer:
                    raise RigError(f"pots: the operator at {self._name} has left (end of input)")
        except (OSError, termios.error) as error:
            raise RigError(f"pots: the operator at {self._name} has left ({error.args[-1]})") from error

    def standing(self, dials: Mapping[str, float]) -> dict[str, float]:
        return {pot: round(dial, DECIMALS) for pot, dial in dials.items()}

    def close(self) -> None:
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


def _quote(output: bytes) -> str:
    """Output in one line, for the end of a message; empty if there was none."""
    text = " / ".join(_shorten(output).split("\n"))
    return f", output: {text}" if text else ""


def _shorten(output: bytes) -> str:
    text = output.decode(errors="replace").strip()
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."
