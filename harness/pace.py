"""Real time: whether a line can keep up at all, when a sample is due, and whether the exchange kept up."""

from __future__ import annotations

import math

from harness import frame
from harness.catalogue import BLOCK_SAMPLES, Estimate, Sample, SampleBlock, Stepped
from harness.devices import DeviceDescription
from harness.errors import ConfigurationError
from harness.timed_wire import BITS_PER_BYTE
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
        """Messages that found the window full when they were due, or went out later than a window of samples lasts."""

    def due_s(self, samples: int) -> float:
        """When so many samples exist, on the clock."""
        if self._start_s is None:
            self._start_s = self._clock()
        return self._start_s + samples * self._period_s

    def sending(self, samples: int, window: int, *, is_full: bool) -> None:
        """A message that brings it to so many ``samples`` goes out now, or has to wait for room in the ``window``."""
        late_s = self._clock() - self.due_s(samples)
        self.messages += 1
        self.overruns += is_full or late_s > window * self._period_s


def check_line(device: DeviceDescription, period_s: float) -> None:
    """That a line of the described speed carries a sample every ``period_s``, alarms and the like not counted.

    :raises ConfigurationError: it does not; with the arithmetic.
    """
    if device.baud is None:
        return
    in_blocks = device.exchange != "sample"
    there = frame.size(SampleBlock) / BLOCK_SAMPLES if in_blocks else frame.size(Sample)
    elements = device.estimator.parameters + 1
    back = frame.size(Stepped) + elements * frame.size(Estimate) / device.report_interval_n
    needed = BITS_PER_BYTE * max(there, back) / period_s
    if needed > device.baud:
        unreported = BITS_PER_BYTE * max(there, frame.size(Stepped)) / period_s
        thinner = ", or more samples for each report" if unreported < device.baud else ""
        raise ConfigurationError(
            f"device {device.name}: real time does not fit its line: {1.0 / period_s:g} samples/s of {there:.4g} bytes"
            f" to the device and {back:.4g} bytes back ({elements} estimates every {device.report_interval_n} samples)"
            f" are {needed:.0f} bit/s, the line has {device.baud} baud;"
            f" {math.ceil(10.0 * needed / device.baud) / 10.0:g} times slower would fit{thinner}"
        )
