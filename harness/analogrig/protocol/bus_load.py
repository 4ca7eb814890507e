"""Bus load: share of a CAN bus that an exchange needs, and the worst-case latency of its answers.

Latencies follow R. I. Davis, A. Burns, R. J. Bril, J. J. Lukkien: Controller Area Network (CAN) schedulability
analysis: refuted, revisited and revised, Real-Time Systems 35, 2007.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from analogrig.catalogue import (
    BLOCK_SAMPLES,
    LAYOUTS,
    Alarm,
    Diagnosis,
    Estimate,
    Message,
    Misfit,
    Sample,
    SampleBlock,
    Stepped,
)
from analogrig.links.line import CanLine
from analogrig.protocol.pace import sample_times
from analogrig.run import Run


@dataclass(frozen=True)
class PeriodicFrames:
    """Frames of one identifier that are queued together, periodically. Lower identifiers have priority."""

    identifier: int
    frame_s: float
    """Longest duration of one of them [s]."""
    period_s: float
    """Shortest time between two queueings [s]; infinite if they are queued once."""
    frames: int = 1
    jitter_s: float = 0.0
    """Longest delay of their queueing [s]."""

    @property
    def utilisation(self) -> float:
        return self.frames * self.frame_s / self.period_s


_MOST_STEPS = 10_000


def latency_s(streams: Iterable[PeriodicFrames], identifier: int, bit_s: float) -> float | None:
    """Worst-case time from the due time of a stream's frames to the end of the last one [s]; None if it is unbounded.

    Davis et al. 2007, Equ 4 to 9, for frames that are queued ``frames`` at a time. A frame is never interrupted; among
    the waiting ones the lowest identifier is next.

    :raises StopIteration: no stream has that identifier.
    """
    streams = tuple(streams)
    own = next(stream for stream in streams if stream.identifier == identifier)
    higher = [stream for stream in streams if stream.identifier < identifier]
    blocking_s = max((stream.frame_s for stream in streams if stream.identifier > identifier), default=0.0)
    if own.utilisation + sum(stream.utilisation for stream in higher) >= 1.0:
        return None
    busy_s = _fixed_point(blocking_s, [*higher, own], 0.0, own.frames * own.frame_s)
    if busy_s is None:
        return None
    longest_s = 0.0
    for instance in range(max(1, math.ceil((busy_s + own.jitter_s) / own.period_s))):
        before_s = blocking_s + ((instance + 1) * own.frames - 1) * own.frame_s
        waiting_s = _fixed_point(before_s, higher, bit_s, before_s)
        if waiting_s is None:
            return None
        passed_s = instance * own.period_s if instance else 0.0
        longest_s = max(longest_s, own.jitter_s + waiting_s - passed_s + own.frame_s)
    return longest_s


def _fixed_point(own_s: float, streams: Iterable[PeriodicFrames], bit_s: float, start_s: float) -> float | None:
    """Smallest t >= start with t = own + time of all frames queued by t; None if the iteration does not end."""
    now_s = start_s
    for _ in range(_MOST_STEPS):
        queued = (each.frames * each.frame_s * _queueings(each, now_s + bit_s) for each in streams)
        next_s = own_s + sum(queued)
        if next_s <= now_s * (1.0 + 1e-12):
            return next_s
        now_s = next_s
    return None


def _queueings(stream: PeriodicFrames, within_s: float) -> int:
    """Largest number of queueings within a time. Excludes one that only a rounding error puts inside."""
    return max(1, math.ceil((within_s + stream.jitter_s) / stream.period_s - 1e-9))


@dataclass(frozen=True)
class BusLoad:
    """Demand of an exchange on a bus, with every frame at its longest."""

    bitrate: int
    data_bitrate: int | None
    sample_s: float
    """Time on the bus of one sample and its answers, without alarms, diagnoses and misfits [s]."""
    utilisation: float
    """Share of the bus in real time; more than 1.0 does not fit."""
    latency_s: float | None
    """Worst-case time in real time from a sample to the end of its last answer, after an Alarm, a Diagnosis and a
    Misfit [s]. The device itself takes no time. None if it is unbounded."""

    @property
    def most_samples_per_s(self) -> float:
        return 1.0 / self.sample_s


def exchange_load(
    line: CanLine, *, in_blocks: bool, parameters: int, report_interval_n: int, period_s: float
) -> BusLoad:
    """Bus load of a sample every ``period_s``, single or in blocks of BLOCK_SAMPLES.

    Each ``report_interval_n`` samples, the device answers ``parameters`` elements of theta and the innovation.
    """

    def stream(
        kind: type[Message], frames: int = 1, every_s: float = math.inf, jitter_s: float = 0.0
    ) -> PeriodicFrames:
        return PeriodicFrames(LAYOUTS[kind.__name__].id, line.message_s(kind), every_s, frames, jitter_s)

    together = BLOCK_SAMPLES if in_blocks else 1
    samples = stream(SampleBlock if in_blocks else Sample, 1, together * period_s)

    def answers(jitter_s: float) -> list[PeriodicFrames]:
        estimates_n = math.ceil(together / report_interval_n) * (parameters + 1)
        estimates = stream(Estimate, estimates_n, max(together, report_interval_n) * period_s, jitter_s)
        return [samples, estimates, stream(Stepped, together, together * period_s, jitter_s)]

    there_s = latency_s(answers(0.0), samples.identifier, 1.0 / line.bitrate)
    late_s = 0.0 if there_s is None else there_s - samples.frame_s
    back = [stream(Alarm), stream(Diagnosis), stream(Misfit), *answers(late_s)]
    back_s = latency_s(back, LAYOUTS["Stepped"].id, 1.0 / line.bitrate)
    sample_s = sum(sample_times(line, parameters=parameters, report_interval_n=report_interval_n, in_blocks=in_blocks))
    return BusLoad(
        line.bitrate,
        line.data_bitrate,
        sample_s=sample_s,
        utilisation=sample_s / period_s,
        latency_s=None if there_s is None or back_s is None else samples.frame_s + back_s,
    )


def load_of(run: Run) -> BusLoad | None:
    """Bus load of a run; None without a CAN bus, or if its bit rate is unknown."""
    ran = run.conditions
    if "bitrate" not in ran.line:
        return None
    return exchange_load(
        CanLine(ran.line["bitrate"], ran.line.get("data_bitrate")),
        in_blocks=ran.line.get("samples_per_message", 1) > 1,
        parameters=run.theta.shape[1],
        report_interval_n=int(ran.dut.get("report_interval_n", 1)),
        period_s=ran.sample_period_s * (ran.real_time or 1.0),
    )
