"""Measured data that is not part of the repository: the Silverbox, imported, estimated, and as a twin.

Without the record the module is skipped; in CI it is then not collected (tests/conftest.py).
"""

from __future__ import annotations

from pathlib import Path

import pytest

from analogrig.cli import main
from analogrig.config import fixtures
from analogrig.judging.verdict import judge
from analogrig.reporting.measured import mode_of
from analogrig.rigs.emulator import ComputerDescription
from analogrig_emulator import load_patch
from analogrig_instruments.calibration.recorded_plant import RecordedPlant, fit_program
from tests.bench import bench_silverbox, silverbox

EXAMPLES = Path(__file__).parents[2] / "harness" / "examples"


def test_the_estimate_is_that_of_batch_least_squares() -> None:
    run = silverbox.import_record(bench_silverbox.ESTIMATED_N)
    played, expected = bench_silverbox.play(run, "least-squares"), bench_silverbox.batch(run)
    found = mode_of(played, played.theta[-1])
    assert found is not None
    assert found.resonance_hz == pytest.approx(expected.resonance_hz, rel=0.01)
    assert found.damping == pytest.approx(expected.damping, rel=0.03)
    assert expected.resonance_hz == pytest.approx(68.63, abs=0.01)
    assert expected.damping == pytest.approx(0.0478, abs=1e-4)
    assert judge(played).outcome == "unjudged"


def test_the_example_is_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example, recording = EXAMPLES / "silverbox", str(tmp_path / "silverbox.npz")
    settings = ["--map", str(example / "import.toml"), "--scenario", str(example / "silverbox.toml")]
    assert main(["import", str(silverbox.find_file()), *settings, "--out", recording]) == 0
    assert main(["replay", recording, "--dut", "inproc", "--out", str(tmp_path / "run")]) == 0
    told = capsys.readouterr().out
    assert "truth: that of scenario silverbox" in told
    assert "false alarms: none in 8000 samples" in told


def test_the_twin_fitted_to_the_multisines_simulates_the_arrow_head() -> None:
    program = load_patch(fixtures() / "programs" / "silverbox.toml")
    plant = RecordedPlant(program, silverbox.import_record(), ComputerDescription())
    twin = fit_program(plant, plant.span(*bench_silverbox.FITTED))
    assert plant.difference(twin.values, plant.span(0, silverbox.GROWTH_END)).rms < bench_silverbox.MOST_V
