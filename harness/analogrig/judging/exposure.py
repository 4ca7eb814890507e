"""Exposure: samples in which the trigger was armed. Denominator of every false-alarm rate.

No device can raise an alarm during warm-up, during the hold-off after an alarm, without the earlier samples of its
equation, or without excitation. Zero alarms in such samples prove nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.run import CHUNK_SAMPLES, INPUT, LOST, UNARMED, Run
from analogrig.wording import number_of

EDGE_NOISES = 9.0
"""Smallest edge, in rms values of the noise of the force. Noise alone makes two samples differ as much once in 5e9
pairs."""

_QUANTISATION_LSB = 12.0**-0.5


_NOT_PROCESSED = np.uint8(SteppedFlag.MISSING | SteppedFlag.REFUSED | LOST)


@dataclass(frozen=True)
class Exposure:
    """Exposure of one run, in samples."""

    samples: int
    armed: int
    """Samples in which the trigger was armed."""
    unexcited: int
    """Samples before the first edge of the force, or more than ``idle_n`` after the last one."""
    non_finite: int
    """Samples without an alarm whose estimate, innovation or statistic was non-finite."""
    datasheet: Datasheet
    """Data sheet of the device."""

    @property
    def lack_of_evidence(self) -> str:
        """Reason that zero alarms prove nothing, in one line; empty if they are evidence."""
        of = number_of(self.samples, "sample")
        if self.non_finite:
            return f"the device reported non-finite estimates in {self.non_finite} of {of}"
        return "" if self.armed else f"the trigger was armed in none of {of}: {self._unarmed_reason()}"

    def _unarmed_reason(self) -> str:
        """Main reason that the trigger was never armed."""
        sheet = self.datasheet
        if not sheet.alarms:
            return "the device has no trigger"
        if sheet.armed:
            return "the device reported it armed in none"
        if 2 * self.unexcited <= self.samples:
            return f"its warm-up takes {sheet.warm_up_n}"
        return (
            f"in {self.unexcited} it was not excited (no edge of the force of {sheet.edge_codes:g} codes, or none for"
            f" {number_of(sheet.idle_n, 'sample')})"
        )


@dataclass(frozen=True, eq=False)
class ObservedRecord:
    """Inputs and answers of one gap-free record of n samples."""

    force: NDArray[np.uint16]
    """(n,) codes."""
    flags: NDArray[np.uint8]
    """(n,) as ``Run.flags``."""
    are_finite: NDArray[np.bool_]
    """(n,): estimate, innovation and statistic are finite."""
    alarms: NDArray[np.int64]
    """(a,) sample indices of the alarms. The trigger was armed in each of them."""


def exposure(run: Run) -> Exposure:
    """Exposure of a run: the sum over its records, each of which the device starts afresh."""
    sheet, noise_lsb = run.datasheet, run.conditions.input.noise_lsb
    are_finite = np.isfinite(run.innovation) & np.isfinite(run.statistic)
    for column in run.theta.T:
        are_finite &= np.isfinite(column)
    parts = [
        record_exposure(
            ObservedRecord(
                run.codes[start:end, INPUT],
                run.flags[start:end],
                are_finite[start:end],
                run.alarm_index[(run.alarm_index >= start) & (run.alarm_index < end)] - start,
            ),
            sheet,
            noise_lsb,
        )
        for start, end in run.records
    ]
    armed, unexcited, non_finite = (
        sum(getattr(part, name) for part in parts) for name in ("armed", "unexcited", "non_finite")
    )
    return Exposure(run.samples, armed, unexcited, non_finite, sheet)


def record_exposure(record: ObservedRecord, sheet: Datasheet, noise_lsb: float) -> Exposure:
    """Exposure of one record; ``noise_lsb`` is the noise of the force channel, rms in LSB."""
    known = (record.flags & _NOT_PROCESSED) == 0
    excited = _excitation_mask(record.force, known, _least_edge(sheet, noise_lsb), sheet.idle_n)
    excited &= (record.flags & SteppedFlag.IDLE) == 0
    if sheet.armed:
        watched = known & ((record.flags & UNARMED) == 0)
        excited[:] = True
    else:
        equations = known & ((record.flags & SteppedFlag.GATHERING) == 0)
        watched = _beyond_hold_off(equations, record.alarms, sheet)
    armed = watched & excited & record.are_finite & sheet.alarms
    armed[record.alarms] = True
    non_finite = ~record.are_finite
    non_finite[record.alarms] = False  # an alarm is the required response to a non-finite estimate
    armed_n, unexcited_n, non_finite_n = (int(np.count_nonzero(each)) for each in (armed, ~excited, non_finite))
    return Exposure(len(armed), armed_n, unexcited_n, non_finite_n, sheet)


def _least_edge(sheet: Datasheet, noise_lsb: float) -> float:
    """Smallest step of the force that counts as an edge, in codes; 0.0 if the trigger needs none."""
    if not sheet.edge_codes:
        return 0.0
    return max(sheet.edge_codes, EDGE_NOISES * math.hypot(noise_lsb, _QUANTISATION_LSB))


def _excitation_mask(
    force: NDArray[np.uint16], known: NDArray[np.bool_], edge_codes: float, idle_n: int
) -> NDArray[np.bool_]:
    """(n,): the force has had an edge, and the last one is at most ``idle_n`` samples ago."""
    codes = force.astype(np.int32)
    edges = np.flatnonzero((np.abs(np.diff(codes)) >= edge_codes) & known[1:] & known[:-1]) + 1
    excited = np.ones(len(codes), np.bool_)
    if len(edges):
        excited[: edges[0]] = False
    else:
        levels = codes[known]
        excited[known] = np.maximum.accumulate(levels) - np.minimum.accumulate(levels) >= edge_codes
    if idle_n:
        bounds = np.concatenate(([0], edges, [len(codes)]))
        for i in np.flatnonzero(np.diff(bounds) > idle_n).tolist():
            idle = slice(bounds[i], bounds[i + 1])
            excited[idle] &= np.cumsum(known[idle], dtype=np.int32) - known[bounds[i]] < idle_n
    return excited


def _beyond_hold_off(equations: NDArray[np.bool_], alarms: NDArray[np.int64], sheet: Datasheet) -> NDArray[np.bool_]:
    """(n,): samples with an equation after warm-up and hold-off, both counted in equations."""
    count = np.cumsum(equations, dtype=np.int32)
    watched = equations & (count > sheet.warm_up_n)
    hold_off_n = sheet.hold_off_n
    if hold_off_n and len(alarms):
        for first in range(0, len(count), CHUNK_SAMPLES):
            part = slice(first, min(first + CHUNK_SAMPLES, len(count)))
            last = (
                np.searchsorted(alarms, np.arange(part.start, part.stop)) - 1
            )  # index of the last alarm before the sample
            watched[part] &= (last < 0) | (count[part] > count[alarms[last]] + hold_off_n)
    return watched
