"""Common parts of the drawings in SVG on the pages: texts, axes and frames, in the colours of the style sheet."""

from __future__ import annotations

import math
from collections.abc import Iterable

from analogrig.reporting.markup import scroll, text


def words(x: float, y: float, content: str, anchor: str = "middle", *, is_faint: bool = False) -> str:
    """Text at a place; ``anchor`` is its ``text-anchor``."""
    ink = "var(--muted)" if is_faint else "currentColor"
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" fill="{ink}">{text(content)}</text>'


def upright(x: float, y: float, content: str) -> str:
    """Title of a vertical axis, centred at a place and read from below."""
    return f'<g transform="translate({x:g} {y:g}) rotate(-90)">{words(0, 0, content, is_faint=True)}</g>'


def levels(most: float) -> list[float]:
    """Round values from 0 to ``most`` for an axis."""
    step = 10.0 ** math.floor(math.log10(most))
    step *= next(factor for factor in (0.2, 0.5, 1.0, 2.0) if most / (factor * step) <= 6.0)
    return [i * step for i in range(int(most / step) + 1)]


def figure(caption: str, label: str, width: float, height: float, parts: Iterable[str], *, has_links: bool) -> str:
    """Figure of a finished drawing.

    :param label: description for screen readers.
    :param has_links: its links are announced one by one; otherwise it is one picture.
    """
    role = "group" if has_links else "img"
    drawing = (
        f'<svg role="{role}" aria-label="{text(label)}" width="{width:g}" height="{height:g}"'
        f' viewBox="0 0 {width:g} {height:g}">{"".join(parts)}</svg>'
    )
    return f"<figure><figcaption>{text(caption)}</figcaption>{scroll(label, drawing)}</figure>"
