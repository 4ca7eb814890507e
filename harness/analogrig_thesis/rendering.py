"""HTML of the page: figures, printed numbers, errata, claims and the comparison of the schemes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.reporting import PLOTS, as_script, assemble_page, deflate
from analogrig_thesis.markup import cell, heading, row, table, text
from analogrig_thesis.models import NAMES, TrackQuality
from analogrig_thesis.texts import Chapter, Drawing, Table

_FOLDER = Path(__file__).parent

_VERDICTS = {
    "holds": ("holds", "hold"),
    "holds with a reading": ("reading", "hold with a reading"),
    "does not hold": ("fails", "do not hold"),
    "not reproduced": ("fails", "are not reproduced"),
}
"""CSS class and plural of each verdict."""

_NUMBERS = (("Where", "What"), ("Printed", "Ours", "Deviation"), ("Note",))
_ERRATA = ("Where", "Printed", "Right", "Because")
_QUALITY = ("Scheme", "Latency", "Missed", "Extra alarms", "Converged after", "Scatter", "Spikes", "Instructions")
_SEEDS = ("Scheme", "Missed", "Extra alarms", "Mean latency", "Median convergence")


def render(chapters: Sequence[Chapter], comparison: Table) -> str:
    """Return the page; the same input gives the same text.

    :raises RecordingError: the build has not put uPlot in its place.
    """
    counts = Counter(claim["verdict"] for chapter in chapters for claim in chapter.claims)
    return assemble_page(
        _FOLDER / "page.html",
        (*PLOTS, _FOLDER / "page.js"),
        title="The thesis, reproduced",
        summary="".join(
            f'<li class="{css}"><strong>{counts[verdict]}</strong>'
            f" {f'claim {verdict}' if counts[verdict] == 1 else f'claims {plural}'}</li>"
            for verdict, (css, plural) in _VERDICTS.items()
        ),
        contents="".join(map(_links, chapters)),
        chapter_options="".join(_option(str(each.number), f"Chapter {each.number}") for each in chapters),
        verdict_options="".join(_option(each, each) for each in _VERDICTS),
        chapters="\n".join(map(_chapter, chapters)),
        comparison="".join(_data(each, comparison["instructions"]) for each in comparison["data"])
        + _seeds(comparison["seeds"]),
        data=as_script(_payload(chapters)),
    )


def _payload(chapters: Sequence[Chapter]) -> dict[str, Any]:
    """Return the data of the plots; every signal is a column, referred to by its index."""
    columns: list[NDArray[np.float32]] = []

    def column(values: NDArray[np.float64]) -> int:
        columns.append(values.astype(np.float32))
        return len(columns) - 1

    def panel(axes: Table, signals: Sequence[NDArray[np.float64]], x: int | None) -> Table:
        curves = zip(axes["curves"], signals, strict=True)
        return {**axes, "x": x, "curves": [{**curve, "column": column(values)} for curve, values in curves]}

    def figure(number: str, axes: Sequence[Table], drawing: Drawing) -> Table:
        x = None if drawing.x is None else column(drawing.x)
        panels = [panel(*each, x) for each in zip(axes, drawing.panels, strict=True)]
        return {"number": number, "marks": [mark._asdict() for mark in drawing.marks], "panels": panels}

    figures = [
        figure(number, each["panels"], chapter.drawings[number])
        for chapter in chapters
        for number, each in chapter.figures.items()
    ]
    described = [{"type": "float32", "points": len(each), "scale": 1, "offset": 0} for each in columns]
    return {"figures": figures, "columns": described, "deflated": deflate(columns)}


def _links(chapter: Chapter) -> str:
    """Return the entry of a chapter in the contents."""
    figures = ", ".join(f'<a href="#{_anchor(number)}">{number}</a>' for number in chapter.figures)
    tables = {"numbers": chapter.numbers, "errata": chapter.errata, "claims": chapter.claims}
    parts = ", ".join(f'<a href="#{name}-{chapter.number}">{name}</a>' for name, rows in tables.items() if rows)
    title = f"Chapter {chapter.number}: {text(chapter.title)}"
    return f'<li><a href="#chapter-{chapter.number}">{title}</a><p>Figures {figures}; {parts}</p></li>'


def _option(value: str, shown: str) -> str:
    return f'<option value="{text(value)}">{text(shown)}</option>'


def _anchor(figure: str) -> str:
    return f"fig-{figure.replace(' ', '-')}"


def _chapter(chapter: Chapter) -> str:
    n, errata = chapter.number, (_texts(each.values()) for each in chapter.errata)
    slips = table(f"Slips of the printed chapter {n}", heading(_ERRATA), errata, "errata")
    figures = (_figure(*each) for each in chapter.figures.items())
    caption = f"Numbers of chapter {n}, as printed and as found here"
    numbers = table(caption, heading(*_NUMBERS), map(_number, chapter.numbers)) if chapter.numbers else ""
    return (
        f'<section aria-labelledby="chapter-{n}" data-chapter="{n}">'
        f'<h2 id="chapter-{n}">Chapter {n}: {text(chapter.title)}</h2>'
        f'<p>{chapter.introduction}</p><div class="figures">{"".join(figures)}</div>'
        + (f'<h3 id="numbers-{n}">Printed numbers</h3>{numbers}' if numbers else "")
        + f'<h3 id="errata-{n}">Errata</h3>{slips}'
        + f'<h3 id="claims-{n}">Claims</h3>{"".join(map(_claim, chapter.claims))}</section>'
    )


def _figure(number: str, figure: Table) -> str:
    return (
        f'<figure id="{_anchor(number)}"><figcaption>Fig. {number} <small>{text(figure["title"])}</small></figcaption>'
        f'<p>{figure["text"]}</p><div data-figure="{number}"></div></figure>'
    )


def _number(each: Table) -> str:
    unit = f" {each['unit']}" if each["unit"] else ""
    values = (f"{each['printed']:.5g}{unit}", f"{each['ours']:.5g}{unit}", f"{each['deviation']:+.2%}")
    note = f"<td><small>{text(each['note'])}</small></td>"
    return row([cell(each["where"]), cell(each["name"]), *(cell(value, "number") for value in values), note])


def _claim(claim: Table) -> str:
    ident, verdict = claim["ident"], claim["verdict"]
    return (
        f'<div class="claim {_VERDICTS[verdict][0]}" id="claim-{ident}" data-verdict="{verdict}">'
        f"<h4>{verdict.capitalize()}<small>{ident} · section {text(claim['where'])}</small></h4>"
        f"<blockquote>{text(claim['quote'])}</blockquote><p>{claim['because']}</p></div>"
    )


def _data(data: Table, instructions: Table) -> str:
    rows = [_texts((NAMES[key], *_quality(each), instructions[key])) for key, each in data["schemes"].items()]
    if data["bound_n"]:
        rows.append(_texts(("first-order bound", _list(data["bound_n"]), *[""] * 6)))
    name = data["name"][0].upper() + data["name"][1:]
    return f"<h3>{text(name)}</h3>{table('Schemes, each on this data', heading(_QUALITY), rows)}"


def _quality(each: TrackQuality) -> list[object]:
    watches = any(n is not None for n in each.latency_n) or each.extra_alarms
    trigger = [_list(each.latency_n), each.missed, each.extra_alarms] if watches else ["no trigger", "", ""]
    scatter = " ".join("–" if x is None else f"{x:.2%}" for x in each.spread)
    return [*trigger, _list(each.reconverged_n), scatter, each.spikes]


def _seeds(seeds: Mapping[str, Table]) -> str:
    some = next(iter(seeds.values()))
    rows = (_texts((NAMES[key], *_summary(each))) for key, each in seeds.items())
    return (
        f"<h3>Circuit, 12 bits, 1 LSB of noise: {some['changes'] // 4} seeds, {some['changes']} changes,"
        f" {some['samples']:,} samples</h3>{table('Schemes, over all seeds', heading(_SEEDS), rows)}"
    )


def _summary(each: Table) -> list[object]:
    latency, converged = (
        "never" if each[key] is None else f"{each[key]:.3g}" for key in ("latency_n", "reconverged_n")
    )
    if each["latency_n"] is None and not each["extra_alarms"]:
        return ["", "", "no trigger", converged]
    return [each["missed"], each["extra_alarms"], latency, converged]


def _texts(values: Iterable[object]) -> str:
    return row(map(cell, values))


def _list(values: Iterable[float | None]) -> str:
    return ", ".join("–" if n is None else f"{n:g}" for n in values)
