"""analogrig netlist: the deck that leaves the house is the machine that is played in it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig.cli import main
from analogrig.reporting.export import netlist
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]

LSB_V = 10.0 / 4096
SAMPLES = 150
SCENARIO = """
samples = 150
random_phase = true
[excitation]
clock = "free"
drift_ppm = 30.0
[[changes]]
sample = 60
stiffness_n_per_m = 18000.0
[[changes]]
sample = 100
mass_kg = 60.0
damping_n_s_per_m = 2500.0
"""


@pytest.fixture
def scenario(tmp_path: Path) -> str:
    (tmp_path / "short.toml").write_text(SCENARIO)
    return str(tmp_path / "short.toml")


def test_ngspice_runs_the_deck_of_a_scenario_and_agrees_at_every_sample(
    ngspice: NgSpice, scenario: str, tmp_path: Path
) -> None:
    what = ["--scenario", scenario, "--rig", "emulator", "--seed", "7"]
    assert main(["netlist", *what, "--out", str(tmp_path / "machine.cir")]) == 0
    assert main(["emulate", *what, "--out", str(tmp_path / "machine.npz")]) == 0
    reference = ngspice((tmp_path / "machine.cir").read_text(), ("in", "u5", "u2", "u1"), SAMPLES)
    volts = np.load(tmp_path / "machine.npz")["volts"]
    # The card reads the net force with its input turned round.
    assert np.abs(volts * (1, 1, 1, -1) - reference).max() < 0.05 * LSB_V


def test_engine_plays_the_deck_to_the_bit_as_the_rig_does(scenario: str, tmp_path: Path) -> None:
    assert main(["emulate", "--scenario", scenario, "--seed", "7", "--out", str(tmp_path / "machine.npz")]) == 0
    with open_rig("emulator") as rig:
        deck = netlist(rig, Scenario.load(scenario), 7)
    volts = np.load(tmp_path / "machine.npz")["volts"]
    assert np.array_equal(deck.volts(["in", "u5", "u2", "u1"]) * (1, 1, 1, -1), volts)


def test_json_names_the_file_or_holds_the_deck(
    scenario: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "machine.cir")
    assert main(["netlist", "--scenario", scenario, "--json", "--out", out]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told.pop("identity")["command"].startswith("analogrig netlist --scenario")
    assert told == {"file": out, "samples": SAMPLES, "seed": 1995}
    assert main(["netlist", "--scenario", scenario, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["deck"] == Path(out).read_text()


def test_a_scenario_that_the_machine_cannot_show_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "light.toml").write_text("samples = 10\n[excitation]\n[plant]\nmass_kg = 3.0\n")
    assert main(["netlist", "--scenario", str(tmp_path / "light.toml")]) == 2
    assert "pot M: coefficient" in capsys.readouterr().err
