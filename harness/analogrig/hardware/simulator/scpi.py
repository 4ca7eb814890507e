"""SCPI: program messages in, response messages out, for whatever instrument has a table of commands.

A program message is a line; a command a header and its arguments, `ACQ:DEC 8`; several stand in a line behind
semicolons, and what they answer comes in a line too, behind semicolons (IEEE 488.2, 8.4). A header's words may be short
or long, in capitals or not: the pattern `SYSTem:ERRor` is met by `syst:err` and `SYSTEM:ERROR`. `#` in a pattern stands
for a number, 1 if there is none; `[...]` for words that may be left out. Behind a semicolon a header may begin where
the one before it left off (SCPI 1999, 6.2.4), or at the root, with a colon or without.

What is wrong goes into the queue of errors, which `SYST:ERR?` reads, and has no other effect.
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
"""The queue holds no more; the last place is then taken by "queue overflow" (SCPI 1999, 21.8.1)."""
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
"""SCPI 1999, 21.8.9 to 21.8.11."""
_MOST_ERROR_CHARACTERS = 255

VOLTS = {"V": 1.0, "MV": 1e-3}
HERTZ = {"HZ": 1.0, "KHZ": 1e3, "MHZ": 1e6}
"""Suffixes behind a number, and what they multiply it with (IEEE 488.2, 7.7.3: MHZ is a million, MV a thousandth)."""
_ERROR_QUEUE = 4
"""The bit of the status byte that says that it holds something (SCPI 1999, 9)."""

_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-z]*)")
_HEADER = re.compile(r"(?:\*|:?[A-Za-z])[\w:]*\??")


class ScpiError(Exception):
    """One of ERRORS, and what it is here."""

    def __init__(self, number: int, detail: str = "") -> None:
        super().__init__(number, detail)
        self.number = number
        self._detail = detail

    def __str__(self) -> str:
        text = ";".join(filter(None, (ERRORS[self.number], self._detail)))
        return f'{self.number},"{text[:_MOST_ERROR_CHARACTERS]}"'


class DropOut(Exception):  # noqa: N818 - the word of the field
    """The instrument ceases to answer, in the middle of a response."""

    def __init__(self, *, hangs_up: bool) -> None:
        super().__init__("the connection is closed" if hangs_up else "nothing more is said")
        self.hangs_up = hangs_up


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
            raise ScpiError(-224, f"{_shown(word)}, it may be {', '.join(allowed)}")
        return word

    def number(self, at: int, low: float, high: float, suffixes: Mapping[str, float] | None = None) -> float:
        """An argument that is a number from ``low`` to ``high``, perhaps with a suffix."""
        text = self._argument(at)
        found = _NUMBER.fullmatch(text)
        if not found:
            raise ScpiError(-104, f"{_shown(text)} is no number")
        value = float(found[1]) * _factor(found[2].upper(), suffixes or {})
        if not (math.isfinite(value) and low <= value <= high):
            raise ScpiError(-222, f"{_shown(text)}, it may be {low:g} to {high:g}")
        return value

    def whole(self, at: int, low: int, high: int) -> int:
        """An argument that is a whole number from ``low`` to ``high``."""
        value = self.number(at, low, high)
        if value != int(value):
            raise ScpiError(-104, f"{_shown(self._argument(at))} is no whole number")
        return int(value)

    def switch(self, at: int) -> bool:
        """An argument that is ON or OFF, or 1 or 0."""
        return self.word(at, ("ON", "OFF", "1", "0")) in ("ON", "1")

    def expect(self, count: int) -> None:
        """That there are no more arguments than that."""
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


@dataclass(frozen=True)
class Broken:
    """A response of which the first half is sent, and then nothing any more: DropOut."""

    response: str | bytes
    hangs_up: bool


Response = str | bytes | Broken | None
"""What a query answers: a text, or a block of bytes as IEEE 488.2 has them; None for a command."""

Command = Callable[[Call], Response]


class Interpreter:
    """Takes lines, calls commands, keeps the errors of one connection."""

    def __init__(self, commands: Mapping[str, tuple[int, Command]]) -> None:
        """``commands``: by pattern the number of arguments it takes at most, and what it does."""
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
        """One line without its end; yields what is to be sent back, in a part for each command, perhaps empty.

        :raises DropOut: the instrument is no longer there.
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
            part = b"" if response is None else separator + _as_sent(response)
            if isinstance(response, Broken):
                yield part
                raise DropOut(hangs_up=response.hangs_up)
            separator = b";" if part else separator
            yield part + END if separator and not left else part

    def refuse(self, error: ScpiError) -> None:
        """Remember what was wrong."""
        if len(self._errors) < MOST_ERRORS:
            self._errors.append(error)
        else:
            self._errors[-1] = ScpiError(-350)

    def _execute(self, unit: str, path: str) -> tuple[Response, str]:
        """Response of a command, and where the next header may begin."""
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
                    call.expect(most)
                    return command(call), path if header.startswith("*") else full[: full.rfind(":") + 1]
        raise ScpiError(-113, _shown(header))

    def _next_error(self) -> str:
        return str(self._errors.popleft() if self._errors else ScpiError(0))


def block(content: bytes) -> bytes:
    """Definite length arbitrary block response data (IEEE 488.2, 8.7.9)."""
    length = str(len(content))
    return f"#{len(length)}{length}".encode("ascii") + content


def _as_sent(response: str | bytes | Broken) -> bytes:
    """As it goes out; of a broken one the first half."""
    if isinstance(response, Broken):
        whole = _as_sent(response.response)
        return whole[: len(whole) // 2]
    return response.encode("ascii") if isinstance(response, str) else block(response)


_PARTS = {"[": "(?:", "]": ")?", "#": r"(\d{0,4})", "?": r"\?", "*": r"\*", ":": ":"}


def _expression(pattern: str) -> re.Pattern[str]:
    """What a header of the pattern may look like."""
    return re.compile("".join(map(_part, re.findall(r"\w+|.", pattern))), re.IGNORECASE)


def _part(part: str) -> str:
    if part in _PARTS:
        return _PARTS[part]
    short = "".join(itertools.takewhile(lambda letter: not letter.islower(), part))
    return f"(?:{part}|{short})"


def _shown(text: str) -> str:
    """Of what a client sent, what an error may repeat."""
    return "".join(letter if letter.isprintable() and letter != '"' else "'" for letter in text[:40])
