"""What a campaign has got so far, in a file that survives whatever ends the campaign.

One line a chunk, on the disk before the next is asked for: JSON, and its CRC in front. A line that was being written
when the power went is not there; everything before it is.
"""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from harness.campaign.spec import Chunk
from harness.campaign.trial import Row
from harness.errors import ConfigurationError, RecordingError

FORMAT = "analogrig-campaign-journal"


class Journal:
    """Of one plan, beside its results."""

    def __init__(self, path: Path, digest: str) -> None:
        """Open or create it; ``rows`` is what it holds.

        :raises ConfigurationError: it is that of another campaign.
        :raises RecordingError: it cannot be read or written.
        """
        self.path = path
        self.rows: dict[Chunk, list[Row]] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.ExitStack() as opened:
                self._file = opened.enter_context(path.open("a+b"))
                self._lock()
                self._begin(digest)
                opened.pop_all()
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror or error}") from error

    def add(self, chunk: Chunk, rows: list[Row]) -> None:
        """It is on the disk when this returns.

        :raises RecordingError: it cannot be written.
        """
        self.rows[chunk] = rows
        try:
            self._write({"chunk": list(chunk), "rows": rows})
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror or error}") from error

    def remove(self) -> None:
        """All of it is elsewhere."""
        self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def _lock(self) -> None:
        import fcntl

        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigurationError(f"{self.path}: another campaign is writing to it") from error

    def _begin(self, digest: str) -> None:
        whole = self._read(digest)
        self._file.truncate(whole)
        if not whole:
            self._write({"format": FORMAT, "plan": digest})

    def _read(self, digest: str) -> int:
        """Takes in all whole lines; the number of their bytes."""
        self._file.seek(0)
        whole = 0
        for line in self._file:
            entry = _entry(line)
            if entry is None:
                break
            if whole == 0 and (entry.get("format") != FORMAT or entry.get("plan") != digest):
                raise ConfigurationError(
                    f"{self.path}: what was kept there is of another campaign: choose another --out, or remove it"
                )
            if "chunk" in entry:
                self.rows[Chunk(entry["chunk"])] = entry["rows"]
            whole += len(line)
        return whole

    def _write(self, entry: dict[str, Any]) -> None:
        text = json.dumps(entry, separators=(",", ":")).encode()
        self._file.write(b"%08x %s\n" % (zlib.crc32(text), text))
        self._file.flush()
        os.fsync(self._file.fileno())


def _entry(line: bytes) -> dict[str, Any] | None:
    """None: damaged, or not all there."""
    check, _, text = line.rstrip(b"\n").partition(b" ")
    if not line.endswith(b"\n") or check != b"%08x" % zlib.crc32(text):
        return None
    entry = json.loads(text)
    return entry if isinstance(entry, dict) else None
