"""SCPI: program messages in, responses out, for whatever instrument has a table of commands (SCPI 1999, IEEE 488.2).

A program message is a line; a command a header and its arguments, `ACQ:DEC 8`; several stand in a line behind semicolons. A
header's words may be short or long, in capitals or not: the pattern `SYSTem:ERRor` is met by `syst:err` and
`SYSTEM:ERROR`. `#` in a pattern stands for a number, `[...]` for words that may be left out.

What is wrong goes into the queue of errors, which `SYST:ERR?` reads, and has no other effect.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

MOST_LINE_BYTES = 4096
MOST_ARGUMENTS = 16
MOST_ERRORS = 32
"""The queue holds no more; the last place is then taken by "queue overflow" (SCPI 1999, 21.8)."""

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_HEADER = re.compile(r"[*:A-Za-z_][*:\w]*\??")


class ScpiError(Exception):
    """A number of SCPI 1999, 21.8, and what it means."""

    def __init__(self, number: int, text: str) -> None:
        super().__init__(text)
        self.number = number

    def __str__(self) -> str:
        return f'{self.number},"{self.args[0]}"'


def undefined_header(header: str) -> ScpiError:
    return ScpiError(-113, f"Undefined header: {_shown(header)}")


def out_of_range(what: str) -> ScpiError:
    return ScpiError(-222, f"Data out of range: {what}")


def conflict(what: str) -> ScpiError:
    return ScpiError(-221, f"Settings conflict: {what}")


@dataclass(frozen=True)
class Call:
    """One command as it came."""

    numbers: tuple[int, ...]
    """For each `#` of the pattern."""
    arguments: tuple[str, ...]

    def word(self, at: int, allowed: Sequence[str]) -> str:
        """An argument that is one of some words, in capitals."""
        word = self._argument(at).upper()
        if word not in allowed:
            raise ScpiError(-224, f"Illegal parameter value: {_shown(word)}, it may be {', '.join(allowed)}")
        return word

    def number(self, at: int, low: float, high: float) -> float:
        """An argument that is a number from ``low`` to ``high``."""
        text = self._argument(at)
        if not _NUMBER.fullmatch(text):
            raise ScpiError(-104, f"Data type error: {_shown(text)} is no number")
        value = float(text)
        if not (math.isfinite(value) and low <= value <= high):
            raise out_of_range(f"{_shown(text)}, it may be {low:g} to {high:g}")
        return value

    def whole(self, at: int, low: int, high: int) -> int:
        """An argument that is a whole number from ``low`` to ``high``."""
        value = self.number(at, low, high)
        if value != int(value):
            raise ScpiError(-104, f"Data type error: {_shown(self._argument(at))} is no whole number")
        return int(value)

    def expect(self, count: int) -> None:
        """That there are no more arguments than that."""
        if len(self.arguments) > count:
            raise ScpiError(-108, f"Parameter not allowed: {_shown(self.arguments[count])}")

    def _argument(self, at: int) -> str:
        if at >= len(self.arguments):
            raise ScpiError(-109, "Missing parameter")
        return self.arguments[at]


Response = str | bytes | None
"""What a query answers: a text, or a block of bytes as IEEE 488.2 has them; None for a command."""

Command = Callable[[Call], Response]


class Interpreter:
    """Takes lines, calls commands, keeps the errors of one connection."""

    def __init__(self, commands: Mapping[str, Command]) -> None:
        """``commands``: pattern to what it does."""
        own: dict[str, Command] = {
            "*CLS": self._clear,
            "SYSTem:ERRor[:NEXT]?": self._next_error,
            "SYSTem:ERRor:COUNt?": lambda _: str(len(self._errors)),
        }
        self._commands = [(_expression(pattern), command) for pattern, command in (*commands.items(), *own.items())]
        self._errors: deque[ScpiError] = deque()

    def enter(self, line: bytes) -> bytes:
        """One line without its end; what is to be sent back, its ends included."""
        try:
            text = line.decode("ascii")
        except UnicodeDecodeError:
            self.refuse(ScpiError(-101, "Invalid character"))
            return b""
        return b"".join(self._response(part) for part in text.split(";"))

    def refuse(self, error: ScpiError) -> None:
        """Remember what was wrong."""
        if len(self._errors) < MOST_ERRORS:
            self._errors.append(error)
        else:
            self._errors[-1] = ScpiError(-350, "Queue overflow")

    def _response(self, text: str) -> bytes:
        text = text.strip()
        if not text:
            return b""
        try:
            response = self._execute(text)
        except ScpiError as error:
            self.refuse(error)
            return b""
        if response is None:
            return b""
        return (response.encode("ascii") if isinstance(response, str) else block(response)) + b"\r\n"

    def _execute(self, text: str) -> Response:
        header, _, rest = text.partition(" ")
        if not _HEADER.fullmatch(header):
            raise ScpiError(-102, f"Syntax error: {_shown(header)}")
        arguments = tuple(part.strip() for part in rest.split(",")) if rest.strip() else ()
        if len(arguments) > MOST_ARGUMENTS:
            raise ScpiError(-108, "Parameter not allowed: too many")
        for expression, command in self._commands:
            if found := expression.fullmatch(header.removeprefix(":")):
                return command(Call(tuple(int(number) for number in found.groups()), arguments))
        raise undefined_header(header)

    def _clear(self, call: Call) -> None:
        call.expect(0)
        self._errors.clear()

    def _next_error(self, call: Call) -> str:
        call.expect(0)
        return str(self._errors.popleft()) if self._errors else '0,"No error"'


def block(content: bytes) -> bytes:
    """Definite length arbitrary block response data (IEEE 488.2, 8.7.9)."""
    length = str(len(content))
    return f"#{len(length)}{length}".encode("ascii") + content


def _expression(pattern: str) -> re.Pattern[str]:
    """What a header of the pattern may look like."""
    parts = re.split(r"([:\[\]#?*]|\w+)", pattern)
    out = []
    for part in filter(None, parts):
        match part:
            case "[":
                out.append("(?:")
            case "]":
                out.append(")?")
            case "#":
                out.append(r"([1-9]\d?)")
            case "?" | "*":
                out.append(re.escape(part))
            case ":":
                out.append(":")
            case _:
                short = "".join(itertools.takewhile(lambda c: not c.islower(), part))
                out.append(f"(?:{short}|{part})")
    return re.compile("".join(out), re.IGNORECASE)


def _shown(text: str) -> str:
    """Of what a client sent, what an error may repeat."""
    return text.replace('"', "'")[:40]
