"""Lines to processes of this machine, on a clock that stands still while the process works or waits for a processor."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from analogrig.links.link import Clock, VirtualClock
from tests.harness.processes import LONG_S, children, is_idle

LOOK_S = 0.01
"""Time between two looks at the process."""

T = TypeVar("T")


class IdleClocked:
    """A wire or bus to a child process. Its time-outs count only time in which the process has nothing to do, so a
    loaded machine causes none."""

    def __init__(self, line: Any) -> None:
        """Take over ``line``, a ChildWire or ChildBus."""
        self._line = line
        self.clock: Clock = VirtualClock()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._line, name)

    def read(self, timeout_s: float) -> bytes:
        received: bytes | None = self._wait(self._line.read, timeout_s)
        return received or b""

    def receive(self, timeout_s: float) -> Any:
        return self._wait(self._line.receive, timeout_s)

    def _wait(self, receive: Callable[[float], T], timeout_s: float) -> T | None:
        assert isinstance(self.clock, VirtualClock)
        deadline_s, longest_s = self.clock() + timeout_s, time.monotonic() + LONG_S
        while True:
            left_s = min(LOOK_S, deadline_s - self.clock())
            received = receive(max(0.0, left_s))
            if received or left_s <= 0.0:
                return received
            if all(map(is_idle, children(self._line.child.tether_pid))):
                self.clock.advance(left_s)
            assert time.monotonic() < longest_s, "the process neither answers nor sleeps"
