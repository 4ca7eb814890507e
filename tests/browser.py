"""Pages in a real browser, for the tests of all that only a browser can tell."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Locator, Page

GRAVE = ("serious", "critical")
"""Impacts of axe-core that no page may have."""

VIEWS: tuple[tuple[Literal["light", "dark"], int], ...] = (("light", 1280), ("dark", 390))
"""Schemes and widths: what may be wrong depends on the scheme or on the width, not on both."""

COUNT_PIXELS = """(canvas, [r, g, b]) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let i = 0; i < data.length; i += 4) count += data[i] === r && data[i + 1] === g && data[i + 2] === b;
    return count;
}"""

PAINTED = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


class Watched:
    """A page of the browser, with everything it complained of and asked for."""

    def __init__(self, browser: Browser, place: Path | str) -> None:
        """Open a file or an address."""
        self.page: Page = browser.new_page(viewport={"width": 1200, "height": 1000})
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("requestfailed", lambda request: self.complaints.append(request.url))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(place if isinstance(place, str) else place.as_uri())

    def faults(self) -> list[str]:
        """Complaints, what is wider than the window, and what axe-core finds: light and dark, wide and narrow."""
        if self.page.locator("script[type='application/json']").count():
            self.page.wait_for_selector("html[data-drawn], [role=alert]:not([hidden])", state="attached")
        found = []
        for scheme, width in VIEWS:
            self.page.emulate_media(color_scheme=scheme)
            self.page.set_viewport_size({"width": width, "height": 900})
            self.page.evaluate(PAINTED)
            reach = self.page.evaluate("document.documentElement.scrollWidth")
            found += [f"{scheme}: {reach} pixels on {width}"] if reach > width else []
            grave = [each for each in Axe().run(self.page).response["violations"] if each["impact"] in GRAVE]
            found += [f"{scheme}, {width} pixels: {each['id']}: {each['nodes'][0]['html'][:200]}" for each in grave]
        return [*self.complaints, *found]

    def plots(self, within: str = "") -> list[Locator]:
        """Texts of the page, or of an element."""
        self.page.wait_for_selector("html[data-drawn]")
        return self.page.locator(f"{within} .u-wrap canvas").all()

    def images(self, within: str = "") -> list[str]:
        """Pixels of each plot, after the browser has painted."""
        self.page.evaluate(PAINTED)
        return [plot.evaluate("(canvas) => canvas.toDataURL()") for plot in self.plots(within)]

    def pixels(self, colour: tuple[int, int, int]) -> list[int]:
        """Count of pixels of exactly this colour in each plot."""
        return [plot.evaluate(COUNT_PIXELS, list(colour)) for plot in self.plots()]

    def drag(self, plot: int, start: float, end: float, within: str = "") -> None:
        """Drag across a plot, between two fractions of its width."""
        x, y, width = self._area(plot, within)
        self.page.mouse.move(x + start * width, y)
        self.page.mouse.down()
        self.page.mouse.move(x + end * width, y, steps=3)
        self.page.mouse.up()
        self.page.mouse.move(0, 0)

    def point_at(self, plot: int, fraction: float) -> None:
        x, y, width = self._area(plot)
        self.page.mouse.move(x + fraction * width, y)

    def values(self, plot: int) -> list[str]:
        """Legend of a plot for the sample under the pointer."""
        return self.page.locator(".u-legend").nth(plot).locator(".u-value").all_inner_texts()

    def _area(self, plot: int, within: str = "") -> tuple[float, float, float]:
        area = self.page.locator(f"{within} .u-over").nth(plot)
        area.scroll_into_view_if_needed()
        box = area.bounding_box()
        assert box is not None
        return box["x"], box["y"] + box["height"] / 2, box["width"]
