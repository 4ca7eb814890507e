"""Every page of the project in a browser: light and dark, wide and narrow, by axe-core. See also tests/thesis."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from analogrig.config import locate
from analogrig.judging.verdict import judge
from analogrig.output import REPORT_FILE, OutputFolder
from analogrig.reporting import write_report
from analogrig.reporting.campaign_page import write_page
from analogrig_circuits import effects_page
from analogrig_emulator.machine.drawing import patch_drawing
from analogrig_emulator.machine.program_loader import load_patch
from analogrig_emulator.nonidealities import Effect
from analogrig_session.session_page import find_session, write_session
from tests.browser import VIEWS, Watched
from tests.harness.reported import empty_run, reported_run, reported_verdict
from tests.harness.test_campaign_page import drawn_results, results
from tests.harness.test_session_page import VERDICT


def report(path: Path) -> None:
    run = reported_run()
    write_report(run, reported_verdict(run), path)


def report_without_samples(path: Path) -> None:
    write_report(empty_run(), judge(empty_run()), path)


def mark_of_a_command_that_goes_on(path: Path) -> None:
    with OutputFolder(path.parent, "analogrig run --out <here>", "2026-01-01T12:00:00+00:00"):
        (path.parent / REPORT_FILE).rename(path)


def session(path: Path) -> None:
    for name, outcome in (("a", "passed"), ("b", "failed"), ("c", "inconclusive")):
        (path.parent / name).mkdir()
        (path.parent / name / "verdict.json").write_text(json.dumps({**VERDICT, "outcome": outcome}))
        (path.parent / name / REPORT_FILE).touch()
    write_session(find_session(path.parent, path), path)


def campaign(path: Path) -> None:
    write_page(results(), path)


def campaign_with_drawn_values(path: Path) -> None:
    write_page(drawn_results(), path)


def effects_picture(path: Path) -> None:
    table = {name: [Effect("offset <of all>", 3.0, 4.0, 5), Effect("noise", 0.02, 0.03, 5)] for name in ("a", "b")}
    effects_page.write_picture(table, path.with_suffix(".svg"))
    embed(path)


def patch(path: Path) -> None:
    path.with_suffix(".svg").write_text(patch_drawing(load_patch(locate("programs", "two-mass"))))
    embed(path)


def embed(path: Path) -> None:
    """Page around a drawing, as axe-core reads only HTML."""
    head = '<!doctype html><html lang="en"><title>drawing</title><meta name="viewport" content="width=device-width">'
    drawing = path.with_suffix(".svg").read_text()
    path.write_text(f'{head}<main><h1>Drawing</h1><div style="overflow-x: auto" tabindex="0">{drawing}</div></main>')


PAGES = (
    report,
    report_without_samples,
    mark_of_a_command_that_goes_on,
    session,
    campaign,
    campaign_with_drawn_values,
    effects_picture,
    patch,
)


@pytest.mark.parametrize("write", PAGES)
def test_page_is_accessible_in_both_schemes_and_widths(
    browser: Browser, tmp_path: Path, write: Callable[[Path], None]
) -> None:
    path = tmp_path / "page.html"
    write(path)
    watched = Watched(browser, path)
    assert watched.faults() == []
    watched.page.close()


def test_faults_are_found(browser: Browser, tmp_path: Path) -> None:
    """A picture without a description, wider than the narrow window, whose file is absent."""
    path = tmp_path / "page.html"
    path.write_text('<!doctype html><html lang="en"><title>a</title><main><h1>a</h1><img src="b.png"><hr width=500>')
    watched = Watched(browser, path)
    found = watched.faults()
    assert any(re.search("image-alt", each) for each in found)
    assert any(re.search("pixels on 390", each) for each in found)
    assert any(re.search("b.png", each) for each in found)
    watched.page.close()


def test_dark_map_has_no_white_square(browser: Browser, tmp_path: Path) -> None:
    """Fill of each square over the paper, and the ink on it: a contrast of 4.5 at least in both schemes."""
    path = tmp_path / "campaign.html"
    write_page(results(), path)
    watched = Watched(browser, path)
    for scheme, _ in VIEWS:
        watched.page.emulate_media(color_scheme=scheme)
        contrasts = watched.page.evaluate(CONTRASTS)
        assert len(contrasts) == 12
        assert min(contrasts) >= 4.5
    watched.page.close()


CONTRASTS = """() => {
    const numbers = (colour) => colour.match(/[0-9.]+/g).slice(0, 3).map(Number);
    const light = (rgb) => rgb.map((c) => (c / 255 <= 0.04045 ? c / 3294.6 : ((c / 255 + 0.055) / 1.055) ** 2.4))
        .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
    const paper = numbers(getComputedStyle(document.body).backgroundColor);
    return [...document.querySelectorAll("#maps ~ .maps a")].map((square) => {
        const { fill, fillOpacity } = getComputedStyle(square.querySelector("rect"));
        const shown = numbers(fill).map((c, i) => paper[i] + Number(fillOpacity) * (c - paper[i]));
        const ink = light(numbers(getComputedStyle(square.querySelector("text")).fill));
        const [low, high] = [ink, light(shown)].sort((a, b) => a - b);
        return (high + 0.05) / (low + 0.05);
    });
}"""
