"""Rates of a live session: samples, and frames on the line of its device."""

from __future__ import annotations

from dataclasses import dataclass

from analogrig import Device

_OVER_S = 1.0
"""Time over which rates are measured."""


@dataclass(frozen=True)
class Rates:
    """Rates per second of wall-clock time."""

    samples_hz: float = 0.0
    frames_hz: float = 0.0
    """Frames on the device's line, in both directions; 0.0 if they are not counted."""
    line_load: float = 0.0
    """Time that the frames take at the line's speed, per time; 0.0 if the speed is unknown."""


class RateMeter:
    """Meter of the rates of a device that is being played."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._samples = 0
        self._begun: tuple[float, float, float, float] | None = None
        """Time, samples, frames and time on the line from which rates are counted."""
        self.rates = Rates()
        """Rates over the last second."""

    def restart(self) -> None:
        """Count from the next block on: after a pause."""
        self._begun = None

    def count(self, samples: int, now_s: float) -> None:
        """Count the answered samples of a block."""
        self._samples += samples
        line = self._device.faulty_line
        frames = 0 if line is None else sum(line.frames.values())
        present = now_s, float(self._samples), float(frames), self._device.line_s
        if self._begun is None:
            self._begun = present
        over_s, *counts = (after - before for after, before in zip(present, self._begun, strict=True))
        if over_s >= _OVER_S:
            # the time on the line restarts with each record
            self.rates, self._begun = Rates(*(max(0.0, count) / over_s for count in counts)), present
