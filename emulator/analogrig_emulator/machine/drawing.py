"""Drawing of a patch as SVG: one row for each computing element, connections by the names of nodes.

The drawing depends on the program alone: the same file gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import escape

from analogrig_emulator.machine.compiler import PatchedCord, PatchedElement, PatchedProgram
from analogrig_emulator.machine.sheet import Inverter, input_text, inverters, signed
from analogrig_emulator.machine.stages import StageKind

_WIDTH = 900
_LINE = 34
_GAP = 22
_LABEL_X, _POT_X, _BODY_X, _BODY_WIDTH = 20, 330, 420, 70
_STYLE = (
    "text{font:13px sans-serif;fill:#222}.small{font-size:11px;fill:#555}"
    ".wire{stroke:#222;stroke-width:1.4;fill:none}.body{stroke:#222;stroke-width:1.6;fill:#fff}"
)


def patch_drawing(program: PatchedProgram) -> str:
    """SVG of the patch.

    A triangle is an amplifier, with a bar for an integrator; a circle is a pot with its coefficient; a square is a
    multiplier or a function generator. Each input names the node that it comes from, each output its node.
    """
    y = 70
    rows: list[str] = []
    for element in program.patch:
        rows += _element(element, y)
        y += _LINE * len(element.cords) + _GAP
    for inverter in inverters(program):
        rows += _inverter(inverter, y)
        y += _LINE + _GAP
    title = f"{program.name}: {program.equations.description}" if program.equations.description else program.name
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{y}" viewBox="0 0 {_WIDTH} {y}" role="img">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style>"
        f'<rect width="{_WIDTH}" height="{y}" fill="#fff"/>'
    )
    sources = ", ".join(f"{name} at {node}" for name, node in program.input_nodes.items())
    caption = _text(_LABEL_X, 28, title) + _text(_LABEL_X, 48, f"inputs: {sources}", small=True)
    return "\n".join([head, caption, *rows, "</svg>"]) + "\n"


def _element(element: PatchedElement, y: int) -> Iterator[str]:
    height = _LINE * len(element.cords)
    for i, cord in enumerate(element.cords):
        yield from _input(element, cord, y + i * _LINE + _LINE // 2)
    if element.stage.kind in (StageKind.PRODUCT, StageKind.FUNCTION):
        sign = "x" if element.stage.kind is StageKind.PRODUCT else "f"
        yield f'<rect class="body" x="{_BODY_X}" y="{y}" width="{_BODY_WIDTH}" height="{height}"/>'
        yield _text(_BODY_X + 30, y + height // 2 + 5, sign)
    else:
        yield from _triangle(y, height, has_bar=element.stage.kind is StageKind.INTEGRATOR)
    detail = element.stage.kind.value + (f", {element.farad * 1e9:g} nF" if element.farad else "")
    yield from _output(element.name, element.node, signed(element.sign, element.stage.name), detail, y + height // 2)


def _inverter(inverter: Inverter, y: int) -> Iterator[str]:
    middle = y + _LINE // 2
    yield _text(_LABEL_X, middle + 4, f"{inverter.node}: {signed(inverter.sign, inverter.quantity)}")
    yield _wire(_POT_X - 20, _BODY_X, middle)
    yield from _triangle(y, _LINE, has_bar=False)
    output = signed(-inverter.sign, inverter.quantity)
    yield from _output(inverter.name, inverter.name.lower(), output, "inverter", middle)


def _input(element: PatchedElement, cord: PatchedCord, y: int) -> Iterator[str]:
    yield _text(_LABEL_X, y + 4, f"{cord.node}: {_short(input_text(element, cord))}")
    yield _wire(_POT_X - 20, _BODY_X, y)
    if cord.pot:
        yield f'<circle class="body" cx="{_POT_X + 12}" cy="{y}" r="12"/>'
        yield _text(_POT_X + 28, y - 3, f"{cord.pot} {cord.coefficient / cord.gain:.4f}", small=True)
    if cord.gain != 1:
        yield _text(_BODY_X - 16, y + 12, str(cord.gain), small=True)


def _triangle(y: int, height: int, *, has_bar: bool) -> Iterator[str]:
    left, right, middle = _BODY_X, _BODY_X + _BODY_WIDTH, y + height / 2
    yield f'<path class="body" d="M{left} {y}L{right} {middle:g}L{left} {y + height}Z"/>'
    if has_bar:
        yield f'<rect class="body" x="{left - 6}" y="{y}" width="6" height="{height}"/>'


def _output(name: str, node: str, quantity: str, detail: str, y: int) -> Iterator[str]:
    right = _BODY_X + _BODY_WIDTH
    yield _wire(right, right + 30, y)
    yield _text(_BODY_X + 6, y + 5, name if len(name) < 4 else "", small=True)
    yield _text(right + 36, y, f"{node}: {_short(quantity)}")
    yield _text(right + 36, y + 15, f"{name}, {detail}", small=True)


def _wire(start: int, stop: int, y: int) -> str:
    return f'<path class="wire" d="M{start} {y}H{stop}"/>'


def _text(x: int, y: int, text: str, *, small: bool = False) -> str:
    style = ' class="small"' if small else ""
    return f'<text x="{x}" y="{y}"{style}>{escape(text)}</text>'


def _short(text: str) -> str:
    return text if len(text) <= 38 else f"{text[:35]}..."
