"""What every command says, and how: results on standard output, one line for each failure on standard error."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harness.bench import Progress

PASSED, FAILED, USAGE, INCONCLUSIVE, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit statuses."""

STATUS = {"passed": PASSED, "failed": FAILED, "inconclusive": INCONCLUSIVE}
"""Of a verdict's outcome."""


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


def progress_line() -> Progress | None:
    """Percent on standard error, at most once a second and only from the second second on; None when nobody watches."""
    if not sys.stderr.isatty():
        return None
    import time

    next_s = time.monotonic() + 1.0

    def show(done: int, asked: int) -> None:
        nonlocal next_s
        now_s = time.monotonic()
        if now_s >= next_s:
            next_s = now_s + 1.0
            end = "\n" if done == asked else ""
            print(f"\r{done} of {asked} samples ({done / asked:.0%})", end=end, file=sys.stderr, flush=True)

    return show
