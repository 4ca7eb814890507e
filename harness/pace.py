"""Real time: when a sample is due, and whether the exchange kept up."""

from __future__ import annotations

from harness.wire import Clock


class Pace:
    """Machine time on a clock: sample k exists k + 1 periods after the start, and does not go out earlier."""

    def __init__(self, clock: Clock, period_s: float) -> None:
        """``period_s`` is between samples, on the clock. Who first asks when something is due starts it."""
        self._clock = clock
        self._period_s = period_s
        self._start_s: float | None = None
        self.messages = 0
        self.overruns = 0
        """Messages that found the window full when they were due, or went out late by more than their samples last."""

    def due_s(self, samples: int) -> float:
        """When so many samples exist, on the clock."""
        if self._start_s is None:
            self._start_s = self._clock()
        return self._start_s + samples * self._period_s

    def sending(self, samples: int, of_message: int, *, is_full: bool) -> None:
        """A message that brings it to so many ``samples`` goes out now, or has to wait for the window."""
        late_s = self._clock() - self.due_s(samples)
        self.messages += 1
        self.overruns += is_full or late_s > of_message * self._period_s
