"""In which samples a false alarm could have come: the exposure, of which every rate of false alarms is one.

A device that is warming up, is held off after an alarm, has no equation for want of the samples before, or is not
excited, raises no alarm whatever it is worth: its silence is no evidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import SteppedFlag
from analogrig.run import CHANNELS, CHUNK_SAMPLES, LOST, Run
from analogrig.wording import number_of

EDGE_NOISES = 9.0
"""Of the noise of the force: less is no edge, whatever the device takes for one. By chance two samples differ as much
once in 5e9 times."""

_QUANTISATION_LSB = 12.0**-0.5

_FORCE = CHANNELS.index("force")

_NOT_PROCESSED = SteppedFlag.MISSING | SteppedFlag.REFUSED | LOST


@dataclass(frozen=True)
class Exposure:
    """Of one run."""

    samples: int
    armed: int
    """Samples in which the trigger was armed."""
    unexcited: int
    """Samples before the force had moved, or after its edges had ceased."""
    non_finite: int
    """Samples after which estimate, innovation or statistic was no number, without an alarm."""
    estimator: Mapping[str, Any]
    """The device's settings, as ``EstimatorConfig.as_table`` gives them."""

    @property
    def lack_of_evidence(self) -> str:
        """Why its silence is no evidence of anything, in one line; empty if it is."""
        of = number_of(self.samples, "sample")
        if self.non_finite:
            return f"in {self.non_finite} of {of} what the device estimated was no number"
        return "" if self.armed else f"no alarm could come in any of {of}: {self._unarmed_reason()}"

    def _unarmed_reason(self) -> str:
        if self.estimator.get("trigger") == "none":
            return "the device has no trigger"
        if 2 * self.unexcited <= self.samples:
            return f"its warm-up takes {self.estimator.get('warm_up_n', 0)}"
        edge_codes, idle_n = self.estimator.get("edge_codes", 0.0), self.estimator.get("idle_n", 0)
        return (
            f"in {self.unexcited} it was not excited (the force had no edge of {edge_codes:g} codes, or none for"
            f" {number_of(idle_n, 'sample')})"
        )


@dataclass(frozen=True, eq=False)
class ObservedRecord:
    """What is known of one record of n samples, from the first on."""

    force: NDArray[np.uint16]
    """(n,) codes."""
    flags: NDArray[np.uint8]
    """(n,) as of a Run."""
    are_numbers: NDArray[np.bool_]
    """(n,): estimate, innovation and statistic are numbers."""
    alarms: NDArray[np.int64]
    """(a,) the samples with an alarm; each was armed, whatever else is known of it."""


def exposure(run: Run) -> Exposure:
    """Of all records, each of which is a run of its own to the device."""
    estimator, noise_lsb = run.conditions.dut["estimator"], run.conditions.channels["force"].noise_lsb
    numbers = np.isfinite(run.innovation) & np.isfinite(run.statistic)
    for column in run.theta.T:
        numbers &= np.isfinite(column)
    parts = [
        record_exposure(
            ObservedRecord(
                run.codes[start:end, _FORCE],
                run.flags[start:end],
                numbers[start:end],
                run.alarm_index[(run.alarm_index >= start) & (run.alarm_index < end)] - start,
            ),
            estimator,
            noise_lsb,
        )
        for start, end in run.records
    ]
    armed, unexcited, non_finite = (
        sum(getattr(part, name) for part in parts) for name in ("armed", "unexcited", "non_finite")
    )
    return Exposure(run.samples, armed, unexcited, non_finite, estimator)


def record_exposure(heard: ObservedRecord, estimator: Mapping[str, Any], noise_lsb: float) -> Exposure:
    """Of one record; ``noise_lsb`` is that of the force."""
    known = (heard.flags & _NOT_PROCESSED) == 0
    edge_codes = float(estimator.get("edge_codes", 0.0))
    if edge_codes:
        edge_codes = max(edge_codes, EDGE_NOISES * math.hypot(noise_lsb, _QUANTISATION_LSB))
    excited = _excitation_mask(heard.force, known, edge_codes, int(estimator.get("idle_n", 0)))
    excited &= (heard.flags & SteppedFlag.IDLE) == 0
    watched = _beyond_hold_off(known & ((heard.flags & SteppedFlag.GATHERING) == 0), heard.alarms, estimator)
    armed = watched & excited & heard.are_numbers & (estimator.get("trigger") != "none")
    armed[heard.alarms] = True
    non_finite = ~heard.are_numbers
    non_finite[heard.alarms] = False  # which is what it should say of them
    return Exposure(len(armed), int(armed.sum()), int((~excited).sum()), int(non_finite.sum()), estimator)


def _excitation_mask(
    force: NDArray[np.uint16], heard: NDArray[np.bool_], edge_codes: float, idle_n: int
) -> NDArray[np.bool_]:
    """(n,): the force has moved by what is an edge, and the last edge was not too long ago."""
    codes = force.astype(np.int32)
    edges = np.flatnonzero((np.abs(np.diff(codes)) >= edge_codes) & heard[1:] & heard[:-1]) + 1
    excited = np.ones(len(codes), np.bool_)
    if len(edges):
        excited[: edges[0]] = False
    else:
        known = codes[heard]
        excited[heard] = np.maximum.accumulate(known) - np.minimum.accumulate(known) >= edge_codes
    if idle_n:
        bounds = np.concatenate(([0], edges, [len(codes)]))
        for i in np.flatnonzero(np.diff(bounds) > idle_n).tolist():
            idle = slice(bounds[i], bounds[i + 1])
            excited[idle] &= np.cumsum(heard[idle], dtype=np.int32) - heard[bounds[i]] < idle_n
    return excited


def _beyond_hold_off(
    equations: NDArray[np.bool_], alarms: NDArray[np.int64], estimator: Mapping[str, Any]
) -> NDArray[np.bool_]:
    """(n,): of the samples with an equation those beyond warm-up and hold-off, which count equations."""
    count = np.cumsum(equations, dtype=np.int32)
    watched = equations & (count > int(estimator.get("warm_up_n", 0)))
    hold_off_n = int(estimator.get("hold_off_n", 0))
    if hold_off_n and len(alarms):
        for first in range(0, len(count), CHUNK_SAMPLES):
            part = slice(first, min(first + CHUNK_SAMPLES, len(count)))
            last = np.searchsorted(alarms, np.arange(part.start, part.stop)) - 1  # of the alarms before the sample
            watched[part] &= (last < 0) | (count[part] > count[alarms[last]] + hold_off_n)
    return watched
