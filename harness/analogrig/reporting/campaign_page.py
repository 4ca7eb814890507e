"""Page of a campaign: maps over two axes of the grid, distributions, and every cell with its trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analogrig.campaigns.plan import Plan
from analogrig.campaigns.results import Results
from analogrig.campaigns.summary import (
    CONFIDENCE,
    DRAWN_BINS,
    ERROR_BINS,
    ERROR_STEP,
    MOST_NOT_PASSED,
    RATES,
    Summary,
)
from analogrig.identity import Identity
from analogrig.pages import FOLDER, TABLES, assemble_page
from analogrig.reporting.campaign import BOUNDS, COLUMNS, labelled
from analogrig.reporting.maps import Square, Squares, heat_map, legend
from analogrig.reporting.markings import figure, levels, words
from analogrig.reporting.markup import SORTABLE, cell, heading, pairs, row, table, text
from analogrig.reporting.tables import provenance
from analogrig.storage import replace_file
from analogrig.wording import number_of

MOST_NUMBERS, MOST_SQUARES = 3_000, 20_000
"""Largest number of squares with numbers on a page, and of all squares."""

MOST_ROWS = 2_000
"""Largest number of cells in the table."""

_BARS, _BARS_WIDTH, _BARS_HEIGHT, _BARS_LEFT = 100, 290, 120, 52


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
        FOLDER / "campaign.html",
        (TABLES,),
        title=text(f"campaign {spec.name}"),
        outcome=results.outcome,
        heading=text(f"Campaign {spec.name}: {results.outcome.upper()}"),
        sentence=text(
            f"{scenario}: {total.trials:,} trials in {len(results.aggregates):,} cells, {total.samples:,} samples;"
            f" {total.missed:,} of {total.visible:,} visible changes missed, {total.late:,} detected late,"
            f" {total.false_alarms:,} false alarms, {total.inconclusive:,} trials inconclusive."
        ),
        maps=_maps(results) + _drawn_maps(results) + _distributions(results),
        table=_table(results),
        trials=_not_passed(results),
        provenance=_provenance(results.played_by),
    )


@dataclass(frozen=True)
class _Mapped:
    """Quantity of the maps."""

    name: str
    form: str
    of: Callable[[Summary], float | None]
    note: Callable[[Summary], str]

    def square(self, summary: Summary, title: str, link: str) -> Square:
        return Square(*_shown(self.of(summary), self.form), self.note(summary), title, link)


def _shown(value: float | None, form: str) -> tuple[float | None, str]:
    return value, "–" if value is None else format(value, form)


def _at_most(rate: float) -> str:
    return "≤ 100%" if rate > 0.99 else f"≤ {100 * rate:.2g}%"


_LATENCY = _Mapped(
    "Mean latency [samples]",
    ".1f",
    lambda summary: summary.latency_n,
    lambda summary: "" if summary.bound_n is None else f"bound {summary.bound_n:.1f}",
)
_MISSES = _Mapped(
    "Miss rate",
    ".1%",
    lambda summary: summary.missed / summary.visible if summary.visible else None,
    lambda summary: _at_most(summary.miss_rate[1]) if summary.visible else "",
)
_MAPPED = (_LATENCY, _MISSES)

_NOTE = (
    f"Second line of a square: the information bound of the latency; ≤ the upper bound of the rate at {CONFIDENCE:.0%}."
)


def _maps(results: Results) -> str:
    """Maps of each quantity, one panel for every combination of the values that are not on the axes."""
    axes = [axis for axis, values in results.plan.spec.grid.items() if len(values) > 1][:2]
    if not axes:
        return ""
    across, down = (*axes, "")[:2]
    groups: dict[str, dict[tuple[str, str], tuple[int, Mapping[str, str], Summary]]] = {}
    for number, (names, summary) in enumerate(labelled(results)):
        where = _place(results.plan, {name: value for name, value in names.items() if name not in axes})
        groups.setdefault(where, {})[names[across], names[down] if down else ""] = number, names, summary
    size = len(_MAPPED) * max(map(len, groups.values()))
    shown, numbered = list(groups.items())[: MOST_SQUARES // size], MOST_NUMBERS // size
    sections = []
    for quantity in _MAPPED:
        known = [value for _, summary in results.cells if (value := quantity.of(summary)) is not None]
        most = max(known, default=0.0)
        panels = (
            heat_map(
                where or "all cells",
                (_axis(results.plan, across), _axis(results.plan, down) if down else ""),
                dict(_squares(results.plan, quantity, found, has_numbers=i < numbered)),
                most,
                with_numbers=i < numbered,
            )
            for i, (where, found) in enumerate(shown)
        )
        sections.append(_section(quantity.name, most, quantity.form, panels))
    hidden = len(groups) - len(shown)
    note = f"<p>{number_of(hidden, 'more map')} of each quantity: see the JSON file.</p>" if hidden else ""
    return (
        f'<section aria-labelledby="maps"><h2 id="maps">Maps</h2><p>{text(_NOTE)} A square leads to its cell and the'
        f" trials that have not passed.</p>{''.join(sections)}{note}</section>"
    )


def _squares(
    plan: Plan,
    quantity: _Mapped,
    found: Mapping[tuple[str, str], tuple[int, Mapping[str, str], Summary]],
    *,
    has_numbers: bool,
) -> Iterator[tuple[tuple[str, str], Square]]:
    for key, (number, names, summary) in found.items():
        link = f"#cell-{number}" if has_numbers and number < MOST_ROWS else ""
        yield (
            key,
            quantity.square(summary, _title(plan, names, summary) if has_numbers else _short(names, summary), link),
        )


def _title(plan: Plan, names: Mapping[str, str], summary: Summary) -> str:
    latency = "none detected" if summary.latency_n is None else f"latency {summary.latency_n:.1f} samples"
    bound = "" if summary.bound_n is None else f" (bound {summary.bound_n:.1f})"
    rate = f" (rate {_at_most(summary.miss_rate[1])})" if summary.visible else ""
    return (
        f"{_place(plan, names)}: {latency}{bound}, {summary.missed:,} of {summary.visible:,} changes missed{rate},"
        f" {number_of(summary.false_alarms, 'false alarm', form=',')}"
    )


def _short(names: Mapping[str, str], summary: Summary) -> str:
    latency = "–" if summary.latency_n is None else f"{summary.latency_n:.1f}"
    return f"{', '.join(names.values())}: {latency}, {summary.missed}/{summary.visible}"


def _place(plan: Plan, names: Mapping[str, str]) -> str:
    """Values on some axes in words."""
    parts = ((*plan.axis(axis), value) for axis, value in names.items())
    return ", ".join(f"{name} {value}{f' {unit}' if unit else ''}" for name, unit, value in parts)


def _axis(plan: Plan, axis: str) -> str:
    """Title of an axis with its unit; of ``rig`` and ``device`` the name."""
    name, unit = plan.axis(axis)
    return f"{name} [{unit}]" if unit else name


def _section(name: str, most: float, form: str, panels: Iterator[str]) -> str:
    return f'<h3>{text(name)}</h3>{legend(name, most, form)}<div class="maps">{"".join(panels)}</div>'


def _drawn_maps(results: Results) -> str:
    """Maps over the first two drawn axes, all cells together."""
    found = results.distribution
    if not found.axes:
        return ""
    names = [
        [f"{low + (i + 0.5) * (high - low) / DRAWN_BINS:.4g}" for i in range(DRAWN_BINS)]
        for low, high in found.axes.values()
    ]
    axes = (*(_axis(results.plan, axis) for axis in found.axes), "")[:2]
    keys = [(name, other) for name in names[0] for other in (names[1] if len(names) > 1 else [""])]
    sections = []
    for quantity, sums, counts in zip(
        _MAPPED, (found.latency_n, found.missed), (found.detected, found.visible), strict=True
    ):
        squares: Squares = {
            key: Square(*_shown(total / count if count else None, quantity.form), *_drawn_notes(quantity, total, count))
            for key, total, count in zip(keys, sums.ravel().tolist(), counts.ravel().tolist(), strict=True)
        }
        most = max((each.value for each in squares.values() if each.value is not None), default=0.0)
        panel = heat_map("drawn values, middle of each bin", axes, squares, most)
        sections.append(_section(quantity.name, most, quantity.form, iter([panel])))
    return f'<section aria-labelledby="drawn"><h2 id="drawn">Drawn values</h2>{"".join(sections)}</section>'


def _drawn_notes(quantity: _Mapped, total: int, count: int) -> tuple[str, str]:
    """Second line and tooltip of a bin."""
    if quantity is _LATENCY:
        return "", f"{number_of(count, 'change', form=',')} detected"
    title = f"{total:,} of {count:,} changes missed"
    if not count:
        return "", title
    bound = RATES["missed"].sequence({"missed": total, "visible": count}, CONFIDENCE).bounds[1]
    return _at_most(bound), title


def _distributions(results: Results) -> str:
    """Histograms of the detection delay and of the errors of M, B, K."""
    delays = results.latencies
    bars = []
    if len(delays.values):
        edges = np.unique(np.linspace(delays.values[0], delays.values[-1] + 1, _BARS + 1).astype(np.int64))
        counts = np.add.reduceat(delays.counts, np.searchsorted(delays.values, edges[:-1]))
        counts[np.searchsorted(delays.values, edges[:-1]) == np.searchsorted(delays.values, edges[1:])] = 0
        ends = f"{edges[0]}", f"{edges[-1] - 1}"
        bars.append(_histogram("Detection delay", "delay [samples]", "changes", counts.tolist(), ends))
    for name, errors in zip(results.plan.estimates, results.distribution.errors, strict=False):
        inner = errors[1:-1]
        if errors.any():
            wide = max((abs(i - ERROR_BINS // 2 + 0.5) for i in np.flatnonzero(inner).tolist()), default=0.0)
            half = max(5, int(wide + 0.5))
            shown = inner[ERROR_BINS // 2 - half : ERROR_BINS // 2 + half]
            outside = int(errors[0] + errors[-1])
            beyond = f"; {number_of(outside, 'trial', form=',')} beyond 100 %" if outside else ""
            ends = f"{-half * ERROR_STEP:.0%}", f"{half * ERROR_STEP:.0%}"
            bars.append(
                _histogram(f"Error of {name}{beyond}", f"relative error of {name}", "trials", shown.tolist(), ends)
            )
    if not bars:
        return ""
    return (
        '<section aria-labelledby="spread"><h2 id="spread">Distributions over all trials</h2>'
        f'<div class="maps">{"".join(bars)}</div></section>'
    )


def _histogram(caption: str, across: str, up: str, counts: Sequence[int], ends: tuple[str, str]) -> str:
    """Bars over an axis with the title ``across``, of which ``ends`` are the ends; ``up``: what is counted."""
    most, step = max(1, *counts), _BARS_WIDTH / len(counts)
    top = 22
    parts = [words(_BARS_LEFT, 12, up, is_faint=True)]
    for value in levels(most):
        y = top + _BARS_HEIGHT * (1.0 - value / most)
        parts.append(f'<path d="M{_BARS_LEFT} {y:.1f}h{_BARS_WIDTH}" stroke="var(--line)"/>')
        parts.append(words(_BARS_LEFT - 6, y + 4, f"{value:g}", "end"))
    bars = "".join(
        f'<path d="M{_BARS_LEFT + i * step:.1f} {top + _BARS_HEIGHT}v{-_BARS_HEIGHT * count / most:.1f}h{step:.1f}'
        f'V{top + _BARS_HEIGHT}z"/>'
        for i, count in enumerate(counts)
        if count
    )
    parts.append(f'<g fill="var(--first)">{bars}</g>')
    right, below = _BARS_LEFT + _BARS_WIDTH, top + _BARS_HEIGHT + 15
    parts += [words(_BARS_LEFT, below, ends[0], "start"), words(right, below, ends[1], "end")]
    parts.append(words((_BARS_LEFT + right) / 2, below + 14, across, is_faint=True))
    caption = f"{caption}: {sum(counts):,} {up}"
    label = f"{caption}; {across} from {ends[0]} to {ends[1]}, highest bar {most:,}"
    return figure(caption, label, right + 6, below + 20, parts, has_links=False)


def _table(results: Results) -> str:
    cells = labelled(results)
    not_passed = [bool(each.not_passed) for each in results.aggregates]
    head = heading((_axis(results.plan, axis) for axis in cells[0][0]), (column.title for column in COLUMNS))
    caption = f"{BOUNDS.capitalize()}; latency and bound in samples from the change"
    if len(cells) > MOST_ROWS:
        caption += f"; {number_of(len(cells) - MOST_ROWS, 'more cell')}: see the JSON file"
    rows = (
        _row(number, list(names.values()), summary, has_trials=not_passed[number])
        for number, (names, summary) in enumerate(cells[:MOST_ROWS])
    )
    return table(caption, head, rows, SORTABLE, MOST_ROWS)


def _row(number: int, names: Sequence[str], summary: Summary, *, has_trials: bool) -> str:
    cells = [f'<th scope="row" class="number">{text(name)}</th>' for name in names]
    for column in COLUMNS:
        content = column.cell(summary, "–")
        if has_trials and column.title in ("failed", "inconclusive") and content != "0":
            content = f'<a href="#trials-{number}">{content}</a>'
        cells.append(f'<td class="number">{content}</td>')
    return row(cells, f"cell-{number}")


def _not_passed(results: Results) -> str:
    """First trials of each cell that have not passed, with their reasons."""
    names = [each for each, _ in labelled(results)]
    rows = []
    for number, found in enumerate(results.aggregates[:MOST_ROWS]):
        for i, (seed, outcome, why) in enumerate(found.not_passed):
            places = [f'<th scope="row" class="number">{text(value)}</th>' for value in names[number].values()]
            cells = [*places, cell(seed, "number"), cell(outcome), cell(why, "text reason")]
            rows.append(row(cells, "" if i else f"trials-{number}"))
    if not rows:
        return "<p>Every trial has passed.</p>"
    head = heading((_axis(results.plan, axis) for axis in names[0]), ("seed",), ("outcome", "reason"))
    caption = f"The first {MOST_NOT_PASSED} of each cell; all trials are in the SQLite file"
    return table(caption, head, rows, SORTABLE, MOST_ROWS)


def _provenance(played_by: Sequence[Identity]) -> str:
    if not played_by:
        return ""
    rows = (pair for identity in played_by for pair in provenance(identity))
    return (
        '<section aria-labelledby="made"><h2 id="made">What made it</h2>'
        f"{pairs('Every command that has played a part', rows)}</section>"
    )
