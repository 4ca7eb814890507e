"""HTML tables of the page. Every text is escaped; cells and rows are HTML."""

from __future__ import annotations

import html
from collections.abc import Iterable


def text(value: object) -> str:
    """Text of a value, escaped."""
    return html.escape(str(value))


def cell(value: object, kind: str = "text") -> str:
    """Cell; ``kind`` is a style class."""
    return f'<td class="{kind}">{text(value)}</td>'


def row(cells: Iterable[str]) -> str:
    """Row of cells."""
    return f"<tr>{''.join(cells)}</tr>"


def heading(texts: Iterable[str], numbers: Iterable[str] = (), more: Iterable[str] = ()) -> str:
    """Row of column headings: of texts, of numbers, and again of texts."""
    kinds = ((texts, ""), (numbers, ' class="number"'), (more, ""))
    return row(f'<th scope="col"{kind}>{text(name)}</th>' for names, kind in kinds for name in names)


def table(caption: str, head: str, rows: Iterable[str], kind: str = "numbers") -> str:
    """Table of finished rows, which scrolls sideways in narrow windows, also by keyboard; ``kind`` is a style class."""
    return (
        f'<div class="scroll" role="group" aria-label="{text(caption)}" tabindex="0"><table class="{kind}">'
        f"<caption>{text(caption)}</caption><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table></div>"
    )
