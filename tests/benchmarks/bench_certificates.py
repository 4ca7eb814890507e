"""Certificates of simulated devices at the limit and below it, whose alarms are independent, bursty or periodic.

python -m tests.benchmarks certificates
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from analogrig.campaigns.certificate import Question
from analogrig.campaigns.plan import rig_table
from analogrig.devices.registry import describe
from analogrig.judging.statistics import lower_rate, upper_rate
from analogrig.scenario import Scenario
from tests.harness.simulated_alarms import BEYOND, COVERED, Kind, certificates

from .figure import Figure

DEVICES = 1000
"""Simulated devices of each kind; seeds from 0 on."""

FAR = 1e-5
"""Limit of the certificates, in false alarms per sample."""

PROCESSES = 2

CONFIDENCE = 0.99
"""Confidence of the two-sided intervals of the table."""

SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "90 %": {"confidence": 0.9},
    "95 %": {"confidence": 0.95},
    "99 %": {"confidence": 0.99},
    "99.9 %": {"confidence": 0.999},
    "95 %, sequential": {"confidence": 0.95, "sequential": True},
    "95 %, burst 1": {"confidence": 0.95, "burst": 1.0},
}
"""Settings of the certificates; the others are the defaults."""

REFUTED = "95 %"
"""Setting of which the refuted devices are counted as well."""

BELOW: Mapping[str, tuple[Kind, float]] = {
    "independent, a tenth of the limit": (COVERED["independent"], 0.1 * FAR),
    "independent, a thirtieth of the limit": (COVERED["independent"], FAR / 30.0),
    "bursts of five, a tenth of the limit": (COVERED["bursts of five"], 0.1 * FAR),
}
"""Devices that deserve a certificate."""

NOTE = f"""\
Each cell is the share of {DEVICES} simulated devices that is certified for {FAR:g} false alarms per
sample, with its {CONFIDENCE:.0%} confidence interval. The seeds are 0 to {DEVICES - 1}. The devices of the first
rows raise alarms at exactly this rate: at most 10, 5, 1 and 0.1 % of them may be certified.

Rows `not covered` break the assumption of bursts of five alarms on average, which no data replace.
The last rows are devices below the limit, and show the power. The column `burst 1` takes alarms as
independent, apart from bursts that the counts of the plays show. The column `refuted` counts
devices that are called worse than the limit."""


KINDS = {**{name: (kind, FAR) for name, kind in {**COVERED, **BEYOND}.items()}, **BELOW}
"""Every kind of device, with its false-alarm rate."""


def figures() -> Iterator[Figure]:
    """Certified and refuted shares of each kind of device."""
    with ProcessPoolExecutor(PROCESSES) as pool:
        for measured in pool.map(_figures, KINDS):
            yield from measured


def _figures(name: str) -> list[Figure]:
    """Figures of one kind of device."""
    kind, rate = KINDS[name]
    outcomes = {setting: certificates(_question(values), kind, rate, DEVICES) for setting, values in SETTINGS.items()}
    shares = [_share(f"{name}: {setting}", found, "certified") for setting, found in outcomes.items()]
    return [*shares, _share(f"{name}: refuted, {REFUTED}", outcomes[REFUTED], "refuted")]


def _question(settings: Mapping[str, Any]) -> Question:
    tables = rig_table("emulator"), describe("inproc").as_table()
    return Question(*tables, Scenario.load("healthy"), far=FAR, **settings)


def _share(name: str, outcomes: Counter[str], outcome: str) -> Figure:
    each = 0.5 * (1.0 + CONFIDENCE)
    low, high = (bound(outcomes[outcome], DEVICES, each) for bound in (lower_rate, upper_rate))
    return Figure(name, 100.0 * outcomes[outcome] / DEVICES, "%", bounds=(100.0 * low, 100.0 * high))
