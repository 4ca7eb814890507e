"""The page of the thesis in a real browser."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from harness.thesis.reproduction import PAGE

DRAWN = """(canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const seen = new Set();
    for (let i = 0; i < data.length; i += 4) {
        if (data[i + 3] === 255) seen.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
    }
    return [...seen];
}"""

SIGNALS = {0x0072B2, 0xCC79A7, 0x009E73}
"""First, second and third, one of which every plot has; its axes have none of them."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("needs a browser: apt-get install chromium")
    with sync_playwright() as playwright:
        # Without a sandbox, since tests may run as root; the page under test is our own.
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def complaints() -> list[str]:
    return []


@pytest.fixture(scope="module")
def opened(browser: Browser, reproduced: Path, complaints: list[str]) -> Page:
    page = browser.new_page(viewport={"width": 1100, "height": 900})
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("requestfailed", lambda request: complaints.append(request.url))
    page.on("request", lambda request: None if request.url.endswith(PAGE) else complaints.append(request.url))
    page.goto((reproduced / PAGE).as_uri())
    page.wait_for_selector("html[data-drawn]")
    return page


def test_every_figure_is_drawn_without_a_complaint_or_a_request(
    opened: Page, complaints: list[str], claims: dict[str, Any]
) -> None:
    figures = opened.locator("figure").all()
    captions = [figure.locator("figcaption").inner_text().split(" ", 1)[1] for figure in figures]
    assert all(caption.startswith(number) for caption, number in zip(captions, claims["figures"], strict=True))
    for figure in figures:
        canvases = figure.locator("canvas").all()
        assert canvases
        for canvas in canvases:
            assert SIGNALS & set(canvas.evaluate(DRAWN)), figure.inner_text()
    assert complaints == []


def test_page_is_less_than_5_mb_and_asks_for_nothing(reproduced: Path) -> None:
    page = (reproduced / PAGE).read_text(encoding="utf-8")
    assert len(page.encode()) < 5_000_000
    assert "default-src 'none'" in page


def test_every_claim_and_every_number_stands_on_the_page(opened: Page, claims: dict[str, Any]) -> None:
    shown = opened.locator(".claim").all()
    assert [each.get_attribute("id") for each in shown] == [f"claim-{each['ident']}" for each in claims["claims"]]
    rows = [opened.locator(f"#{name}-{chapter} + .scroll tbody tr").count() for name, chapter in _TABLES]
    assert sum(rows) == len(claims["numbers"]) + len(claims["errata"])


_TABLES = (("errata", 3), ("numbers", 4), ("errata", 4), ("numbers", 5), ("errata", 5))


def test_drag_zooms_the_plots_of_one_figure_and_no_other(opened: Page) -> None:
    own, other = opened.locator("#fig-4\\.6 canvas").all(), opened.locator("#fig-4\\.7 canvas").first
    before = [canvas.evaluate("(c) => c.toDataURL()") for canvas in (*own, other)]
    area = opened.locator("#fig-4\\.6 .u-over").first
    area.scroll_into_view_if_needed()
    box = area.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    opened.mouse.move(box["x"] + 0.2 * box["width"], y)
    opened.mouse.down()
    opened.mouse.move(box["x"] + 0.4 * box["width"], y, steps=3)
    opened.mouse.up()
    opened.mouse.move(0, 0)
    after = [canvas.evaluate("(c) => c.toDataURL()") for canvas in (*own, other)]
    assert [a != b for a, b in zip(before, after, strict=True)] == [True, True, False]
    area.dblclick()
    opened.mouse.move(0, 0)
    assert [canvas.evaluate("(c) => c.toDataURL()") for canvas in own] == before[:-1]


def test_printed_page_is_light_and_as_wide_as_the_paper(opened: Page) -> None:
    opened.emulate_media(color_scheme="dark")
    opened.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert opened.locator(".u-wrap").first.evaluate("(plot) => plot.offsetWidth") == 700
    assert 0x0072B2 in opened.locator("#fig-3\\.5 canvas").first.evaluate(DRAWN)
    opened.evaluate("dispatchEvent(new Event('afterprint'))")
    assert 0x0072B2 not in opened.locator("#fig-3\\.5 canvas").first.evaluate(DRAWN)
    opened.emulate_media(color_scheme="light")
