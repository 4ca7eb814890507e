"""Thesis page in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser

from analogrig_thesis.reproduction import PAGE
from tests.browser import Watched

DRAWN = """(canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const seen = new Set();
    for (let i = 0; i < data.length; i += 4) {
        if (data[i + 3] === 255) seen.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
    }
    return [...seen];
}"""

SIGNALS = {0x0072B2, 0xCC79A7, 0x009E73}
"""Colours of the curves: every plot has at least one of them, the axes have none."""


@pytest.fixture(scope="module")
def opened(browser: Browser, reproduced: Path) -> Watched:
    watched = Watched(browser, reproduced / PAGE)
    watched.plots()
    return watched


def test_every_figure_is_drawn_without_an_error_or_a_request(opened: Watched, claims: dict[str, Any]) -> None:
    figures = opened.page.locator("figure").all()
    captions = [figure.locator("figcaption").inner_text().split(" ", 1)[1] for figure in figures]
    assert all(caption.startswith(number) for caption, number in zip(captions, claims["figures"], strict=True))
    for figure in figures:
        canvases = figure.locator("canvas").all()
        assert canvases
        for canvas in canvases:
            assert SIGNALS & set(canvas.evaluate(DRAWN)), figure.inner_text()
    assert opened.complaints == []
    assert [url.rpartition("/")[2] for url in opened.requests] == [PAGE]


def test_page_is_accessible_in_both_schemes_and_widths(browser: Browser, reproduced: Path) -> None:
    watched = Watched(browser, reproduced / PAGE)
    assert watched.faults() == []
    watched.page.close()


def test_filter_shows_the_claims_of_a_chapter_and_verdict(browser: Browser, reproduced: Path, claims: Any) -> None:
    watched = Watched(browser, reproduced / PAGE)
    page = watched.page
    page.get_by_role("combobox", name="Verdict").select_option("does not hold")
    wanted = [f"claim-{each['ident']}" for each in claims["claims"] if each["verdict"] == "does not hold"]
    assert [each.get_attribute("id") for each in page.locator(".claim:visible").all()] == wanted
    assert page.locator("figure:visible").count() == 0
    page.get_by_role("combobox", name="Chapter").select_option("3")
    assert page.locator("#count").inner_text() == f"0 of {len(claims['claims'])} claims"
    page.get_by_role("link", name="4.6", exact=True).click()
    page.locator("#fig-4\\.6").wait_for()  # the event comes after the click
    assert page.locator(".claim:visible").count() == len(claims["claims"])
    page.close()


def test_page_is_below_5_mb_and_loads_nothing(reproduced: Path) -> None:
    page = (reproduced / PAGE).read_text(encoding="utf-8")
    assert len(page.encode()) < 5_000_000
    assert "default-src 'none'" in page


def test_page_shows_every_claim_and_every_number(opened: Watched, claims: dict[str, Any]) -> None:
    shown = opened.page.locator(".claim").all()
    assert [each.get_attribute("id") for each in shown] == [f"claim-{each['ident']}" for each in claims["claims"]]
    rows = [opened.page.locator(f"#{name}-{chapter} + .scroll tbody tr").count() for name, chapter in _TABLES]
    assert sum(rows) == len(claims["numbers"]) + len(claims["errata"])


_TABLES = (("errata", 3), ("numbers", 4), ("errata", 4), ("numbers", 5), ("errata", 5))


def test_drag_zooms_the_plots_of_one_figure_only(opened: Watched) -> None:
    own, other = "#fig-4\\.6", "#fig-4\\.7"
    whole = opened.images(own), opened.images(other)
    opened.drag(0, 0.2, 0.4, within=own)
    assert all(before != after for before, after in zip(whole[0], opened.images(own), strict=True))
    assert opened.images(other) == whole[1]
    opened.page.locator(f"{own} .u-over").first.dblclick()
    opened.page.mouse.move(0, 0)
    assert opened.images(own) == whole[0]


def test_printed_page_is_light_and_as_wide_as_the_paper(opened: Watched) -> None:
    page = opened.page
    first = page.locator("#fig-3\\.5 canvas").first
    page.emulate_media(color_scheme="dark")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator(".u-wrap").first.evaluate("(plot) => plot.offsetWidth") == 700
    assert 0x0072B2 in first.evaluate(DRAWN)
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert 0x0072B2 not in first.evaluate(DRAWN)
    page.emulate_media(color_scheme="light")
