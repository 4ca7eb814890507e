"""`make pictures`: screenshots of the pages for README and documentation, into fixtures/pictures.

python -m tests.pictures [NAME ...]; without a name, all of them.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path

from playwright.sync_api import sync_playwright

from analogrig.cli import main as analogrig
from analogrig_live.commands import Restart, SetPlaying, Step, Turn
from tests import tools
from tests.harness.live.benches import LiveBench

Page = AbstractContextManager[str]
"""Address of a page, as long as it is served."""

FOLDER = tools.ROOT / "fixtures" / "pictures"

WIDTH = 1200

HIDDEN = "section[aria-labelledby=conditions], section[aria-labelledby=made]"
"""Parts that name the machine and the hour."""
HIDE = "(parts) => document.querySelectorAll(parts).forEach((part) => { part.hidden = true; })"

CAMPAIGN = """
description = "falls of the stiffness"
trials = 20
samples = 2000
change_at = 1200
[grid]
damping_n_s_per_m = [2500, 3021]
stiffness_factor = [0.8, 0.9, 0.95]
noise_lsb = [0.7, 1.0]
"""


def report(folder: Path) -> Page:
    analogrig(["run", "--dut", "inproc", "--seed", "7", "--out", str(folder)])
    return nullcontext((folder / "report.html").as_uri())


def campaign(folder: Path) -> Page:
    (folder / "noise-and-damping.toml").write_text(CAMPAIGN, encoding="utf-8")
    analogrig(["campaign", str(folder / "noise-and-damping.toml"), "--out", str(folder / "campaign.sqlite")])
    return nullcontext((folder / "campaign.html").as_uri())


def thesis(folder: Path) -> Page:
    analogrig(["thesis", "--out", str(folder)])
    return nullcontext((folder / "thesis.html").as_uri())


def patch(folder: Path) -> Page:
    analogrig(["patch", "two-mass", "--drawing", str(folder / "patch.svg")])
    page = folder / "patch.html"
    page.write_text(f"<!doctype html>{(folder / 'patch.svg').read_text(encoding='utf-8')}", encoding="utf-8")
    return nullcontext(page.as_uri())


@contextmanager
def bench(folder: Path) -> Iterator[str]:
    """Bench that is paused 300 samples after a turn of a pot, so that the picture is always the same."""
    with LiveBench(folder) as server:
        for end, commands in (
            (1700, (SetPlaying(on=False), Restart(), Step(1700))),
            (2000, (Turn("K", 18000.0), Step(300))),
        ):
            for command in commands:
                server.session.do(command)
            while server.session.ring.end != end:
                time.sleep(0.01)
        yield server.address


PICTURES: dict[str, tuple[Callable[[Path], Page], str, int]] = {
    "report": (report, "main", 4000),
    "campaign": (campaign, "main", 900),
    "thesis": (thesis, "main", 1250),
    "patch": (patch, "svg", 1000),
    "bench": (bench, "main", 1000),
}
"""Page of each picture, the element that is shown, and the largest height in pixels of the page."""


def main(names: Sequence[str]) -> None:
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=tools.found("chromium"), args=["--no-sandbox"])
        for name in names or PICTURES:
            make, shown, most = PICTURES[name]
            (Path(folder) / name).mkdir()
            page = browser.new_page(viewport={"width": WIDTH, "height": 1000})
            address = stack.enter_context(make(Path(folder) / name))
            page.goto(address)
            if address.startswith("http") or page.locator("script[type='application/json']").count():
                page.wait_for_selector("html[data-drawn]")
            page.evaluate(HIDE, HIDDEN)
            box = page.locator(shown).first.bounding_box()
            assert box is not None
            clip = {"x": box["x"], "y": box["y"], "width": box["width"], "height": min(box["height"], most)}
            page.screenshot(path=FOLDER / f"{name}.png", full_page=True, clip=clip)  # type: ignore[arg-type]
            page.close()
        browser.close()


if __name__ == "__main__":
    main(sys.argv[1:])
