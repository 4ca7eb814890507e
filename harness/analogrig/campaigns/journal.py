"""Journal of an unfinished campaign: a file that survives any interruption.

It has one line for the plan and one for each chunk: JSON, preceded by its CRC. Each line is on the disk before the next
chunk is requested. A line cut short by a power failure or a full disk is ignored; every earlier line is valid.
"""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from analogrig.campaigns.plan import Chunk, Plan
from analogrig.campaigns.rows import Row, check_rows
from analogrig.errors import ConfigurationError, RecordingError

FORMAT, FORMAT_VERSION = "analogrig-campaign-journal", 2


class Journal:
    """Journal of one plan, beside its results."""

    def __init__(self, path: Path, plan: Plan) -> None:
        """Open or create the journal; ``rows`` holds its contents.

        :raises ConfigurationError: it is that of another campaign, or none, or another process has it.
        :raises RecordingError: it cannot be read or written.
        """
        self.path = path
        self.rows: dict[Chunk, list[Row]] = {}
        with self._on_disk(), contextlib.ExitStack() as opened:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = opened.enter_context(path.open("a+b", buffering=0))  # nothing is left to be written by close()
            self._lock()
            self._begin(plan)
            opened.pop_all()

    def add(self, chunk: Chunk, rows: list[Row]) -> None:
        """Append the rows of a chunk; they are on the disk when this returns.

        :raises RecordingError: it cannot be written.
        """
        with self._on_disk():
            self._write(_line({"chunk": list(chunk), "rows": rows}))

    def remove(self) -> None:
        """Delete the journal, once the results file holds all of its rows.

        :raises RecordingError: the folder does not let it go.
        """
        with self._on_disk():
            self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @contextlib.contextmanager
    def _on_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror or error}") from error

    def _lock(self) -> None:
        import fcntl

        taken = ConfigurationError(f"{self.path}: another campaign is writing to it")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise taken from error
        if not (self.path.exists() and os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())):
            raise taken  # which ended, and removed it, since it was opened here

    def _begin(self, plan: Plan) -> None:
        head = _line({"format": FORMAT, "version": FORMAT_VERSION, "plan": plan.as_table()})
        self._file.seek(0)
        with open(self._file.fileno(), "rb", closefd=False) as lines:
            first = next(lines, b"")
            self._check(first, head, plan)
            whole = self._read(lines, len(head), plan) if len(first) >= len(head) else 0
        self._file.truncate(whole)
        if not whole:
            self._write(head)

    def _check(self, first: bytes, head: bytes, plan: Plan) -> None:
        """:raises ConfigurationError: the first line is neither that of this plan, nor as much of it as the end of the
        power has left: then it is not ours to touch."""
        if head.startswith(first):
            return
        entry = _entry(first) or {}
        if (entry.get("format"), entry.get("version")) != (FORMAT, FORMAT_VERSION):
            what = (
                "of another version of analogrig" if entry.get("format") == FORMAT else "that no campaign has written"
            )
            raise ConfigurationError(f"{self.path}: is a file {what}: choose another --out, or remove it")
        plan.check_same(entry.get("plan"), f"{self.path}: what was kept there is of another campaign")

    def _read(self, lines: Iterator[bytes], whole: int, plan: Plan) -> int:
        """Read all whole lines; return the number of bytes up to the end of the last one."""
        seeds = {chunk: plan.seeds(chunk) for chunk in plan.chunks()}
        for line in lines:
            entry = _entry(line)
            if entry is None:
                break
            try:
                chunk, rows = Chunk(*entry["chunk"]), list(entry["rows"])
                check_rows(rows, seeds[chunk])
            except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
                raise RecordingError(f"{self.path}: a line that no campaign writes ({error}): remove it") from error
            self.rows[chunk] = rows
            whole += len(line)
        return whole

    def _write(self, line: bytes) -> None:
        while line:
            line = line[self._file.write(line) :]
        os.fsync(self._file.fileno())


def _line(entry: dict[str, Any]) -> bytes:
    text = json.dumps(entry, sort_keys=True, separators=(",", ":")).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _entry(line: bytes) -> dict[str, Any] | None:
    """Contents of a journal line; None if it is damaged or incomplete."""
    check, _, text = line.rstrip(b"\n").partition(b" ")
    if not line.endswith(b"\n") or check != b"%08x" % zlib.crc32(text):
        return None
    try:
        entry = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) else None
