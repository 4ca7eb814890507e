"""Tables of a campaign, and its page: with maps of latency and miss rate over two axes of the grid."""

from __future__ import annotations

import html
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig.campaigns.results import CONFIDENCE, Results, Summary
from analogrig.campaigns.rows import RATES
from analogrig.errors import ConfigurationError
from analogrig.identity import Identity
from analogrig.judging.bursts import BURST
from analogrig.reporting.page import FOLDER, assemble_page
from analogrig.reporting.tables import provenance
from analogrig.storage import replace_file
from analogrig.wording import counter_text, number_of

_TEMPLATE = FOLDER / "campaign.html"

_MARK = b'data-page="analogrig-campaign"'
"""Marker that identifies the page of a campaign."""

_WIDTH, _HEIGHT, _LEFT, _TOP = 74, 34, 110, 26
_DEEPEST = (0, 114, 178)
"""Blue of Okabe and Ito for the largest value; a value of zero is white."""

MOST_MAPS = 40

_BOUNDS = f"bounds at {CONFIDENCE:.0%}, whenever the campaign ended, for bursts of {BURST:g} false alarms on average"
"""Note on the bounds in the tables."""


def _labelled(results: Results) -> list[tuple[dict[str, str], Summary]]:
    """Cells with the labels that identify them: rig and device where there are several, and the values of the grid."""
    plan, out = results.plan, []
    for cell, summary in results.cells():
        labels = {"rig": str(plan.rigs[cell.rig]["name"])} if len(plan.rigs) > 1 else {}
        labels |= {"device": str(plan.devices[cell.device]["name"])} if len(plan.devices) > 1 else {}
        out.append((labels | {axis: f"{value:g}" for axis, value in cell.values.items()}, summary))
    return out


def anytime_text(counted: Mapping[str, int]) -> str:
    """Rates of the events that ``rows.counts`` counts, with bounds, in one line."""
    parts = []
    for name, rate in RATES.items():
        if counted[rate.exposure]:
            below = rate.sequence(counted, CONFIDENCE).bounds[1]
            events, exposure = counter_text(counted[name], name), counter_text(counted[rate.exposure], rate.unit)
            parts.append(f"{events} in {exposure} (rate below {below:.2g})")
    return ", ".join(parts)


@dataclass(frozen=True)
class Column:
    """Column of the tables."""

    title: str
    short: str
    """Title where there is little room."""
    form: str
    of: Callable[[Summary], float | None]

    def cell(self, summary: Summary, absent: str) -> str:
        value = self.of(summary)
        return absent if value is None else format(value, self.form)


COLUMNS = (
    Column("trials", "trials", ",", lambda summary: summary.trials),
    Column("failed", "failed", ",", lambda summary: summary.failed),
    Column("inconclusive", "inconcl.", ",", lambda summary: summary.inconclusive),
    Column("missed", "missed", ",", lambda summary: summary.missed),
    Column("visible", "of", ",", lambda summary: summary.visible),
    Column("miss rate at most", "at most", ".2g", lambda summary: summary.miss_rate[1] if summary.visible else None),
    Column("false alarms", "false al.", ",", lambda summary: summary.false_alarms),
    Column(
        "per sample at most",
        "rate below",
        ".2g",
        lambda summary: summary.false_alarm_rate[1] if summary.armed else None,
    ),
    Column("latency", "latency", ".1f", lambda summary: summary.latency_n),
    Column("95th percentile", "p95", ".1f", lambda summary: summary.latency_p95_n),
    Column("bound", "bound", ".1f", lambda summary: summary.bound_n),
)

MAPPED = (
    Column("Mean latency [samples]", "", ".1f", lambda summary: summary.latency_n),
    Column("Miss rate", "", ".1%", lambda summary: summary.missed / summary.visible if summary.visible else None),
)
"""Quantities of the maps."""


def text(results: Results) -> str:
    """Results as several lines of text, without a final newline."""
    spec, total = results.plan.spec, results.total()
    cells = _labelled(results)
    names = list(cells[0][0]) if len(cells) > 1 else []
    counts = ((len(cells), "cell"), (total.trials, "trial"), (total.samples, "sample"))
    head = f"campaign {spec.name}: {', '.join(number_of(*each) for each in counts)}: "
    rows = [[*names, *(column.short for column in COLUMNS)]]
    rows += [[*(labels[name] for name in names), *_numbers(summary)] for labels, summary in cells]
    if len(cells) > 1:
        rows.append([*("all" if name == names[0] else "" for name in names), *_numbers(total)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)) for row in rows]
    notes = [f"{_BOUNDS}; latency, p95 and bound in samples"]
    if total.inconclusive:
        notes.append(f"{number_of(total.inconclusive, 'trial')} inconclusive, such as {total.doubt}")
    return "\n".join(
        [head + results.outcome().upper(), "", *(f"  {line}" for line in lines), "", *(f"  {note}" for note in notes)]
    )


def as_json(results: Results) -> dict[str, Any]:
    """Results as plain values; rates as [low, high]."""
    cells = [{**labels, **vars(summary)} for labels, summary in _labelled(results)]
    return {
        "campaign": results.plan.spec.name,
        "outcome": results.outcome(),
        "total": vars(results.total()),
        "cells": cells,
    }


def _numbers(summary: Summary) -> list[str]:
    return [column.cell(summary, "-") for column in COLUMNS]


def page_of(out: Path) -> Path:
    """Path of the page beside the results.

    :raises ConfigurationError: something else stands there, or the results themselves would.
    """
    if not out.name or (out.exists() and not out.is_file()):
        raise ConfigurationError(f"--out {out}: is no file that results could be written to")
    page = out.with_suffix(".html")
    if page == out:
        raise ConfigurationError(f"--out {out}: the page of the results is to be called so: choose another name")
    try:
        is_free = not page.exists() or _MARK in page.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{page}: {error.strerror or error}") from error
    if not is_free:
        raise ConfigurationError(f"{page}: is no page of a campaign: choose another --out, or remove it")
    return page


def write_page(results: Results, path: Path, played_by: Sequence[Identity] = ()) -> None:
    """Write the page: either all of it or nothing. The same arguments give the same bytes.

    :param played_by: the commands that have played the campaign.
    :raises RecordingError: the page cannot be written.
    """
    with replace_file(path) as file:
        file.write(render(results, played_by).encode("utf-8", "replace"))


def render(results: Results, played_by: Sequence[Identity] = ()) -> str:
    """The page as text."""
    spec, total = results.plan.spec, results.total()
    scenario = str(results.plan.scenario["name"])
    return assemble_page(
        _TEMPLATE,
        (FOLDER / "page.css",),
        (),
        title=html.escape(f"campaign {spec.name}"),
        outcome=results.outcome(),
        heading=html.escape(f"Campaign {spec.name}: {results.outcome().upper()}"),
        sentence=html.escape(
            f"{scenario}: {total.trials:,} trials in {len(results.rows):,} cells, {total.samples:,} samples;"
            f" {total.missed:,} of {total.visible:,} visible changes missed, {total.false_alarms:,} false alarms,"
            f" {total.inconclusive:,} trials inconclusive."
        ),
        maps=_maps(results),
        table=_table(results),
        provenance=_provenance(played_by),
    )


def _maps(results: Results) -> str:
    """Maps of each quantity, one for every combination of the values that are not on the axes."""
    axes = [axis for axis, values in results.plan.spec.grid.axes().items() if len(values) > 1][:2]
    if not axes:
        return ""
    across, down = axes[0], axes[1] if len(axes) > 1 else None
    cells = _labelled(results)
    rest = [tuple((name, value) for name, value in names.items() if name not in axes) for names, _ in cells]
    sections = []
    for group in list(dict.fromkeys(rest))[:MOST_MAPS]:
        found = {
            (names[across], names[down] if down else ""): summary
            for (names, summary), other in zip(cells, rest, strict=True)
            if other == group
        }
        where = ", ".join(f"{name} {value}" for name, value in group)
        maps = "".join(_map(quantity, found, (across, down or ""), where) for quantity in MAPPED)
        sections.append(f'<div class="maps">{maps}</div>')
    return f'<section aria-labelledby="maps"><h2 id="maps">Maps</h2>{"".join(sections)}</section>'


def _map(quantity: Column, found: dict[tuple[str, str], Summary], axes: tuple[str, str], where: str) -> str:
    columns, rows = (list(dict.fromkeys(key[i] for key in found)) for i in range(2))
    values = {key: quantity.of(summary) for key, summary in found.items()}
    most = max((value for value in values.values() if value is not None), default=0.0)
    parts = [_words(_LEFT + (i + 0.5) * _WIDTH, _TOP - 8, name) for i, name in enumerate(columns)]
    parts += [_words(_LEFT - 8, _TOP + (j + 0.6) * _HEIGHT, name, "end") for j, name in enumerate(rows)]
    for (i, column), (j, row) in itertools.product(enumerate(columns), enumerate(rows)):
        parts.append(_square(i, j, values[column, row], most, quantity.form))
    width, height = _LEFT + len(columns) * _WIDTH + 2, _TOP + len(rows) * _HEIGHT + 2
    title = f"{quantity.title}{f' ({where})' if where else ''}"
    caption = f"{title}; across: {axes[0]}{f', down: {axes[1]}' if axes[1] else ''}"
    return (
        f'<figure><figcaption>{html.escape(caption)}</figcaption><div class="scroll">'
        f'<svg role="img" aria-label="{html.escape(caption)}; the numbers are in the table below"'
        f' width="{width}" height="{height}" font-size="13">{"".join(parts)}</svg></div></figure>'
    )


def _square(i: int, j: int, value: float | None, most: float, form: str) -> str:
    share = 0.0 if value is None or most == 0.0 else value / most
    colour = "#" + "".join(f"{round(255 + share * (deep - 255)):02x}" for deep in _DEEPEST)
    x, y = _LEFT + i * _WIDTH, _TOP + j * _HEIGHT
    text = "–" if value is None else format(value, form)
    ink = "#ffffff" if share > 0.85 else "#1a1a1a"
    return (
        f'<rect x="{x}" y="{y}" width="{_WIDTH}" height="{_HEIGHT}" fill="{"#d5d5d5" if value is None else colour}"'
        f' stroke="#8a8a8a"/>{_words(x + 0.5 * _WIDTH, y + 0.62 * _HEIGHT, text, colour=ink)}'
    )


def _words(x: float, y: float, text: str, anchor: str = "middle", colour: str = "currentColor") -> str:
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" fill="{colour}">{html.escape(text)}</text>'


def _table(results: Results) -> str:
    cells = _labelled(results)
    names = list(cells[0][0])
    head = "".join(f'<th scope="col">{html.escape(name)}</th>' for name in names)
    head += "".join(f'<th scope="col" class="number">{column.title}</th>' for column in COLUMNS)
    rows = "".join(f"<tr>{_row(list(each.values()), summary)}</tr>" for each, summary in cells)
    caption = f"{_BOUNDS.capitalize()}; latency and bound in samples from the change"
    return (
        f'<div class="scroll"><table class="numbers"><caption>{caption}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _provenance(played_by: Sequence[Identity]) -> str:
    if not played_by:
        return ""
    rows = "".join(
        f'<tr><th scope="row">{html.escape(name)}</th><td>{html.escape(value)}</td></tr>'
        for identity in played_by
        for name, value in provenance(identity)
    )
    return (
        '<section aria-labelledby="made"><h2 id="made">What made it</h2><table class="pairs">'
        f"<caption>Every command that has played a part</caption><tbody>{rows}</tbody></table></section>"
    )


def _row(names: Sequence[str], summary: Summary) -> str:
    cells = "".join(f'<th scope="row">{html.escape(name)}</th>' for name in names)
    return cells + "".join(f'<td class="number">{column.cell(summary, "–")}</td>' for column in COLUMNS)
