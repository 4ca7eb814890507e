"""Exposure: samples in which the trigger was armed. Denominator of every false-alarm rate.

No device can raise an alarm during warm-up, during the hold-off after an alarm, without the earlier samples of its
equation, or without excitation. Zero alarms in such samples prove nothing.
"""

from __future__ import annotations

import dataclasses
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

_LEAST_SHARE = 0.1
"""Share of the samples that a warm-up must leave, times ``least_exposure``: else any silent device could state one that
ends with the record."""

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
    after_warm_up: int = 0
    """Samples after the warm-up of the data sheet."""
    unarmed_alarms: tuple[int, ...] = ()
    """Sample indices of the alarms that came while the trigger cannot have been armed."""

    @property
    def lack_of_evidence(self) -> str:
        """Reason that the run proves nothing, in one line; empty if it is evidence."""
        of = number_of(self.samples, "sample")
        if self.non_finite:
            return f"the device reported non-finite estimates in {self.non_finite} of {of}"
        if self.armed or self.unarmed_alarms:
            return ""
        return f"the trigger was armed in none of {of}: {self._unarmed_reason('none')}"

    def shortfall(self, least: float) -> str:
        """Reason that zero alarms prove nothing with this ``least`` share of armed samples, in one line; or empty."""
        if self.armed >= least * self.after_warm_up:
            if self.datasheet.latches or self.armed >= least * _LEAST_SHARE * self.samples:
                return ""
            armed = f"the trigger was armed in {self.armed} of {number_of(self.samples, 'sample')}"
            return f"{armed}, too few to judge it by: {self._unarmed_reason('no more')}"
        return (
            f"the trigger was armed in {self.armed} of {number_of(self.after_warm_up, 'sample')} after warm-up, fewer"
            f" than [expect] least_exposure = {least:g} asks for: {self._unarmed_reason('no more')}"
        )

    @property
    def contradiction(self) -> str:
        """Finding that alarms came while the trigger was not armed, in one line; empty without one."""
        if not self.unarmed_alarms:
            return ""
        sheet, alarms = self.datasheet, number_of(len(self.unarmed_alarms), "alarm")
        says = "the device reported its trigger"
        if not sheet.alarms:
            says = "the data sheet ([datasheet] alarms = false) has the trigger"
        elif not sheet.armed:
            says = f"the data sheet (warm_up_n = {sheet.warm_up_n}, hold_off_n = {sheet.hold_off_n}) has the trigger"
        return f"{alarms} while unarmed, the first at {self.unarmed_alarms[0]}: there {says} not armed"

    def _unarmed_reason(self, quantity: str) -> str:
        """Main reason that the trigger was armed in ``quantity``: ``none``, ``no more``."""
        sheet = self.datasheet
        if not sheet.alarms:
            return "the device has no trigger"
        if sheet.armed:
            return f"the device reported it armed in {quantity}"
        if 2 * self.unexcited <= self.samples:
            if self.armed and sheet.hold_off_n:
                return f"its hold-off after each alarm takes {sheet.hold_off_n}"
            if not sheet.warm_up_n:
                return "the others were missing, refused or lost" if self.armed else "each was missing, refused or lost"
            return f"its warm-up takes {sheet.warm_up_n}"
        return (
            f"in {self.unexcited} it was not excited (no edge of the input of {sheet.edge_codes:g} codes, or none for"
            f" {number_of(sheet.idle_n, 'sample')})"
        )


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
    unarmed: list[list[int]] = [[] for _ in runs]
    for start, end in run.records:
        alarms = [each.alarm_index[(each.alarm_index >= start) & (each.alarm_index < end)] - start for each in runs]
        part = slice(start, end)
        count, found = count_armed(driven[:, part], flags[:, part], are_finite[:, part], alarms, sheet, noise_lsb)
        counts += count
        for i, in_record in enumerate(found):
            unarmed[i] += (in_record + start).tolist()
    return [
        Exposure(run.samples, armed, unexcited, non_finite, sheet, _after_warm_up(each), tuple(indices))
        for each, (armed, unexcited, non_finite), indices in zip(runs, counts.T.tolist(), unarmed, strict=True)
    ]


def _after_warm_up(run: Run) -> int:
    """Samples after the warm-up, in each record until a device that latches has raised its alarm."""
    latched = latched_from(run)
    ends = {(start, end): latched.get((start, end), end - 1) + 1 for start, end in run.records}
    return sum(max(0, end - start - run.datasheet.warm_up_n) for (start, _), end in ends.items())


def latched_from(run: Run) -> dict[tuple[int, int], int]:
    """First alarm of each record (start, end) from which on a device that latches is not judged; empty for others."""
    alarms = run.alarm_index.tolist() if run.datasheet.latches else []
    found = {}
    for start, end in run.records:
        first = next((alarm for alarm in alarms if start <= alarm < end), None)
        if first is not None:
            found[start, end] = first
    return found


def until_latched(run: Run) -> Run:
    """The run without the alarms that a latched trigger held; the run itself for other devices."""
    if not run.datasheet.latches:
        return run
    firsts = latched_from(run)
    kept = [i for i, alarm in enumerate(run.alarm_index.tolist()) if alarm in firsts.values()]
    kept = [i for i in kept if i == 0 or run.alarm_index[i - 1] != run.alarm_index[i]]
    return dataclasses.replace(
        run,
        alarm_index=run.alarm_index[kept],
        alarm_kind=run.alarm_kind[kept],
        alarm_statistic=run.alarm_statistic[kept],
    )


def count_armed(
    driven: NDArray[np.uint16],
    flags: NDArray[np.uint8],
    are_finite: NDArray[np.bool_],
    alarms: Sequence[NDArray[np.int64]],
    sheet: Datasheet,
    noise_lsb: float,
) -> tuple[NDArray[np.int64], list[NDArray[np.int64]]]:
    """Armed, unexcited and non-finite samples of each of r records, (3, r), and their alarms while unarmed.

    driven, flags and are_finite are (r, n). ``alarms`` are indices in each record, ``noise_lsb`` is that of the input.
    """
    known = (flags & _NOT_PROCESSED) == 0
    noises = EDGE_NOISES * math.hypot(noise_lsb, _QUANTISATION_LSB)
    excited = _excitation_mask(driven, known, max(sheet.edge_codes, noises) if sheet.edge_codes else 0.0, sheet.idle_n)
    excited &= (flags & SteppedFlag.IDLE) == 0
    if sheet.armed:
        watched = known & ((flags & UNARMED) == 0)
        excited[:] = True
    else:
        equations = known & ((flags & SteppedFlag.GATHERING) == 0)
        watched = _beyond_hold_off(equations, alarms, sheet)
    armed = watched & excited & are_finite & sheet.alarms
    non_finite = ~are_finite
    unarmed = []
    for i, raised in enumerate(alarms):
        # An alarm is the required response to a non-finite estimate, armed or not.
        unarmed.append(raised[_are_unarmed(raised, flags[i], sheet) & are_finite[i, raised]])
        armed[i, raised], armed[i, unarmed[i]] = True, False
        if sheet.latches and len(raised):
            armed[i, raised[0] + 1 :] = False
        non_finite[i, raised] = False
    # Row by row: along an axis it takes ten times as long.
    counts = np.array([[np.count_nonzero(row) for row in each] for each in (armed, ~excited, non_finite)])
    return counts, unarmed


def _are_unarmed(alarms: NDArray[np.int64], flags: NDArray[np.uint8], sheet: Datasheet) -> NDArray[np.bool_]:
    """(a,): the trigger cannot have been armed when the alarm at this sample of a record came.

    A device may report its state before or after the alarm, so it must be unarmed in the sample before as well.
    Warm-up and hold-off are counted in equations, of which there are at most as many as samples.
    """
    if not sheet.alarms or sheet.latches:
        return np.full(len(alarms), not sheet.alarms)
    if sheet.armed:
        return np.asarray((flags[alarms] & flags[np.maximum(alarms - 1, 0)] & UNARMED) != 0)
    since = np.diff(alarms, prepend=-1 - sheet.hold_off_n)
    return np.asarray((alarms < sheet.warm_up_n) | ((since > 0) & (since <= sheet.hold_off_n)))


def _excitation_mask(
    driven: NDArray[np.uint16], known: NDArray[np.bool_], edge_codes: float, idle_n: int
) -> NDArray[np.bool_]:
    """(r, n): the input has had an edge, and the last one is at most ``idle_n`` samples ago.

    :param edge_codes: smallest step of the input that counts as an edge; 0: the trigger needs none.
    """
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
