"""The page of a campaign: what a browser makes of it, and that its numbers are those of the results."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from analogrig.campaigns.plan import Plan
from analogrig.campaigns.results import Results
from analogrig.campaigns.rows import Row
from analogrig.campaigns.spec import Axes, CampaignSpec
from analogrig.campaigns.summary import Aggregate, Distribution
from analogrig.campaigns.trials import Trials
from analogrig.reporting.campaign import render, write_page
from tests.browser import Watched


def results(name: str = "made") -> Results:
    """Three stiffnesses by two factors: latencies 1 to 6, and every second change of the last cell missed."""
    grid = {"K": (20000.0, 22000.0, 24500.0), "K_factor": (0.8, 0.9)}
    plan = Plan.of(CampaignSpec(trials=2, samples=1100, grid=grid, name=name))
    return counted(plan, [Trials.of([row(seed, cell) for seed in range(2)]) for cell in range(6)])


def counted(plan: Plan, cells: Sequence[Trials]) -> Results:
    """Results of these trials of each cell."""
    aggregates, distribution = [], Distribution(plan.spec.draw)
    for trials in cells:
        aggregates.append(Aggregate())
        aggregates[-1].add(trials, 0)
        distribution.add(trials)
    return Results(plan, aggregates, distribution)


def row(seed: int, cell: int) -> Row:
    missed = cell == 5 and seed == 1
    change = [None if missed else cell + 1, 2, missed, False]
    outcome = "failed" if missed else "passed"
    counts = {"seed": seed, "outcome": outcome, "samples": 1100, "armed": 950, "false_alarms": 0}
    return {**counts, "changes": [change], "errors": [0.0, 0.0, 0.0], "theta": "0"}


def test_browser_draws_the_maps_and_asks_for_nothing(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "campaign.html"
    write_page(results(), path)
    watched = Watched(browser, path)
    assert watched.complaints == []
    assert watched.requests == [path.as_uri()]
    maps = watched.page.locator("svg")
    assert maps.count() == 2 + 4  # and the distributions of delays and of three errors
    shown = [each.locator("text").all_text_contents() for each in maps.all()[:2]]
    across, down = ["20000", "22000", "24500"], ["0.8", "0.9"]
    assert shown[0] == [*across, *down, "1.0", "2.0", "3.0", "4.0", "5.0", "6.0"]
    assert shown[1] == [*across, *down, *["0.0%"] * 5, "50.0%"]
    fills = watched.page.locator("rect").evaluate_all("all => all.map(each => getComputedStyle(each).fill)")
    assert fills[5] == fills[11] == "rgb(0, 114, 178)"
    assert fills[6] == "rgb(255, 255, 255)"
    assert len(set(fills[:6])) == 6
    watched.page.close()


def test_table_holds_every_cell_and_the_banner_the_outcome() -> None:
    page = render(results())
    body = page[page.index("<tbody>") :]
    assert body.count("<tr>") == 6
    assert "Campaign made: FAILED" in page
    assert "1 of 12 visible changes missed" in page


def test_same_results_give_the_same_page_and_names_are_escaped() -> None:
    assert render(results()) == render(results())
    page = render(results("<script>alert(1)</script>"))
    assert "<script" not in page
    assert "&lt;script&gt;" in page


@pytest.mark.parametrize("grid", [{}, {"noise_lsb": (1.0,)}])
def test_campaign_without_a_plane_has_no_map(grid: Axes) -> None:
    made = results()
    spec = dataclasses.replace(made.plan.spec, grid=grid)
    page = render(Results(dataclasses.replace(made.plan, spec=spec), made.aggregates[:1], made.distribution))
    assert not re.search("<rect", page)


def test_page_of_many_cells_is_bounded(browser: Browser, tmp_path: Path) -> None:
    """Beyond 2,000 cells the table ends, and beyond 2,000 squares of a map have no numbers."""
    factors = tuple(round(0.5 + 0.006 * i, 4) for i in range(50))
    dampings = tuple(2500.0 + 10.0 * i for i in range(50))
    spec = CampaignSpec(trials=100, samples=1100, grid={"B": dampings, "K_factor": factors}, name="many")
    made = results()
    plan = dataclasses.replace(made.plan, spec=dataclasses.replace(spec, scenario=made.plan.spec.scenario))
    path = tmp_path / "many.html"
    write_page(Results(plan, [made.aggregates[i % 6] for i in range(2_500)], made.distribution), path)
    assert path.stat().st_size < 2_000_000
    watched = Watched(browser, path)
    assert watched.complaints == []
    assert watched.page.locator("tbody tr").count() == 2_000
    assert watched.page.locator(".maps").first.locator("path").count() == 2 * 2_500
    watched.page.close()


def test_drawn_values_have_maps() -> None:
    """Eight trials at the low end of the range, missed, and eight at the high end, detected."""
    spec = CampaignSpec(trials=16, samples=1100, draw={"K_factor": (0.5, 0.9)}, name="drawn")
    plan = dataclasses.replace(results().plan, spec=spec)
    rows = [row(seed, 5) | {"changes": [[None if seed < 8 else 3, 2, seed < 8, False]]} for seed in range(16)]
    drawn = [each | {"drawn": {"K_factor": 0.5 if i < 8 else 0.9}} for i, each in enumerate(rows)]
    page = render(counted(plan, [Trials.of(drawn, ["K_factor"])]))
    section = page[page.index('id="drawn"') : page.index('id="spread"')]
    assert ">100.0%<" in section and ">0.0%<" in section and ">3.0<" in section
