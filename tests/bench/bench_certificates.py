"""Certificates of simulated devices at the limit and below it, with any dependence of alarms within a play.

python -m tests.bench certificates
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from analogrig.campaigns.certificate import ALLOWED
from analogrig.datasheet import DEFAULT_ARL0
from analogrig.judging.betting import quiet_plays
from analogrig.judging.bursts import BURST, Design, bound_rate
from analogrig.judging.statistics import lower_rate, upper_rate
from tests.harness.simulated_alarms import ARMED_N, BEYOND, COVERED, GAP_N, MOST, Kind, Law, bet, exposure_n

from .figure import Figure

DEVICES, NAMED_DEVICES = 20_000, 1000
"""Simulated devices of each kind, for betting and for the named bounds."""

FAR = 1.0 / DEFAULT_ARL0
"""Limit of the certificates, in false alarms per sample."""

CONFIDENCES = (0.95, 0.99, 0.999)

CONFIDENCE = 0.99
"""Confidence of the two-sided intervals of the table."""

BELOW: Mapping[str, tuple[Kind, float]] = {
    "independent, a tenth of the limit": (COVERED["independent"], 0.1 * FAR),
    "independent, half of the limit": (COVERED["independent"], 0.5 * FAR),
    "90 % single alarms, 10 % bursts of 41, a tenth of the limit": (
        BEYOND["90 % single alarms, 10 % bursts of 41"],
        0.1 * FAR,
    ),
}
"""Devices that deserve a certificate."""

COSTS = {
    f"no alarm, plays of {armed_n:,} armed samples, at most {most} in each": (most, armed_n)
    for most, armed_n in ((1, GAP_N + 1), (MOST, ARMED_N), (582, 582))
}
"""Most alarms and armed samples of the plays of devices that never alarm."""

NOTE = f"""\
Each share is the part of {DEVICES:,} simulated devices that is certified for {FAR:g} false alarms per
sample, with its {CONFIDENCE:.0%} confidence interval. In the column `bursts` it is of {NAMED_DEVICES:,} devices. The
devices of the first rows raise alarms at exactly this rate. At most 5, 1 and 0.1 % of them may be
certified, and at most 5 % refuted at 95 %. Devices have a hold-off of {GAP_N} samples and plays of
{ARMED_N:,} armed samples, in which {MOST} alarms have room. All tests look after every play, for as long as
the one at 99.9 %: three times the plays of a silent device.

The column `bursts` is `--bounds bursts`: bursts of {BURST:g} alarms on average are assumed. Its promise
does not cover the rows from `bursts of twenty` on.

All alarms in a thousandth of these short plays stand for all alarms in a tenth of long ones: each
such play has 24 alarms on average.

The lower rows give the mean number of armed samples until a certificate. The ratio is to the
exposure for independent alarms, a fixed length and no alarm. This is ln(1 / error) / limit, or
690,775 samples at 99.9 %. The last row is the default device, which has no hold-off."""


def figures() -> Iterator[Figure]:
    """Certified and refuted shares of each kind of device, and armed samples until a certificate."""
    for name, kind in {**COVERED, **BEYOND}.items():
        law = Law(kind, FAR)
        found = bet(law, FAR, CONFIDENCES, DEVICES)
        for confidence, each in zip(CONFIDENCES, found, strict=True):
            yield _share(f"{name}: {confidence * 100:g} %", int(np.isfinite(each.certified).sum()), DEVICES)
        yield _share(f"{name}: refuted, 95 %", int(np.isfinite(found[0].refuted).sum()), DEVICES)
        yield _share(f"{name}: bursts, 99.9 %", _certified_by_bursts(law, 0.999), NAMED_DEVICES)
    for name, (kind, rate) in BELOW.items():
        found = bet(Law(kind, rate), FAR, CONFIDENCES, DEVICES // 10)
        for confidence, each in zip(CONFIDENCES, found, strict=True):
            certified = each.certified[np.isfinite(each.certified)]
            yield _cost(f"{name}: {confidence * 100:g} %", float(certified.mean()) * ARMED_N, confidence)
    for name, (most, armed_n) in COSTS.items():
        for confidence in CONFIDENCES:
            samples = quiet_plays(FAR, confidence, most, armed_n) * armed_n
            yield _cost(f"{name}: {confidence * 100:g} %", samples, confidence)


def _certified_by_bursts(law: Law, confidence: float) -> int:
    """Devices that the test of fixed length certifies under the assumption of bursts."""
    rng, design = np.random.default_rng(0), Design(FAR, confidence, ALLOWED)
    plays, certified = math.ceil(design.trials / ARMED_N), 0
    for _ in range(NAMED_DEVICES):
        alarms = law.draw(rng, (plays,)) * (rng.random(plays) < law.chance)
        if alarms.sum() <= ALLOWED:  # more never certify
            bounds = bound_rate(alarms.tolist(), exposure_n(alarms).tolist(), confidence)
            certified += bounds.high <= FAR
    return certified


def _share(name: str, count: int, devices: int) -> Figure:
    each = 0.5 * (1.0 + CONFIDENCE)
    low, high = (bound(count, devices, each) for bound in (lower_rate, upper_rate))
    return Figure(name, 100.0 * count / devices, "%", bounds=(100.0 * low, 100.0 * high))


def _cost(name: str, samples: float, confidence: float) -> Figure:
    ratio = samples * FAR / -math.log1p(-confidence)
    return Figure(name, samples, "samples", f"{ratio:.3g} x")
