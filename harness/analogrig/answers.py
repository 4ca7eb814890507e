"""Samples to a device, and its answers: what passes between the bench and every device."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
"""Largest magnitude of a reported quantity."""


@dataclass(frozen=True, eq=False)
class Samples:
    """n consecutive samples; all arrays are (n,)."""

    first: int
    """Index of the first sample, from 0 in each record. A device takes skipped indices as missing samples."""
    u: NDArray[np.uint16]
    """Input of the plant (force) in codes."""
    y: NDArray[np.uint16]
    """Output of the plant (displacement) in codes."""
    valid: NDArray[np.bool_]
    """False where the sample is missing; u and y mean nothing there."""

    def __len__(self) -> int:
        return len(self.u)

    def skipped_after(self, next_index: int) -> int:
        """Number of samples from ``next_index`` to the first.

        :raises ValueError: the first has been sent before.
        """
        if self.first < next_index:
            raise ValueError(f"sample {self.first} comes again: the next one is {next_index}")
        return self.first - next_index


@dataclass(frozen=True)
class RaisedAlarm:
    """An alarm of the device."""

    index: int
    """Sample after which it was raised, counted from the start of the record without wrap-around."""
    kind: int = 0
    """Trigger of the catalogue that raised it; 0 for a device with triggers of its own."""
    statistic: float = 0.0
    """Statistic of the trigger; 0.0 if the device does not report it."""


@dataclass(frozen=True)
class ReportedDiagnosis:
    """A diagnosis of the device: the parameter that has changed, or the fault of a channel."""

    index: int
    """Sample after which it was sent, counted, like ``onset``, from the start of the record without wrap-around."""
    change: int
    """Change of the catalogue."""
    onset: int
    """Most likely sample of the change; that of the alarm if several parameters have changed."""
    extent: float
    """Parameter, or gain of a channel, after the change over that before; 1 for all other changes."""


@dataclass(frozen=True)
class ReportedMisfit:
    """A change of the cause of a poor fit, as the device reports it."""

    index: int
    """Sample after which it was found, counted from the start of the record without wrap-around."""
    cause: int
    """Cause of the catalogue; NONE: the model fits again."""
    frequency: float = 0.0
    """Frequency of the disturbance in cycles per sample; 0 unless the cause is HUM."""
    strength: float = 0.0
    """Statistic over its limit; 0 if the device does not report it."""


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers to the n oldest unanswered samples, with p parameters.

    None stands for a quantity that the device does not report (``Datasheet``).
    """

    flags: NDArray[np.uint8]
    """(n,): SteppedFlag of the catalogue, LOST, UNREPORTED and UNARMED of ``analogrig.run``."""
    alarms: tuple[RaisedAlarm, ...] = ()
    """In ascending order."""
    theta: NDArray[np.float32] | None = None
    """(n, p): the estimate after each sample, in codes."""
    innovation: NDArray[np.float32] | None = None
    """(n,) codes."""
    statistic: NDArray[np.float32] | None = None
    """(n,): of the trigger."""
    diagnoses: tuple[ReportedDiagnosis, ...] = ()
    misfits: tuple[ReportedMisfit, ...] = ()
    """In ascending order."""

    def __len__(self) -> int:
        return len(self.flags)

    def shifted(self, first: int) -> Self:
        """The same answers with ``first`` added to every sample index."""
        if not first:
            return self
        return dataclasses.replace(
            self,
            alarms=tuple(dataclasses.replace(alarm, index=first + alarm.index) for alarm in self.alarms),
            diagnoses=tuple(
                dataclasses.replace(each, index=first + each.index, onset=first + each.onset) for each in self.diagnoses
            ),
            misfits=tuple(dataclasses.replace(each, index=first + each.index) for each in self.misfits),
        )
