"""Misfits that a device reports: from the sample to the verdict, the summary, the page and the recording."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.catalogue import Cause
from analogrig.devices.registry import open_dut
from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.advice import advice
from analogrig.judging.verdict import CURES, NONLINEAR_CURE, MisfitPeriod, as_json, judge, misfit_periods
from analogrig.recordings import CanLog, import_run
from analogrig.reporting.page import render
from analogrig.reporting.run_summary import summary
from analogrig.rigs.description import open_rig
from analogrig.rigs.recording import RecordingRig
from analogrig.run import Run
from analogrig.scenario import Scenario
from analogrig_emulator import CHANNELS
from tests.harness.runs import ESTIMATOR, made_run

from .plants import front

HUM_HZ = 50.0
SAMPLES = 2500
SCENARIO = dataclasses.replace(Scenario.load("healthy"), samples=SAMPLES)
WATCHING = {**ESTIMATOR, "misfit": True}
FRONT = front(115.0, 3021.0, 24500.0)


@pytest.fixture(scope="module")
def disturbed() -> Run:
    """Recording of a healthy plant, with hum of a code on the displacement."""
    with open_rig("emulator") as rig, open_dut("inproc", exchange="block") as dut:
        run = Bench(rig, dut).play(SCENARIO, 7)
    codes = run.codes.copy()
    at = np.arange(SAMPLES) * run.conditions.sample_period_s
    hum = np.round(np.sin(2.0 * np.pi * HUM_HZ * at)).astype(np.int64)
    codes[:, CHANNELS.index("displacement")] = codes[:, CHANNELS.index("displacement")] + hum
    return dataclasses.replace(run, codes=codes)


def played(disturbed: Run, device: str, **changes: Any) -> Run:
    rig = RecordingRig.of(disturbed, Path("run.npz"))
    with rig, open_dut(device, **changes) as dut:
        return Bench(rig, dut).play(rig.scenario(), 7)


@pytest.mark.parametrize(
    ("device", "changes"),
    [("inproc", {}), ("inproc", {"exchange": "block"}), ("host", {"exchange": "block"})],
    ids=["in process", "in blocks", "over the serial executable"],
)
def test_hum_is_named_in_verdict_summary_and_page(
    disturbed: Run, device: str, changes: dict[str, Any], tmp_path: Path
) -> None:
    run = played(disturbed, device, **changes)
    run.save(tmp_path / "run.npz")
    run = Run.load(tmp_path / "run.npz")
    verdict = judge(run)
    assert verdict.fit is not None
    (period,) = verdict.fit
    assert (period.cause, period.end) == ("hum", SAMPLES)
    assert period.start < 2000
    assert period.frequency_hz == pytest.approx(HUM_HZ, rel=0.15)
    assert period.strength is not None
    assert period.strength > 1.0
    assert f"misfit: {period.text}" in summary(run, verdict)
    assert any("(hum)" in sentence and CURES["hum"] in sentence for sentence in advice(run, verdict))
    assert CURES["hum"] in render(run, verdict)
    (stated,) = as_json(verdict)["fit"]
    assert (stated["cause"], stated["start"], stated["cure"]) == ("hum", period.start, CURES["hum"])


def test_misfits_come_back_from_a_can_log(disturbed: Run, tmp_path: Path) -> None:
    log = CanLog(tmp_path / "can.log")
    log.begin()

    def listen(frame: can.Message) -> None:
        log(frame)

    run = played(disturbed, "inproc?link=can&bitrate=1000000", listener=listen)
    log.close()
    with open_rig("emulator") as rig:
        again = import_run(tmp_path / "can.log", SCENARIO, rig)
    assert len(run.misfit_index)
    for name in ("misfit_index", "misfit_cause", "misfit_frequency", "misfit_strength"):
        np.testing.assert_array_equal(getattr(again, name), getattr(run, name))


def test_device_that_fits_reports_nothing() -> None:
    with open_rig("emulator") as rig, open_dut("inproc", exchange="block") as dut:
        run = Bench(rig, dut).play(SCENARIO, 8)
    verdict = judge(run)
    assert verdict.fit == ()
    assert as_json(verdict)["fit"] == []
    assert "misfit" not in summary(run, verdict)
    assert "The device reported no misfit." in render(run, verdict)


def test_device_that_does_not_watch_is_not_judged() -> None:
    run = made_run(np.zeros(100), [(0, FRONT)])
    verdict = judge(run)
    assert verdict.fit is None
    assert as_json(verdict)["fit"] is None
    assert "the device does not watch whether its model fits" in render(run, verdict)


def test_period_ends_with_the_next_report_with_its_record_or_with_the_run() -> None:
    said = [(10, Cause.NOISE, 0.0, 2.0), (20, Cause.NONE, 0.0, 0.0), (30, Cause.DRIFT, 0.0, 0.0)]
    said += [(60, Cause.HUM, 0.0025, 3.0), (80, Cause.SLOW_PLANT, 0.0, 1.5)]
    run = made_run(np.zeros(100), [(0, FRONT)], misfits=said, estimator=WATCHING)
    run = dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, records=(0, 50)))
    assert misfit_periods(run) == (
        MisfitPeriod("noise", 10, 20, 2.0, None),
        MisfitPeriod("drift", 30, 50, None, None),
        MisfitPeriod("hum", 60, 80, 3.0, float(np.float32(0.0025)) / 5e-5),
        MisfitPeriod("slow plant", 80, 100, 1.5, None),
    )
    assert misfit_periods(run)[2].text == "hum at 50 Hz in samples 60-79"


def test_every_cause_has_a_cure() -> None:
    assert set(CURES) == {cause.name.lower().replace("_", " ") for cause in Cause if cause != Cause.NONE}


def test_advice_has_one_sentence_a_cause() -> None:
    said = [(10 * k, Cause.NOISE if k % 2 else Cause.NONE, 0.0, 2.0) for k in range(1, 8)]
    run = made_run(np.zeros(100), [(0, FRONT)], misfits=said, estimator=WATCHING)
    assert sum("(noise)" in sentence for sentence in advice(run, judge(run))) == 1


def test_a_nonlinear_plant_is_named_in_place_of_faults_of_the_rig() -> None:
    scenario = dataclasses.replace(Scenario.load("bump-stop"), samples=4000)
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        run = Bench(rig, dut).play(scenario, 8)
    verdict = judge(run)
    assert {period.cause for period in verdict.fit or ()} == {"nonlinear", "noise"}
    assert [fault.name for fault in verdict.channel_faults] == ["displacement offset"]
    said = advice(run, verdict)
    assert (
        f"the model does not fit (noise, nonlinear): alarms may be false, and changes missed; {NONLINEAR_CURE}" in said
    )
    assert any("(displacement offset)" in sentence and sentence.endswith(NONLINEAR_CURE) for sentence in said)
    assert not any(cure in sentence for sentence in said for cure in (CURES["hum"], CURES["noise"]))
    found = dataclasses.replace(verdict.channel_faults[0], name="displacement stuck")
    assert found.cure == "displacement: check its cable and its input"
    assert MisfitPeriod("excitation", 1, 2, None, None, beyond_model=True).cure == CURES["excitation"]


def test_a_failed_run_of_a_nonlinear_program_names_it() -> None:
    with open_rig("emulator") as rig, open_dut("inproc", estimator=EstimatorConfig(orders="program", arl0=1e5)) as dut:
        run = Bench(rig, dut).play(Scenario.load("van-der-pol"), 3)
    verdict = judge(run)
    assert verdict.outcome == "failed" and not verdict.fit
    text = "the program van-der-pol is not linear and has 2 states, the device's model is linear, of order 2: if it"
    assert any(sentence.startswith(text) for sentence in advice(run, verdict))
