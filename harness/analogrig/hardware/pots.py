"""Who turns the pots of a real rig where its instrument cannot: a command, a box at a serial line, or the operator.

None of them knows the sample at which a pot got there: that is learned from the samples afterwards
(``analogrig.hardware.dating``).
Dials go from 0 to 1; how far each pot may be turned is for the caller to check, before anything moves.
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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal, Protocol, Self

import serial

from analogrig.errors import ConfigurationError, LinkError, RigError
from analogrig.links.wire import DEFAULT_BAUD, PortWire
from analogrig.trust import Thing, placed, placed_port

TERMINAL = Path("/dev/tty")
"""Where the operator is, whatever standard input and output are."""

DECIMALS = 4
"""Of a dial in words: a ten-turn pot is set to 1e-3."""

_MOST_TIMEOUT_S = 3600.0
_MOST_STEPS = 1 << 24
_MOST_SHOWN = 300
"""Characters of what a command or a box said that stand in an error."""
_MOST_REPLY_BYTES = 4096
_PLACEHOLDER = re.compile(r"\{(\w*)\}")
_PLACEHOLDERS = ("pot", "dial", "step")


class Pots(Protocol):
    """Pots that can be set."""

    slow: bool
    """A hand turns them, and is on its way for many samples; otherwise each jumps, one after the other."""

    def settle(self, dials: Mapping[str, float], words: str) -> None:
        """Set pots, by their names, and be done with it when this returns: nothing is being recorded.

        :param words: what is asked for as an operator thinks of it: ``M 115 kg, K 24500 N/m``.
        :raises RigError: they could not be set, or nobody knows.
        """

    def turn(self, dials: Mapping[str, float], words: str) -> None:
        """The same while a record is being taken: at once, and so fast as can be. All raise what ``settle`` does."""

    def close(self) -> None:
        """Let go of what turns them."""


@dataclass(frozen=True, kw_only=True)
class _Boxed:
    """Settings of whatever counts a pot's positions in steps and has names of its own for the pots."""

    steps: int = 256
    """Positions of a pot: ``{step}`` goes from 0 to one less."""
    names: Mapping[str, str] = field(default_factory=dict)
    """What ``{pot}`` is to be for the rig's name of a pot; that name itself where it is not given."""
    timeout_s: float = 5.0

    def __post_init__(self) -> None:
        if not 2 <= self.steps <= _MOST_STEPS:
            raise ValueError(f"steps must be 2 to {_MOST_STEPS}, not {self.steps}")
        if not 0.0 < self.timeout_s <= _MOST_TIMEOUT_S:
            raise ValueError(f"timeout_s must be more than 0 and at most {_MOST_TIMEOUT_S:g}, not {self.timeout_s:g}")

    def filled(self, template: str, pot: str, dial: float) -> str:
        """With the pot's name, its dial and its step in their places."""
        values = {
            "pot": self.names.get(pot, pot),
            "dial": f"{dial:.{DECIMALS}f}",
            "step": str(round(dial * (self.steps - 1))),
        }
        return _PLACEHOLDER.sub(lambda found: values[found.group(1)], template)


@dataclass(frozen=True, kw_only=True)
class CommandPots(_Boxed):
    """A program of the user's that sets one pot, and ends with status 0 when it stands there."""

    kind: Literal["command"]
    arguments: tuple[str, ...]
    """The program and its arguments, with {pot}, {dial} (0 to 1) or {step} in them. No shell is asked."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.arguments or not self.arguments[0]:
            raise ValueError("arguments must begin with the program")
        if _PLACEHOLDER.search(self.arguments[0]):  # --allow names a program, not as many as a file likes to make of it
            raise ValueError(f"arguments must begin with the program, without placeholders, not {self.arguments[0]!r}")
        _check_placeholders("arguments", " ".join(self.arguments))

    @property
    def things(self) -> tuple[Thing, ...]:
        """Its program; a name without a slash is looked for on the PATH."""
        return (Thing("command", self.arguments[0], "pots run the command", self.arguments[1:]),)

    def placed(self, folder: Path) -> Self:
        """The same with an absolute program path, where its own is relative to ``folder``."""
        program, *rest = self.arguments
        return dataclasses.replace(self, arguments=(placed(program, folder) if "/" in program else program, *rest))

    def check(self) -> None:
        """Nothing is known before it is started."""

    def open(self) -> Pots:
        return _Command(self)


@dataclass(frozen=True, kw_only=True)
class SerialPots(_Boxed):
    """A box of digital pots at a serial line, or at any URL of pyserial, that takes a line of text for each pot."""

    kind: Literal["serial"]
    url: str
    baud: int = DEFAULT_BAUD
    line: str
    r"""What is sent, its end included, with {pot}, {dial} (0 to 1) or {step} in it: ``"W {pot} {step}\n"``."""
    reply: str = ""
    """The line that the box answers when the pot stands there, without its end; placeholders as in ``line``. Empty: it
    says nothing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.url:
            raise ValueError("url must say where the box is: a serial port, or any URL of pyserial")
        if not 1 <= self.baud <= 100_000_000:
            raise ValueError(f"baud must be 1 to 100000000, not {self.baud}")
        _check_placeholders("line", self.line)
        _check_placeholders("reply", self.reply, needed=False)

    @property
    def things(self) -> tuple[Thing, ...]:
        return (Thing("serial port", self.url, "pots open the serial port"),)

    def placed(self, folder: Path) -> Self:
        """The same with an absolute port, where its own is relative to ``folder``."""
        return dataclasses.replace(self, url=placed_port(self.url, folder))

    def check(self) -> None:
        """Find out before anything plays whether pyserial knows such a URL; even that may open files (``spy://``).

        :raises ConfigurationError: it does not.
        """
        try:
            serial.serial_for_url(self.url, do_not_open=True)
        except OSError:  # what is not there may be there when it is opened
            pass
        except Exception as error:  # as PortWire
            raise ConfigurationError(f"pots: url {self.url}: {error}") from error

    def open(self) -> Pots:
        """:raises RigError: the line cannot be opened.
        :raises ConfigurationError: pyserial knows no such URL.
        """
        return _Box(self)


class Harmless:
    """Pots whose description names nothing outside analogrig."""

    things: ClassVar[tuple[Thing, ...]] = ()

    def placed(self, folder: Path) -> Self:  # noqa: ARG002
        return self

    def check(self) -> None:
        """There is nothing to find out."""


@dataclass(frozen=True, kw_only=True)
class OperatorPots(Harmless):
    """Whoever sits at the terminal."""

    kind: Literal["operator"]

    def open(self, terminal: Path = TERMINAL) -> Pots:
        """:raises ConfigurationError: there is no terminal."""
        return _Operator(terminal)


@dataclass(frozen=True, kw_only=True)
class NoPots(Harmless):
    """Nobody: they stand where they stand."""

    kind: Literal["none"]

    def open(self) -> Pots:
        return _Nobody()


PotsDescription = CommandPots | SerialPots | OperatorPots | NoPots
"""``[rig.NAME.pots]``, by its ``kind``."""


def _check_placeholders(key: str, template: str, *, needed: bool = True) -> None:
    """:raises ValueError: one is none, or it cannot say which pot goes where."""
    found = _PLACEHOLDER.findall(template)
    for name in found:
        if name not in _PLACEHOLDERS:
            known = ", ".join(f"{{{each}}}" for each in _PLACEHOLDERS)
            raise ValueError(f"{key}: unknown placeholder {{{name}}} (known: {known})")
    if needed and not ("pot" in found and {"dial", "step"} & set(found)):
        raise ValueError(f"{key} must have {{pot}}, and {{dial}} or {{step}}, in it")


class _OneByOne:
    """Pots that are set one after another, in settling and in turning alike."""

    slow = False

    def settle(self, dials: Mapping[str, float], words: str) -> None:  # noqa: ARG002 - words are for an operator
        for pot, dial in dials.items():
            self._set(pot, dial)

    def turn(self, dials: Mapping[str, float], words: str) -> None:
        self.settle(dials, words)

    def close(self) -> None:
        pass

    def _set(self, pot: str, dial: float) -> None:
        raise NotImplementedError


class _Command(_OneByOne):
    def __init__(self, description: CommandPots) -> None:
        self._description = description

    def _set(self, pot: str, dial: float) -> None:
        arguments = [self._description.filled(each, pot, dial) for each in self._description.arguments]
        where = f"pot {pot} to {dial:.{DECIMALS}f}: {shlex.join(arguments)}"
        with _started(arguments, where) as process:
            try:
                said = _heard(process, self._description.timeout_s)
            except subprocess.TimeoutExpired:
                raise RigError(f"{where}: not done within {self._description.timeout_s:g} s, killed") from None
        if process.returncode:
            how = f"status {process.returncode}" if process.returncode > 0 else f"signal {-process.returncode}"
            raise RigError(f"{where}: ended with {how}{_quoted(said)}")


def _heard(process: subprocess.Popen[bytes], timeout_s: float) -> bytes:
    """The beginning of what it said, when it has ended.

    :raises subprocess.TimeoutExpired: it has not.
    """
    assert process.stdout is not None  # noqa: S101 - as it was started
    said, deadline_s = b"", time.monotonic() + timeout_s
    while select.select([process.stdout], [], [], max(0.0, deadline_s - time.monotonic()))[0]:
        if not (heard := os.read(process.stdout.fileno(), _MOST_REPLY_BYTES)):
            process.wait(max(0.0, deadline_s - time.monotonic()))
            return said
        said = (said + heard)[:_MOST_REPLY_BYTES]
        if time.monotonic() > deadline_s:
            break
    raise subprocess.TimeoutExpired(process.args, timeout_s)


@contextlib.contextmanager
def _started(arguments: list[str], where: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process in a group of its own, of which nothing is left in the end."""
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
    with process:
        try:
            yield process
        finally:
            if process.returncode is None:
                os.killpg(process.pid, signal.SIGKILL)


class _Box(_OneByOne):
    def __init__(self, description: SerialPots) -> None:
        self._description = description
        try:
            self._wire = PortWire(description.url, description.baud)
        except LinkError as error:
            raise RigError(f"pots: {error}") from error

    def _set(self, pot: str, dial: float) -> None:
        description = self._description
        where = f"pot {pot} to {dial:.{DECIMALS}f}: {description.url}"
        wanted = description.filled(description.reply, pot, dial)
        try:
            if wanted:
                self._forget()
            self._wire.write(description.filled(description.line, pot, dial).encode())
            if wanted:
                self._expect(wanted, where)
        except LinkError as error:
            raise RigError(f"{where}: {str(error).removeprefix(f'{description.url}: ')}") from error

    def _forget(self) -> None:
        """What the box said before it was asked: a greeting, or an answer that came too late."""
        while self._wire.read(0.0):
            pass

    def _expect(self, wanted: str, where: str) -> None:
        """:raises RigError: another line comes, or none in time."""
        deadline_s = self._wire.clock() + self._description.timeout_s
        said = b""
        while b"\n" not in said and len(said) < _MOST_REPLY_BYTES:
            left_s = deadline_s - self._wire.clock()
            if left_s <= 0.0:
                raise RigError(f"{where}: no answer {wanted!r} within {self._description.timeout_s:g} s{_quoted(said)}")
            said += self._wire.read(left_s)
        line = said.partition(b"\n")[0].strip(b"\r\n ")
        if line != wanted.strip().encode():
            raise RigError(f"{where}: answered {_brief(line)!r}, not {wanted!r}")

    def close(self) -> None:
        self._wire.close()


class _Operator:
    slow = True

    def __init__(self, terminal: Path) -> None:
        self._name = str(terminal)
        try:
            self._fd = os.open(terminal, os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC)
        except OSError as error:
            raise ConfigurationError(
                f"pots: an operator turns them, and there is no terminal to ask at ({self._name}: {error.strerror})"
            ) from error
        if not os.isatty(self._fd):
            self.close()
            raise ConfigurationError(f"pots: an operator turns them, and {self._name} is no terminal")

    def settle(self, dials: Mapping[str, float], words: str) -> None:
        self._ask(f"Set the pots to {_at(dials)} ({words}), then press Enter: ")

    def turn(self, dials: Mapping[str, float], words: str) -> None:
        self._ask(f"NOW turn to {_at(dials)} ({words}), then press Enter: ")

    def _ask(self, prompt: str) -> None:
        if self._fd < 0:
            raise RigError(f"pots: {self._name} was closed")
        try:
            termios.tcflush(self._fd, termios.TCIFLUSH)  # an Enter from before the question answers nothing
            os.write(self._fd, prompt.encode())
            answer = b""
            while not answer.endswith(b"\n"):
                typed = os.read(self._fd, 1024)
                if not typed:
                    raise RigError(f"pots: the operator at {self._name} has left (end of input)")
                answer = typed
        except (OSError, termios.error) as error:
            raise RigError(f"pots: the operator at {self._name} has left ({error.args[-1]})") from error

    def close(self) -> None:
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


class _Nobody:
    slow = False

    def settle(self, dials: Mapping[str, float], words: str) -> None:
        """They are taken to stand there."""

    def turn(self, dials: Mapping[str, float], words: str) -> None:
        raise RigError(f"pots: nobody turns them on this rig, and {_at(dials)} ({words}) was asked for")

    def close(self) -> None:
        pass


def _at(dials: Mapping[str, float]) -> str:
    return ", ".join(f"{pot} {dial:.{DECIMALS}f}" for pot, dial in dials.items())


def _quoted(said: bytes) -> str:
    """What was said, in one line; nothing if nothing was."""
    text = " / ".join(_brief(said).split("\n"))
    return f", and said: {text}" if text else ""


def _brief(said: bytes) -> str:
    text = said.decode(errors="replace").strip()
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."
