"""Results of a campaign as a table for the terminal, as JSON, and as a page.

The page has maps over two axes of the grid, distributions, and every cell with its trials.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from analogrig.campaigns.aggregates import (
    CONFIDENCE,
    DRAWN_BINS,
    ERROR_BINS,
    ERROR_STEP,
    MOST_NOT_PASSED,
    RATES,
    Summary,
    independent,
)
from analogrig.campaigns.plan import Plan
from analogrig.campaigns.tally import Results
from analogrig.errors import ConfigurationError
from analogrig.output import replace_file
from analogrig.pages import TABLES, render_page
from analogrig.reporting.page import provenance
from analogrig.wording import counter_text, number_of

_MARK, _FORMAT = b'data-page="analogrig-campaign"', b'"format": "analogrig-campaign"'
"""Markers that identify the page and the aggregated results of a campaign."""

BOUNDS = f"bounds at {CONFIDENCE:.0%}, whenever the campaign ended and whatever the dependence within a trial"
"""Note on the bounds in the tables."""


def labelled(results: Results) -> list[tuple[dict[str, str], Summary]]:
    """Cells with the labels that identify them: rig and device where there are several, and the values of the grid."""
    plan, out = results.plan, []
    for cell, summary in results.cells:
        labels = {"rig": str(plan.rigs[cell.rig]["name"])} if len(plan.rigs) > 1 else {}
        labels |= {"device": str(plan.devices[cell.device]["name"])} if len(plan.devices) > 1 else {}
        out.append((labels | {axis: f"{value:g}" for axis, value in cell.values.items()}, summary))
    return out


def counts_text(counted: Mapping[str, int]) -> str:
    """Events so far, with their exposures, in one line."""
    parts = []
    for name, rate in RATES.items():
        if counted[rate.exposure]:
            parts.append(f"{counter_text(counted[name], name)} in {counter_text(counted[rate.exposure], rate.unit)}")
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


def text(results: Results) -> str:
    """Results as several lines of text, without a final newline."""
    spec, total = results.plan.spec, results.total
    cells = labelled(results)
    names = list(cells[0][0]) if len(cells) > 1 else []
    counts = ((len(cells), "cell"), (total.trials, "trial"), (total.samples, "sample"))
    head = f"campaign {spec.name}: {', '.join(number_of(*each) for each in counts)}: "
    rows = [[*names, *(column.short for column in COLUMNS)]]
    rows += [[*(labels[name] for name in names), *_numbers(summary)] for labels, summary in cells]
    if len(cells) > 1:
        rows.append([*("all" if name == names[0] else "" for name in names), *_numbers(total)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)) for row in rows]
    notes = [f"{BOUNDS}; latency, p95 and bound in samples"]
    if total.inconclusive:
        notes.append(f"{number_of(total.inconclusive, 'trial')} inconclusive, such as {total.inconclusive_reason}")
    return "\n".join(
        [head + results.outcome.upper(), "", *(f"  {line}" for line in lines), "", *(f"  {note}" for note in notes)]
    )


def as_json(results: Results) -> dict[str, Any]:
    """Results as plain values; rates as [low, high]."""
    cells = [{**labels, **vars(summary)} for labels, summary in labelled(results)]
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


# ---------------------------------------------------------------------------------------------------------- the page

MOST_NUMBERS, MOST_SQUARES = 3_000, 20_000
"""Largest number of squares with numbers on a page, and of all squares."""

MOST_ROWS = 2_000
"""Largest number of cells in the table."""

_BARS = 100


class Square(NamedTuple):
    """Square of a map."""

    value: float | None
    """None: unknown."""
    label: str
    note: str = ""
    """Second line, such as the bound of a rate."""
    title: str = ""
    """Description of the cell for its tooltip and for screen readers."""
    link: str = ""


@dataclass(frozen=True)
class Map:
    """Panel of a map. Without numbers its squares are small, and only their tooltips have the numbers."""

    caption: str
    across: str
    down: str
    """Titles of the axes; that down may be empty."""
    squares: Mapping[tuple[str, str], Square]
    """Squares by the values on the axes across and down."""
    has_numbers: bool = True

    @property
    def columns(self) -> list[str]:
        return list(dict.fromkeys(across for across, _ in self.squares))

    @property
    def rows(self) -> list[str]:
        return list(dict.fromkeys(down for _, down in self.squares))

    @property
    def width(self) -> int:
        return 74 if self.has_numbers else 9

    @property
    def height(self) -> int:
        return 42 if self.has_numbers else 9

    @property
    def has_links(self) -> bool:
        return any(square.link for square in self.squares.values())

    def places(self) -> Iterator[tuple[int, int, Square]]:
        """Squares with the numbers of their columns and rows."""
        rows = self.rows
        for i, across in enumerate(self.columns):
            for j, down in enumerate(rows):
                yield i, j, self.squares[across, down]


@dataclass(frozen=True)
class PlottedQuantity:
    """Quantity that maps show."""

    name: str
    form: str
    of: Callable[[Summary], float | None]
    note: Callable[[Summary], str]
    most: float = 0.0
    """Value of the deepest colour."""
    maps: Sequence[Map] = ()

    def square(self, value: float | None, note: str = "", title: str = "", link: str = "") -> Square:
        return Square(value, "–" if value is None else format(value, self.form), note, title, link)


class PlottedHistogram(NamedTuple):
    """Bars over an axis with the title ``across`` from ``first`` to ``last``; ``counted``: what is counted."""

    caption: str
    across: str
    counted: str
    counts: list[int]
    first: str
    last: str


class _Cell(NamedTuple):
    number: int
    labels: Mapping[str, str]
    summary: Summary
    not_passed: Sequence[tuple[int, str, str]]


class _Trial(NamedTuple):
    """Trial that has not passed."""

    cell: _Cell
    is_first: bool
    """True for the first one of its cell, to which links lead."""
    seed: int
    outcome: str
    why: str


def write_page(results: Results, path: Path) -> None:
    """Write the page: either all of it or nothing. The same results give the same bytes.

    :raises RecordingError: the page cannot be written.
    """
    with replace_file(path) as file:
        file.write(render(results).encode("utf-8", "replace"))


def render(results: Results) -> str:
    """The page as text: at most 5 MB, whatever the number of cells and trials."""
    cells = [
        _Cell(number, *labels_and_summary, found.not_passed)
        for number, (labels_and_summary, found) in enumerate(zip(labelled(results), results.aggregates, strict=True))
    ]
    quantities, hidden = _mapped(results, cells)
    return render_page(
        "campaign.html",
        (TABLES,),
        title=f"campaign {results.plan.spec.name}",
        results=results,
        cells=cells,
        axes=[_axis(results.plan, axis) for axis in cells[0].labels],
        columns=COLUMNS,
        quantities=quantities,
        hidden_maps=hidden,
        drawn=_drawn(results),
        histograms=list(_histograms(results)),
        trials=[_Trial(cell, not i, *trial) for cell in cells[:MOST_ROWS] for i, trial in enumerate(cell.not_passed)],
        provenance=[pair for identity in results.played_by for pair in provenance(identity)],
        bounds=BOUNDS,
        confidence=CONFIDENCE,
        most_rows=MOST_ROWS,
        most_not_passed=MOST_NOT_PASSED,
    )


def _at_most(rate: float) -> str:
    return "≤ 100%" if rate > 0.99 else f"≤ {100 * rate:.2g}%"


_LATENCY = PlottedQuantity(
    "Mean latency [samples]",
    ".1f",
    lambda summary: summary.latency_n,
    lambda summary: "" if summary.bound_n is None else f"bound {summary.bound_n:.1f}",
)
_MISSES = PlottedQuantity(
    "Miss rate",
    ".1%",
    lambda summary: summary.missed / summary.visible if summary.visible else None,
    lambda summary: _at_most(summary.miss_rate[1]) if summary.visible else "",
)


def _mapped(results: Results, cells: Sequence[_Cell]) -> tuple[list[PlottedQuantity], int]:
    """Quantities with a map for every combination of the values that are not on the axes, and how many are hidden."""
    plan = results.plan
    axes = [axis for axis, values in plan.spec.grid.items() if len(values) > 1][:2]
    if not axes:
        return [], 0
    across, down = (*axes, "")[:2]
    groups: dict[str, dict[tuple[str, str], _Cell]] = {}
    for cell in cells:
        where = _place(plan, {name: value for name, value in cell.labels.items() if name not in axes})
        groups.setdefault(where, {})[cell.labels[across], cell.labels[down] if down else ""] = cell
    size = 2 * max(map(len, groups.values()))
    shown, numbered = list(groups.items())[: MOST_SQUARES // size], MOST_NUMBERS // size
    titles = _axis(plan, across), _axis(plan, down) if down else ""
    out = []
    for quantity in (_LATENCY, _MISSES):
        maps = []
        for i, (where, found) in enumerate(shown):
            squares = {key: _square(plan, quantity, cell, has_numbers=i < numbered) for key, cell in found.items()}
            maps.append(Map(where or "all cells", *titles, squares, has_numbers=i < numbered))
        out.append(dataclasses.replace(quantity, most=_most(map(quantity.of, (c.summary for c in cells))), maps=maps))
    return out, len(groups) - len(shown)


def _most(values: Iterable[float | None]) -> float:
    return max((value for value in values if value is not None), default=0.0)


def _square(plan: Plan, quantity: PlottedQuantity, cell: _Cell, *, has_numbers: bool) -> Square:
    summary = cell.summary
    link = f"#cell-{cell.number}" if has_numbers and cell.number < MOST_ROWS else ""
    latency = "–" if summary.latency_n is None else f"{summary.latency_n:.1f}"
    title = f"{', '.join(cell.labels.values())}: {latency}, {summary.missed}/{summary.visible}"
    if has_numbers:
        delay = "none detected" if summary.latency_n is None else f"latency {latency} samples"
        bound = "" if summary.bound_n is None else f" (bound {summary.bound_n:.1f})"
        rate = f" (rate {_at_most(summary.miss_rate[1])})" if summary.visible else ""
        title = (
            f"{_place(plan, cell.labels)}: {delay}{bound}, {summary.missed:,} of {summary.visible:,} changes"
            f" missed{rate}, {number_of(summary.false_alarms, 'false alarm', form=',')}"
        )
    return quantity.square(quantity.of(summary), quantity.note(summary), title, link)


def _place(plan: Plan, labels: Mapping[str, str]) -> str:
    """Values on some axes in words."""
    parts = ((*plan.axis(axis), value) for axis, value in labels.items())
    return ", ".join(f"{name} {value}{f' {unit}' if unit else ''}" for name, unit, value in parts)


def _axis(plan: Plan, axis: str) -> str:
    """Title of an axis with its unit; of ``rig`` and ``device`` the name."""
    name, unit = plan.axis(axis)
    return f"{name} [{unit}]" if unit else name


def _drawn(results: Results) -> list[PlottedQuantity]:
    """Quantities with a map over the first two drawn axes, all cells together; empty if nothing is drawn."""
    found = results.distribution
    if not found.axes:
        return []
    names = [
        [f"{low + (i + 0.5) * (high - low) / DRAWN_BINS:.4g}" for i in range(DRAWN_BINS)]
        for low, high in found.axes.values()
    ]
    across, down = (*(_axis(results.plan, axis) for axis in found.axes), "")[:2]
    keys = [(name, other) for name in names[0] for other in (names[1] if len(names) > 1 else [""])]
    detected = [
        _LATENCY.square(total / count if count else None, title=f"{number_of(count, 'change', form=',')} detected")
        for total, count in zip(found.latency_n.ravel().tolist(), found.detected.ravel().tolist(), strict=True)
    ]
    missed = [
        _MISSES.square(
            total / count if count else None,
            _at_most(independent(total, count).bounds[1]) if count else "",
            f"{total:,} of {count:,} changes missed",
        )
        for total, count in zip(found.missed.ravel().tolist(), found.visible.ravel().tolist(), strict=True)
    ]
    out = []
    for quantity, squares in ((_LATENCY, detected), (_MISSES, missed)):
        maps = [Map("drawn values, middle of each bin", across, down, dict(zip(keys, squares, strict=True)))]
        out.append(dataclasses.replace(quantity, most=_most(each.value for each in squares), maps=maps))
    return out


def _histograms(results: Results) -> Iterator[PlottedHistogram]:
    """Histograms of the detection delay and of the errors of the estimates."""
    delays = results.latencies
    if len(delays.values):
        edges = np.unique(np.linspace(delays.values[0], delays.values[-1] + 1, _BARS + 1).astype(np.int64))
        counts = np.add.reduceat(delays.counts, np.searchsorted(delays.values, edges[:-1]))
        counts[np.searchsorted(delays.values, edges[:-1]) == np.searchsorted(delays.values, edges[1:])] = 0
        ends = f"{edges[0]}", f"{edges[-1] - 1}"
        yield PlottedHistogram("Detection delay", "delay [samples]", "changes", counts.tolist(), *ends)
    for name, errors in zip(results.plan.estimates, results.distribution.errors, strict=False):
        inner = errors[1:-1]
        if errors.any():
            wide = max((abs(i - ERROR_BINS // 2 + 0.5) for i in np.flatnonzero(inner).tolist()), default=0.0)
            half = max(5, int(wide + 0.5))
            shown = inner[ERROR_BINS // 2 - half : ERROR_BINS // 2 + half]
            outside = int(errors[0] + errors[-1])
            beyond = f"; {number_of(outside, 'trial', form=',')} beyond 100 %" if outside else ""
            ends = f"{-half * ERROR_STEP:.0%}", f"{half * ERROR_STEP:.0%}"
            yield PlottedHistogram(
                f"Error of {name}{beyond}", f"relative error of {name}", "trials", shown.tolist(), *ends
            )
