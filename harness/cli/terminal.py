"""What every command says, and how: results on standard output, one line for each failure on standard error."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harness.bench import Progress

PASSED, FAILED, USAGE, INCONCLUSIVE, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit statuses."""

STATUS = {"passed": PASSED, "failed": FAILED, "inconclusive": INCONCLUSIVE}
"""Of a verdict's outcome."""


_PROGRESS_S = 1.0


def complain(message: str, status: int) -> int:
    print(f"analogrig: {message}", file=sys.stderr)
    return status


def show(text: str) -> None:
    """To standard output. If nobody listens any more, that is no reason to change what the command has found."""
    try:
        print(text, flush=True)
    except OSError as error:
        print(f"analogrig: standard output: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


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
        print(f"\r{text:<{self._width}}", end=end, file=sys.stderr, flush=True)
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
