"""Overload lamps on their way from the rig to whoever reads the result."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from analogrig import cli
from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.judging.advice import advice
from analogrig.judging.verdict import as_json, judge
from analogrig.reporting import render
from analogrig.reporting.run_summary import summary
from analogrig.rigs.description import open_rig
from analogrig.rigs.recording import RecordingRig
from analogrig.run import Run
from analogrig.scenario import Scenario
from tests.harness.reported import Page, reported_run, reported_verdict

OVERLOADING = """
samples = 120
description = "a force that falls by 20 V asks -20 V of the summer at sample 50"

[excitation]
low_v = -10.0
high_v = 10.0
"""


@pytest.fixture(scope="module")
def scenario_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("overload") / "overloading.toml"
    path.write_text(OVERLOADING)
    return path


@pytest.fixture(scope="module")
def run(scenario_file: Path) -> Run:
    with open_rig("emulator") as rig, open_dut("host") as dut:
        return Bench(rig, dut).play(Scenario.load(str(scenario_file)), 1)


def test_run_knows_which_lamp_lit_at_which_sample(run: Run) -> None:
    """The edge is at sample 50, the lamp lights 10 us (0.2 samples) later: sample 51 is the first taken with it lit."""
    assert run.conditions.overloads == {"U1": 51}


def test_lamps_survive_saving_loading_and_replay(run: Run, tmp_path: Path) -> None:
    run.save(tmp_path / "run.npz")
    rig = RecordingRig.open(tmp_path / "run.npz")
    assert rig.run.conditions.overloads == {"U1": 51}
    with open_dut("host") as dut:
        again = Bench(rig, dut).play(rig.scenario(), rig.run.conditions.seed)
    assert again.conditions.overloads == {"U1": 51}


def test_verdict_summary_and_advice_name_the_amplifier(run: Run) -> None:
    verdict = judge(run)
    assert json.loads(json.dumps(as_json(verdict)))["overloads"] == {"U1": 51}
    assert "overload lamps: U1 from sample 51" in summary(run, verdict)
    assert advice(run, verdict)[0].startswith("U1 overloaded from sample 51 on")


def test_lamp_counts_the_samples_of_the_card_when_the_machine_runs_faster(scenario_file: Path, tmp_path: Path) -> None:
    """A skew of a fifth of a sample makes the machine take five instants a sample."""
    rig_file = (
        Path("fixtures/rigs/emulator.toml")
        .read_text()
        .replace("[card]", "[card]\nfaults = { skew_s = [0.0, 10e-6, 0.0, 0.0] }")
    )
    (tmp_path / "skewed.toml").write_text(rig_file)
    with open_rig(str(tmp_path / "skewed.toml")) as rig:
        performance = rig.perform(Scenario.load(str(scenario_file)), 1)
        assert not performance.hindsight().lamps
        list(performance.blocks)
        assert performance.hindsight().lamps == {"U1": 51}


def test_healthy_run_says_nothing_of_lamps(recorded_thesis: Path) -> None:
    healthy = Run.load(recorded_thesis)
    assert healthy.conditions.overloads == {}
    assert "overload" not in summary(healthy, judge(healthy))


def test_report_has_a_line_and_a_mark(run: Run) -> None:
    del run
    shown = reported_run()
    read = Page(render(shown, dataclasses.replace(reported_verdict(shown), overloads={"U2": 70, "U1": 51})))
    assert read.value("Overload lamps") == "U1 from sample 51, U2 from sample 70"
    assert read.data()["overloads"] == [{"sample": 51, "label": "U1"}, {"sample": 70, "label": "U2"}]


def test_emulate_shows_them(scenario_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["emulate", "--scenario", str(scenario_file), "--out", str(tmp_path / "signals.csv")]
    assert cli.main(arguments) == 0
    assert "overload lamps: U1 from sample 51" in capsys.readouterr().out
    assert cli.main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["overloads"] == {"U1": 51}
