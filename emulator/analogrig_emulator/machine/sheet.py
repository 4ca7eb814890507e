"""Scaling sheet of a compiled program: the table that an operator fills in before patching."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from analogrig_emulator.circuit.pot import dial_for
from analogrig_emulator.machine.patched_program import PatchedCord, PatchedElement, PatchedProgram
from analogrig_emulator.machine.stages import is_atom


def scaling_sheet(program: PatchedProgram) -> str:
    """Text of the sheet: quantities with scales, computing elements with their inputs, pots with dials."""
    equations = program.equations
    head = f"{program.name}: {equations.description}" if equations.description else program.name
    parts = [
        [head, f"1 s of the machine is {equations.speed:g} s of the plant.", *diagram_lines(program)],
        ["Quantities: 10 V stand for the full scale.", *table(_quantities(program))],
        ["Computing elements", *table(_elements(program))],
        ["Pots, set under load", *table(_pots(program))],
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def diagram_lines(program: PatchedProgram) -> list[str]:
    """Difference between the patch of the equations and the circuit of a run, if there is one."""
    diagram = program.equations.diagram
    return [f"This patch is compiled from the equations; a run plays the diagram {diagram}."] if diagram else []


def dials(program: PatchedProgram, values: Mapping[str, float]) -> dict[str, float]:
    """Dials of nominal pots for values of the parameters."""
    return {
        pot: dial_for(program.pot_coefficient(pot, values), *ohms, pot)
        for pot, ohms in program.pot_ohms(program.elements).items()
    }


def _quantities(program: PatchedProgram) -> Iterator[Sequence[str]]:
    yield "quantity", "unit", "full scale", "trial play", "node", "sign"
    for name, quantity in program.equations.quantities.items():
        scale, reach = program.scales.quantities[name], program.reach[name]
        unit = quantity.unit.text if quantity.unit else "-"
        span = f"{reach.low:.4g} to {reach.high:.4g}"
        yield name, unit, f"{scale.full:g}", span, scale.node, "+" if scale.sign > 0 else "-"


def _elements(program: PatchedProgram) -> Iterator[Sequence[str]]:
    yield "element", "kind", "output", "full scale", "input", "from", "pot", "gain", "capacitor"
    for element in program.patch:
        output = signed(element.sign, element.stage.name)
        head = (element.name, element.stage.kind.title, output, f"{element.full:g}")
        farad = f"{element.farad * 1e9:g} nF" if element.farad else ""
        for cord in element.cords:
            gain = f"{cord.gain:g}" if element.stage.kind.has_amplifier else ""
            yield *head, input_text(element, cord), cord.node, cord.pot, gain, farad
            head, farad = ("", "", "", ""), ""
    for each in inverters(program):
        outputs = signed(-each.sign, each.quantity), f"{program.fulls[each.quantity]:g}"
        yield each.name, "inverter", *outputs, signed(each.sign, each.quantity), each.node, "", "1", ""


class Inverter(NamedTuple):
    """Inverter of a quantity; node, sign: where it comes from, and its sign there."""

    name: str
    quantity: str
    node: str
    sign: int


def inverters(program: PatchedProgram) -> Iterator[Inverter]:
    """Inverters of a patch, in the order of their amplifiers."""
    for quantity, name in program.inverters.items():
        yield Inverter(name, quantity, *program.places[quantity])


def signed(sign: int, quantity: str) -> str:
    """Quantity with its sign: -x, or -(a + b) for a formula."""
    return quantity if sign > 0 else f"-{quantity if is_atom(quantity) else f'({quantity})'}"


def input_text(element: PatchedElement, cord: PatchedCord) -> str:
    """Term of an input; for elements without coefficients the source with its sign."""
    if element.stage.kind.adds:
        return cord.cord.text
    return signed(cord.sign, cord.cord.source)


def _pots(program: PatchedProgram) -> Iterator[Sequence[str]]:
    yield "pot", "coefficient", "dial", "turned by"
    at = dials(program, program.values)
    for pot, row in program.pots.items():
        coefficient = program.pot_coefficient(pot, program.values)
        yield pot, f"{coefficient:.4f}", f"{at[pot]:.4f}", ", ".join(row.settings) or "nothing"


def table(rows: Iterator[Sequence[str]]) -> list[str]:
    """Lines of left-aligned columns."""
    cells = [list(row) for row in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in cells]
