"""The page: figures as in the thesis, every printed number beside ours, errata, claims and the comparison.

Texts of ours may hold HTML where ``document`` says so; all others are escaped here, in ``_text``.
"""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.reporting.page import SCRIPTS, STYLES, assembled
from analogrig.reporting.payload import as_script, deflated
from analogrig_thesis.comparison import Comparison, Data
from analogrig_thesis.document import Chapter, Claim, Figure, Number, Panel, Verdict
from analogrig_thesis.tracking import Performance

_FOLDER = Path(__file__).parent

_CLASSES: dict[Verdict, str] = {
    "holds": "holds",
    "holds with a reading": "reading",
    "does not hold": "fails",
    "not reproduced": "fails",
}


def render(chapters: Sequence[Chapter], comparison: Comparison) -> str:
    """The page as text; the same input gives the same text.

    :raises RecordingError: the build has not put uPlot in its place.
    """
    figures = [figure for chapter in chapters for figure in chapter.figures]
    order = {figure.number: i for i, figure in enumerate(figures)}
    claims = [claim for chapter in chapters for claim in chapter.claims]
    return assembled(
        _FOLDER / "page.html",
        (*STYLES, _FOLDER / "page.css"),
        (*SCRIPTS, _FOLDER / "page.js"),
        title="The thesis, reproduced",
        summary=_summary(claims),
        contents=_contents(chapters),
        chapters="\n".join(_chapter(chapter, order) for chapter in chapters),
        comparison=_comparison(comparison),
        data=as_script(_payload(figures)),
    )


def _payload(figures: Sequence[Figure]) -> dict[str, Any]:
    """All that the plots need: every signal is a column, named by its place."""
    columns: list[NDArray[np.float32]] = []

    def column(values: NDArray[np.float64]) -> int:
        columns.append(values.astype(np.float32))
        return len(columns) - 1

    def panel(each: Panel) -> dict[str, Any]:
        return {
            "title": each.title,
            "x_label": each.x_label,
            "y_label": each.y_label,
            "log": each.log_x,
            "shown": each.shown,
            "x": None if each.x is None else column(each.x),
            "curves": [
                {"label": curve.label, "ink": curve.ink, "style": curve.style, "column": column(curve.values)}
                for curve in each.curves
            ],
        }

    described = [
        {
            "number": figure.number,
            "marks": [vars(mark) for mark in figure.marks],
            "panels": [panel(each) for each in figure.panels],
        }
        for figure in figures
    ]
    return {"figures": described, "lengths": [len(each) for each in columns], "deflated": deflated(columns)}


def _summary(claims: Sequence[Claim]) -> str:
    counted = Counter(claim.verdict for claim in claims)
    tally = "".join(
        f'<li class="{_CLASSES[verdict]}"><strong>{counted[verdict]}</strong>'
        f" claim{'' if counted[verdict] == 1 else 's'} {_verb(verdict, counted[verdict])}</li>"
        for verdict in _CLASSES
    )
    return f'<ul class="tally" aria-label="Verdicts">{tally}</ul>'


def _verb(verdict: Verdict, count: int) -> str:
    if count == 1:
        return verdict
    return {
        "holds": "hold",
        "holds with a reading": "hold with a reading",
        "does not hold": "do not hold",
        "not reproduced": "are not reproduced",
    }[verdict]


def _contents(chapters: Sequence[Chapter]) -> str:
    def links(chapter: Chapter) -> str:
        figures = ", ".join(f'<a href="#{_anchor(each)}">{each.number}</a>' for each in chapter.figures)
        parts = ", ".join(
            f'<a href="#{name}-{chapter.number}">{name}</a>'
            for name, rows in (("numbers", chapter.numbers), ("errata", chapter.errata), ("claims", chapter.claims))
            if rows
        )
        return (
            f'<div><h3><a href="#chapter-{chapter.number}">Chapter {chapter.number}: {_text(chapter.title)}</a></h3>'
            f"<p>Figures {figures}; {parts}</p></div>"
        )

    last = '<div><h3><a href="#comparison">All schemes on the same data</a></h3></div>'
    return f"<nav aria-label='Contents'>{''.join(map(links, chapters))}{last}</nav>"


def _anchor(figure: Figure) -> str:
    return f"fig-{figure.number.replace(' ', '-')}"


def _chapter(chapter: Chapter, order: dict[str, int]) -> str:
    figures = "".join(_figure(figure, order[figure.number]) for figure in chapter.figures)
    return (
        f'<section aria-labelledby="chapter-{chapter.number}">'
        f'<h2 id="chapter-{chapter.number}">Chapter {chapter.number}: {_text(chapter.title)}</h2>'
        f"<p>{chapter.introduction}</p>"
        f'<div class="figures">{figures}</div>'
        f"{_numbers(chapter)}{_errata(chapter)}{_claims(chapter)}</section>"
    )


def _figure(figure: Figure, index: int) -> str:
    return (
        f'<figure id="{_anchor(figure)}">'
        f"<figcaption>Fig. {figure.number} <small>{_text(figure.title)}</small></figcaption>"
        f'<p>{figure.text}</p><div data-figure="{index}"></div></figure>'
    )


def _numbers(chapter: Chapter) -> str:
    if not chapter.numbers:
        return ""
    head = _row("th", ["Where", "What", "Printed", "Ours", "Deviation", ""])
    rows = (_number(each) for each in chapter.numbers)
    return f'<h3 id="numbers-{chapter.number}">Printed numbers</h3>{_table(head, rows)}'


def _number(each: Number) -> str:
    unit = f" {each.unit}" if each.unit else ""
    deviation = "" if each.deviation is None else f"{each.deviation + 0.0:+.2%}"
    printed = "–" if each.printed is None else f"{each.printed:.5g}{unit}"
    cells = [each.where, each.name, printed, f"{each.ours:.5g}{unit}", deviation]
    kinds = ("", "", "number", "number", "number")
    shown = "".join(f'<td class="{kind}">{_text(cell)}</td>' for cell, kind in zip(cells, kinds, strict=True))
    return f"<tr>{shown}<td><small>{_text(each.note)}</small></td></tr>"


def _errata(chapter: Chapter) -> str:
    if not chapter.errata:
        return ""
    head = _row("th", ["Where", "Printed", "Right", "Because"])
    rows = (_row("td", [each.where, each.printed, each.right, each.derivation]) for each in chapter.errata)
    return f'<h3 id="errata-{chapter.number}">Errata</h3>{_table(head, rows, "errata")}'


def _claims(chapter: Chapter) -> str:
    return f'<h3 id="claims-{chapter.number}">Claims</h3>' + "".join(map(_claim, chapter.claims))


def _claim(claim: Claim) -> str:
    return (
        f'<div class="claim {_CLASSES[claim.verdict]}" id="claim-{claim.ident}">'
        f"<h4>{claim.verdict.capitalize()}<small>{_text(claim.ident)} · section {_text(claim.where)}</small></h4>"
        f"<blockquote>{_text(claim.quote)}</blockquote><p>{claim.because}</p></div>"
    )


def _comparison(comparison: Comparison) -> str:
    tables = "".join(_data(each, comparison) for each in comparison.data)
    return (
        '<section aria-labelledby="comparison"><h2 id="comparison">All schemes on the same data</h2>'
        "<p>Latency and convergence in samples after each of the four changes (K falls; B rises; B falls while K"
        " rises; M falls). Converged: M, B and K within 5 % for good (–: never). Scatter: standard deviation of M, B,"
        " K over the truth in the second halves of the stretches; – where an estimate there describes no suspension."
        " Spikes: excursions beyond 50 %. Instructions, on the noisy circuit: of the same C on x86-64 a sample, n = 5"
        " for the thesis's schemes and 6 for ours (<code>python -m tests.thesis.cost</code>); on a Cortex-M4F n = 6"
        " takes 566 typically, 605 the shape n = 5 (estimator_c/README.md, <code>make cost</code>). The bound is the"
        " latency that no detector with a false alarm in 100,000 samples can beat on average. Ceilings: 1500 units"
        " for the prediction error, 300 (simulation) and 500 (circuit) for the mean. Read missed and extra together:"
        " a scheme that raises an alarm every few samples misses nothing, and its samples without an equation are"
        f" cheap.</p>{tables}{_seeds(comparison)}</section>"
    )


def _data(data: Data, comparison: Comparison) -> str:
    names = [
        "Scheme",
        "Latency",
        "Missed",
        "Extra alarms",
        "Converged after",
        "Scatter of M, B, K",
        "Spikes",
        "Instructions",
    ]
    rows = [
        _row("td", [comparison.names[key], *_cells(each), f"{comparison.cost[key]:.0f}"])
        for key, each in data.rows.items()
    ]
    if data.bound_n:
        rows.append(_row("td", ["bound of any detector", _list(data.bound_n), *[""] * 6]))
    return f"<h3>{_text(data.name[0].upper() + data.name[1:])}</h3>{_table(_row('th', names), rows)}"


def _cells(each: Performance) -> list[str]:
    watches = any(n is not None for n in each.latency_n) or each.extra_alarms
    trigger = [_list(each.latency_n), str(each.missed), str(each.extra_alarms)] if watches else ["no trigger", "", ""]
    scatter = " ".join("–" if x is None else f"{x:.2%}" for x in each.spread)
    return [*trigger, _list(each.reconverged_n), scatter, str(each.spikes)]


def _seeds(comparison: Comparison) -> str:
    names = ["Scheme", "Missed", "Extra alarms", "Mean latency", "Median convergence"]
    rows = [
        _row(
            "td",
            [
                comparison.names[key],
                *_seed_cells(each.latency_n, each.missed, each.extra_alarms),
                _one(each.reconverged_n),
            ],
        )
        for key, each in comparison.seeds.items()
    ]
    some = next(iter(comparison.seeds.values()))
    return (
        f"<h3>Circuit, 12 bits, 1 LSB of noise: {some.changes // 4} seeds, {some.changes} changes, {some.samples:,}"
        f" samples</h3>{_table(_row('th', names), rows)}"
    )


def _seed_cells(latency_n: float | None, missed: int, extra: int) -> list[str]:
    if latency_n is None and not extra:
        return ["", "", "no trigger"]
    return [str(missed), str(extra), _one(latency_n)]


def _one(value: float | None) -> str:
    return "never" if value is None else f"{value:.3g}"


def _list(values: Iterable[float | None]) -> str:
    return ", ".join("–" if n is None else f"{n:g}" for n in values)


def _table(head: str, rows: Iterable[str], kind: str = "numbers") -> str:
    return (
        f'<div class="scroll"><table class="{kind}"><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _row(tag: str, cells: Iterable[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{_text(cell)}</{tag}>" for cell in cells) + "</tr>"


def _text(value: object) -> str:
    return html.escape(str(value))
