"""HTML tables of the pages. Every text is escaped; cells and rows are HTML."""

from __future__ import annotations

import html
from collections.abc import Iterable

MOST_ROWS = 500
"""Largest number of rows in most tables."""


def text(value: object) -> str:
    """Text of a value, escaped."""
    return html.escape(str(value))


def cell(value: object, kind: str = "text") -> str:
    """Cell; ``kind`` is a style class."""
    return f'<td class="{kind}">{text(value)}</td>'


def number(value: float | None, form: str = ".4g") -> str:
    """Cell of a number; a dash for None."""
    return cell("–" if value is None else format(value, form), "number")


def row(cells: Iterable[str], ident: str = "") -> str:
    """Row of cells; ``ident`` is the target of links to it."""
    start = f'<tr id="{ident}">' if ident else "<tr>"
    return f"{start}{''.join(cells)}</tr>"


def heading(texts: Iterable[str], numbers: Iterable[str] = (), more: Iterable[str] = ()) -> str:
    """Row of column headings: of texts, of numbers, and again of texts."""
    kinds = ((texts, ""), (numbers, ' class="number"'), (more, ""))
    return row(f'<th scope="col"{kind}>{text(name)}</th>' for names, kind in kinds for name in names)


def scroll(label: str, content: str) -> str:
    """Content that scrolls sideways where the window is narrower, also by keyboard."""
    return f'<div class="scroll" role="group" aria-label="{text(label)}" tabindex="0">{content}</div>'


SORTABLE = "numbers sortable"
"""Style class of a table that its reader can sort."""


def table(caption: str, head: str, rows: Iterable[str], kind: str = "numbers", most: int = MOST_ROWS) -> str:
    """Table of finished rows, of which the first ``most`` are shown; ``kind`` is a style class."""
    shown = list(rows)
    if len(shown) > most:
        caption += f"; the first {most:,} of {len(shown):,} rows"
    return scroll(
        caption,
        f'<table class="{kind}"><caption>{text(caption)}</caption>'
        f"{f'<thead>{head}</thead>' if head else ''}<tbody>{''.join(shown[:most])}</tbody></table>",
    )


def pairs(caption: str, values: Iterable[tuple[str, object]]) -> str:
    """Table of names and values."""
    rows = (row([f'<th scope="row">{text(name)}</th>', cell(value)]) for name, value in values)
    return table(caption, "", rows, "pairs")
