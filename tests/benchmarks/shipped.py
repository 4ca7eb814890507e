"""Device ``inproc`` as shipped, without its line, for the benchmarks of the conditions that users meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from analogrig.answers import Answers, Samples
from analogrig.devices.direct import DirectDevice
from analogrig.devices.inproc import InprocDevice
from analogrig.run import Channel

from .played import CARD, FORCE, Played

ONSET_N, ONSET_SPAN_N = 2500, 400
"""Earliest sample of a change, and span of the instants. The device has settled, even if a fifth of the samples is
missing: its warm-up counts equations."""


@dataclass(frozen=True)
class Misfit:
    """Report of the device that its model does not describe the samples."""

    kind: str
    sample: int


def shipped() -> DirectDevice:
    """Device with its default settings."""
    device = InprocDevice(name="shipped").direct(alarms_only=True)
    assert isinstance(device, DirectDevice)
    low_v, lsb_v = CARD.ranges_v[FORCE][0], float(CARD.lsb_v[FORCE])
    device.prepare({"force": Channel(low_v, lsb_v, "N", 294.0, 1.0)}, 1.0 / CARD.rate_hz)
    return device


def settling_n(device: DirectDevice) -> int:
    """Samples from the start after which the promise on false alarms holds: the header states them."""
    return int(device.description()["estimator"]["warm_up_n"])


def reported_misfits(played: Played) -> Sequence[Misfit]:
    """Misfits that the device reports in a run, in the order of their samples.

    :raises LookupError: the device reports no misfits at all.
    """
    del played
    raise LookupError("the device reports no misfits")


def answers_to(device: DirectDevice, played: Played) -> Answers:
    """Answers of the device, started anew, to a run."""
    device.start()
    samples = Samples(0, played.u, played.y, played.valid)  # type: ignore[arg-type]  # up to 18 bits
    (answers,) = device.play([samples])
    return answers
