"""The page of a campaign: what a browser makes of it, and that its numbers are those of the results."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from analogrig.campaigns.aggregates import Aggregate, Distribution, independent
from analogrig.campaigns.plan import Plan
from analogrig.campaigns.spec import Axes, CampaignSpec
from analogrig.campaigns.tally import Results
from analogrig.campaigns.trials import Change, Trial, Trials, columns_of
from analogrig.reporting.campaign_page import render, write_page
from tests.browser import Watched


def results(name: str = "made") -> Results:
    """Three stiffnesses by two factors: latencies 1 to 6, and every second change of the last cell missed."""
    grid = {"K": (20000.0, 22000.0, 24500.0), "K_factor": (0.8, 0.9)}
    plan = Plan.of(CampaignSpec(trials=2, samples=1100, grid=grid, name=name))
    return counted(plan, [columns_of([trial(seed, cell) for seed in range(2)]) for cell in range(6)])


def counted(plan: Plan, cells: Sequence[Trials]) -> Results:
    """Results of these trials of each cell."""
    aggregates, distribution = [], Distribution(plan.spec.draw)
    for trials in cells:
        aggregates.append(Aggregate())
        aggregates[-1].add(trials, 0)
        distribution.add(trials)
    return Results(plan, aggregates, distribution)


def trial(seed: int, cell: int) -> Trial:
    missed = cell == 5 and seed == 1
    change = Change(None if missed else cell + 1, 2, missed, late=False)
    return Trial(seed, "failed" if missed else "passed", "", 1100, 950, 0, (change,), (0.0, 0.0, 0.0))


def test_browser_draws_the_maps_and_asks_for_nothing(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "campaign.html"
    write_page(results(), path)
    watched = Watched(browser, path)
    assert watched.complaints == []
    assert watched.requests == [path.as_uri()]
    assert watched.page.locator("#spread + .maps svg").count() == 4  # of delays and of three errors
    maps = watched.page.locator("#maps ~ .maps svg").all()
    lines = [each.locator("text").all_text_contents() for each in maps]
    axes = ["20000", "22000", "24500", "0.8", "0.9", "K [N/m]", "K factor"]
    assert [each[:7] for each in lines] == [axes, axes]
    latencies = ["1.0", "2.0", "3.0", "4.0", "5.0", "6.0"]
    assert lines[0][7:] == [text for latency in latencies for text in (latency, "bound 2.0")]
    assert lines[1][7::2] == [*["0.0%"] * 5, "50.0%"]
    shares = [
        float(each.get_attribute("fill-opacity") or "") for each in watched.page.locator("#maps ~ .maps rect").all()
    ]
    assert shares == [0.17, 0.33, 0.5, 0.67, 0.83, 1.0, *[0.0] * 5, 1.0]
    watched.page.close()


def test_all_panels_share_one_scale_that_the_legend_shows() -> None:
    """Two panels of one quantity, the second with half the latencies of the first."""
    made = results()
    grid = {"K": (20000.0, 24500.0), "K_factor": (0.8, 0.9), "noise_lsb": (0.5, 1.0)}
    plan = Plan.of(CampaignSpec(trials=2, samples=1100, grid=grid, name="made"))
    cells = [columns_of([trial(seed, i // 2 if i % 2 else i) for seed in range(2)]) for i in range(8)]
    page = render(counted(plan, cells))
    section = page[page.index("<h3>Mean latency") : page.index("<h3>Miss rate")]
    shares = {
        label: share
        for share, label in re.findall(r'fill-opacity="([0-9.]+)" stroke="[^"]*"/><text[^>]*>([0-9.]+)<', section)
    }
    assert "noise 0.5 LSB rms" in section and "noise 1 LSB rms" in section
    assert section.count('class="legend"') == 1 and ">7.0</text>" in section
    assert all(float(share) == round(float(label) / 7.0, 2) for label, share in shares.items())
    assert len(shares) > 4 and made.plan != plan


def test_table_holds_every_cell_and_the_banner_the_outcome() -> None:
    page = render(results())
    assert [f'<tr id="cell-{i}">' in page for i in range(7)] == [True] * 6 + [False]
    assert "Campaign made: FAILED" in page
    assert "1 of 12 visible changes missed" in page


def test_same_results_give_the_same_page_and_names_are_escaped() -> None:
    assert render(results()) == render(results())
    page = render(results("<script>alert(1)</script>"))
    assert "<script>alert" not in page
    assert "&lt;script&gt;" in page


@pytest.mark.parametrize("grid", [{}, {"noise_lsb": (1.0,)}])
def test_campaign_without_a_plane_has_no_map(grid: Axes) -> None:
    made = results()
    spec = dataclasses.replace(made.plan.spec, grid=grid)
    page = render(Results(dataclasses.replace(made.plan, spec=spec), made.aggregates[:1], made.distribution))
    assert not re.search("<rect", page)


def write_large_page(path: Path) -> str:
    """Write the page of 2,500 cells, and return its text."""
    factors = tuple(round(0.5 + 0.006 * i, 4) for i in range(50))
    dampings = tuple(2500.0 + 10.0 * i for i in range(50))
    spec = CampaignSpec(trials=100, samples=1100, grid={"B": dampings, "K_factor": factors}, name="many")
    made = results()
    plan = dataclasses.replace(made.plan, spec=dataclasses.replace(spec, scenario=made.plan.spec.scenario))
    many = Results(plan, [made.aggregates[i % 6] for i in range(2_500)], made.distribution)
    summaries = [summary for _, summary in made.cells]  # whose bounds take long
    vars(many)["cells"] = [(cell, summaries[i % 6]) for i, cell in enumerate(plan.cells())]
    write_page(many, path)
    return path.read_text()


def test_page_of_many_cells_is_bounded(tmp_path: Path) -> None:
    """Beyond 2,000 cells the table ends, and beyond 2,000 squares of a map have no numbers."""
    page = write_large_page(tmp_path / "many.html")
    assert len(page) < 3_000_000
    assert page.count('<tr id="cell-') == 2_000
    assert page.count("h9v9h-9z") == 2 * 2_500


@pytest.mark.heavy
def test_browser_draws_the_page_of_many_cells(browser: Browser, tmp_path: Path) -> None:
    write_large_page(tmp_path / "many.html")
    watched = Watched(browser, tmp_path / "many.html")
    assert watched.complaints == []
    assert watched.page.locator("section[aria-labelledby=cells] tbody tr").count() == 2_000
    assert watched.page.locator("#maps ~ .maps path").count() == 2 * 2_500
    watched.page.close()


def drawn_results() -> Results:
    """Eight trials at the low end of the range, missed, and eight at the high end, detected."""
    spec = CampaignSpec(trials=16, samples=1100, draw={"K_factor": (0.5, 0.9)}, name="drawn")
    plan = dataclasses.replace(results().plan, spec=spec)
    trials = [
        trial(seed, 5)._replace(
            changes=(Change(None if seed < 8 else 3, 2, seed < 8, late=False),),
            drawn={"K_factor": 0.5 if seed < 8 else 0.9},
        )
        for seed in range(16)
    ]
    return counted(plan, [columns_of(trials, ["K_factor"])])


def test_drawn_values_have_maps() -> None:
    page = render(drawn_results())
    section = page[page.index('id="drawn"') : page.index('id="spread"')]
    assert ">100.0%<" in section and ">0.0%<" in section and ">3.0<" in section
    bound = independent(0, 8).bounds[1]
    assert "8 of 8 changes missed" in section and f">≤ {100 * bound:.2g}%<" in section


def test_bound_stands_beside_a_rate_of_zero_and_a_square_leads_to_its_trials(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "campaign.html"
    write_page(results(), path)
    watched = Watched(browser, path)
    first, last = (watched.page.locator("#maps ~ .maps a").nth(i) for i in (6, 11))
    assert first.locator("text").all_text_contents() == ["0.0%", "≤ 88%"]
    title = last.locator("title").text_content()
    assert title is not None
    assert title.startswith("K 24500 N/m, K factor 0.9: latency 6.0 samples (bound 2.0), 1 of 2 changes")
    last.focus()
    watched.page.keyboard.press("Enter")
    cell = watched.page.locator("tr:target")
    assert cell.locator("th").all_text_contents() == ["24500", "0.9"]
    cell.get_by_role("link", name="1").click()
    assert watched.page.locator("tr:target td").all_text_contents()[:2] == ["1", "failed"]
    watched.page.close()


def test_heading_sorts_the_table_by_its_numbers_both_ways(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "campaign.html"
    write_page(results(), path)
    watched = Watched(browser, path)
    button = watched.page.get_by_role("button", name="latency")
    for order in ((1, 2, 3, 4, 5, 6), (6, 5, 4, 3, 2, 1)):
        button.press("Enter")
        column = watched.page.locator("section[aria-labelledby=cells] tbody tr td:nth-child(12)")
        assert [float(each) for each in column.all_text_contents()] == list(order)
    assert watched.page.locator("[aria-sort=descending]").count() == 1
    watched.page.close()
