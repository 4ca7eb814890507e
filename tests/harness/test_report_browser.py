"""The page in a real browser: whatever only a browser can tell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from analogrig.judging.verdict import Verdict, judge
from analogrig.reporting import write_report
from analogrig.run import Run
from tests.browser import Watched
from tests.harness.reported import NOTICED, empty_run, reported_run, reported_verdict
from tests.harness.runs import with_fault
from tests.soak.long_runs import long_run

PLOTS = 7
FORCE, MASS, STIFFNESS, INNOVATION, STATISTIC = 0, 2, 4, 5, 6

LONG = 90_000
"""Samples of a run whose plots show minima and maxima of several samples."""

ALARM, FALSE_ALARM, MISSING = (0, 158, 115), (213, 94, 0), (86, 180, 233)
"""Bluish green, vermilion and sky blue of Okabe and Ito."""


@pytest.fixture(scope="module")
def run() -> Run:
    return reported_run()


@pytest.fixture(scope="module")
def report(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(run, reported_verdict(run), path)
    return path


@pytest.fixture
def opened(browser: Browser, report: Path) -> Iterator[Watched]:
    watched = Watched(browser, report)
    yield watched
    watched.page.close()


def test_every_plot_is_drawn_without_a_complaint_or_a_request(opened: Watched) -> None:
    assert len(opened.plots()) == PLOTS
    assert min(opened.pixels((0, 114, 178))) > 100  # the first signal of each
    assert opened.complaints == []
    assert [url.rpartition("/")[2] for url in opened.requests] == ["report.html"]


def test_alarms_are_marked_in_every_plot(opened: Watched) -> None:
    assert min(opened.pixels(ALARM)) > 20  # a flag at the least, where a signal hides the line
    assert min(opened.pixels(FALSE_ALARM)) > 20
    assert min(opened.pixels(MISSING)) > 50


def test_run_without_alarms_and_gaps_shows_no_such_mark(browser: Browser, run: Run, tmp_path: Path) -> None:
    quiet = replace(
        run,
        clipped=run.clipped & False,
        alarm_index=run.alarm_index[:0],
        alarm_kind=run.alarm_kind[:0],
        alarm_statistic=run.alarm_statistic[:0],
    )
    watched = _open(browser, quiet, replace(reported_verdict(run), false_alarms=()), tmp_path)
    for colour in (ALARM, FALSE_ALARM, MISSING):
        assert watched.pixels(colour) == [0] * PLOTS


def test_drag_zooms_every_plot_and_double_click_shows_the_whole_run_again(opened: Watched) -> None:
    whole = opened.images()
    opened.drag(MASS, 0.2, 0.5)
    zoomed = opened.images()
    assert all(before != after for before, after in zip(whole, zoomed, strict=True))
    opened.page.locator(".u-over").nth(FORCE).dblclick()
    opened.page.mouse.move(0, 0)
    assert opened.images() == whole


def test_button_shows_the_whole_run_again(opened: Watched) -> None:
    whole = opened.images()
    opened.drag(STATISTIC, 0.6, 0.8)
    opened.page.get_by_role("button", name="Whole run").click()
    assert opened.images() == whole


def test_drag_with_shift_wheel_and_keys_move_every_plot_within_the_run(opened: Watched) -> None:
    opened.page.get_by_role("button", name="1200", exact=True).click()
    opened.page.keyboard.down("Shift")
    opened.drag(MASS, 0.5, 0.75)
    opened.page.keyboard.up("Shift")
    assert _shown(opened) == (1130, 1250)
    opened.point_at(STATISTIC, 0.5)
    opened.page.mouse.wheel(_width(opened) / 2, 0)
    assert _shown(opened) == (1190, 1310)
    opened.page.locator("figure.plot").nth(INNOVATION).focus()
    for key, expected in (("ArrowLeft", (1160, 1280)), ("Home", (0, 120)), ("ArrowLeft", (0, 120)), ("0", (0, 1799))):
        opened.page.keyboard.press(key)
        assert _shown(opened) == expected
    opened.page.keyboard.press("+")
    assert _shown(opened) == (180, 1619)
    opened.page.keyboard.press("End")
    opened.page.keyboard.press("-")
    assert _shown(opened) == (180, 1799)


def test_pointer_reads_the_innovation_in_codes(opened: Watched, run: Run) -> None:
    opened.page.get_by_role("button", name="1200", exact=True).click()
    opened.point_at(INNOVATION, 0.5)
    sample, innovation = opened.values(INNOVATION)
    assert _number(innovation, "codes") == pytest.approx(float(run.innovation[int(sample.replace(",", ""))]), abs=1e-4)


def test_row_of_a_change_takes_all_plots_there(opened: Watched) -> None:
    opened.page.get_by_role("button", name="1200", exact=True).click()
    opened.point_at(MASS, 0.0)
    assert [opened.values(plot)[0] for plot in range(PLOTS)] == ["1,160"] * PLOTS
    opened.point_at(MASS, 0.999)
    assert opened.values(STIFFNESS)[0] == "1,280"


def test_pointer_in_one_plot_reads_the_values_of_all(opened: Watched, run: Run) -> None:
    opened.page.get_by_role("button", name="0–1199").click()
    opened.point_at(STATISTIC, 400 / 1199)
    (k,) = {int(opened.values(plot)[0]) for plot in range(PLOTS)}
    assert k == pytest.approx(400, abs=2)  # a pixel is more than a sample
    force, displacement = opened.values(FORCE)[1:]
    assert _number(force, "N") == pytest.approx(run.codes[k, 0] * 2940.0 / 4096, rel=1e-4)
    assert _number(displacement, "mm") == pytest.approx(run.codes[k, 1] * 199.6 / 4096, rel=1e-4)
    truth, estimate = opened.values(STIFFNESS)[1:]
    assert _number(truth, "N/m") == 24500.0
    assert _number(estimate, "N/m") == pytest.approx(24500.0, rel=1e-3)


def test_transients_are_hidden_until_asked_for(opened: Watched) -> None:
    calm = opened.images()
    every = opened.page.get_by_label("show every value")
    every.check()
    wild = opened.images()
    changed = [plot for plot in range(PLOTS) if wild[plot] != calm[plot]]
    assert changed == [2, 3, 4, INNOVATION, STATISTIC]
    every.uncheck()
    assert opened.images() == calm


def test_dark_scheme_redraws_the_plots_in_its_own_colours(opened: Watched) -> None:
    light = opened.images()
    opened.page.emulate_media(color_scheme="dark")
    dark = opened.images()
    assert min(opened.pixels((86, 180, 233))) > 100
    assert all(before != after for before, after in zip(light, dark, strict=True))
    assert opened.complaints == []


def test_narrow_window_does_not_cut_the_plots(opened: Watched) -> None:
    opened.plots()
    opened.page.set_viewport_size({"width": 600, "height": 900})
    opened.images()
    assert opened.page.evaluate("document.documentElement.scrollWidth") <= 600


def test_printed_page_is_light_and_holds_every_plot(opened: Watched) -> None:
    opened.page.emulate_media(color_scheme="dark")
    dark = opened.images()
    opened.page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert min(opened.pixels((0, 114, 178))) > 100
    assert opened.page.locator(".u-wrap").first.evaluate("(plot) => plot.offsetWidth") == 700
    opened.page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert opened.images() == dark


def test_run_without_a_sample_says_so_where_the_plots_would_be(browser: Browser, tmp_path: Path) -> None:
    watched = _open(browser, empty_run(), judge(empty_run()), tmp_path)
    assert "before its first sample" in watched.page.get_by_role("alert").inner_text()
    assert watched.complaints == []


@pytest.mark.parametrize("samples", [1, 2, NOTICED])
def test_run_that_broke_off_is_drawn(browser: Browser, run: Run, tmp_path: Path, samples: int) -> None:
    arrays = ("codes", "clipped", "theta", "innovation", "statistic", "flags")
    short = with_fault(replace(run, **{name: getattr(run, name)[:samples] for name in arrays}), "cut")
    watched = _open(browser, short, judge(short), tmp_path)
    assert len(watched.plots()) == PLOTS
    assert watched.complaints == []


def test_run_without_truth_and_trigger_is_drawn(browser: Browser, run: Run, tmp_path: Path) -> None:
    blind = replace(run, conditions=replace(run.conditions, segments=()))
    watched = _open(browser, blind, replace(judge(blind), ceiling=None), tmp_path)
    assert len(watched.plots()) == PLOTS
    assert len(watched.values(MASS)) == 2  # sample and estimate
    assert watched.complaints == []


def test_page_of_a_long_run_is_drawn_with_its_alarms_and_zooms(browser: Browser, tmp_path: Path) -> None:
    long = long_run(LONG, false_alarms=5, changes=2)
    watched = _open(browser, long, judge(long), tmp_path)
    assert len(watched.plots()) == PLOTS
    assert watched.complaints == []
    whole = watched.images()
    assert min(watched.pixels(ALARM)) > 20
    assert min(watched.pixels(FALSE_ALARM)) > 20
    watched.page.get_by_role("button", name="60000", exact=True).click()
    near = watched.images()
    assert all(before != after for before, after in zip(whole, near, strict=True))
    watched.point_at(FORCE, 40 / 120)
    assert watched.values(FORCE)[0] == "60,000"  # full resolution: a point for every sample
    force, displacement = watched.values(FORCE)[1:]
    assert _number(force, "N") == pytest.approx(long.codes[60_000, 0] * 2940.0 / 4096, rel=1e-4)
    assert _number(displacement, "mm") == pytest.approx(long.codes[60_000, 1] * 199.6 / 4096, rel=1e-4)
    watched.page.get_by_role("button", name="Whole run").click()
    watched.page.mouse.move(0, 0)
    assert watched.images() == whole


def test_spike_of_one_sample_in_a_long_run_is_drawn(browser: Browser, tmp_path: Path) -> None:
    flat = long_run(LONG, false_alarms=0, changes=0)
    flat.statistic[:] = 0.0
    spiked = replace(flat, statistic=flat.statistic.copy())
    spiked.statistic[37_457] = 11.0  # below the ceiling, which makes the scale
    (tmp_path / "spiked").mkdir()
    without, with_it = (
        _open(browser, run, judge(run), folder).images()[STATISTIC]
        for run, folder in ((flat, tmp_path), (spiked, tmp_path / "spiked"))
    )
    assert without != with_it


def test_run_that_converged_nowhere_is_drawn(browser: Browser, run: Run, tmp_path: Path) -> None:
    nowhere = replace(run, theta=run.theta * 0.0)
    watched = _open(browser, nowhere, judge(nowhere), tmp_path)
    assert len(watched.plots()) == PLOTS
    assert watched.complaints == []


def _open(browser: Browser, run: Run, verdict: Verdict, folder: Path) -> Watched:
    write_report(run, verdict, folder / "report.html")
    return Watched(browser, folder / "report.html")


def _shown(watched: Watched) -> object:
    """First and last sample that all plots show, to a pixel."""
    ends = set()
    for fraction in (0.0, 0.999):
        watched.point_at(MASS, fraction)
        (sample,) = {watched.values(plot)[0] for plot in range(PLOTS)}
        ends.add(int(sample.replace(",", "")))
    return pytest.approx((min(ends), max(ends)), abs=2)


def _width(watched: Watched) -> float:
    box = watched.page.locator(".u-over").nth(MASS).bounding_box()
    assert box is not None
    return box["width"]


def _number(text: str, unit: str) -> float:
    value, found = text.split()
    assert found == unit
    return float(value)
