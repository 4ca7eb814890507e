"""A device that raises alarms and reports nothing else is judged in full on latency and false alarms."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from analogrig import Bench, Run, Scenario, judge, open_dut, open_rig, write_report
from analogrig.answers import Answers, RaisedAlarm, Samples
from analogrig.catalogue import SteppedFlag
from analogrig.datasheet import Datasheet, ModelOrders
from analogrig.devices.device import AdaptedDescription, Device
from analogrig.devices.library import Estimator
from analogrig.devices.pace import Pace
from analogrig.errors import DeviceRefused, RecordingError
from analogrig.judging.advice import advice
from analogrig.judging.exposure import exposure
from analogrig.judging.verdict import DIAGNOSES, ESTIMATES, STATISTIC, as_json
from analogrig.reporting.run_summary import summary
from analogrig.run import UNARMED

THESIS = Scenario.load("thesis")
STATED = Datasheet(warm_up_n=550, arl0=1e5, edge_codes=64.0, idle_n=1000)


@dataclass(frozen=True, kw_only=True)
class AlarmOnly(AdaptedDescription):
    """Our estimator, of which the harness learns nothing but the alarms and, if stated, the armed samples."""

    kind: ClassVar[str] = "alarm-only"
    usage: ClassVar[str] = "alarm-only"
    summary: ClassVar[str] = "alarms and nothing else"

    def open(self) -> Device:
        return _AlarmOnlyDevice(self)


class _AlarmOnlyDevice(Device):
    def recover(self) -> None:
        self._estimator = Estimator()

    def start(self, pace: Pace | None = None) -> None:  # noqa: ARG002
        self._estimator.restart()
        self._fed = 0

    def play(self, blocks: Iterable[Samples]) -> Iterator[Answers]:
        for block in blocks:
            steps = self._estimator.run(block.u, block.y, block.valid)
            flags = steps.flags & np.uint8(SteppedFlag.MISSING)
            if self.datasheet.armed:
                flags[np.arange(self._fed, self._fed + len(block)) < STATED.warm_up_n] |= UNARMED
            self._fed += len(block)
            yield Answers(flags, tuple(RaisedAlarm(block.first + int(index)) for index in steps.alarms))


def played(sheet: Datasheet = STATED) -> Run:
    with open_rig("emulator") as rig, AlarmOnly(name="bob", datasheet=sheet).connect() as dut:
        return Bench(rig, dut).play(THESIS, seed=7)


@pytest.fixture(scope="module")
def run() -> Run:
    return played()


@pytest.fixture(scope="module")
def ours() -> Run:
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        return Bench(rig, dut).play(THESIS, seed=7)


def test_alarms_are_judged_as_those_of_our_device(run: Run, ours: Run) -> None:
    verdict, reference = judge(run), judge(ours)
    assert verdict.outcome == "passed"
    assert verdict.alarm_hash == reference.alarm_hash
    for mine, other in zip(verdict.changes, reference.changes, strict=True):
        assert dataclasses.replace(other, diagnosis=None) == mine
    assert verdict.false_alarms == reference.false_alarms


def test_what_is_not_reported_is_not_judged_and_named(run: Run) -> None:
    verdict = judge(run)
    assert {ESTIMATES, STATISTIC, DIAGNOSES} < {*verdict.not_judged}
    assert verdict.theta_hash == ""
    assert verdict.ceiling is None
    assert all(segment.estimate is None for segment in verdict.estimates)
    assert as_json(verdict)["not_judged"] == [*verdict.not_judged]
    (note,) = advice(run, verdict)
    assert note.startswith("not judged, because the device does not report")
    text = summary(run, verdict)
    assert "alarm hash" in text
    assert "M [kg]" not in text


def test_stated_figures_stand_for_the_settings_of_our_estimator(run: Run, ours: Run) -> None:
    assert abs(exposure(run).armed - exposure(ours).armed) <= 16  # equations that its regressors await
    assert judge(run).arl0 == pytest.approx(1e5)
    assert judge(played(Datasheet(arl0=1e3))).arl0 == pytest.approx(1e3)


def test_device_that_reports_what_is_armed_needs_no_statement() -> None:
    run = played(Datasheet(armed=True))
    assert exposure(run).armed == run.samples - STATED.warm_up_n
    none = dataclasses.replace(run, flags=run.flags | np.uint8(UNARMED), alarm_index=run.alarm_index[:0])
    assert "reported it armed in none" in exposure(none).lack_of_evidence


def test_device_without_statements_is_exposed_in_every_sample() -> None:
    assert exposure(played(Datasheet())).armed >= THESIS.samples - 1


def test_run_is_kept_in_a_file(run: Run, tmp_path: Path) -> None:
    run.save(tmp_path / "run.npz")
    again = Run.load(tmp_path / "run.npz")
    assert judge(again) == judge(run)
    wider = dataclasses.replace(run, theta=np.zeros((run.samples, 3), np.float32))
    wider.save(tmp_path / "wider.npz")
    with pytest.raises(RecordingError, match="its theta do not fit together"):
        Run.load(tmp_path / "wider.npz")


def test_page_shows_what_there_is(run: Run, ours: Run, tmp_path: Path) -> None:
    for each, path in ((run, tmp_path / "alarms.html"), (ours, tmp_path / "ours.html")):
        write_report(each, judge(each), path)
    alarms, whole = ((tmp_path / name).read_text() for name in ("alarms.html", "ours.html"))
    for text in ("does not report estimates of them", "does not report diagnoses"):
        assert text in alarms
        assert text not in whole

    def columns(page: str) -> set[str]:
        data = json.loads(page.split('<script type="application/json" id="run">')[1].split("</script>", maxsplit=1)[0])
        return {column["name"] for column in data["columns"]}

    assert columns(whole) - columns(alarms) == {"M", "B", "K", "innovation", "statistic"}


def test_device_without_settings_refuses_them_by_name() -> None:
    with AlarmOnly(name="bob").connect() as dut, pytest.raises(DeviceRefused, match="^device bob: has no setting gain"):
        dut.configure(gain=1.0)
    with pytest.raises(ValueError, match="^settings: a device of the kind alarm-only has none"):
        AlarmOnly(name="bob", settings={"gain": 1.0})


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"warm_up_n": -1}, "warm_up_n must be 0 to"),
        ({"theta_n": 65}, "theta_n must be 0 to 64, not 65"),
        ({"theta_n": 4, "model": ModelOrders(2, 3)}, "model has 5 parameters, theta 4"),
        ({"arl0": 1.0}, "arl0 must be more than 1 sample"),
        ({"noise_variance": 0.0}, "noise_variance must be more than 0"),
        ({"is_ceiling_log_arl0": True}, "is_ceiling_log_arl0 needs a ceiling"),
        ({"edge_codes": -1.0}, "edge_codes must be 0 or more"),
    ],
)
def test_wrong_data_sheet_names_the_figure(wrong: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        dataclasses.replace(Datasheet(), **wrong)  # type: ignore[arg-type]


def test_theta_without_a_model_is_said() -> None:
    sheet = dataclasses.replace(STATED, theta_n=2)
    run = dataclasses.replace(played(), theta=np.zeros((THESIS.samples, 2), np.float32))
    described = {**run.conditions.dut, "datasheet": sheet.as_table()}
    run = dataclasses.replace(run, conditions=dataclasses.replace(run.conditions, dut=described))
    assert any("[datasheet.model]" in note for note in advice(run, judge(run)))
