"""Python estimators that act on the process at sample 300: ``python:tests.harness.hostile_python:make?act=NAME``."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

AT = 300


def _print() -> None:
    print("x" * 100_000, flush=True)  # noqa: T201
    os.write(1, b"{}\n")
    ctypes.CDLL(None).puts(b"from C")


def _close_standard_streams() -> None:
    for number in range(3):
        os.close(number)


def _alarm() -> None:
    signal.setitimer(signal.ITIMER_REAL, 0.01)
    time.sleep(1000.0)


def _kill_parent() -> None:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(1000.0)


ACTS: dict[str, Callable[[], object]] = {
    "exit": lambda: os._exit(0),
    "exit-with-failure": lambda: os._exit(1),
    "sys-exit": lambda: sys.exit(0),
    "sleep": lambda: time.sleep(1000.0),
    "deadlock": lambda: threading.Event().wait(),
    "print": _print,
    "thread": lambda: threading.Thread(target=time.sleep, args=(1000.0,)).start(),
    "terminate": lambda: os.kill(os.getpid(), signal.SIGTERM),
    "interrupt": lambda: os.kill(os.getpid(), signal.SIGINT),
    "hang-up": lambda: os.kill(os.getpid(), signal.SIGHUP),
    "kill-group": lambda: os.killpg(0, signal.SIGKILL),
    "kill-parent": _kill_parent,
    "stop": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "fork": os.fork,
    "fork-and-exit": lambda: os.fork() and os._exit(0),
    "close-standard-streams": _close_standard_streams,
    "close-all": lambda: os.closerange(0, 1000),
    "segfault": lambda: ctypes.string_at(0),
    "daemon": lambda: subprocess.Popen(["sleep", "1000.25"], start_new_session=True),
    "alarm": _alarm,
}


class Hostile:
    """Raises no alarm, and acts at one sample."""

    def __init__(self, act: str) -> None:
        self._act = ACTS[act]
        self._n = 0

    def step(self, u: int, y: int, valid: bool) -> bool:  # noqa: ARG002, FBT001
        self._n += 1
        if self._n == AT + 1:
            self._act()
        return False


def make(act: str) -> Hostile:
    """Estimator with this act."""
    return Hostile(act)
