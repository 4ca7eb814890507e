"""Output of every command: results on standard output, one line for each failure on standard error.

Verdicts are coloured and progress is shown on terminals only. Files, pipes and ``--json`` get plain text.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import math
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TextIO

from analogrig.wording import one_line, printable

if TYPE_CHECKING:
    import argparse

    from analogrig.bench import Progress
    from analogrig.identity import DeviceFile

PASSED, FAILED, USAGE, INCONCLUSIVE, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit statuses."""

STATUS = {"passed": PASSED, "failed": FAILED, "inconclusive": INCONCLUSIVE, "unjudged": INCONCLUSIVE}
"""Exit status by outcome of a verdict."""

_GREEN, _RED, _YELLOW = 32, 31, 33
_COLOURS = {
    **dict.fromkeys(("PASSED", "CERTIFIED"), _GREEN),
    **dict.fromkeys(("FAILED", "REFUTED", "WRONG", "WORSE"), _RED),
    **dict.fromkeys(("INCONCLUSIVE", "NOT MEASURED", "UNJUDGED"), _YELLOW),
}
"""SGR colour codes of the verdicts, which the results write in capitals."""

_VERDICT = re.compile(rf"\b(?:{'|'.join(_COLOURS)})\b")

_PROGRESS_S = 1.0


def complain(message: str, status: int) -> int:
    """Print one line on standard error; return ``status``."""
    _print(_colour(f"analogrig: {one_line(message)}\n", sys.stderr), sys.stderr)
    return status


def show(text: str) -> None:
    """Print text for people on standard output."""
    _show(_colour(f"{printable(text)}\n", _Results.stream()))


def show_plain(text: str) -> None:
    """Print text for programs on standard output: never coloured, whatever the environment asks for."""
    _show(f"{text}\n")


def show_json(value: Any) -> None:
    """Print one JSON object on standard output. JSON has no NaN or infinity: they become null."""
    import json  # here, for --help needs none

    show_plain(json.dumps(_finite(value), allow_nan=False))


def show_result(table: Mapping[str, Any], arguments: argparse.Namespace, devices: Sequence[DeviceFile] = ()) -> None:
    """Print one JSON object on standard output: a result, and the identity of the command."""
    from analogrig.identity import Identity

    identity = Identity.here(arguments.command_line, arguments.started, devices)
    show_json({**table, "identity": identity.as_table()})


def _finite(value: Any) -> Any:
    """Replace non-finite numbers by None, in tables and lists of any depth."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return value


class _Results:
    """Standard output of the results, while ``keep_results_apart`` is in force."""

    own: ClassVar[TextIO | None] = None
    are_lost: ClassVar[bool] = False
    """True if some could not be written."""

    @classmethod
    def stream(cls) -> TextIO:
        return cls.own or sys.stdout


@contextlib.contextmanager
def keep_results_apart() -> Iterator[None]:
    """Send to standard error what anything but this module prints on standard output: libraries and foreign code."""
    before = sys.stdout
    with contextlib.ExitStack() as stack:
        _Results.own = before
        if _is_descriptor(before, 1):
            before.flush()
            saved = fcntl.fcntl(1, fcntl.F_DUPFD_CLOEXEC, 3)
            _Results.own = stack.enter_context(open(saved, "w", encoding=before.encoding, errors=before.errors))  # noqa: PTH123 - a descriptor
            os.dup2(2, 1)
            stack.callback(os.dup2, saved, 1)  # before the stream closes ``saved``
            import ctypes  # here, for --help needs none

            stack.callback(ctypes.CDLL(None).fflush, None)  # and before that: what a C library still holds
        sys.stdout = sys.stderr
        try:
            yield
        finally:
            sys.stdout, _Results.own = before, None


def output_for_command() -> TextIO | None:
    """Standard output for a command of the user; None: that of this process."""
    own = _Results.own
    with contextlib.suppress(OSError, ValueError):  # a stream without a descriptor
        return own if own is not None and own.fileno() != 1 else None
    return None


def _is_descriptor(stream: TextIO, number: int) -> bool:
    with contextlib.suppress(OSError, ValueError):  # io.UnsupportedOperation is both
        return stream.fileno() == number
    return False


def end_output(status: int) -> int:
    """Write what standard output still holds; return INCONCLUSIVE instead of PASSED if some of it could not be."""
    _show("")
    return INCONCLUSIVE if status == PASSED and _Results.are_lost else status


def _show(text: str) -> None:
    """Print on standard output. A reader that is gone changes nothing about the command's status."""
    error = _print(text, _Results.stream())
    if error is not None:
        _Results.are_lost = _Results.are_lost or error.errno != errno.EPIPE
        _print(f"analogrig: standard output: {error.strerror}\n", sys.stderr)


def _print(text: str, stream: TextIO) -> OSError | None:
    """Write text below the progress line, if there is one. Return the error, if any."""
    with ProgressLine.lock:
        if ProgressLine.unfinished is not None:
            ProgressLine.unfinished.end()
        return _write(text, stream)


def _write(text: str, stream: TextIO) -> OSError | None:
    """Write text. Return the error, if any: the stream then discards all output, also what it still holds."""
    try:
        stream.write(text)
        stream.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return error
    return None


def _colour(text: str, stream: TextIO) -> str:
    """Colour the verdicts if the stream takes colour."""
    if not _takes_colour(stream):
        return text
    return _VERDICT.sub(lambda found: f"\x1b[{_COLOURS[found[0]]}m{found[0]}\x1b[0m", text)


def _takes_colour(stream: TextIO) -> bool:
    """True if the stream takes colour: NO_COLOR forbids it, FORCE_COLOR or CLICOLOR_FORCE demand it.

    Otherwise true on a terminal that is not dumb.
    """
    if os.environ.get("NO_COLOR"):
        return False
    if any(os.environ.get(name, "0") not in {"", "0"} for name in ("FORCE_COLOR", "CLICOLOR_FORCE")):
        return True
    return _is_terminal(stream)


def _is_terminal(stream: TextIO) -> bool:
    """True if the stream is a terminal that can overwrite a line."""
    return stream.isatty() and os.environ.get("TERM") != "dumb"


def open_standard_streams() -> None:
    """Open the standard streams that the caller closed, so that no file opened later takes their number."""
    _Results.are_lost = False
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
            setattr(sys, name, open(number, "w", closefd=False))  # noqa: SIM115 - for as long as the process lives


class ProgressLine:
    """A line on standard error that is overwritten: at most once a second, and not in the first second.

    Whatever else is printed ends the line first, so that no message continues it.
    """

    lock: ClassVar[threading.RLock] = threading.RLock()
    """Held while anything is printed: `show_work` prints from a thread."""
    unfinished: ClassVar[ProgressLine | None] = None
    """The line that the cursor is in."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._next_s = clock() + _PROGRESS_S
        self._width = 0
        """Characters of the text shown last; 0: none."""

    def show(self, text: str, *, is_last: bool) -> None:
        """Show ``text``. The last text is shown if any was, and ends the line."""
        if self._clock() < self._next_s and not (is_last and self._width):
            return
        self._next_s = self._clock() + _PROGRESS_S
        with self.lock:
            if ProgressLine.unfinished is not None and ProgressLine.unfinished is not self:
                ProgressLine.unfinished.end()
            # Before the text is written: Ctrl-C may come at any time, and no message may continue the line.
            ProgressLine.unfinished = self
            width, self._width = self._width, len(text)
            _write(f"\r{text:<{width}}", sys.stderr)
            if is_last:
                self.end()

    def end(self) -> None:
        """End the line, if it was shown."""
        with self.lock:
            if ProgressLine.unfinished is self:
                _write("\n", sys.stderr)
                ProgressLine.unfinished = None
            self._width = 0


def open_progress_line() -> ProgressLine | None:
    """A progress line; None if standard error is no terminal."""
    return ProgressLine() if _is_terminal(sys.stderr) else None


def progress_line(of: str = "samples") -> Progress | None:
    """A callback that shows how many of how many, and percent; None if standard error is no terminal."""
    line = open_progress_line()
    if line is None:
        return None

    def show(done: int, asked: int) -> None:
        line.show(f"{done} of {asked} {of} ({done / asked:.0%})", is_last=done == asked)

    return show


@contextlib.contextmanager
def show_work(on: str) -> Iterator[Callable[[str], None]]:
    """Show what the command works on and for how long, where there is no end to count to.

    Yields a function that takes what has been done so far.
    """
    line = open_progress_line()
    if line is None:
        yield lambda done: None  # noqa: ARG005
        return
    start_s, is_done, so_far = time.monotonic(), threading.Event(), [""]

    def tell() -> None:
        while not is_done.wait(_PROGRESS_S):
            line.show(f"{on}: {time.monotonic() - start_s:.0f} s{so_far[-1]}", is_last=False)

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield lambda done: so_far.append(f", {done}")
    finally:
        is_done.set()
        thread.join()
        line.end()
