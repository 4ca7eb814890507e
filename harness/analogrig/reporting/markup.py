"""HTML tables of the pages. Every text is escaped; cells and rows are HTML."""

from __future__ import annotations

import html
from collections.abc import Iterable

_MOST_ROWS = 500
"""Largest number of rows in any table."""


def text(value: object) -> str:
    """Text of a value, escaped."""
    return html.escape(str(value))


def cell(value: object, kind: str = "text") -> str:
    """Cell; ``kind`` is a style class."""
    return f'<td class="{kind}">{text(value)}</td>'


def number(value: float | None, form: str = ".4g") -> str:
    """Cell of a number; a dash for None."""
    return cell("–" if value is None else format(value, form), "number")


def row(cells: Iterable[str]) -> str:
    """Row of cells."""
    return f"<tr>{''.join(cells)}</tr>"


def heading(texts: Iterable[str], numbers: Iterable[str] = (), more: Iterable[str] = ()) -> str:
    """Row of column headings: of texts, of numbers, and again of texts."""
    kinds = ((texts, ""), (numbers, ' class="number"'), (more, ""))
    return row(f'<th scope="col"{kind}>{text(name)}</th>' for names, kind in kinds for name in names)


def table(caption: str, head: str, rows: Iterable[str], kind: str = "numbers") -> str:
    """Table of finished rows, of which the first are shown; ``kind`` is a style class."""
    shown = list(rows)
    if len(shown) > _MOST_ROWS:
        caption += f"; the first {_MOST_ROWS} of {len(shown):,} rows"
    return (
        f'<div class="scroll"><table class="{kind}">{f"<caption>{text(caption)}</caption>" if caption else ""}'
        f"{f'<thead>{head}</thead>' if head else ''}<tbody>{''.join(shown[:_MOST_ROWS])}</tbody></table></div>"
    )


def pairs(caption: str, values: Iterable[tuple[str, object]]) -> str:
    """Table of names and values."""
    rows = (row([f'<th scope="row">{text(name)}</th>', cell(value)]) for name, value in values)
    return table(caption, "", rows, "pairs")
