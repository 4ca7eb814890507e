"""Whoever plays on an instrument has it alone on this machine; and a process that is ended lets go of it."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import signal
import tempfile
import threading
from pathlib import Path
from types import FrameType

from analogrig.errors import RigClosed

_ENDED_BY = (signal.SIGTERM, signal.SIGHUP)


class Lock:
    """On the instrument of a URL. While it is held, a signal that would end the process ends it in good order."""

    def __init__(self, url: str) -> None:
        """:raises RigClosed: somebody else on this machine has it."""
        place = hashlib.sha256(url.lower().encode()).hexdigest()[:16]
        path = Path(tempfile.gettempdir()) / f"analogrig-{os.getuid()}-{place}.lock"
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            raise RigClosed(f"instrument {url}: cannot be locked: {path}: {error.strerror or error}") from error
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._fd)
            raise RigClosed(f"instrument {url}: somebody else on this machine plays on it") from error
        self._handled = _handle_ends()

    def release(self) -> None:
        for number in self._handled:
            with contextlib.suppress(ValueError):
                signal.signal(number, signal.SIG_DFL)
        os.close(self._fd)


def _handle_ends() -> tuple[signal.Signals, ...]:
    """Those that nobody handles yet; only the main thread may."""
    if threading.current_thread() is not threading.main_thread():
        return ()
    free = tuple(number for number in _ENDED_BY if signal.getsignal(number) is signal.SIG_DFL)
    for number in free:
        signal.signal(number, _end)
    return free


def _end(number: int, _: FrameType | None) -> None:
    """As the system's own way of ending, but that what is open is closed before."""
    raise SystemExit(128 + number)
