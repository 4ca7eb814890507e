"""Instrument lock among the processes of one user on one machine; after a signal too the instrument is safe.

The lock is a file in the folder for temporary files, with the user's number in its name. Processes of other users, and
those with another TMPDIR, do not see it.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import signal
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from analogrig.errors import RigClosed
from analogrig_instruments.tcp_address import resolved_places

_ENDING = (signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def lock_instrument(url: str, place: str) -> Iterator[None]:
    """Hold the lock of the instrument at a URL; the kernel releases it with the process, also after SIGKILL.

    All names of a host lock the same instrument: there is a lock for each address of the driver's ``place``.
    Meanwhile SIGTERM and SIGHUP raise SystemExit unless the process handles them, so that generators are switched off.

    :raises RigClosed: another process, or another rig of this one, holds it.
    """
    with contextlib.ExitStack() as locks:
        for name in resolved_places(place):
            _lock(url, name, locks)
        with _exit_at_signals():
            yield


def _lock(url: str, name: str, locks: contextlib.ExitStack) -> None:
    digest = hashlib.sha256(name.encode()).hexdigest()[:16]
    path = Path(tempfile.gettempdir()) / f"analogrig-{os.getuid()}-{digest}.lock"
    try:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise RigClosed(f"instrument {url}: cannot be locked: {path}: {error.strerror or error}") from error
    locks.enter_context(os.fdopen(fd, "wb"))
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise RigClosed(f"instrument {url}: in use by another process or rig on this machine") from error


@contextlib.contextmanager
def _exit_at_signals() -> Iterator[None]:
    """Raise SystemExit at signals that have no handler yet; in the main thread only, as Python requires."""
    is_main = threading.current_thread() is threading.main_thread()
    free = [number for number in _ENDING if is_main and signal.getsignal(number) is signal.SIG_DFL]
    for number in free:
        signal.signal(number, _exit)
    try:
        yield
    finally:
        for number in free:
            with contextlib.suppress(ValueError):  # released in another thread
                signal.signal(number, signal.SIG_DFL)


def _exit(number: int, _: FrameType | None) -> None:
    """Exit with the status of a process that the signal has ended, after closing what is open."""
    raise SystemExit(128 + number)
