"""The public interface takes values as files spell them, and paths as text."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import hypothesis
import pytest

from analogrig import Bench, ConfigurationError, Plant, PotChange, Program, Run, Scenario, judge, open_dut, open_rig
from analogrig.config import fixtures
from analogrig.reporting.page import write_report
from analogrig.scenario import Expectations
from analogrig.testing import strategies
from analogrig_emulator import Excitation

SQUARE = Excitation(low_v=0.0, high_v=8.0)
MOTOR = Program.load("dc-motor")
FILE = fixtures() / "programs" / "dc-motor.toml"
TABLE: Any = {"low_v": 0.0, "high_v": 8.0}

SPELT: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "program by its name": ({"program": "dc-motor"}, {"program": MOTOR}),
    "program by its file": ({"program": str(FILE)}, {"program": MOTOR}),
    "program by its path": ({"program": FILE}, {"program": MOTOR}),
    "program by its tables": ({"program": MOTOR.as_value()}, {"program": MOTOR}),
    "excitation as a table": ({"excitation": TABLE}, {"excitation": SQUARE}),
    "expectations as a table": ({"expect": {"missed": 1}}, {"expect": Expectations(missed=1)}),
    "change as a table": (
        {"program": "dc-motor", "changes": [{"sample": 50, "set": {"J": 1e-4}}]},
        {"program": MOTOR, "changes": (PotChange(50, {"J": 1e-4}),)},
    ),
    "changes as a list": (
        {"program": MOTOR, "changes": [PotChange(50, {"J": 1e-4})]},
        {"program": MOTOR, "changes": (PotChange(50, {"J": 1e-4}),)},
    ),
    "alias at the start": ({"set": {"stiffness_n_per_m": 2e4}}, {"set": {"K": 2e4}}),
    "alias in a change": (
        {"changes": [{"sample": 50, "stiffness_n_per_m": 2e4}]},
        {"changes": (PotChange(50, {"K": 2e4}),)},
    ),
}


@pytest.mark.parametrize("case", SPELT)
def test_scenario_takes_values_as_files_spell_them(case: str) -> None:
    spelt, typed = SPELT[case]
    defaults: dict[str, Any] = {"samples": 100, "excitation": SQUARE}
    assert Scenario(**(defaults | spelt)) == Scenario(**(defaults | typed))


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"program": "dc-moter"}, "no program is called 'dc-moter'"),
        ({"program": 7}, "program: must be a name, a .toml file, or a table, not 7"),
        ({"excitation": {"low": 0.0}}, "excitation: unknown key 'low'"),
        ({"expect": {"mised": 0}}, "expect: unknown key 'mised'"),
        ({"changes": [{"sample": 50, "sett": {}}]}, r"changes\[0\]: unknown key 'sett'"),
    ],
)
def test_wrong_spelling_is_one_line(wrong: dict[str, Any], why: str) -> None:
    values: dict[str, Any] = {"samples": 100, "excitation": SQUARE} | wrong
    with pytest.raises(ConfigurationError, match=f"^{why}"):
        Scenario(**values)


def test_programs_are_given_by_name_everywhere() -> None:
    assert Plant.of("dc-motor") == Plant.of(MOTOR)
    assert Scenario.of_program("dc-motor") == Scenario.of_program(MOTOR)
    still = dataclasses.replace(Scenario.load("thesis"), changes=())
    assert still.on_program("dc-motor") == still.on_program(MOTOR)
    assert hypothesis.find(strategies.plants("dc-motor"), lambda _: True) == Plant.of(MOTOR)


def test_paths_are_given_as_text_or_path(tmp_path: Path) -> None:
    named = Path(fixtures() / "scenarios" / "dc-motor.toml")
    assert Scenario.load(named) == Scenario.load(str(named))
    assert Program.load(FILE) == MOTOR
    with open_rig(fixtures() / "rigs" / "emulator.toml") as rig, open_dut(fixtures() / "devices" / "host.toml") as dut:
        run = Bench(rig, dut).play("shock", seed=1)
    run.save(str(tmp_path / "run.npz"))
    again = Run.load(str(tmp_path / "run.npz"))
    assert judge(again) == judge(Run.load(tmp_path / "run.npz"))
    write_report(again, judge(again), str(tmp_path / "page.html"))
    assert (tmp_path / "page.html").stat().st_size


def test_a_file_may_call_changes_tweaks(tmp_path: Path) -> None:
    texts = [
        f'samples = 100\nexcitation.shape = "square"\n[[{word}]]\nsample = 50\nset.K = 2e4\n'
        for word in ("changes", "tweaks")
    ]
    files = [tmp_path / "new.toml", tmp_path / "old.toml"]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    new, old = map(Scenario.load, files)
    assert old.changes == new.changes == (PotChange(50, {"K": 2e4}),)
