"""The shipped properties find nothing where nothing was to be found: silence of a device that could say nothing."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any, cast

import pytest

from analogrig.bench import Bench
from analogrig.devices.library import InprocDevice
from analogrig.estimator_config import EstimatorConfig
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario
from analogrig.testing.properties.experiments import false_alarms_at_most, false_alarms_of_plants_rarer
from analogrig.testing.statement import Finding, Play


@dataclasses.dataclass
class Alone:
    """Part of the fixture ``hil_play`` that trials need."""

    bench: Bench

    def note(self, finding: Finding, seed: int) -> None:
        pass


CERTIFICATE: Callable[[Play], Finding] = lambda play: false_alarms_at_most(  # noqa: E731
    play, Scenario.load("healthy"), 0, allowed=5, samples=40_000, samples_each=2000
)
PLANTS: Callable[[Play], Finding] = lambda play: false_alarms_of_plants_rarer(  # noqa: E731
    play, Scenario.load("healthy"), 1, rate=1e-5, confidence=0.999, plants=4, samples_each=2000
)


@pytest.mark.parametrize("judge", [CERTIFICATE, PLANTS])
@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"warm_up_n": 65535}, "INCONCLUSIVE: the trigger was armed in none of 2000 samples: its warm-up takes 65535"),
        ({"warm_up_n": 1999}, "INCONCLUSIVE: the trigger was armed in none of 2000 samples"),
        ({"warm_up_n": 1500}, "INCONCLUSIVE: the trigger was armed in [0-9]+ of [0-9]+ samples"),
        ({"trigger": "none"}, "INCONCLUSIVE: the trigger was armed in none of 2000 samples: the device has no trigger"),
        ({}, "0 false alarms in "),
    ],
)
def test_silence_of_a_device_that_could_raise_no_alarm_is_no_evidence(
    judge: Callable[[Play], Finding], settings: dict[str, Any], why: str
) -> None:
    device = InprocDevice(name="inproc", estimator=EstimatorConfig(**settings))
    with open_rig("emulator") as rig, device.connect() as dut:
        finding = judge(cast(Play, Alone(Bench(rig, dut))))
    assert bool(finding) is not bool(settings)
    assert re.match(why, finding.why), finding.why
