"""Gaps in measured data: they are neither scored, nor in the spectra, nor drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser

from analogrig.cli import main
from analogrig.judging.verdict import judge
from analogrig.reporting import render, write_report
from analogrig.reporting.measured import fits, measured, measured_response, spectrum
from analogrig.run import OUTPUT, Run
from tests.browser import Watched

SAMPLES = 1500
RATE_HZ = 2000.0

FAST, SLOW = np.exp(-1.0 / 3.0), np.exp(-1.0 / 20.0)
GAIN = 10.0 * (1.0 - FAST) * (1.0 - SLOW)

Values = NDArray[np.float64]


def square_wave() -> tuple[Values, Values]:
    """Square wave of 20 Hz at 2 kHz, and the response of two lags with a little noise."""
    rng = np.random.default_rng(10)
    u = np.where((np.arange(SAMPLES) // 50) % 2 == 0, 20.0, 0.0)
    y = np.zeros(SAMPLES)
    for k in range(2, SAMPLES):
        y[k] = (FAST + SLOW) * y[k - 1] - FAST * SLOW * y[k - 2] + GAIN * u[k - 1]
    return u + 0.01 * rng.normal(size=SAMPLES), y + 0.15 * rng.normal(size=SAMPLES)


def replayed(u: Values, y: Values, folder: Path) -> Run:
    """Run of ``inproc`` on these columns."""
    np.savez(folder / "a.npz", u=u, y=y)
    recording = str(folder / "recording.npz")
    named = ["--input", "u", "--output", "y", "--rate", "2000"]
    assert main(["import", str(folder / "a.npz"), *named, "--out", recording]) == 0
    assert main(["replay", recording, "--dut", "inproc", "--out", str(folder / "out")]) == 3
    return Run.load(folder / "out" / "run.npz")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return replayed(*square_wave(), tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module", params=["input", "output", "both"])
def gapped(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    u, y = square_wave()
    if request.param != "output":
        u[1275] = np.nan
    if request.param != "input":
        y[1230], y[1329:1334] = np.nan, np.inf
    return replayed(u, y, tmp_path_factory.mktemp("gapped"))


def test_missing_samples_do_not_change_the_fit(whole: Run, gapped: Run) -> None:
    (*_, expected), (*_, found) = fits(whole), fits(gapped)
    assert gapped.missing.any() and expected.simulated and found.simulated
    assert found.simulated == pytest.approx(expected.simulated, abs=0.005)
    assert found.predicted == pytest.approx(expected.predicted, abs=0.005)


def test_a_stretch_that_was_hardly_measured_has_no_fit(tmp_path: Path) -> None:
    u, y = square_wave()
    y[760:] = np.nan
    assert not fits(replayed(u, y, tmp_path))


def test_missing_samples_do_not_raise_the_spectra(whole: Run, gapped: Run) -> None:
    expected, found = spectrum(whole), spectrum(gapped)
    assert expected and found
    for one, other in (
        (expected.input_density, found.input_density),
        (expected.output_density, found.output_density),
    ):
        assert np.median(other) == pytest.approx(np.median(one), rel=0.5)
    assert np.isfinite(measured_response(found)).sum() == pytest.approx(
        np.isfinite(measured_response(expected)).sum(), abs=2
    )
    assert "Straight lines bridge" in render(gapped, judge(gapped))
    assert "Straight lines bridge" not in render(whole, judge(whole))


def test_a_long_gap_ends_the_stretch_of_a_spectrum(tmp_path: Path) -> None:
    u, y = square_wave()
    y[:2], y[500:517] = np.nan, np.nan
    found = spectrum(run := replayed(u, y, tmp_path))
    assert found and (found.start, found.end, found.bridged_n) == (517, SAMPLES, 0)
    figures = measured(run)
    assert figures and "those of samples 517 to 1499" in figures.gaps[0]


def test_a_response_is_measured_where_the_input_has_power(whole: Run) -> None:
    found = spectrum(whole)
    assert found
    z = np.exp(2j * np.pi * found.frequency_hz / RATE_HZ)
    true = np.abs(GAIN * z / ((z - FAST) * (z - SLOW)))
    off_db = 20.0 * np.log10(measured_response(found) / true)
    assert np.isfinite(off_db).sum() >= 10 and np.nanmax(off_db) < 12.0


def test_gaps_are_drawn_as_gaps(browser: Browser, tmp_path: Path) -> None:
    u, y = square_wave()
    y[:3], y[700] = np.nan, np.nan
    run = replayed(u, y, tmp_path)
    assert run.codes[700, OUTPUT] == run.codes[699, OUTPUT] and run.clipped[[0, 2, 700], OUTPUT].all()
    write_report(run, judge(run), tmp_path / "report.html")
    watched = Watched(browser, tmp_path / "report.html")
    drawn = _drawn_values(watched)
    assert [k for k, value in enumerate(drawn) if value is None] == [0, 1, 2, 700]
    assert watched.complaints == []


def _drawn_values(watched: Watched) -> list[Any]:
    """Values of the output in the first plot."""
    watched.plots()
    return list(watched.page.evaluate("uPlot.sync('run').plots[0].data[2]"))


def test_ticks_of_small_quantities_have_their_digits(browser: Browser, tmp_path: Path) -> None:
    u, y = square_wave()
    run = replayed(u * 5e-6, y * 1e-3, tmp_path)
    write_report(run, judge(run), tmp_path / "report.html")
    watched = Watched(browser, tmp_path / "report.html")
    watched.plots()
    for axis in (2, 3):
        labels = watched.page.evaluate(f"uPlot.sync('run').plots[0].axes[{axis}]._values")
        assert len(set(labels)) == len(labels) > 2
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'text-anchor="end"' in page.partition("<svg")[2].rpartition(">1000<")[0].rpartition("<text")[2]
