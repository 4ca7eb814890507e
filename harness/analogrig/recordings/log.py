"""What a run leaves: its frames in a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from analogrig.errors import RecordingError

if TYPE_CHECKING:
    import can

WRITTEN = ("log", "blf", "asc", "mf4")
"""Formats that a run can leave, by the suffix of the file."""


class _FrameWriter(Protocol):
    def __call__(self, frame: can.Message) -> None: ...

    def stop(self) -> None: ...


class CanLog:
    """A listener to a link that writes each frame to a file; there is none before the first frame after ``begin``.

    A disk that is full does not end the run: ``close`` tells.
    """

    def __init__(self, path: Path) -> None:
        """The suffix of ``path`` is one of WRITTEN."""
        self.path = path
        self._held: list[can.Message] | None = []
        """What passed before the beginning."""
        self._writer: _FrameWriter | None = None
        self._failure: Exception | None = None

    @property
    def has_frames(self) -> bool:
        """Whether a frame has passed before the beginning; after the handshake with a device on a CAN bus some have."""
        return bool(self._held)

    def begin(self) -> None:
        """The device has answered: what an earlier run has left in the file may go, what was said so far is written."""
        held, self._held = self._held or [], None
        for frame in held:
            self(frame)

    def __call__(self, frame: can.Message) -> None:
        if self._held is not None:
            self._held.append(frame)
            return
        if self._failure is not None:
            return
        try:
            if self._writer is None:
                self._writer = _open_writer(self.path)
            self._writer(frame)
        except Exception as error:  # noqa: BLE001 - the formats raise what they like; the run goes on
            self._failure = error

    def close(self) -> None:
        """Finish the file. May be called twice.

        :raises RecordingError: not all of it could be written.
        """
        writer, self._writer = self._writer, None
        try:
            if writer is not None:
                writer.stop()
        except Exception as error:  # noqa: BLE001 - as above
            self._failure = self._failure or error
        failure, self._failure = self._failure, None
        if failure is not None:
            said = getattr(failure, "strerror", None) or " ".join(str(failure).split())
            raise RecordingError(f"{self.path}: cannot be written: {said}") from failure


def _open_writer(path: Path) -> _FrameWriter:
    from analogrig.links.python_can import can

    writers: Mapping[str, Any] = {
        "log": can.CanutilsLogWriter,
        "blf": can.BLFWriter,
        "asc": can.ASCWriter,
        "mf4": can.MF4Writer,
    }
    writer: _FrameWriter = writers[path.suffix[1:]](path)
    return writer
