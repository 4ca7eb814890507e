"""Memory and page of a long run: bounded by a few bytes a sample, and by 5 MB."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analogrig.config import locate
from analogrig.judging.verdict import judge
from analogrig.plant import Segment
from analogrig.reporting import render
from analogrig.reporting.payload import MOST_POINTS, Piece, condense, pieces
from analogrig.run import Run
from tests.harness.plants import front
from tests.harness.reported import Page
from tests.soak.long_runs import FIRM, long_run

MOST_BYTES_A_SAMPLE = 100
MOST_PAGE_BYTES = 5_000_000
PATIENCE_S = 1800.0
"""A machine may be loaded; the test waits for an event, not for the clock."""

MEASURED = """
import re, sys
from pathlib import Path
from analogrig.cli import main
status = main(sys.argv[2:])
peak = re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())
Path(sys.argv[1]).write_text(f"{status} {int(peak[1]) * 1024}")
"""
"""The peak of this very process: getrusage() of a child counts what its parent had when it forked."""

needs_proc = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc, that is Linux")


def peak_bytes(folder: Path, *arguments: str | Path) -> int:
    """Greatest resident memory of a command that runs to its end."""
    told = folder / "peak"
    command = [sys.executable, "-c", MEASURED, str(told), *map(str, arguments)]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("ANALOGRIG_")}
    environment |= {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    status, peak = map(int, told.read_text().split())
    assert status in {0, 1}, done.stderr
    return int(peak)


def healthy(folder: Path, samples: int) -> Path:
    path = folder / f"healthy-{samples}.toml"
    path.write_text(locate("scenarios", "healthy").read_text().replace("samples = 20000", f"samples = {samples}"))
    assert f"samples = {samples}" in path.read_text()
    return path


@pytest.mark.heavy
@needs_proc
@pytest.mark.timeout(2 * PATIENCE_S)
@pytest.mark.parametrize(("dut", "long"), [("inproc", 210_000), ("host", 210_000)])
def test_run_takes_at_most_a_hundred_bytes_a_sample(tmp_path: Path, dut: str, long: int) -> None:
    short = 110_000  # beyond what a page shows sample by sample, which takes more
    peaks = [
        peak_bytes(
            tmp_path,
            *("run", "--scenario", healthy(tmp_path, samples), "--dut", dut, "--out", tmp_path / str(samples)),
            *("--report-interval", "100", "--exchange", "stream"),  # the same arrays, with fewer messages and waits
        )
        for samples in (short, long)
    ]
    assert Run.load(tmp_path / str(long) / "run.npz").samples == long
    assert (peaks[1] - peaks[0]) / (long - short) <= MOST_BYTES_A_SAMPLE


@pytest.mark.heavy
@needs_proc
@pytest.mark.timeout(2 * PATIENCE_S)
@pytest.mark.parametrize("changes", [0, 2])
def test_judging_a_recording_takes_at_most_a_hundred_bytes_a_sample(tmp_path: Path, changes: int) -> None:
    short, long = 110_000, 510_000
    peaks = []
    for samples in (short, long):
        path = tmp_path / f"{samples}.npz"
        long_run(samples, changes=changes).save(path)
        peaks.append(peak_bytes(tmp_path, "judge", path, "--out", tmp_path / "judged"))
    assert (peaks[1] - peaks[0]) / (long - short) <= MOST_BYTES_A_SAMPLE


@pytest.mark.heavy
@pytest.mark.parametrize("samples", [100_000, 400_000, 2_000_000])
def test_page_has_at_most_five_megabytes(samples: int) -> None:
    run = long_run(samples)
    assert len(render(run, judge(run)).encode()) <= MOST_PAGE_BYTES


@pytest.mark.parametrize("alarms", [20_000, pytest.param(100_000, marks=pytest.mark.heavy)])
def test_page_of_many_false_alarms_changes_and_ramps_has_at_most_five_megabytes(alarms: int) -> None:
    run = long_run(2 * alarms, false_alarms=alarms, changes=300 * alarms // 100_000)
    verdict = judge(run)
    assert len(verdict.false_alarms) > 0.9 * alarms
    ramped = tuple(
        replace(segment, ramp_n=600 if segment.start else 0) for segment in run.conditions.segments
    )  # nearly all samples
    turning = replace(run, conditions=replace(run.conditions, segments=ramped))
    page = render(turning, verdict)
    assert len(page.encode()) <= MOST_PAGE_BYTES * min(1.0, 2 * alarms / MOST_POINTS)
    assert "alarms are marked" in Page(page).text


SPIKE_AT, SPIKED_SAMPLES = 123_457, 300_000
SIGNALS = ("force", "displacement", "velocity", "net_force")


@pytest.fixture(scope="module")
def spiked() -> Page:
    """Page of a long run with a spike in every signal, of a single sample."""
    run = long_run(SPIKED_SAMPLES, false_alarms=0, changes=0)
    run.codes[SPIKE_AT] = 4090
    run.statistic[SPIKE_AT] = 9e3
    run.theta[SPIKE_AT, 2:5] *= 0.9  # of the gain: mass and stiffness are more by a ninth
    return Page(render(run, judge(run)))


@pytest.mark.parametrize("name", [*SIGNALS, "statistic", "M"])
def test_spike_of_a_single_sample_is_in_the_page_of_a_long_run(spiked: Page, name: str) -> None:
    column = next(each for each in spiked.data()["columns"] if each["name"] == name)
    shown = spiked.columns()[name]
    if name in SIGNALS:
        assert np.nanmax(shown) == pytest.approx(column["offset"] + column["scale"] * 4090)
    elif name == "statistic":
        assert np.nanmax(shown) == 9e3
    else:
        assert np.nanmax(np.abs(shown - FIRM.parameters()["M"])) > 5.0  # noise alone: less than 2 kg
    assert len(shown) < 0.4 * SPIKED_SAMPLES


def test_clipped_and_missing_samples_are_in_the_page_of_a_long_run() -> None:
    at, samples = 123_457, 300_000
    run = long_run(samples, false_alarms=0, changes=0)
    run.codes[at, 1], run.clipped[at, 1] = 4095, True
    page = Page(render(run, judge(run)))
    columns = page.columns()
    assert columns["missing"].sum() == 2  # both points of one bucket
    (point,) = np.flatnonzero(columns["clipped"])
    assert columns["clipped"][point] == 2
    assert columns["displacement"][point] == columns["displacement"].max()


def test_short_run_is_shown_sample_by_sample() -> None:
    run = long_run(MOST_POINTS)
    page = Page(render(run, judge(run)))
    assert page.data()["pieces"] == [[0, MOST_POINTS, 1]]
    np.testing.assert_array_equal(page.columns()["statistic"], run.statistic.astype(float))
    assert "The run is long" not in page.text


def test_changes_and_alarms_of_a_long_run_are_shown_sample_by_sample() -> None:
    samples = 400_000
    run = long_run(samples)
    data = Page(render(run, judge(run))).data()
    whole = [range(start, end) for start, end, size in data["pieces"] if size == 1]
    for moment in (0, samples // 2, *run.alarm_index.tolist()):
        for near in (max(0, moment - 100), moment, moment + 100):
            assert any(near in span for span in whole), near
    assert [alarm["sample"] for alarm in data["alarms"]] == run.alarm_index.tolist()


@pytest.mark.parametrize("samples", [MOST_POINTS + 1, 100_003, 123_457, 1_000_000, 9_999_999])
@pytest.mark.parametrize("seed", range(4))
def test_pieces_hold_every_sample_once_and_few_points(samples: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    moments = rng.integers(0, samples, rng.choice([0, 1, 7, 3000])).tolist()
    found = pieces(samples, [0, samples - 1, *moments])
    assert [piece.start for piece in found] == [0, *(piece.end for piece in found[:-1])]
    assert found[-1].end == samples
    assert all((piece.end - piece.start) % piece.size != 1 for piece in found if piece.size > 1)
    assert sum(piece.points for piece in found) <= 1.1 * MOST_POINTS
    for piece in found:
        parts = list(piece.parts())
        assert [part.start for part in parts] == [piece.start, *(part.stop for part in parts[:-1])]
        assert parts[-1].stop == piece.end


def test_bucket_is_shown_by_its_least_and_greatest_finite_value() -> None:
    values = np.array([3.0, 1.0, np.nan, 7.0, np.inf, np.nan, np.nan, np.nan, 5.0, 4.0])
    np.testing.assert_array_equal(condense(values, 4), [1.0, 7.0, np.nan, np.nan, 4.0, 5.0])


def test_points_of_a_piece_are_counted_as_they_are_made() -> None:
    for piece in (Piece(0, 10, 4), Piece(3, 11, 4), Piece(0, 7, 1)):
        made = sum(len(condense(np.zeros(part.stop - part.start), piece.size)) for part in piece.parts())
        assert made == piece.points


def test_ramp_of_a_long_run_is_shown_in_bounded_steps() -> None:
    samples, ramp_n = 300_000, 200_000
    run = long_run(samples, changes=0)
    segments = (Segment(0, FIRM), Segment(50_000, front(115.0, 3021.0, 18000.0), ramp_n))
    data = Page(render(replace(run, conditions=replace(run.conditions, segments=segments)), judge(run))).data()
    assert len(data["segments"]) < 5_000
    stiffness = [segment["K"] for segment in data["segments"]]
    assert stiffness[0] == 24500.0
    assert stiffness[-1] == 18000.0
    assert max(-np.diff(stiffness)) < 2.0  # of 6500
