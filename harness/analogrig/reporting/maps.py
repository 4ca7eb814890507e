"""Maps of one quantity over two axes: panels that share one scale of colours, with its legend."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analogrig.reporting.markings import figure, upright, words
from analogrig.reporting.markup import text

_WIDTH, _HEIGHT, _LEFT, _TOP = 74, 42, 92, 44
_SMALL = 9
"""Side of a square of a map that has too many of them for numbers."""
_LEAST_WIDTH, _LEAST_HEIGHT = 230, 150
"""Room for the titles of the axes of a small map."""
_LETTER = 7
"""Room for a letter of a title."""
_STEPS = 5


@dataclass(frozen=True)
class Square:
    """Square of a map."""

    value: float | None
    """None: unknown."""
    label: str
    note: str = ""
    """Second line, such as the bound of a rate."""
    title: str = ""
    """Description of the cell for its tooltip and for screen readers."""
    link: str = ""


Squares = Mapping[tuple[str, str], Square]
"""Squares by the values on the axes across and down."""


def legend(name: str, most: float, form: str) -> str:
    """Scale of the colours from 0 to ``most``, which all maps of a quantity share."""
    if not most:
        return f'<p class="legend">{text(name)}: {most:{form}} in all cells.</p>'
    swatches = [
        f'<rect x="{60 * i + 1}" y="1" width="60" height="16" stroke="var(--line)" {_fill(i / (_STEPS - 1))}/>'
        + words(60 * i + 31, 32, format(most * i / (_STEPS - 1), form))
        for i in range(_STEPS)
    ]
    x = 60 * _STEPS + 20
    swatches.append(f'<rect x="{x}" y="1" width="36" height="16" {_fill(None)}/>{words(x + 18, 32, "none")}')
    label = f"Colours of all maps: {name}, 0 to {most:{form}}; grey where there is none"
    return (
        f'<p class="legend"><span>{text(name)}</span> <svg role="img" aria-label="{text(label)}" width="{x + 44}"'
        f' height="38" viewBox="0 0 {x + 44} 38">{"".join(swatches)}</svg></p>'
    )


def heat_map(caption: str, axes: Sequence[str], squares: Squares, most: float, *, with_numbers: bool = True) -> str:
    """Panel of a map.

    :param axes: titles of the axes across and down; that down may be empty.
    :param most: value of the deepest colour.
    :param with_numbers: squares are large, with numbers and links; otherwise only their tooltips have the numbers.
    """
    columns, rows = (list(dict.fromkeys(key[i] for key in squares)) for i in range(2))
    width, height = (_WIDTH, _HEIGHT) if with_numbers else (_SMALL, _SMALL)
    right, bottom = _LEFT + len(columns) * width, _TOP + len(rows) * height
    across, down = (_ticked(each, with_numbers=with_numbers) for each in (columns, rows))
    parts = [words(_LEFT + (i + 0.5) * width, _TOP - 8, name) for i, name in across]
    parts += [words(_LEFT - 8, _TOP + (j + 0.5) * height + 4, name, "end") for j, name in down]
    title_x = max(_LEFT, (_LEFT + right) / 2 - 60)
    parts.append(words(title_x, 14, axes[0], "start", is_faint=True))
    if axes[1]:
        parts.append(upright(14, max((_TOP + bottom) / 2, _LEAST_HEIGHT / 2), axes[1]))
    for (i, column), (j, row) in itertools.product(enumerate(columns), enumerate(rows)):
        draw = _large if with_numbers else _small
        parts.append(draw(_LEFT + i * width, _TOP + j * height, squares[column, row], most))
    described = f"{caption}; across: {axes[0]}{f', down: {axes[1]}' if axes[1] else ''}"
    size = (
        max(right + 2, _LEAST_WIDTH, title_x + _LETTER * len(axes[0])),
        max(bottom + 2, _LEAST_HEIGHT if axes[1] else 0),
    )
    return figure(caption, described, *size, parts, has_links=any(each.link for each in squares.values()))


def _ticked(names: Sequence[str], *, with_numbers: bool) -> list[tuple[int, str]]:
    """Places and names of the columns or rows that have a tick: in a dense map the ends alone."""
    return [(i, name) for i, name in enumerate(names) if with_numbers or i in (0, len(names) - 1)]


def _fill(share: float | None) -> str:
    if share is None:
        return 'fill="var(--line)"'
    return f'fill="var(--deep)" fill-opacity="{share:.2f}"'


def _share(square: Square, most: float) -> float | None:
    return None if square.value is None else square.value / most if most else 0.0


def _small(x: float, y: float, square: Square, most: float) -> str:
    fill = _fill(_share(square, most))
    return f'<path d="M{x} {y}h{_SMALL}v{_SMALL}h-{_SMALL}z" {fill}><title>{text(square.title)}</title></path>'


def _large(x: float, y: float, square: Square, most: float) -> str:
    middle = y + (0.43 if square.note else 0.6) * _HEIGHT
    lines = words(x + 0.5 * _WIDTH, middle, square.label)
    if square.note:
        lines += f'<g font-size="11">{words(x + 0.5 * _WIDTH, y + 0.8 * _HEIGHT, square.note)}</g>'
    body = (
        f'<title>{text(square.title)}</title><rect x="{x}" y="{y}" width="{_WIDTH}" height="{_HEIGHT}"'
        f' {_fill(_share(square, most))} stroke="var(--muted)"/>{lines}'
    )
    return f'<a href="{square.link}" aria-label="{text(square.title)}">{body}</a>' if square.link else f"<g>{body}</g>"
