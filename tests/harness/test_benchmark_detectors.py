"""Machinery of the table of detectors, with few runs. Detectors of packages are tested where these are installed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tests.bench import bench_detectors, pages
from tests.bench.bench_detectors import CALIBRATION_SEED, QUICK, _arl0, _bench, _first_alarms, _play_change
from tests.bench.detectors import CANDIDATES, CHANGES

PRESENT = [name for name, candidate in CANDIDATES.items() if not candidate.missing]

COLUMNS = {"setting", "ARL0", "missed", "false alarms", "CPU time"}


@pytest.mark.parametrize("name", PRESENT)
def test_a_detector_yields_its_row(name: str) -> None:
    figures = bench_detectors.measure(name, QUICK)
    columns = {figure.name.removeprefix(f"{name}: ") for figure in figures}
    assert columns >= COLUMNS
    assert columns - COLUMNS <= {f"mean delay, {what}" for what in CHANGES}


@pytest.mark.parametrize("name", ["ours", "our estimator, prediction-error"])
def test_a_calibrated_level_has_the_arl0_on_the_runs_of_the_calibration(name: str) -> None:
    """The level comes from recorded statistics; the alarms of devices with that level must nearly agree.

    Nearly, because our estimator discards blocks whose sum comes near its ceiling.
    """
    candidate, seeds = CANDIDATES[name], range(CALIBRATION_SEED, CALIBRATION_SEED + QUICK.calibration_runs)
    level = bench_detectors.calibrate(candidate, QUICK)
    at, below = (_arl0(_first_alarms(candidate, each, seeds, QUICK), QUICK)[0] for each in (level, level / 1.01))
    assert 0.9 * below < QUICK.arl0 <= 1.1 * at


def test_arl0_is_exposure_over_alarms() -> None:
    arl0, (low, high), alarms, exposure = _arl0(np.array([9, 500, 89]), QUICK)
    assert (alarms, exposure) == (2, 600) and arl0 == 300.0
    assert low < arl0 < high


def test_the_glr_test_detects_every_change_at_once_and_then_follows_the_plant() -> None:
    bench = _bench(CANDIDATES["GLR that knows the plants"], 15.0)
    for what in CHANGES:
        for trial in range(2):
            found = _play_change(bench, what, trial, dataclasses.replace(QUICK, arl0=1e4))
            assert found.latency_n is not None and found.latency_n <= found.bound_n + 4
            assert (found.before, found.after) == (0, 0)


def test_absent_packages_are_named_with_their_cure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    absent = dataclasses.replace(CANDIDATES["ours"], packages=("no_such_package",))
    monkeypatch.setitem(CANDIDATES, "ours", absent)
    assert not list(bench_detectors.figures(QUICK, ["ours"], jobs=1))
    line = capsys.readouterr().out
    assert line.startswith("absent: no_such_package: .venv/bin/pip install ") and line.count("\n") == 1


def test_the_page_has_a_row_for_each_detector(tmp_path: Path) -> None:
    entries = [
        {"name": "a: ARL0", "value": 900.0, "unit": "samples", "bounds": (800.0, 1100.0), "compared_with": "9 alarms"},
        {"name": "a: CPU time", "value": 0.5, "unit": "us", "measured": "today"},
        {"name": "b: CPU time", "value": 2.0, "unit": "us", "measured": "today"},
    ]
    page = pages.write("detectors", entries, tmp_path).read_text()
    assert [line for line in page.splitlines() if line.startswith("|")] == [
        "|  | ARL0 | CPU time | measured |",
        "|---|---|---|---|",
        "| a | 900 samples (800 to 1100, 9 alarms) | 0.5 us | today |",
        "| b |  | 2 us | today |",
    ]
