"""Drawing of a patch as SVG: computing elements in columns, pots at their inputs, and the wires between them.

The drawing depends on the program alone: the same file gives the same bytes. Groups with ``data-node`` are the wire and
the output of a node; the output also has the id ``node-NAME``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple
from xml.sax.saxutils import escape, quoteattr

from analogrig_emulator.machine.layout import BLOCK_WIDTH, ROW, Box, Point, WirePath, lay_out
from analogrig_emulator.machine.patched_program import PatchedElement, PatchedProgram
from analogrig_emulator.machine.sheet import Inverter, input_text, inverters, signed
from analogrig_emulator.machine.stages import StageKind

PALETTE = (
    "svg{--paper:#fff;--ink:#1a1a1a;--muted:#555;--line:#d5d5d5;--first:#0072b2;--second:#a84a00}"
    "@media(prefers-color-scheme:dark){svg{--paper:#14171a;--ink:#ececec;--muted:#a8adb2;--line:#3a4046;"
    "--first:#56b4e9;--second:#ff9a4d}}"
)
"""Colours of drawings that stand alone, light and dark: those of the pages."""

_STYLE = (
    f"{PALETTE}.patch text{{font:13px sans-serif;fill:var(--ink)}}"
    ".patch .small{font-size:11px;fill:var(--muted)}.patch .wire{stroke:var(--first);stroke-width:1.5;fill:none}"
    ".patch .joint{fill:var(--first)}.patch .body{stroke:var(--ink);stroke-width:1.6;fill:var(--paper)}"
    ".patch .terminal{stroke:var(--first);fill:var(--paper)}.patch .paper{fill:var(--paper)}"
)
_POT_X, _BODY_X, _BODY_WIDTH = 34, 92, 64
_LONGEST = 26


class _Pin(NamedTuple):
    """Input: its node, its term in words, its pot with the coefficient, and its gain."""

    node: str
    term: str
    pot: str = ""
    gain: float = 1


@dataclass(frozen=True)
class _Drawn:
    """Block as it is drawn: name, output node with its quantity, kind, and pins."""

    name: str
    node: str
    quantity: str
    kind: str
    symbol: str = ""
    has_bar: bool = False
    pins: tuple[_Pin, ...] = ()


def patch_drawing(program: PatchedProgram) -> str:
    """SVG of the patch.

    A triangle is an amplifier, with a bar for an integrator; a circle is a pot with its coefficient; a square is a
    multiplier or another function. A name below an element is that of its output node.
    """
    blocks = [*map(_element, program.patch), *map(_inverter, inverters(program))]
    blocks = [*_sources(program, blocks), *blocks]
    layout = lay_out([Box(each.node, tuple(pin.node for pin in each.pins)) for each in blocks])
    title = f"{program.name}: {program.equations.description}" if program.equations.description else program.name
    size = f'width="{layout.width:g}" height="{layout.height:g}"'
    view = f'viewBox="0 0 {layout.width:g} {layout.height:g}"'
    label = quoteattr(f"patch of {title}")
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="patch" role="group" aria-label={label} {size} {view}>',
        f"<title>{escape(title)}</title><style>{_STYLE}</style>",
        f'<rect class="paper" {size}/>{text_at(Point(16, 26), title)}',
        *(_wire(node, wire) for node, wire in layout.wires.items()),
    ]
    for block, place in zip(blocks, layout.places, strict=True):
        parts += _block(block, place)
    return "\n".join([*parts, "</svg>"]) + "\n"


def _element(element: PatchedElement) -> _Drawn:
    kind = element.stage.kind
    return _Drawn(
        element.name,
        element.node,
        signed(element.sign, element.stage.name),
        kind.title + (f", {element.farad * 1e9:g} nF" if element.farad else ""),
        kind.symbol,
        kind is StageKind.INTEGRATOR,
        tuple(
            _Pin(
                cord.node,
                input_text(element, cord),
                f"{cord.pot} {cord.coefficient / cord.gain:.4f}" if cord.pot else "",
                cord.gain,
            )
            for cord in element.cords
        ),
    )


def _inverter(inverter: Inverter) -> _Drawn:
    output = signed(-inverter.sign, inverter.quantity)
    pins = (_Pin(inverter.node, signed(inverter.sign, inverter.quantity)),)
    return _Drawn(inverter.name, inverter.name.lower(), output, "inverter", pins=pins)


def _sources(program: PatchedProgram, blocks: list[_Drawn]) -> list[_Drawn]:
    """Inputs of the program and reference voltages: the nodes that no element drives."""
    names: Mapping[str, str] = {node: name for name, node in program.input_nodes.items()}
    driven = {each.node for each in blocks}
    nodes = dict.fromkeys(pin.node for each in blocks for pin in each.pins if pin.node not in driven)
    return [_Drawn("", node, names.get(node, "reference"), "input" if node in names else "source") for node in nodes]


def _wire(node: str, wire: WirePath) -> str:
    path = "".join(f"M{start.x:g} {start.y:g}L{end.x:g} {end.y:g}" for start, end in wire.lines)
    joints = "".join(f'<circle class="joint" cx="{at.x:g}" cy="{at.y:g}" r="3"/>' for at in wire.joints)
    return f'<g class="net" data-node={quoteattr(node)}><path class="wire" d="{path}"/>{joints}</g>'


def _block(block: _Drawn, place: Point) -> Iterator[str]:
    height = ROW * max(1, len(block.pins))
    left, right, middle = place.x + _BODY_X, place.x + _BODY_X + _BODY_WIDTH, place.y + height / 2
    terms = "; ".join(f"{pin.node}: {pin.term}" for pin in block.pins)
    title = ", ".join(filter(None, (block.name, block.kind, f"{block.node}: {block.quantity}", terms)))
    yield f'<g class="element"><title>{escape(title)}</title>'
    for i, pin in enumerate(block.pins):
        yield from _input(pin, Point(place.x, place.y + (i + 0.5) * ROW), left)
    if block.symbol:
        yield f'<rect class="body" x="{left:g}" y="{place.y:g}" width="{_BODY_WIDTH}" height="{height}"/>'
        yield text_at(Point(left + _BODY_WIDTH / 2, middle + 5), block.symbol, anchor="middle")
        yield text_at(Point(left + 4, place.y + 12), block.name, is_small=True)
    elif block.pins:
        yield f'<path class="body" d="M{left:g} {place.y:g}L{right:g} {middle:g}L{left:g} {place.y + height:g}Z"/>'
        if block.has_bar:
            yield f'<rect class="body" x="{left - 6:g}" y="{place.y:g}" width="6" height="{height}"/>'
        yield text_at(Point(left + 6, middle + 4), block.name, is_small=True)
    label, end = f"{block.node}: {block.quantity}", place.x + BLOCK_WIDTH
    below, beside = Point(right, place.y + height + 14), Point(end - 10, middle + 4)
    yield text_at(below if block.pins else beside, shorten(label, _LONGEST), anchor="end", is_small=True)
    yield "</g>"
    start = right if block.pins else end
    yield (
        f"<g id={quoteattr(f'node-{block.node}')} data-node={quoteattr(block.node)}><title>{escape(label)}</title>"
        f'<path class="wire" d="M{start:g} {middle:g}H{end:g}"/>'
        f'<circle class="terminal" cx="{end:g}" cy="{middle:g}" r="4"/></g>'
    )


def _input(pin: _Pin, at: Point, left: float) -> Iterator[str]:
    yield f'<path class="wire" d="M{at.x:g} {at.y:g}H{left:g}"/>'
    if pin.pot:
        yield f'<circle class="body" cx="{at.x + _POT_X:g}" cy="{at.y:g}" r="9"/>'
        yield text_at(Point(at.x + 2, at.y - 11), pin.pot, is_small=True)
    if pin.gain != 1:
        yield text_at(Point(left - 22, at.y - 3), f"{pin.gain:g}", is_small=True)


def text_at(at: Point, text: str, *, anchor: str = "start", is_small: bool = False) -> str:
    """Text of a drawing."""
    style = ' class="small"' if is_small else ""
    return f'<text x="{at.x:g}" y="{at.y:g}" text-anchor="{anchor}"{style}>{escape(text)}</text>'


def shorten(text: str, most: int) -> str:
    """Text of at most so many characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."
