"""The frames of a file, whoever wrote it."""

from __future__ import annotations

import contextlib
import gc
import io
import logging
import sys
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from analogrig.errors import RecordingError
from analogrig.recordings.log import WRITTEN
from analogrig.wording import number_of

if TYPE_CHECKING:
    import can

READ = (*WRITTEN, "trc")
"""Formats that can be read."""


class _CountedLines(io.TextIOBase):
    """A text file that knows where it is."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self.number = 0

    def readline(self, _size: int | None = -1, /) -> str:  # type: ignore[override]
        line = self._file.readline()
        self.number += line != ""
        return line


@dataclass
class CapturedFrames:
    """The frames of a file, as python-can reads them; to be taken once."""

    path: Path
    damaged: list[int] = field(default_factory=list)
    """Lines that are no frames, and were passed over."""
    end: str = ""
    """Why it ended before its end, if it did."""

    def __post_init__(self) -> None:
        """:raises RecordingError: no such file, or none of a format that is known."""
        if self.path.suffix[1:].lower() not in READ:
            raise RecordingError(f"{self.path}: not a CAN log: the suffix must be one of .{', .'.join(READ)}")
        try:
            with self.path.open("rb"):
                pass
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror or error}") from error

    def __iter__(self) -> Iterator[can.Message]:
        return self._read_candump() if self.path.suffix.lower() == ".log" else self._read_binary()

    def _read_candump(self) -> Iterator[can.Message]:
        """candump's, where a line stands for itself."""
        from analogrig.links.python_can import can

        with self.path.open(encoding="ascii", errors="replace") as file:
            lines = _CountedLines(file)
            while True:
                before = lines.number
                try:
                    yield from can.CanutilsLogReader(typing.cast(TextIO, lines))
                except Exception:  # noqa: BLE001 - whatever a line makes of python-can
                    self.damaged.append(lines.number)
                    if lines.number > before:
                        continue
                return

    def _read_binary(self) -> Iterator[can.Message]:
        """The others, which cannot be read on after a fault."""
        from analogrig.links.python_can import can

        readers: Mapping[str, Any] = {
            "blf": can.BLFReader,
            "asc": can.ASCReader,
            "mf4": can.MF4Reader,
            "trc": can.TRCReader,
        }
        suffix = self.path.suffix[1:].lower()
        n = 0
        # Opened here, since readers that fail leave the file open.
        with self.path.open("rb") as raw:
            file = io.TextIOWrapper(raw, "utf-8", "replace") if suffix in {"asc", "trc"} else raw
            with silence_logger("asammdf"), silence_logger("can"), _silence_asammdf():
                try:
                    for frame in readers[suffix](file):
                        yield frame
                        n += 1
                except Exception as error:  # noqa: BLE001 - as above
                    said = " ".join(str(error).split()) or type(error).__name__
                    self.end = f"{self.path} is damaged after {number_of(n, 'frame')}: {said}"
                if self.end:
                    gc.collect()


@contextlib.contextmanager
def silence_logger(library: str) -> Iterator[None]:
    """Keep what a library logs of a file off standard error: the error that it raises is reported in one line."""
    logger = logging.getLogger(library)
    before = logger.level, logger.disabled
    logger.setLevel(logging.CRITICAL + 1)  # of those below it as well
    logger.disabled = True  # whatever level the library, loaded only now, gives it
    try:
        yield
    finally:
        logger.disabled = before[1]
        logger.setLevel(before[0])


@contextlib.contextmanager
def _silence_asammdf() -> Iterator[None]:
    """Of a file that it could not open its destructor complains, with a traceback and when the garbage is collected."""
    before = sys.unraisablehook

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if not str(getattr(unraisable.object, "__module__", "")).startswith("asammdf"):
            before(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before
