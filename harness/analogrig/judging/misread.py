"""Signs in a run that the answers of the device are misread: their bytes, their scale, or their alarm."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import plausible_orders
from analogrig.catalogue import SteppedFlag
from analogrig.judging.verdict import Verdict, refusal_cause
from analogrig.run import LOST, UNREPORTED, Run
from analogrig.wording import number_of

_LEAST_ROW = 5
"""Alarms in a row that look like a level. A trigger with an alarm in every sample is rare."""

_MOST_READ = 20_000
"""Most samples, at even intervals, in which the byte order is looked at."""

_FACTOR_DEVIATION = 0.03
"""Largest relative deviation of a parameter from the factor that all have in common."""

_LEAST_FACTOR = 0.1
"""Least relative deviation of this factor from 1."""


def misreadings(run: Run, verdict: Verdict) -> Iterator[str]:
    """One sentence for each sign."""
    yield from _refused(run)
    yield from _alarms_in_a_row(run)
    yield from _byte_order(run)
    yield from _common_factor(verdict)


def _refused(run: Run) -> Iterator[str]:
    """Sentence on refused samples of a device without a counter of them, which is a reason of its own."""
    n = int(np.count_nonzero((run.flags & (SteppedFlag.REFUSED | LOST)) == SteppedFlag.REFUSED))
    if n and "refused" not in run.conditions.counters:
        yield f"the device did not use {number_of(n, 'sample')}{refusal_cause(run)}"


def _alarms_in_a_row(run: Run) -> Iterator[str]:
    samples = np.unique(run.alarm_index)
    is_level = run.datasheet.latches or run.conditions.device.alarm_is != "event"
    if is_level or not len(samples):
        return
    ends = np.flatnonzero(np.diff(samples) > 1)
    starts = np.concatenate(([0], ends + 1))
    lengths = np.diff(np.concatenate((starts, [len(samples)])))
    longest = int(np.argmax(lengths))
    if lengths[longest] >= _LEAST_ROW:
        yield (
            f"alarms in {lengths[longest]} samples in a row, from sample {samples[starts[longest]]} on: if the device"
            ' holds its alarm, set alarm_is = "level" in its file, or latches = true in its [datasheet] if it never'
            " learns the changed plant"
        )


def _byte_order(run: Run) -> Iterator[str]:
    every = slice(None, None, 1 + run.samples // _MOST_READ)
    is_reported = (run.flags[every] & (LOST | UNREPORTED)) == 0
    columns: Mapping[str, NDArray[np.float32]] = {
        "theta": run.theta[every][is_reported],
        "statistic": run.statistic[every][is_reported],
        "innovation": run.innovation[every][is_reported],
    }
    for name, values in columns.items():
        for order, example, read in plausible_orders(values):
            yield (
                f"{name} is implausible as it is read, such as {example:g}, and plausible {order} ({read:g}): correct"
                " the byte order of its fields (in templates f32be, in a DBC the byte order of the signal)"
            )


def _common_factor(verdict: Verdict) -> Iterator[str]:
    known = [each for each in verdict.estimates if each.estimate is not None]
    ratios = np.array([1.0 + error for each in known for error in each.error.values()])
    if len(known) < len(verdict.estimates) or len(ratios) < 2 or not np.isfinite(ratios).all():
        return
    factor = float(np.median(ratios))
    is_common = bool((np.abs(ratios - factor) <= _FACTOR_DEVIATION * abs(factor)).all())
    if is_common and factor > 0.0 and abs(factor - 1.0) >= _LEAST_FACTOR:
        yield (
            f"every estimate is {_shown(factor)} of its true value: is u scaled by {_shown(factor)}, or y by"
            f" {_shown(1.0 / factor)}, on the way into the device?"
        )


def _shown(factor: float) -> str:
    """Positive factor with at least three significant digits, without an exponent."""
    return f"{factor:.{max(0, 2 - math.floor(math.log10(factor)))}f}"
