"""What every command says, and how: results on standard output, one line for each failure on standard error."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from analogrig.bench import Progress

PASSED, FAILED, USAGE, INCONCLUSIVE, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit statuses."""

STATUS = {"passed": PASSED, "failed": FAILED, "inconclusive": INCONCLUSIVE}
"""Of a verdict's outcome."""


_PROGRESS_S = 1.0


def complain(message: str, status: int) -> int:
    """One line on standard error; returns ``status``."""
    _print(f"analogrig: {message}\n", sys.stderr, 2)
    return status


def show(text: str) -> None:
    """To standard output. If nobody listens any more, that is no reason to change what the command has found."""
    error = _print(f"{text}\n", sys.stdout, 1)
    if error is not None:
        _print(f"analogrig: standard output: {error.strerror}\n", sys.stderr, 2)


def _print(text: str, stream: TextIO, number: int) -> OSError | None:
    """Returns why it could not be; from then on the stream swallows what it is given, also what it still holds."""
    try:
        stream.write(text)
        stream.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        return error
    return None


def open_standard_streams() -> None:
    """Whoever closed one of them wants to hear nothing; a file opened later must not take its place."""
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            setattr(sys, name, open(number, "w", closefd=False))  # noqa: SIM115 - for as long as we live


class ProgressLine:
    """A line on standard error that is written over: at most once a second, and only from the second second on."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._next_s = clock() + _PROGRESS_S
        self._width = 0
        """Of what stands there."""

    def show(self, text: str, *, is_last: bool) -> None:
        """The last one is shown if any was, and ends the line."""
        if self._clock() < self._next_s and not (is_last and self._width):
            return
        self._next_s = self._clock() + _PROGRESS_S
        end = "\n" if is_last else ""
        _print(f"\r{text:<{self._width}}{end}", sys.stderr, 2)
        self._width = 0 if is_last else len(text)


def watched() -> ProgressLine | None:
    """None when nobody watches."""
    return ProgressLine() if sys.stderr.isatty() else None


def progress_line(of: str = "samples") -> Progress | None:
    """How many of how many, and percent; None when nobody watches."""
    line = watched()
    if line is None:
        return None

    def show(done: int, asked: int) -> None:
        line.show(f"{done} of {asked} {of} ({done / asked:.0%})", is_last=done == asked)

    return show
