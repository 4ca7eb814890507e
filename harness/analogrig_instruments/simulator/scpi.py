"""SCPI interpreter: program messages in, response messages out, for an instrument with a table of commands.

A program message is a line. A command is a header and its arguments, `ACQ:DEC 8`. Semicolons separate several commands
in a line, and their responses in one line (IEEE 488.2, 8.4). Words of a header may be short or long, in either case:
the pattern `SYSTem:ERRor` matches `syst:err` and `SYSTEM:ERROR`. In a pattern, `#` stands for a number, 1 if it is
missing, and `[...]` for optional words. After a semicolon, a header may continue the previous path (SCPI 1999, 6.2.4),
or start at the root, with or without a colon.

Errors go into the queue that `SYST:ERR?` reads, and have no other effect.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

MOST_LINE_BYTES = 4096
MOST_ARGUMENTS = 16
MOST_ERRORS = 32
"""Length of the queue; its last entry then becomes "queue overflow" (SCPI 1999, 21.8.1)."""
END = b"\r\n"

ERRORS = {
    0: "No error",
    -101: "Invalid character",
    -102: "Syntax error",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -114: "Header suffix out of range",
    -131: "Invalid suffix",
    -138: "Suffix not allowed",
    -221: "Settings conflict",
    -222: "Data out of range",
    -223: "Too much data",
    -224: "Illegal parameter value",
    -230: "Data corrupt or stale",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
}
"""Texts by number (SCPI 1999, 21.8.9 to 21.8.11)."""
_MOST_ERROR_CHARACTERS = 255

VOLTS = {"V": 1.0, "MV": 1e-3}
HERTZ = {"HZ": 1.0, "KHZ": 1e3, "MHZ": 1e6}
"""Factors by suffix of a number (IEEE 488.2, 7.7.3: MHZ is a million, MV a thousandth)."""
_ERROR_QUEUE = 4
"""Bit of the status byte: the error queue is not empty (SCPI 1999, 9)."""

_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-z]*)")
_HEADER = re.compile(r"(?:\*|:?[A-Za-z])[\w:]*\??")


class ScpiError(Exception):
    """One of ERRORS, with details."""

    def __init__(self, number: int, detail: str = "") -> None:
        super().__init__(number, detail)
        self.number = number
        self._detail = detail

    def __str__(self) -> str:
        text = ";".join(filter(None, (ERRORS[self.number], self._detail)))
        return f'{self.number},"{text[:_MOST_ERROR_CHARACTERS]}"'


class DropOut(Exception):  # noqa: N818 - the word of the field
    """The instrument stops after the first half of a response."""

    def __init__(self, response: str | bytes, *, hangs_up: bool) -> None:
        super().__init__("the connection is closed" if hangs_up else "nothing more is sent")
        self.response = response
        self.hangs_up = hangs_up


@dataclass(frozen=True)
class Call:
    """Received command."""

    numbers: tuple[int, ...]
    """Number for each `#` of the pattern."""
    arguments: tuple[str, ...]

    def word(self, at: int, allowed: Sequence[str]) -> str:
        """Argument that is one of the allowed words, in capitals."""
        word = self._argument(at).upper()
        if word not in allowed:
            raise ScpiError(-224, f"{_shown(word)}: must be {', '.join(allowed)}")
        return word

    def number(self, at: int, low: float, high: float, suffixes: Mapping[str, float] | None = None) -> float:
        """Argument that is a number from ``low`` to ``high``, with an optional suffix."""
        text = self._argument(at)
        found = _NUMBER.fullmatch(text)
        if not found:
            raise ScpiError(-104, f"{_shown(text)} is not a number")
        value = float(found[1]) * _factor(found[2].upper(), suffixes or {})
        if not (math.isfinite(value) and low <= value <= high):
            raise ScpiError(-222, f"{_shown(text)}: must be {low:g} to {high:g}")
        return value

    def whole(self, at: int, low: int, high: int) -> int:
        """Argument that is a whole number from ``low`` to ``high``."""
        value = self.number(at, low, high)
        if value != int(value):
            raise ScpiError(-104, f"{_shown(self._argument(at))} is not a whole number")
        return int(value)

    def switch(self, at: int) -> bool:
        """Argument that is ON or OFF, or 1 or 0."""
        return self.word(at, ("ON", "OFF", "1", "0")) in ("ON", "1")

    def check_count(self, count: int) -> None:
        """:raises ScpiError: there are more arguments than ``count``."""
        if len(self.arguments) > count:
            raise ScpiError(-108, _shown(self.arguments[count]))

    def _argument(self, at: int) -> str:
        if at >= len(self.arguments):
            raise ScpiError(-109)
        return self.arguments[at]


def _factor(suffix: str, suffixes: Mapping[str, float]) -> float:
    if suffix and suffix not in suffixes:
        raise ScpiError(-131 if suffixes else -138, _shown(suffix))
    return suffixes[suffix] if suffix else 1.0


Response = str | bytes | None
"""Response of a query: a text, or the content of a block of IEEE 488.2; None for a command."""

Command = Callable[[Call], Response]
"""Action of a command.

:raises ScpiError: the command is refused. :raises DropOut: the instrument drops out.
"""


class Interpreter:
    """Interpreter of one connection, with its error queue."""

    def __init__(self, commands: Mapping[str, tuple[int, Command]]) -> None:
        """``commands``: by pattern, the largest number of arguments and the action."""
        own: dict[str, tuple[int, Command]] = {
            "*CLS": (0, lambda _: self._errors.clear()),
            "*STB?": (0, lambda _: str(_ERROR_QUEUE if self._errors else 0)),
            "SYSTem:ERRor[:NEXT]?": (0, lambda _: self._next_error()),
            "SYSTem:ERRor:COUNt?": (0, lambda _: str(len(self._errors))),
        }
        self._commands = [
            (_expression(pattern), most, command) for pattern, (most, command) in (*commands.items(), *own.items())
        ]
        self._errors: deque[ScpiError] = deque()

    def enter(self, line: bytes) -> Iterator[bytes]:
        """Execute a line without its end. Yield the bytes to send back, one part for each command; it may be empty.

        :raises DropOut: the instrument drops out.
        """
        try:
            text = line.decode("ascii")
        except UnicodeDecodeError:
            self.refuse(ScpiError(-101))
            return
        separator, path = b"", ""
        units = text.split(";")
        for left, unit in enumerate(units, start=1 - len(units)):
            try:
                response, path = self._execute(unit.strip(), path)
            except ScpiError as error:
                self.refuse(error)
                response = None
            except DropOut as drop_out:
                whole = _encode(drop_out.response)
                yield separator + whole[: len(whole) // 2]
                raise
            part = b"" if response is None else separator + _encode(response)
            separator = b";" if part else separator
            yield part + END if separator and not left else part

    def refuse(self, error: ScpiError) -> None:
        """Add an error to the queue."""
        if len(self._errors) < MOST_ERRORS:
            self._errors.append(error)
        else:
            self._errors[-1] = ScpiError(-350)

    def _execute(self, unit: str, path: str) -> tuple[Response, str]:
        """Execute a command. Return its response, and the path that the next header may continue."""
        if not unit:
            return None, path
        header, *rest = unit.split(maxsplit=1)
        if not _HEADER.fullmatch(header):
            raise ScpiError(-102, _shown(header))
        arguments = tuple(part.strip() for part in rest[0].split(",")) if rest else ()
        if len(arguments) > MOST_ARGUMENTS:
            raise ScpiError(-108, f"more than {MOST_ARGUMENTS}")
        for full in (path + header, header.removeprefix(":")):
            for expression, most, command in self._commands:
                if found := expression.fullmatch(full):
                    call = Call(tuple(int(number or 1) for number in found.groups()), arguments)
                    call.check_count(most)
                    return command(call), path if header.startswith("*") else full[: full.rfind(":") + 1]
        raise ScpiError(-113, _shown(header))

    def _next_error(self) -> str:
        return str(self._errors.popleft() if self._errors else ScpiError(0))


def block(content: bytes) -> bytes:
    """Definite length arbitrary block response data (IEEE 488.2, 8.7.9)."""
    length = str(len(content))
    return f"#{len(length)}{length}".encode("ascii") + content


def _encode(response: str | bytes) -> bytes:
    return response.encode("ascii") if isinstance(response, str) else block(response)


_PARTS = {"[": "(?:", "]": ")?", "#": r"(\d{0,4})", "?": r"\?", "*": r"\*", ":": ":"}


def _expression(pattern: str) -> re.Pattern[str]:
    """Regular expression for the headers that match a pattern."""
    return re.compile("".join(map(_part, re.findall(r"\w+|.", pattern))), re.IGNORECASE)


def _part(part: str) -> str:
    if part in _PARTS:
        return _PARTS[part]
    short = "".join(itertools.takewhile(lambda letter: not letter.islower(), part))
    return f"(?:{part}|{short})"


def _shown(text: str) -> str:
    """Printable part of received text, for error messages."""
    return "".join(letter if letter.isprintable() and letter != '"' else "'" for letter in text[:40])
