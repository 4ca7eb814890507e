"""The device in this process against the reference: every case, every misfit, every message, in float32 and float64."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.catalogue import Cause, SteppedFlag
from analogrig.devices.library import InprocDevice
from analogrig.estimator_config import EstimatorConfig
from analogrig.links.can_link import CanLink
from analogrig.rigs.description import open_rig
from analogrig.run import Run, missing_samples
from analogrig.testing.properties.cases import MISFITS, PlayedCase, SpoiledRig, U, Y
from analogrig.testing.properties.conversed import Talk, agrees, batches, largest_orders
from analogrig.testing.properties.scripts import SCRIPTS, DeviceBuild, Garbage, is_for
from tests.reference.cases import CASES, STATED
from tests.reference.comparison import differences, expected_of
from tests.reference.device import ReferenceDevice
from tests.reference.drawn import DRAWN, drawn
from tests.reference.fit import hum_in_block, stated_n
from tests.reference.settings import ReferenceSettings

pytestmark = pytest.mark.heavy

SEED = 1
TRIES = 40
"""Most seeds of a case. One play in two or more is judged: 40 seeds fail with a probability of 1e-12."""

FREQUENCY_UNITS, STRENGTH_UNITS, MISFIT_ROUNDING = 65_536, 256, 1e-3
"""Units of a Misfit, and largest deviation of its strength, relative to it."""

LINES: dict[str, dict[str, Any]] = {"serial": {}, "can": {"link": "can"}, "can fd": {"link": "can", "fd": True}}


def play(case: PlayedCase, seed: int) -> Run:
    """Run of the device with the settings of a case."""
    config = dataclasses.replace(EstimatorConfig(), **{"arl0": None, **case.settings})
    device = InprocDevice(name="inproc", exchange=case.exchange or "sample", estimator=config)
    with open_rig("emulator") as rig, device.connect() as dut:
        run = Bench(SpoiledRig(rig, case.spoil) if case.spoil else rig, dut).play(case.scenario, seed)
    assert run.conditions.faults == ()
    return run


def first_difference(case: PlayedCase, tries: int) -> str:
    """First difference from the reference; empty if there is none. Of ``tries`` seeds one has to be judged whole."""
    for seed in range(SEED, SEED + tries):
        run = play(case, seed)
        config = EstimatorConfig(**run.conditions.dut["estimator"])
        u, y = (np.ascontiguousarray(run.codes[:, channel]) for channel in (U, Y))
        expected = expected_of(config, u, y, ~missing_samples(run.clipped))
        wrong = next(differences(run, expected), "")
        if wrong or tries == 1 or not expected.is_doubtful:
            return wrong
    return f"rounding may decide a threshold in each of {tries} plays"


@pytest.mark.parametrize("case", CASES)
def test_device_and_reference_agree_in_named_cases(case: str) -> None:
    assert first_difference(CASES[case], TRIES) == ""


@pytest.mark.parametrize("number", DRAWN[:80] + DRAWN[160:])
def test_device_and_reference_agree_in_drawn_cases(number: int) -> None:
    assert first_difference(drawn(number), 1) == ""


@pytest.mark.parametrize("disturbance", STATED)
def test_misfits_are_stated_when_they_are_due(disturbance: str) -> None:
    case = MISFITS[disturbance]
    for seed in (SEED, SEED + 1):
        run = play(case, seed)
        due = [(stated_n(block), int(cause)) for block, cause in STATED[disturbance]]
        assert list(zip(run.misfit_index.tolist(), run.misfit_cause.tolist(), strict=True)) == due
        if "ceiling" in case.settings:
            check_hums(run, case, disturbance)


def check_hums(run: Run, case: PlayedCase, disturbance: str) -> None:
    """The hums that a run without alarms states are those in its innovations."""
    assert len(run.alarm_index) == 0
    used = (run.flags & (SteppedFlag.MISSING | SteppedFlag.REFUSED | SteppedFlag.GATHERING)) == 0
    reported = zip(STATED[disturbance], run.misfit_frequency.tolist(), run.misfit_strength.tolist(), strict=True)
    for (block, cause), frequency, strength in reported:
        if cause == Cause.HUM:
            due = hum_in_block(run.innovation.astype(np.float64), used, case.settings["noise_variance"], block)
            assert abs(frequency - due.frequency) < 1.0 / FREQUENCY_UNITS
            assert abs(strength - due.strength) < MISFIT_ROUNDING * due.strength + 1.0 / STRENGTH_UNITS


@pytest.mark.parametrize(
    ("script", "line"), [(script, line) for script in SCRIPTS for line in LINES if is_for(script, can=line != "serial")]
)
def test_device_answers_messages_as_the_reference(script: str, line: str) -> None:
    assert next(wrong_answers(InprocDevice(name="inproc", **LINES[line]), script), "") == ""


def wrong_answers(description: InprocDevice, script: str) -> Iterator[str]:
    """Differences from the answers of the reference."""
    with Talk.with_device(description) as talk:
        build = DeviceBuild(largest_orders(talk))
    with contextlib.closing(description.open_link()) as link:
        talk = Talk(link, description.timeout_s)
        device = ReferenceDevice(*talk.greet(), ReferenceSettings(build), on_can=isinstance(link, CanLink))
        for batch in batches(SCRIPTS[script](talk.numbers, build), in_blocks=talk.carries_blocks):
            if not isinstance(batch, list):
                talk.disturb(batch)
                if isinstance(batch, Garbage):
                    device.counters["frames_dropped"] += batch.dropped
                elif batch.counter:
                    device.counters[batch.counter] += 1
                continue
            talk.send(batch)
            for due in [answer for each in batch for answer in device.enter(each)]:
                found = talk.receive()
                if found is None or not agrees(found, due):
                    yield f"expected {due}, received {found}"
                    return
        if (more := talk.receive(timeout_s=0.0)) is not None:
            yield f"expected nothing, received {more}"
