"""HTML of the page: figures, printed numbers, errata, claims and the comparison of the schemes.

Introductions, explanations of figures and reasons of claims are HTML; ``_escape`` escapes all other texts.
"""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.reporting.page import SCRIPTS, STYLES, assemble_page
from analogrig.reporting.payload import as_script, deflate
from analogrig_thesis.document import Chapter, Claim, Figure, Number, ReproducedChapter, Verdict
from analogrig_thesis.scheme_comparison import ComparedData, SchemeComparison, SeedSummary
from analogrig_thesis.schemes import NAMES
from analogrig_thesis.tracking import TrackQuality

_FOLDER = Path(__file__).parent

_VERDICTS: dict[Verdict, tuple[str, str]] = {
    "holds": ("holds", "hold"),
    "holds with a reading": ("reading", "hold with a reading"),
    "does not hold": ("fails", "do not hold"),
    "not reproduced": ("fails", "are not reproduced"),
}
"""CSS class and plural of each verdict."""

_NUMBERS = ("Where", "What", "Printed", "Ours", "Deviation", "")
_ERRATA = ("Where", "Printed", "Right", "Because")
_QUALITY = ("Scheme", "Latency", "Missed", "Extra alarms", "Converged after", "Scatter", "Spikes", "Instructions")
_SEEDS = ("Scheme", "Missed", "Extra alarms", "Mean latency", "Median convergence")


def render(chapters: Sequence[ReproducedChapter], comparison: SchemeComparison) -> str:
    """Return the page; the same input gives the same text.

    :raises RecordingError: the build has not put uPlot in its place.
    """
    texts = [chapter.text for chapter in chapters]
    order = {figure.number: i for i, figure in enumerate(figure for text in texts for figure in text.figures)}
    return assemble_page(
        _FOLDER / "page.html",
        (*STYLES, _FOLDER / "page.css"),
        (*SCRIPTS, _FOLDER / "page.js"),
        title="The thesis, reproduced",
        summary=_summary([claim for text in texts for claim in text.claims]),
        contents="".join(map(_links, texts)),
        chapters="\n".join(_chapter(chapter, order) for chapter in chapters),
        comparison="".join(_data(each, comparison) for each in comparison.data) + _seeds(comparison),
        data=as_script(_payload(chapters)),
    )


def _payload(chapters: Sequence[ReproducedChapter]) -> dict[str, Any]:
    """Return the data of the plots; every signal is a column, referred to by its index."""
    columns: list[NDArray[np.float32]] = []

    def column(values: NDArray[np.float64]) -> int:
        columns.append(values.astype(np.float32))
        return len(columns) - 1

    def figure(chapter: ReproducedChapter, each: Figure) -> dict[str, Any]:
        drawing, panels = chapter.drawings[each.number], []
        for key, signals in zip(each.panels, drawing.panels, strict=True):
            axes = chapter.text.panels[key]
            x = None if drawing.x is None else column(drawing.x)
            curves = [
                {**vars(curve), "column": column(values)} for curve, values in zip(axes.curves, signals, strict=True)
            ]
            panels.append({**vars(axes), "x": x, "curves": curves})
        return {"number": each.number, "marks": [vars(mark) for mark in drawing.marks], "panels": panels}

    described = [figure(chapter, each) for chapter in chapters for each in chapter.text.figures]
    return {"figures": described, "lengths": [len(each) for each in columns], "deflated": deflate(columns)}


def _summary(claims: Sequence[Claim]) -> str:
    counts = Counter(claim.verdict for claim in claims)
    return "".join(
        f'<li class="{css}"><strong>{counts[verdict]}</strong>'
        f" {f'claim {verdict}' if counts[verdict] == 1 else f'claims {plural}'}</li>"
        for verdict, (css, plural) in _VERDICTS.items()
    )


def _links(chapter: Chapter) -> str:
    """Return the entry of a chapter in the contents."""
    figures = ", ".join(f'<a href="#{_anchor(each)}">{each.number}</a>' for each in chapter.figures)
    parts = ", ".join(
        f'<a href="#{name}-{chapter.number}">{name}</a>'
        for name, rows in (("numbers", chapter.numbers), ("errata", chapter.errata), ("claims", chapter.claims))
        if rows
    )
    title = f"Chapter {chapter.number}: {_escape(chapter.title)}"
    return f'<div><h3><a href="#chapter-{chapter.number}">{title}</a></h3><p>Figures {figures}; {parts}</p></div>'


def _anchor(figure: Figure) -> str:
    return f"fig-{figure.number.replace(' ', '-')}"


def _chapter(chapter: ReproducedChapter, order: dict[str, int]) -> str:
    text = chapter.text
    figures = "".join(_figure(figure, order[figure.number]) for figure in text.figures)
    numbers = (_number(*each) for each in zip(text.numbers, chapter.numbers, strict=True))
    errata = (_row("td", (each.where, each.printed, each.right, each.derivation)) for each in text.errata)
    return (
        f'<section aria-labelledby="chapter-{text.number}">'
        f'<h2 id="chapter-{text.number}">Chapter {text.number}: {_escape(text.title)}</h2>'
        f"<p>{text.introduction}</p>"
        f'<div class="figures">{figures}</div>'
        + (f'<h3 id="numbers-{text.number}">Printed numbers</h3>{_table(_NUMBERS, numbers)}' if text.numbers else "")
        + f'<h3 id="errata-{text.number}">Errata</h3>{_table(_ERRATA, errata, "errata")}'
        + f'<h3 id="claims-{text.number}">Claims</h3>{"".join(map(_claim, text.claims))}</section>'
    )


def _figure(figure: Figure, index: int) -> str:
    return (
        f'<figure id="{_anchor(figure)}">'
        f"<figcaption>Fig. {figure.number} <small>{_escape(figure.title)}</small></figcaption>"
        f'<p>{figure.text}</p><div data-figure="{index}"></div></figure>'
    )


def _number(number: Number, ours: float) -> str:
    unit = f" {number.unit}" if number.unit else ""
    values = (f"{number.printed:.5g}{unit}", f"{ours:.5g}{unit}", f"{ours / number.printed - 1.0:+.2%}")
    cells = "".join(f'<td class="number">{_escape(each)}</td>' for each in values)
    return (
        f"<tr><td>{_escape(number.where)}</td><td>{_escape(number.name)}</td>{cells}"
        f"<td><small>{_escape(number.note)}</small></td></tr>"
    )


def _claim(claim: Claim) -> str:
    return (
        f'<div class="claim {_VERDICTS[claim.verdict][0]}" id="claim-{claim.ident}">'
        f"<h4>{claim.verdict.capitalize()}<small>{_escape(claim.ident)} · section {_escape(claim.where)}</small></h4>"
        f"<blockquote>{_escape(claim.quote)}</blockquote><p>{claim.because}</p></div>"
    )


def _data(data: ComparedData, comparison: SchemeComparison) -> str:
    rows = [
        _row("td", (NAMES[key], *_cells(each), str(comparison.instructions[key]))) for key, each in data.schemes.items()
    ]
    if data.bound_n:
        rows.append(_row("td", ("bound of any detector", _list(data.bound_n), *[""] * 6)))
    return f"<h3>{_escape(data.name[0].upper() + data.name[1:])}</h3>{_table(_QUALITY, rows)}"


def _cells(each: TrackQuality) -> list[str]:
    watches = any(n is not None for n in each.latency_n) or each.extra_alarms
    trigger = [_list(each.latency_n), str(each.missed), str(each.extra_alarms)] if watches else ["no trigger", "", ""]
    scatter = " ".join("–" if x is None else f"{x:.2%}" for x in each.spread)
    return [*trigger, _list(each.reconverged_n), scatter, str(each.spikes)]


def _seeds(comparison: SchemeComparison) -> str:
    some = next(iter(comparison.seeds.values()))
    rows = (_row("td", (NAMES[key], *_seed_cells(each))) for key, each in comparison.seeds.items())
    return (
        f"<h3>Circuit, 12 bits, 1 LSB of noise: {some.changes // 4} seeds, {some.changes} changes, {some.samples:,}"
        f" samples</h3>{_table(_SEEDS, rows)}"
    )


def _seed_cells(each: SeedSummary) -> list[str]:
    latency, converged = ("never" if n is None else f"{n:.3g}" for n in (each.latency_n, each.reconverged_n))
    if each.latency_n is None and not each.extra_alarms:
        return ["", "", "no trigger", converged]
    return [str(each.missed), str(each.extra_alarms), latency, converged]


def _list(values: Iterable[float | None]) -> str:
    return ", ".join("–" if n is None else f"{n:g}" for n in values)


def _table(head: Iterable[str], rows: Iterable[str], kind: str = "numbers") -> str:
    return (
        f'<div class="scroll"><table class="{kind}"><thead>{_row("th", head)}</thead><tbody>{"".join(rows)}</tbody>'
        "</table></div>"
    )


def _row(tag: str, cells: Iterable[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{_escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def _escape(value: object) -> str:
    return html.escape(str(value))
