"""Tables of a campaign, and its page: with maps of latency and miss rate over two axes of the grid."""

from __future__ import annotations

import html
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analogrig.campaigns.results import Results
from analogrig.campaigns.summary import CONFIDENCE, DRAWN_BINS, ERROR_BINS, ERROR_STEP, RATES, Summary
from analogrig.errors import ConfigurationError
from analogrig.identity import Identity
from analogrig.judging.bursts import BURST
from analogrig.reporting.page import FOLDER, assemble_page
from analogrig.reporting.tables import provenance
from analogrig.storage import replace_file
from analogrig.wording import counter_text, number_of

_TEMPLATE = FOLDER / "campaign.html"

_MARK, _FORMAT = b'data-page="analogrig-campaign"', b'"format": "analogrig-campaign"'
"""Markers that identify the page and the aggregated results of a campaign."""

_WIDTH, _HEIGHT, _LEFT, _TOP = 74, 34, 110, 26
_BARS, _BARS_WIDTH, _BARS_HEIGHT = 100, 400, 120
_DEEPEST = (0, 114, 178)
"""Blue of Okabe and Ito for the largest value; a value of zero is white."""

_SMALL = 9
"""Side of a square of a map that has too many of them for numbers."""

MOST_NUMBERS, MOST_SQUARES = 4_000, 20_000
"""Largest number of squares with numbers on a page, and of all squares."""

MOST_ROWS = 2_000
"""Largest number of cells in the table."""

_BOUNDS = f"bounds at {CONFIDENCE:.0%}, whenever the campaign ended, for bursts of {BURST:g} false alarms on average"
"""Note on the bounds in the tables."""


def _labelled(results: Results) -> list[tuple[dict[str, str], Summary]]:
    """Cells with the labels that identify them: rig and device where there are several, and the values of the grid."""
    plan, out = results.plan, []
    for cell, summary in results.cells:
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
    Column("late", "late", ",", lambda summary: summary.late),
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
    spec, total = results.plan.spec, results.total
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
        [head + results.outcome.upper(), "", *(f"  {line}" for line in lines), "", *(f"  {note}" for note in notes)]
    )


def as_json(results: Results) -> dict[str, Any]:
    """Results as plain values; rates as [low, high]."""
    cells = [{**labels, **vars(summary)} for labels, summary in _labelled(results)]
    found = results.distribution
    return {
        "format": "analogrig-campaign",
        "campaign": results.plan.spec.name,
        "outcome": results.outcome,
        "total": vars(results.total),
        "latency_n": {
            "values": results.latencies.values.tolist(),
            "counts": results.latencies.counts.tolist(),
        },
        "errors": {
            "step": ERROR_STEP,
            "counts": dict(zip(results.plan.estimates, found.errors.tolist(), strict=False)),
        },
        "drawn": {
            "axes": {axis: list(ends) for axis, ends in found.axes.items()},
            **{name: getattr(found, name).tolist() for name in ("visible", "missed", "detected", "latency_n")},
        },
        "cells": cells,
    }


def _numbers(summary: Summary) -> list[str]:
    return [column.cell(summary, "-") for column in COLUMNS]


def places_of(out: Path) -> tuple[Path, Path]:
    """Paths of the aggregated results and of the page, beside the trials.

    :raises ConfigurationError: something else stands at one of them, or the trials themselves would.
    """
    if not out.name or (out.exists() and not out.is_file()):
        raise ConfigurationError(f"--out {out}: is no file that results could be written to")
    for path, mark, what in ((out.with_suffix(".json"), _FORMAT, "results"), (out.with_suffix(".html"), _MARK, "page")):
        if path == out:
            raise ConfigurationError(f"--out {out}: the {what} of the campaign is to be called so: choose another name")
        try:
            is_free = not path.exists() or mark in path.read_bytes()
        except OSError as error:
            raise ConfigurationError(f"{path}: {error.strerror or error}") from error
        if not is_free:
            raise ConfigurationError(f"{path}: is no {what} of a campaign: choose another --out, or remove it")
    return out.with_suffix(".json"), out.with_suffix(".html")


def write_json(results: Results, path: Path) -> None:
    """Write the aggregated results. Equal plans give equal bytes.

    :raises RecordingError: the file cannot be written.
    """
    with replace_file(path) as file:
        file.write(f"{json.dumps(as_json(results), indent=1)}\n".encode())


def write_page(results: Results, path: Path) -> None:
    """Write the page: either all of it or nothing. The same results give the same bytes.

    :raises RecordingError: the page cannot be written.
    """
    with replace_file(path) as file:
        file.write(render(results).encode("utf-8", "replace"))


def render(results: Results) -> str:
    """The page as text: at most 5 MB, whatever the number of cells and trials."""
    spec, total = results.plan.spec, results.total
    scenario = str(results.plan.scenario["name"])
    return assemble_page(
        _TEMPLATE,
        (FOLDER / "page.css",),
        (),
        title=html.escape(f"campaign {spec.name}"),
        outcome=results.outcome,
        heading=html.escape(f"Campaign {spec.name}: {results.outcome.upper()}"),
        sentence=html.escape(
            f"{scenario}: {total.trials:,} trials in {len(results.aggregates):,} cells, {total.samples:,} samples;"
            f" {total.missed:,} of {total.visible:,} visible changes missed, {total.late:,} detected late,"
            f" {total.false_alarms:,} false alarms, {total.inconclusive:,} trials inconclusive."
        ),
        maps=_maps(results) + _drawn_maps(results) + _distributions(results),
        table=_table(results),
        provenance=_provenance(results.played_by),
    )


def _maps(results: Results) -> str:
    """Maps of each quantity, one for every combination of the values that are not on the axes."""
    axes = [axis for axis, values in results.plan.spec.grid.items() if len(values) > 1][:2]
    if not axes:
        return ""
    across, down = axes[0], axes[1] if len(axes) > 1 else None
    cells = _labelled(results)
    rest = [tuple((name, value) for name, value in names.items() if name not in axes) for names, _ in cells]
    sections: list[str] = []
    groups = list(dict.fromkeys(rest))
    numbers, squares = MOST_NUMBERS, MOST_SQUARES
    for group in groups:
        found = {
            (names[across], names[down] if down else ""): summary
            for (names, summary), other in zip(cells, rest, strict=True)
            if other == group
        }
        squares -= len(MAPPED) * len(found)
        numbers -= len(MAPPED) * len(found)
        if squares < 0:
            break
        where = ", ".join(f"{name} {value}" for name, value in group)
        maps = "".join(
            _map(
                quantity,
                {key: quantity.of(each) for key, each in found.items()},
                (across, down or ""),
                where,
                with_numbers=numbers >= 0,
            )
            for quantity in MAPPED
        )
        sections.append(f'<div class="maps">{maps}</div>')
    hidden = len(groups) - len(sections)
    note = f"<p>{number_of(hidden, 'more map')} of each quantity: see the JSON file.</p>" if hidden else ""
    return f'<section aria-labelledby="maps"><h2 id="maps">Maps</h2>{"".join(sections)}{note}</section>'


def _drawn_maps(results: Results) -> str:
    """Maps over the first two drawn axes, all cells together."""
    found = results.distribution
    if not found.axes:
        return ""
    names = [
        [f"{low + (i + 0.5) * (high - low) / DRAWN_BINS:.4g}" for i in range(DRAWN_BINS)]
        for low, high in found.axes.values()
    ]
    across, down = (*found.axes, "")[:2]
    names = [*names, [""]][:2]
    maps = []
    for quantity, sums, counts in zip(
        MAPPED, (found.latency_n, found.missed), (found.detected, found.visible), strict=True
    ):
        ratios = {
            (name, other): total / count if count else None
            for (name, other), total, count in zip(
                itertools.product(*names), sums.ravel().tolist(), counts.ravel().tolist(), strict=True
            )
        }
        maps.append(_map(quantity, ratios, (across, down), "drawn values, middle of each bin"))
    return (
        '<section aria-labelledby="drawn"><h2 id="drawn">Drawn values</h2>'
        f'<div class="maps">{"".join(maps)}</div></section>'
    )


def _distributions(results: Results) -> str:
    """Histograms of the detection delay and of the errors of the estimates."""
    delays = results.latencies
    bars = []
    if len(delays.values):
        edges = np.unique(np.linspace(delays.values[0], delays.values[-1] + 1, _BARS + 1).astype(np.int64))
        counts = np.add.reduceat(delays.counts, np.searchsorted(delays.values, edges[:-1]))
        counts[np.searchsorted(delays.values, edges[:-1]) == np.searchsorted(delays.values, edges[1:])] = 0
        bars.append(_histogram("Detection delay [samples]", counts.tolist(), (f"{edges[0]}", f"{edges[-1] - 1}")))
    for name, row in zip(results.plan.estimates, results.distribution.errors, strict=False):
        inner = row[1:-1]
        if row.any():
            wide = max((abs(i - ERROR_BINS // 2 + 0.5) for i in np.flatnonzero(inner).tolist()), default=0.0)
            half = max(5, int(wide + 0.5))
            shown = inner[ERROR_BINS // 2 - half : ERROR_BINS // 2 + half]
            beyond = f"; {number_of(int(row[0] + row[-1]), 'trial', form=',')} beyond 100 %" if row[0] + row[-1] else ""
            ends = (f"{-half * ERROR_STEP:.0%}", f"{half * ERROR_STEP:.0%}")
            bars.append(_histogram(f"Relative error of {name}{beyond}", shown.tolist(), ends))
    if not bars:
        return ""
    return (
        '<section aria-labelledby="spread"><h2 id="spread">Distributions over all trials</h2>'
        f'<div class="maps">{"".join(bars)}</div></section>'
    )


def _histogram(title: str, counts: Sequence[int], ends: tuple[str, str]) -> str:
    most, step = max(counts), _BARS_WIDTH / len(counts)
    bars = "".join(
        f'<path d="M{i * step + 2:.1f} {_BARS_HEIGHT}v{-_BARS_HEIGHT * count / most:.1f}h{step:.1f}V{_BARS_HEIGHT}z"/>'
        for i, count in enumerate(counts)
        if count
    )
    caption = html.escape(f"{title}; {sum(counts):,} in all, highest bar {most:,}")
    return (
        f'<figure><figcaption>{caption}</figcaption><svg role="img" aria-label="{caption}"'
        f' width="{_BARS_WIDTH + 4}" height="{_BARS_HEIGHT + 20}" font-size="13">'
        f'<g fill="{_colour(1.0)}">{bars}</g>'
        f"{_words(0, _BARS_HEIGHT + 15, ends[0], 'start')}{_words(_BARS_WIDTH, _BARS_HEIGHT + 15, ends[1], 'end')}"
        "</svg></figure>"
    )


def _map(
    quantity: Column,
    values: Mapping[tuple[str, str], float | None],
    axes: tuple[str, str],
    where: str,
    *,
    with_numbers: bool = True,
) -> str:
    columns, rows = (list(dict.fromkeys(key[i] for key in values)) for i in range(2))
    most = max((value for value in values.values() if value is not None), default=0.0)
    width, height = (_WIDTH, _HEIGHT) if with_numbers else (_SMALL, _SMALL)
    parts = [
        _words(_LEFT + (i + 0.5) * width, _TOP - 8, name)
        for i, name in enumerate(columns)
        if with_numbers or i in (0, len(columns) - 1)
    ]
    parts += [
        _words(_LEFT - 8, _TOP + (j + 0.6) * height, name, "end")
        for j, name in enumerate(rows)
        if with_numbers or j in (0, len(rows) - 1)
    ]
    for (i, column), (j, row) in itertools.product(enumerate(columns), enumerate(rows)):
        value = values[column, row]
        share = 0.0 if value is None or most == 0.0 else value / most
        x, y = _LEFT + i * width, _TOP + j * height
        fill = "#d5d5d5" if value is None else _colour(share)
        parts.append(
            _square(x, y, fill, share, "–" if value is None else format(value, quantity.form))
            if with_numbers
            else f'<path d="M{x} {y}h{width}v{height}h-{width}z" fill="{fill}"/>'
        )
    title = f"{quantity.title}{f' ({where})' if where else ''}"
    caption = f"{title}; across: {axes[0]}{f', down: {axes[1]}' if axes[1] else ''}; darkest: {most:{quantity.form}}"
    return (
        f'<figure><figcaption>{html.escape(caption)}</figcaption><div class="scroll">'
        f'<svg role="img" aria-label="{html.escape(caption)}"'
        f' width="{_LEFT + len(columns) * width + 2}" height="{_TOP + len(rows) * height + 2}" font-size="13">'
        f"{''.join(parts)}</svg></div></figure>"
    )


def _colour(share: float) -> str:
    return "#" + "".join(f"{round(255 + share * (deep - 255)):02x}" for deep in _DEEPEST)


def _square(x: float, y: float, fill: str, share: float, text: str) -> str:
    ink = "#ffffff" if share > 0.85 else "#1a1a1a"
    return (
        f'<rect x="{x}" y="{y}" width="{_WIDTH}" height="{_HEIGHT}" fill="{fill}"'
        f' stroke="#8a8a8a"/>{_words(x + 0.5 * _WIDTH, y + 0.62 * _HEIGHT, text, colour=ink)}'
    )


def _words(x: float, y: float, text: str, anchor: str = "middle", colour: str = "currentColor") -> str:
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" fill="{colour}">{html.escape(text)}</text>'


def _table(results: Results) -> str:
    cells = _labelled(results)
    names = list(cells[0][0])
    head = "".join(f'<th scope="col">{html.escape(name)}</th>' for name in names)
    head += "".join(f'<th scope="col" class="number">{column.title}</th>' for column in COLUMNS)
    rows = "".join(f"<tr>{_row(list(each.values()), summary)}</tr>" for each, summary in cells[:MOST_ROWS])
    hidden = f"; {number_of(len(cells) - MOST_ROWS, 'more cell')}: see the JSON file" if len(cells) > MOST_ROWS else ""
    caption = f"{_BOUNDS.capitalize()}; latency and bound in samples from the change{hidden}"
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
