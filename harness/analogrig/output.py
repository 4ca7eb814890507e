"""Output folders and files: a folder holds one run, complete or marked INCONCLUSIVE; older results are moved aside.

A single file is either whole or not there (``replace_file``).

While a command runs, ``verdict.json`` and the page in its folder say INCONCLUSIVE. A command that is killed therefore
leaves no older verdict. The result replaces them at the end: recording, page, and last the verdict.
"""

from __future__ import annotations

import contextlib
import fcntl
import html
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from analogrig.errors import AnalogrigError, ConfigurationError, RecordingError
from analogrig.identity import Identity
from analogrig.pages import FOLDER, assemble_page
from analogrig.signals import hold_signals, interruption

__all__ = ["FORMAT", "FORMAT_VERSION", "REPORT_FILE", "VERDICT_FILE", "OutputFolder", "move_aside", "replace_file"]
"""Names for packages beside the core."""

VERDICT_FILE, RUN_FILE, REPORT_FILE, CAN_LOG = "verdict.json", "run.npz", "report.html", "can"

RUN_FILES = (RUN_FILE, *(f"{CAN_LOG}.{suffix}" for suffix in ("log", "blf", "asc", "mf4")))
"""Files that a run may leave beside its page and its verdict."""

FORMAT, FORMAT_VERSION = "analogrig-verdict", 1
"""Format name and version of ``verdict.json``."""

NOT_ENDED = "the run has not ended: it is still going on, or was killed"

_PREVIOUS = ".previous"
_PARTS = ".analogrig-parts"
"""Folder of unfinished files."""

_PAGE = FOLDER / "status.html"


class OutputFolder:
    """A folder that holds the results of one command.

    Earlier results under the same names move to ``FOLDER.previous``, which holds one generation; where that cannot be
    written, to ``.previous`` within the folder. Other files are left alone.
    """

    def __init__(
        self,
        path: Path,
        command: str,
        started: str,
        *,
        holds: Sequence[str] = RUN_FILES,
        page: str = REPORT_FILE,
        reads: Iterable[Path] = (),
    ) -> None:
        """Nothing is touched before the folder is entered.

        :param holds: files that the command may leave beside ``page`` and ``verdict.json``, relative to ``path``.
        :param reads: files that the command reads, and must not move or overwrite.
        """
        self.path = path
        self.parts = path / _PARTS
        """Folder for files that are written while the command works; ``conclude`` puts them in their place."""
        self.page = path / page
        self._command, self._started = command, started
        self._holds = tuple(holds)
        self._status = (VERDICT_FILE, page)
        self._reads = tuple(reads)
        self._concluded = False
        self._lock: int | None = None

    def identity(self) -> Identity:
        """Identity of the command; which devices it uses is not known here."""
        return Identity.here(self._command, self._started)

    def __enter__(self) -> Self:
        """Move earlier results aside, and mark the folder INCONCLUSIVE.

        :raises ConfigurationError: the folder cannot be written to, holds a file that is read, or is in use.
        """
        self._check_reads()
        make_folder(self.path)
        for place in (self.path / name for name in (*self._status, *self._holds)):
            if place.exists() and not place.is_file():
                raise ConfigurationError(f"--out {self.path}: {place} is no file: remove it, or choose another folder")
        self._lock = _lock_folder(self.path)
        try:
            with hold_signals():
                self._begin()
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                self.fail(self.reason(error))
            self._release()
            raise
        return self

    def _begin(self) -> None:
        try:
            try:
                self._stage_status(NOT_ENDED, {"command": self._command, "started": self._started})
            finally:  # a disk that is full must not keep an older verdict
                self._move_aside()
            self._put_in_place()
        except OSError as error:
            raise ConfigurationError(f"--out {self.path}: cannot be written to: {error.strerror or error}") from error

    def conclude(self, write: Callable[[Path], None], verdict: Mapping[str, Any]) -> None:
        """Replace the mark by a result: the files that ``write`` creates, those in ``parts``, then ``verdict.json``.

        ``write`` receives the folder to write to. A signal that ends the command is held until the result is complete.

        :raises RecordingError: not all of it can be written; the folder then says so.
        """
        with hold_signals():
            try:
                write(self.parts)
                self._write_verdict(verdict)
                self._put_in_place()
            except (OSError, RecordingError) as error:
                self.fail(self.reason(error))
                raise RecordingError(self.reason(error)) from error
            self._concluded = True

    def fail(self, reason: str) -> None:
        """Mark the folder INCONCLUSIVE for this reason; it holds no other result."""
        with hold_signals():
            self._concluded = True
            with contextlib.suppress(OSError):  # then the folder still says that the command has not ended
                for name in self._holds:
                    if (self.path / name).is_file():
                        (self.path / name).unlink()
                self._stage_status(reason, self.identity().as_table())
                self._put_in_place()

    def reason(self, error: BaseException | None) -> str:
        """One line that says what ended a command."""
        from analogrig_emulator import EmulatorError

        if error is None:
            return "the command ended without a result"
        if (signalled := interruption(error)) is not None:
            return f"interrupted by {str(signalled) or 'SIGINT'}"
        if isinstance(error, OSError):
            return f"{self.path}: cannot be written: {error.strerror or error}"
        text = " ".join(str(error).split()).replace(str(self.parts), str(self.path))
        is_named = isinstance(error, AnalogrigError | EmulatorError)
        return text if is_named else f"a fault of analogrig itself: {type(error).__name__}: {text}"

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if not self._concluded:
                self.fail(self.reason(error))
        finally:
            self._release()

    def _release(self) -> None:
        shutil.rmtree(self.parts, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _check_reads(self) -> None:
        """:raises ConfigurationError: the command reads a file that would be moved or overwritten."""
        names = (*self._status, *self._holds)
        folders = (self.path, previous_of(self.path), self.path / _PREVIOUS)
        taken = {(folder / name).resolve() for folder in folders for name in names}
        for file in self._reads:
            if file.resolve() in taken:
                what = "recording" if file.suffix == ".npz" else "CAN log"
                raise ConfigurationError(
                    f"--out {self.path}: would overwrite the {what} that is played; choose another folder"
                )

    def _move_aside(self) -> None:
        """Move the earlier result to ``.previous``.

        A verdict without a recording is not kept: it would push the last recording out of ``.previous``.
        """
        results = [name for name in self._holds if (self.path / name).is_file()]
        if not results:
            return
        try:
            self._move(results, previous_of(self.path))
        except OSError:
            self._move(results, self.path / _PREVIOUS)

    def _move(self, results: Sequence[str], place: Path) -> None:
        place.mkdir(exist_ok=True)
        for name in (*self._status, *self._holds):
            if (place / name).is_file():
                (place / name).unlink()
        for name in (*self._status, *results):
            if (self.path / name).is_file():
                (place / name).parent.mkdir(parents=True, exist_ok=True)
                (self.path / name).rename(place / name)

    def _stage_status(self, reason: str, identity: Mapping[str, Any]) -> None:
        shutil.rmtree(self.parts, ignore_errors=True)
        self.parts.mkdir()
        page = assemble_page(
            _PAGE,
            title=html.escape(f"INCONCLUSIVE: {self._command}"),
            reason=html.escape(reason),
            command=html.escape(self._command),
            started=html.escape(self._started),
        )
        (self.parts / self.page.name).write_text(page, encoding="utf-8", errors="replace")
        self._write_verdict({"outcome": "inconclusive", "valid": False, "reasons": [reason], "identity": identity})

    def _write_verdict(self, verdict: Mapping[str, Any]) -> None:
        table = {"format": FORMAT, "version": FORMAT_VERSION, **verdict}
        text = json.dumps(table, indent=1, allow_nan=False)
        (self.parts / VERDICT_FILE).write_text(f"{text}\n", encoding="utf-8")

    def _put_in_place(self) -> None:
        """Move each finished file into place, the verdict last: everything that it refers to is then in the folder."""
        for name in (*self._holds, self.page.name, VERDICT_FILE):
            if (self.parts / name).is_file():
                (self.path / name).parent.mkdir(parents=True, exist_ok=True)
                (self.parts / name).replace(self.path / name)


def move_aside(path: Path, reads: Iterable[Path] = ()) -> None:
    """Rename an earlier result to ``NAME.previous``: from the start of a command on it is not taken for the new one.

    :raises ConfigurationError: the command reads that very file, or it cannot be renamed.
    """
    if not path.is_file():
        return
    if path.resolve() in {file.resolve() for file in reads}:
        raise ConfigurationError(f"--out {path}: would overwrite a file that is read; choose another")
    try:
        path.replace(previous_of(path))
    except OSError as error:
        raise ConfigurationError(f"--out {path}: cannot be moved aside: {error.strerror or error}") from error


def previous_of(path: Path) -> Path:
    """Path to which an earlier result is moved."""
    whole = path.resolve()
    return whole.with_name(f"{whole.name}{_PREVIOUS}") if whole.name else whole / _PREVIOUS


def make_folder(out: Path) -> None:
    """Create the folder, and check before the work that results can be written to it.

    :raises ConfigurationError: the folder cannot be made, or cannot be written to.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"--out {out}: {error.strerror or error}") from error
    if not os.access(out, os.W_OK | os.X_OK):
        raise ConfigurationError(f"--out {out}: cannot be written to")


def _lock_folder(folder: Path) -> int | None:
    """Descriptor that holds the folder until it is closed; None where folders cannot be locked.

    :raises ConfigurationError: another command holds it.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise ConfigurationError(
            f"--out {folder}: another command is writing to it: wait for its end, or choose another folder"
        ) from error
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


@contextlib.contextmanager
def replace_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write to that takes the place of ``path`` when the block ends well; folders are made as needed.

    :raises RecordingError: it cannot be written; whatever stood at ``path`` before still does.
    """
    if not path.name or (path.exists() and not path.is_file()):  # replaced by a file, /dev/null would serve nobody
        raise RecordingError(f"{path}: cannot be written: it is a folder, or no regular file")
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                yield file
            partial.replace(path)
        finally:
            with contextlib.suppress(OSError):
                partial.unlink()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
