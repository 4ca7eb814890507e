"""Drawing of a patch sheet for THE ANALOG THING as SVG: every element with its jacks, and the cables between them.

Elements stand by kind, not at their places on the panel. Cables from one output share a colour. The number at a jack is
that of the cable on the sheet. Elements that are not in use are pale.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from xml.sax.saxutils import escape, quoteattr

from analogrig_emulator.machine.drawing import PALETTE, shorten, text_at
from analogrig_emulator.machine.layout import Point
from analogrig_emulator.machine.that_sheet import COUNTS, INPUTS, ThatSheet

_WIDTH, _MARGIN = 1280, 24
_CELL_WIDTH, _PITCH = 142, 154
_TOPS, _HEIGHTS = (84, 240, 464), (104, 160, 160)
_HEIGHT = 720
_LONGEST = 14
_COLOURS = {
    "light": ("#0072b2", "#a84a00", "#00795c", "#8a3a73", "#7a6200", "#5b5bd6", "#b3123c", "#5f6b76"),
    "dark": ("#56b4e9", "#ff9a4d", "#2fc79a", "#e08fc4", "#d9c14a", "#a6a6ff", "#ff8095", "#b4bec8"),
}
_LIGHT, _DARK = ("".join(f"--c{i}:{colour};" for i, colour in enumerate(each)) for each in _COLOURS.values())
_STYLE = (
    f"{PALETTE}svg{{{_LIGHT}}}@media(prefers-color-scheme:dark){{svg{{{_DARK}}}}}"
    ".panel text{font:14px sans-serif;fill:var(--ink);paint-order:stroke;stroke:var(--paper);stroke-width:3}"
    ".panel .small{font-size:11px;fill:var(--muted)}"
    ".panel .number{font-size:10px;text-anchor:middle;font-weight:bold}"
    ".panel .paper{fill:var(--paper)}.panel .cell{fill:var(--paper);stroke:var(--line);stroke-width:1.5}"
    ".panel .jack{fill:var(--paper);stroke:var(--ink);stroke-width:1.5}"
    ".panel .knob{fill:var(--paper);stroke:var(--ink)}"
    ".panel .cable{fill:none;stroke-width:3;stroke-linecap:round;opacity:.8}.panel .free{opacity:.35}"
    + "".join(f".panel .c{i}{{stroke:var(--c{i})}}" for i in range(len(_COLOURS["light"])))
)

_Cell = tuple[int, Point]
"""Row and upper left corner of an element; a row of -1 is that of the sources."""

_Jack = tuple[str, str]
"""Element, and the name of its jack: a weight with its number, X, Y, IN, SLOW or OUT."""


def that_drawing(sheet: ThatSheet) -> str:
    """SVG of a sheet."""
    cells, cables = _cells(sheet), list(_cables(sheet))
    jacks = {jack: at for element, cell in cells.items() for jack, at in _jacks(element, cell)}
    used = {element for _, *ends, _, _ in cables for element, _ in ends}
    numbers = {end: number for number, _, end, _, _ in cables}
    title, speed = sheet.head
    size = f'width="{_WIDTH}" height="{_HEIGHT}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" class="panel" role="img" aria-label={quoteattr(title)} {size}'
    parts = [
        f'{head} viewBox="0 0 {_WIDTH} {_HEIGHT}"><title>{escape(title)}</title><style>{_STYLE}</style>',
        f'<rect class="paper" {size}/>{text_at(Point(_MARGIN, 34), title)}',
        text_at(Point(_MARGIN, 56), f"{speed} Numbers are those of the cables on the sheet.", is_small=True),
        *map(_body, cells.values()),
        *(_cable(*each, jacks) for each in cables),
    ]
    for element, cell in cells.items():
        face = "".join(_face(sheet, element, cell, numbers))
        parts.append(f'<g class="{"element" if element in used else "free"}">{face}</g>')
    return "\n".join([*parts, "</svg>"]) + "\n"


# ---- elements


def _cells(sheet: ThatSheet) -> dict[str, _Cell]:
    """Cells of all elements and sources."""
    rows = [["COEF"], ["SUM", "INV"], ["INT", "MULT"]]
    names = [[f"{kind}{i}" for kind in kinds for i in range(1, COUNTS[kind] + 1)] for kinds in rows]
    cells = {
        name: (row, Point(_MARGIN + i * _PITCH, _TOPS[row]))
        for row, each in enumerate(names)
        for i, name in enumerate(each)
    }
    right = Point(_MARGIN + len(names[-1]) * _PITCH, _TOPS[-1])
    for i, source in enumerate((*sheet.program.input_nodes, "+1", "-1")):
        cells[source] = (-1, Point(right.x, right.y + i * 54))
    return cells


def _jacks(element: str, cell: _Cell) -> Iterator[tuple[_Jack, Point]]:
    (row, at), kind = cell, element.rstrip("0123456789")
    middle = at.y + (22 if row < 0 else _HEIGHTS[row] / 2)
    yield (element, "OUT"), Point(at.x + 122, middle)
    match kind:
        case "COEF" | "INV":
            yield (element, "IN"), Point(at.x + 20, middle)
        case "MULT":
            yield from (((element, name), Point(at.x + 20, middle + dy)) for name, dy in (("X", -20), ("Y", 20)))
        case "SUM" | "INT":
            for column, (weight, count) in enumerate(INPUTS.items()):
                for i in range(count):
                    yield (element, f"{weight}{'abcd'[i]}"), Point(at.x + 20 + 36 * column, at.y + 64 + 26 * i)
            if kind == "INT":
                yield (element, "SLOW"), Point(at.x + 122, at.y + 142)


def _body(cell: _Cell) -> str:
    row, at = cell
    height = 44 if row < 0 else _HEIGHTS[row]
    return f'<rect class="cell" x="{at.x:g}" y="{at.y:g}" width="{_CELL_WIDTH}" height="{height}" rx="6"/>'


def _face(sheet: ThatSheet, element: str, cell: _Cell, numbers: Mapping[_Jack, int]) -> Iterator[str]:
    """Texts, knob and jacks of an element."""
    (row, at), kind = cell, element.rstrip("0123456789")
    yield text_at(Point(at.x + 10, at.y + (27 if row < 0 else 20)), element)
    for each in sheet.outputs:
        if each.place == element:
            quantity = shorten(each.quantity, _LONGEST)
            yield f"<title>{escape(f'{element}: {each.quantity}')}</title>"
            yield text_at(Point(at.x + _CELL_WIDTH - 8, at.y + 18), quantity, anchor="end", is_small=True)
            yield text_at(
                Point(at.x + _CELL_WIDTH - 8, at.y + 32), f"10 V = {each.full:g}", anchor="end", is_small=True
            )
    if kind == "COEF":
        dials = dict(zip(sheet.coefficients, sheet.cables, strict=True))
        yield from _knob(Point(at.x + 71, at.y + 52), dials[element].coefficient if element in dials else 0.0)
        if element in dials:
            label = f"{dials[element].coefficient:.4f} {dials[element].pot}".rstrip()
            yield text_at(Point(at.x + 71, at.y + 94), label, anchor="middle", is_small=True)
    if kind in ("SUM", "INT"):
        for column, weight in enumerate(INPUTS):
            yield text_at(Point(at.x + 20 + 36 * column, at.y + 52), str(weight), anchor="middle", is_small=True)
    for jack, place in _jacks(element, cell):
        if jack[1] in ("X", "Y", "SLOW"):
            end = jack[1] == "SLOW"
            beside = Point(place.x + (-14 if end else 14), place.y + 4)
            yield text_at(beside, jack[1], anchor="end" if end else "start", is_small=True)
        yield f'<circle class="jack" cx="{place.x:g}" cy="{place.y:g}" r="{6 if jack[1] == "OUT" else 9}"/>'
        if number := numbers.get(jack):
            yield f'<text class="number" x="{place.x:g}" y="{place.y + 3.5:g}">{number}</text>'


def _knob(at: Point, dial: float) -> Iterator[str]:
    """Knob that turns by 270 degrees."""
    angle = math.radians(270.0 * dial - 135.0)
    yield f'<circle class="knob" cx="{at.x:g}" cy="{at.y:g}" r="20"/>'
    yield (
        f'<path class="knob" d="M{at.x:g} {at.y:g}L{at.x + 20 * math.sin(angle):.1f}'
        f' {at.y - 20 * math.cos(angle):.1f}"/>'
    )


# ---- cables


def _cables(sheet: ThatSheet) -> Iterator[tuple[int, _Jack, _Jack, int, str]]:
    """Number, both ends, colour and words of each piece of cable. A coefficient on the way makes two pieces."""
    sources = list(dict.fromkeys(cable.source for cable in sheet.cables))
    counts: Counter[_Jack] = Counter()
    for number, (cable, coefficient) in enumerate(zip(sheet.cables, sheet.coefficients, strict=True), 1):
        place = (cable.target, cable.jack)
        jack = _jack_name(cable.target, cable.jack, counts[place])
        counts[place] += 1
        colour = sources.index(cable.source) % len(_COLOURS["light"])
        way = [(cable.source, "OUT"), (cable.target, jack)]
        if coefficient:
            way[1:1] = [(coefficient, "IN"), (coefficient, "OUT")]
        words = f"cable {number}: {' to '.join(dict.fromkeys(element for element, _ in way))}, jack {cable.jack}"
        for start, end in zip(way[::2], way[1::2], strict=True):
            yield number, start, end, colour, words
    for element in sheet.slow:
        yield 0, (element, "OUT"), (element, "SLOW"), 0, f"{element} to its jack SLOW"


def _jack_name(element: str, jack: str, number: int) -> str:
    if element.startswith("INV"):
        return "IN"
    return f"{jack}{'abcd'[number]}" if jack.isdecimal() else jack


def _cable(number: int, start: _Jack, end: _Jack, colour: int, words: str, jacks: Mapping[_Jack, Point]) -> str:
    """Cable that sags."""
    a, b = jacks[start], jacks[end]
    sag = min(110.0, 24.0 + 0.12 * math.hypot(b.x - a.x, b.y - a.y))
    path = f"M{a.x:g} {a.y:g}C{a.x:g} {a.y + sag:.1f} {b.x:g} {b.y + sag:.1f} {b.x:g} {b.y:g}"
    return f'<path class="cable c{colour}" data-cable="{number}" d="{path}"><title>{escape(words)}</title></path>'
