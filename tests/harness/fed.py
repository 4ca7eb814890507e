"""Samples fed to a device of our catalogue without a bench."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analogrig.answers import RaisedAlarm, ReportedDiagnosis, Samples
from analogrig.devices.catalogue_device import CatalogueDevice
from analogrig.devices.device import Device


@dataclass(frozen=True, eq=False)
class Fed:
    """Answers that hold everything that our catalogue reports."""

    theta: NDArray[np.float32]
    innovation: NDArray[np.float32]
    statistic: NDArray[np.float32]
    flags: NDArray[np.uint8]
    alarms: tuple[RaisedAlarm, ...]
    diagnoses: tuple[ReportedDiagnosis, ...]


def fed(dut: Device, first: int, u: ArrayLike, y: ArrayLike, missing: ArrayLike) -> Fed:
    """Answers to one block of samples."""
    valid = ~np.asarray(missing, np.bool_)
    (answers,) = dut.play([Samples(first, np.asarray(u, np.uint16), np.asarray(y, np.uint16), valid)])
    assert answers.theta is not None
    assert answers.innovation is not None
    assert answers.statistic is not None
    alarms = tuple(RaisedAlarm(*each) for each in answers.alarms.tolist())
    diagnoses = tuple(ReportedDiagnosis(*each) for each in answers.diagnoses.tolist())
    return Fed(answers.theta, answers.innovation, answers.statistic, answers.flags, alarms, diagnoses)


def catalogue(device: Device) -> CatalogueDevice:
    """The device, which is one of our catalogue."""
    assert isinstance(device, CatalogueDevice)
    return device
