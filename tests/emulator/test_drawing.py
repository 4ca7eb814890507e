"""Drawing of a patch: every connection of the program is a wire, and no two wires run on top of each other."""

from __future__ import annotations

import itertools
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from analogrig_emulator.machine.drawing import patch_drawing
from analogrig_emulator.machine.layout import BLOCK_WIDTH, ROW, Box, PatchLayout, Point, lay_out
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.program_loader import load_patch
from analogrig_emulator.machine.sheet import inverters

PROGRAMS = Path(__file__).parents[2] / "fixtures" / "programs"

Line = tuple[Point, Point]


@pytest.fixture(params=sorted(PROGRAMS.glob("*.toml")), ids=lambda path: path.stem)
def program(request: pytest.FixtureRequest) -> PatchedProgram:
    return load_patch(request.param)


def blocks_of(program: PatchedProgram) -> list[Box]:
    blocks = [Box(each.node, tuple(cord.node for cord in each.cords)) for each in program.patch]
    blocks += [Box(each.name.lower(), (each.node,)) for each in inverters(program)]
    driven = {each.node for each in blocks}
    sources = dict.fromkeys(node for each in blocks for node in each.pins if node not in driven)
    return [*map(Box, sources), *blocks]


def reached(layout: PatchLayout, node: str, start: Point) -> set[Point]:
    """Points that a wire joins, directly or over its other lines, with one of its ends."""
    lines, found = set(layout.wires[node].lines), {start}
    while more := {line for line in lines if any(touches(line, point) for point in found)}:
        lines -= more
        crossings = {point for line in more for other in layout.wires[node].lines for point in meeting(line, other)}
        found |= {point for line in more for point in line} | crossings
    return found


def touches(line: Line, point: Point) -> bool:
    (a, b), inside = line, True
    for low, high, value in ((a.x, b.x, point.x), (a.y, b.y, point.y)):
        inside &= min(low, high) <= value <= max(low, high)
    return inside


def meeting(one: Line, other: Line) -> list[Point]:
    """Point at which a horizontal and a vertical line meet."""
    places = (Point(a[0].x, b[0].y) for a, b in ((one, other), (other, one)) if a[0].x == a[1].x and b[0].y == b[1].y)
    return [point for point in places if touches(one, point) and touches(other, point)]


def run_together(one: Line, other: Line) -> bool:
    """True if two parallel lines share more than a point."""
    for axis in ("x", "y"):
        across = "y" if axis == "x" else "x"
        if len({getattr(point, across) for point in (*one, *other)}) == 1:
            (a, b), (c, d) = (sorted(getattr(point, axis) for point in line) for line in (one, other))
            if min(b, d) > max(a, c):
                return True
    return False


def test_wire_of_each_node_joins_its_output_with_all_its_pins_and_no_other(program: PatchedProgram) -> None:
    blocks = blocks_of(program)
    layout = lay_out(blocks)
    pins = {
        Point(place.x, place.y + (i + 0.5) * ROW): node
        for block, place in zip(blocks, layout.places, strict=True)
        for i, node in enumerate(block.pins)
    }
    assert len(pins) == sum(len(block.pins) for block in blocks)
    for block, place in zip(blocks, layout.places, strict=True):
        if block.node in layout.wires:
            found = reached(layout, block.node, Point(place.x + BLOCK_WIDTH, place.y + block.height / 2))
            assert {pins[point] for point in found if point in pins} == {block.node}
            assert {point for point, node in pins.items() if node == block.node} <= found


def test_no_wire_runs_on_another_and_no_block_covers_one(program: PatchedProgram) -> None:
    blocks = blocks_of(program)
    layout = lay_out(blocks)
    for one, other in itertools.combinations(layout.wires.values(), 2):
        assert not any(run_together(a, b) for a, b in itertools.product(one.lines, other.lines))
    for block, place in zip(blocks, layout.places, strict=True):
        middle = Point(place.x + BLOCK_WIDTH / 2, place.y + block.height / 2)
        assert not any(touches(line, middle) for wire in layout.wires.values() for line in wire.lines)
        assert place.x + BLOCK_WIDTH < layout.width and place.y + block.height < layout.height


def test_drawing_names_every_node_once_and_is_the_same_again(program: PatchedProgram) -> None:
    drawing = patch_drawing(program)
    assert drawing == patch_drawing(program)
    root = ET.fromstring(drawing)  # noqa: S314 - our own
    named = [each.get("id", "").removeprefix("node-") for each in root.iter() if each.get("id")]
    assert sorted(named) == sorted(block.node for block in blocks_of(program))
    assert {each.get("data-node") for each in root.iter() if each.get("data-node")} == set(named)
    assert float(root.get("width", "0")) < 1500
