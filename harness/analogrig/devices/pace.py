"""Real time: due times of samples, overruns, and a check that the line is fast enough."""

from __future__ import annotations

import math

from analogrig.catalogue import BLOCK_SAMPLES, Estimate, Sample, SampleBlock, Stepped
from analogrig.errors import ConfigurationError
from analogrig.links.line import Line
from analogrig.links.link import Clock

__all__ = ["Pace"]
"""Names for packages beside the core."""


class Pace:
    """Machine time on a clock: sample k exists k + 1 periods after the start and is not sent earlier."""

    def __init__(self, clock: Clock, period_s: float) -> None:
        """Prepare for a sample every ``period_s`` on the clock. The first call of ``due_s`` starts it."""
        self._clock = clock
        self._period_s = period_s
        self._start_s: float | None = None
        self.messages = 0
        self.overruns = 0
        """Messages that had to wait for a full window, or that were late by more than a window of samples."""

    def restart(self) -> None:
        """Begin a new record with the next sample."""
        self._start_s = None

    def due_s(self, samples: int) -> float:
        """Time on the clock at which this number of samples exists [s]."""
        if self._start_s is None:
            self._start_s = self._clock()
        return self._start_s + samples * self._period_s

    def sending(self, samples: int, window: int, *, is_full: bool) -> None:
        """Count a message that is sent now, or has to wait because the ``window`` is full.

        :param samples: samples sent, including those of this message.
        :param window: samples that may be unanswered.
        """
        late_s = self._clock() - self.due_s(samples)
        self.messages += 1
        self.overruns += is_full or late_s > window * self._period_s


def sample_times(line: Line, *, parameters: int, report_interval_n: int, in_blocks: bool) -> tuple[float, float]:
    """Time on the line of one sample and of its answers, without alarms and diagnoses [s].

    :param parameters: elements of theta.
    """
    to_s = line.message_s(SampleBlock) / BLOCK_SAMPLES if in_blocks else line.message_s(Sample)
    return to_s, line.message_s(Stepped) + (parameters + 1) * line.message_s(Estimate) / report_interval_n


def check_line(
    line: Line, period_s: float, *, device: str, parameters: int, report_interval_n: int, in_blocks: bool
) -> None:
    """Check that ``line`` carries a sample every ``period_s``; parameters as of ``sample_times``.

    :param device: its name, for the error.
    :raises ConfigurationError: the line is too slow; shows the calculation.
    """
    to_s, from_s = sample_times(line, parameters=parameters, report_interval_n=report_interval_n, in_blocks=in_blocks)
    load = line.together_s(to_s, from_s) / period_s
    if load > 1.0:
        would_fit = line.together_s(to_s, line.message_s(Stepped)) < period_s
        thinner = ", or more samples for each report" if would_fit else ""
        raise ConfigurationError(
            f"device {device}: real time does not fit its line: {1.0 / period_s:g} samples/s, each of"
            f" {to_s * 1e6:.4g} us to the device and {from_s * 1e6:.4g} us back ({parameters + 1} estimates every"
            f" {report_interval_n} samples), need {load:.4g} times the capacity of {line.speed};"
            f" {math.ceil(10.0 * load) / 10.0:g} times slower would fit{thinner}"
        )
