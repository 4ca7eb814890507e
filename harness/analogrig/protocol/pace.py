"""Real time: whether a line can keep up at all, when a sample is due, and whether the exchange kept up."""

from __future__ import annotations

import math

from analogrig.devices.devices import DeviceDescription
from analogrig.errors import ConfigurationError
from analogrig.links.line import Line
from analogrig.links.wire import Clock
from analogrig.protocol.catalogue import BLOCK_SAMPLES, Estimate, Sample, SampleBlock, Stepped


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

    def restart(self) -> None:
        """The next sample is the first of a record."""
        self._start_s = None

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


def check_line(device: DeviceDescription, line: Line, period_s: float, *, in_blocks: bool) -> None:
    """That ``line`` carries a sample every ``period_s``, alarms and the like not counted.

    :raises ConfigurationError: it does not; with the arithmetic.
    """
    to_s = line.message_s(SampleBlock) / BLOCK_SAMPLES if in_blocks else line.message_s(Sample)
    elements = device.estimator.parameters + 1
    stepped_s = line.message_s(Stepped)
    from_s = stepped_s + elements * line.message_s(Estimate) / device.report_interval_n
    load = line.together_s(to_s, from_s) / period_s
    if load > 1.0:
        thinner = ", or more samples for each report" if line.together_s(to_s, stepped_s) < period_s else ""
        raise ConfigurationError(
            f"device {device.name}: real time does not fit its line: {1.0 / period_s:g} samples/s, each of"
            f" {to_s * 1e6:.4g} us to the device and {from_s * 1e6:.4g} us back ({elements} estimates every"
            f" {device.report_interval_n} samples), are {load:.4g} times what {line.speed} carry;"
            f" {math.ceil(10.0 * load) / 10.0:g} times slower would fit{thinner}"
        )
