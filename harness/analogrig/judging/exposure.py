"""Exposure: samples in which the trigger was armed. Denominator of every false-alarm rate.

No device can raise an alarm during warm-up, during the hold-off after an alarm, without the earlier samples of its
equation, or without excitation. Zero alarms in such samples prove nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import SteppedFlag
from analogrig.datasheet import Datasheet
from analogrig.run import INPUT, LOST, UNARMED, Run, stack
from analogrig.wording import number_of

EDGE_NOISES = 9.0
"""Smallest edge, in rms values of the noise of the input. Noise alone makes two samples differ as much once in 5e9
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
    """Samples before the first edge of the input, or more than ``idle_n`` after the last one."""
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
            f"in {self.unexcited} it was not excited (no edge of the input of {sheet.edge_codes:g} codes, or none for"
            f" {number_of(sheet.idle_n, 'sample')})"
        )


@dataclass(frozen=True, eq=False)
class ObservedRecord:
    """Inputs and answers of one gap-free record of n samples."""

    input: NDArray[np.uint16]
    """(n,) codes."""
    flags: NDArray[np.uint8]
    """(n,) as ``Run.flags``."""
    are_finite: NDArray[np.bool_]
    """(n,): estimate, innovation and statistic are finite."""
    alarms: NDArray[np.int64]
    """(a,) sample indices of the alarms. The trigger was armed in each of them."""


def exposure(run: Run) -> Exposure:
    """Exposure of a run: the sum over its records, each of which the device starts afresh."""
    return exposures([run])[0]


def exposures(runs: Sequence[Run]) -> list[Exposure]:
    """Exposure of each run, for runs that have length, records, channels and device in common."""
    run, sheet = runs[0], runs[0].datasheet
    noise_lsb = run.conditions.input.noise_lsb
    driven, flags = stack([each.codes[:, INPUT] for each in runs]), stack([each.flags for each in runs])
    are_finite = np.isfinite(stack([each.innovation for each in runs]))
    are_finite &= np.isfinite(stack([each.statistic for each in runs]))
    for i in range(run.theta.shape[1]):
        are_finite &= np.isfinite(stack([each.theta[:, i] for each in runs]))
    counts = np.zeros((3, len(runs)), np.int64)
    for start, end in run.records:
        alarms = [each.alarm_index[(each.alarm_index >= start) & (each.alarm_index < end)] - start for each in runs]
        part = slice(start, end)
        counts += _count(driven[:, part], flags[:, part], are_finite[:, part], alarms, sheet, noise_lsb)
    return [
        Exposure(run.samples, armed, unexcited, non_finite, sheet) for armed, unexcited, non_finite in counts.T.tolist()
    ]


def record_exposure(record: ObservedRecord, sheet: Datasheet, noise_lsb: float) -> Exposure:
    """Exposure of one record; ``noise_lsb`` is the noise of the input's channel, rms in LSB."""
    driven, flags, are_finite = record.input[None], record.flags[None], record.are_finite[None]
    counts = _count(driven, flags, are_finite, [record.alarms], sheet, noise_lsb)
    armed, unexcited, non_finite = counts[:, 0].tolist()
    return Exposure(len(record.input), armed, unexcited, non_finite, sheet)


def _count(
    driven: NDArray[np.uint16],
    flags: NDArray[np.uint8],
    are_finite: NDArray[np.bool_],
    alarms: Sequence[NDArray[np.int64]],
    sheet: Datasheet,
    noise_lsb: float,
) -> NDArray[np.int64]:
    """Armed, unexcited and non-finite samples of each of r records, (3, r); driven, flags and are_finite are (r, n)."""
    known = (flags & _NOT_PROCESSED) == 0
    excited = _excitation_mask(driven, known, _least_edge(sheet, noise_lsb), sheet.idle_n)
    excited &= (flags & SteppedFlag.IDLE) == 0
    if sheet.armed:
        watched = known & ((flags & UNARMED) == 0)
        excited[:] = True
    else:
        equations = known & ((flags & SteppedFlag.GATHERING) == 0)
        watched = _beyond_hold_off(equations, alarms, sheet)
    armed = watched & excited & are_finite & sheet.alarms
    non_finite = ~are_finite
    for i, raised in enumerate(alarms):
        armed[i, raised] = True
        non_finite[i, raised] = False  # an alarm is the required response to a non-finite estimate
    # Row by row: along an axis it takes ten times as long.
    return np.array([[np.count_nonzero(row) for row in each] for each in (armed, ~excited, non_finite)])


def _least_edge(sheet: Datasheet, noise_lsb: float) -> float:
    """Smallest step of the input that counts as an edge, in codes; 0.0 if the trigger needs none."""
    if not sheet.edge_codes:
        return 0.0
    return max(sheet.edge_codes, EDGE_NOISES * math.hypot(noise_lsb, _QUANTISATION_LSB))


def _excitation_mask(
    driven: NDArray[np.uint16], known: NDArray[np.bool_], edge_codes: float, idle_n: int
) -> NDArray[np.bool_]:
    """(r, n): the input has had an edge, and the last one is at most ``idle_n`` samples ago."""
    codes = driven.astype(np.int32)
    are_edges = (np.abs(np.diff(codes)) >= edge_codes) & known[:, 1:] & known[:, :-1]
    excited = np.ones(codes.shape, np.bool_)
    for i, record in enumerate(are_edges):
        first = int(record.argmax()) + 1 if record.size else 1
        if record.size and record[first - 1]:
            excited[i, :first] = False
        else:
            levels = codes[i, known[i]]
            excited[i, known[i]] = np.maximum.accumulate(levels) - np.minimum.accumulate(levels) >= edge_codes
        if 0 < idle_n < len(codes[i]):
            _mark_idle(np.flatnonzero(record) + 1, known[i], idle_n, excited[i])
    return excited


def _mark_idle(edges: NDArray[np.int64], known: NDArray[np.bool_], idle_n: int, excited: NDArray[np.bool_]) -> None:
    """Clear ``excited``, (n,), more than ``idle_n`` known samples after the last edge."""
    bounds = np.concatenate(([0], edges, [len(known)]))
    for i in np.flatnonzero(np.diff(bounds) > idle_n).tolist():
        idle = slice(bounds[i], bounds[i + 1])
        excited[idle] &= np.cumsum(known[idle], dtype=np.int32) - known[bounds[i]] < idle_n


def _beyond_hold_off(
    equations: NDArray[np.bool_], alarms: Sequence[NDArray[np.int64]], sheet: Datasheet
) -> NDArray[np.bool_]:
    """(r, n): samples with an equation after warm-up and hold-off, both counted in equations."""
    count = np.cumsum(equations, axis=1, dtype=np.int32)
    watched = equations & (count > sheet.warm_up_n)
    if sheet.hold_off_n:
        for i, raised in enumerate(alarms):
            for alarm, following in itertools.pairwise([*raised.tolist(), count.shape[1]]):
                held = slice(alarm + 1, following + 1)
                watched[i, held] &= count[i, held] > count[i, alarm] + sheet.hold_off_n
    return watched
