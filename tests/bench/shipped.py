"""Device ``inproc`` as shipped, without its line, for the benchmarks of the conditions that users meet."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analogrig.answers import Answers, Samples
from analogrig.catalogue import Cause
from analogrig.devices.device import Device
from analogrig.devices.library import DirectDevice, InprocDevice
from analogrig.judging.exposure import count_armed
from analogrig.run import Channel

from .played import CARD, FORCE, Played

ONSET_N, ONSET_SPAN_N = 2500, 400
"""Earliest sample of a change, and span of the instants. The trigger is armed by then, even if a fifth of the samples
is missing: the warm-up counts equations."""

MOST_CODE = 65535
"""Largest code of a message."""


@dataclass(frozen=True)
class Misfit:
    """Report of the device that its model does not describe the samples."""

    kind: str
    sample: int


def shipped() -> DirectDevice:
    """Device with its default settings."""
    return direct(InprocDevice(name="shipped"))


def direct(description: InprocDevice) -> DirectDevice:
    """Device without its line, prepared for the card."""
    device = description.direct(alarms_only=True)
    assert isinstance(device, DirectDevice)
    _prepare(device)
    return device


def _prepare(device: Device) -> None:
    low_v, lsb_v = CARD.ranges_v[FORCE][0], float(CARD.lsb_v[FORCE])
    device.prepare({"u": Channel(low_v, lsb_v, "N", 294.0, 1.0)}, 1.0 / CARD.rate_hz)


def reported_misfits(played: Played) -> Sequence[Misfit]:
    """Misfits that the device reports in a run through its messages, in the order of their samples.

    :raises LookupError: the device reports no misfits, or the codes do not fit in its messages.
    """
    device = _behind_its_line()
    if not device.datasheet.misfits:
        raise LookupError("the device reports no misfits")
    if max(played.u.max(), played.y.max()) > MOST_CODE:
        raise LookupError(f"messages carry codes up to {MOST_CODE}")
    device.start()
    samples = Samples(0, played.u.astype(np.uint16), played.y.astype(np.uint16), played.valid)
    answers = list(device.play([samples]))
    device.stop()
    misfits = [each for part in answers for each in part.misfits if each.cause != Cause.NONE]
    return [Misfit(Cause(each.cause).name.lower().replace("_", "-"), each.index) for each in misfits]


@functools.cache
def _behind_its_line() -> Device:
    """Device with its default settings, behind its line; it reports no estimates."""
    device = InprocDevice(name="shipped", exchange="block", report_interval_n=60_000).open()
    _prepare(device)
    return device


def answers_to(device: DirectDevice, played: Played) -> Answers:
    """Answers of the device, started anew, to a run."""
    device.start()
    samples = Samples(0, played.u, played.y, played.valid)  # type: ignore[arg-type]  # up to 18 bits
    (answers,) = device.play([samples])
    return answers


def exposure_n(device: DirectDevice, played: Played, answers: Answers) -> int:
    """Samples of a run in which the trigger was armed."""
    are_finite = np.ones(len(played.u), np.bool_)
    alarms = np.array([alarm.index for alarm in answers.alarms], np.int64)
    driven: Any = played.u[None]  # up to 18 bits
    rows = driven, answers.flags[None], are_finite[None], [alarms]
    return int(count_armed(*rows, device.datasheet, CARD.noise_lsb[FORCE])[0][0, 0])
