"""Clock of a live session."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class LiveClock(Protocol):
    """Time of a session, and its waiting."""

    def __call__(self) -> float:
        """Time [s]."""

    def wait(self, woken: threading.Event, seconds: float | None) -> None:
        """Wait until the event is set, for at most ``seconds``; None: without limit."""


class WallClock:
    """Monotonic clock of the system."""

    def __call__(self) -> float:
        return time.monotonic()

    def wait(self, woken: threading.Event, seconds: float | None) -> None:
        woken.wait(seconds)
