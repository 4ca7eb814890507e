"""Scaling sheets, patch sheets and drawings of a program."""

from __future__ import annotations

import functools
import itertools
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from analogrig.config import locate, names
from analogrig_emulator import ProgramError, SuspensionComputer
from analogrig_emulator.machine.drawing import patch_drawing
from analogrig_emulator.machine.layout import BLOCK_WIDTH, ROW, Box, PatchLayout, Point, lay_out
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.program_loader import compile_program, load_patch, parse_program
from analogrig_emulator.machine.sheet import dials, inverters, scaling_sheet
from analogrig_emulator.machine.that_drawing import that_drawing
from analogrig_emulator.machine.that_sheet import ThatSheet

FOLDER = Path(__file__).parents[2] / "fixtures" / "programs"
SVG = "{http://www.w3.org/2000/svg}"


def test_sheet_has_what_an_operator_needs() -> None:
    lines = [" ".join(line.split()) for line in scaling_sheet(load_patch(FOLDER / "dc-motor.toml")).splitlines()]
    for line in (
        "1 s of the machine is 10 s of the plant.",
        "u V 24 0 to 20 in +",
        "U1 summer -(u - R*i - k*omega) 30 + u in P1 1",
        "- R*i u5 R 10",
        "U2 integrator i 20 + (u - R*i - k*omega)/L u1 L 1 1 nF",
        "U5 inverter -i 20 i u2 1",
        "J 0.6250 0.6394 J",
    ):
        assert line in lines


def test_dials_of_the_sheet_are_those_of_the_machine() -> None:
    program = load_patch(FOLDER / "dc-motor.toml")
    assert SuspensionComputer(program).dials == pytest.approx(dials(program, program.values))


@pytest.mark.parametrize("stem", sorted(path.stem for path in FOLDER.glob("*.toml")))
def test_drawing_shows_every_element_and_pot(stem: str) -> None:
    program = load_patch(FOLDER / f"{stem}.toml")
    drawing = ET.fromstring(patch_drawing(program))  # noqa: S314 - our own
    words = " ".join(text.text or "" for text in drawing.iter(f"{SVG}text")).split()
    names = (*(element.name for element in program.patch), *program.inverters.values(), *program.pots)
    assert set(names) <= set(words)


def test_sheet_and_drawing_depend_on_the_file_alone() -> None:
    path = FOLDER / "pendulum.toml"
    program, again = load_patch(path), compile_program.__wrapped__(parse_program(path.read_bytes() + b"\n", "again"))
    assert scaling_sheet(program) == scaling_sheet(again)
    assert patch_drawing(program) == patch_drawing(again)


def test_text_of_a_file_is_no_markup_in_the_drawing() -> None:
    text = (FOLDER / "dc-motor.toml").read_text().replace("DC motor with load", "<script>alert(1)</script> & more")
    drawing = patch_drawing(compile_program(parse_program(text, "motor.toml")))
    assert "<script" not in drawing and "&lt;script&gt;" in drawing


# ---- patch sheets for THE ANALOG THING: the cables compute the equations


K0 = 1000.0
"""Volts per second and volt of an integrator at weight 1."""

REFUSED = {
    "bump-stop": "needs a half-wave rectifier, and THE ANALOG THING has none",
    "rc-battery": "needs 12 coefficients, and THE ANALOG THING has 8",
    "silverbox": "needs 5 inputs of weight 1 at INT2, which has 4",
    "two-mass": "needs 5 summers, and THE ANALOG THING has 4",
    "two-tanks": "needs a square root, and THE ANALOG THING has none",
}


@functools.cache
def program_named(name: str) -> PatchedProgram:
    return load_patch(locate("programs", name))


def rates(sheet: ThatSheet, outputs: dict[str, float], driven: dict[str, float]) -> dict[str, float]:
    """Rates of the integrators, in machine units per second, worked out cable by cable from their outputs."""
    values = {**outputs, **driven, "+1": 1.0, "-1": -1.0}
    places = sheet.places.values()
    for _ in places:  # as many passes as a chain can have elements
        for place in places:
            into = [cable for cable in sheet.cables if cable.target == place]
            if all(cable.source in values for cable in into) and not place.startswith("INT"):
                signals = [values[cable.source] for cable in into]
                values[place] = float(np.prod(signals)) if place.startswith("MULT") else -weighted(sheet, place, values)
    slow = {place: 0.01 if place in sheet.slow else 1.0 for place in outputs}
    return {place: -K0 * slow[place] * weighted(sheet, place, values) for place in outputs}


def weighted(sheet: ThatSheet, place: str, values: dict[str, float]) -> float:
    into = (cable for cable in sheet.cables if cable.target == place)
    return sum(int(cable.jack) * cable.coefficient * values[cable.source] for cable in into)


@pytest.mark.parametrize("name", sorted(set(names("programs")) - set(REFUSED)))
def test_cables_compute_the_equations(name: str) -> None:
    program = program_named(name)
    sheet, equations, rng = ThatSheet(program), program.equations, np.random.default_rng(1)
    integrators = {each.stage.name: each for each in program.patch if each.farad}
    (source,) = equations.inputs
    for _ in range(5):
        state = {x: rng.uniform(-0.5, 0.5) * program.fulls[x] for x in equations.states}
        driven = rng.uniform(-0.5, 0.5)
        known = {**equations.values, source: driven * program.fulls[source]}
        expected = equations.slopes()(known, np.array([state[x] for x in equations.states]))
        places = {x: sheet.places[each.name] for x, each in integrators.items()}
        scale = {x: each.sign / each.full for x, each in integrators.items()}
        found = rates(sheet, {places[x]: scale[x] * state[x] for x in state}, {source: driven})
        for x, slope in zip(equations.states, expected, strict=True):
            assert found[places[x]] == pytest.approx(scale[x] * slope * sheet.speed, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", sorted(set(names("programs")) - set(REFUSED)))
def test_every_cable_of_the_sheet_is_drawn_from_an_output_to_an_input_of_its_own(name: str) -> None:
    sheet = ThatSheet(program_named(name))
    drawing = ET.fromstring(that_drawing(sheet))  # noqa: S314 - our own
    jacks = {
        (each.get("cx"), each.get("cy")): each for each in drawing.iter(f"{SVG}circle") if each.get("class") == "jack"
    }
    sources = len(sheet.program.input_nodes) + 2
    assert len(jacks) == 8 * 2 + 4 * 8 + 4 * 2 + 5 * 9 + 2 * 3 + sources
    ends, pieces = [], []
    for path in drawing.iter(f"{SVG}path"):
        if number := path.get("data-cable"):
            pieces.append(int(number))
            points = re.findall(r"[\d.]+ [\d.]+", path.get("d", ""))
            start, end = (tuple(each.split()) for each in (points[0], points[-1]))
            assert jacks[start].get("r") == "6" and jacks[end].get("r") == "9"
            assert all(0 <= float(x) <= 1280 and 0 <= float(y) <= 720 for x, y in map(str.split, points))
            ends.append(end)
    assert len(set(ends)) == len(ends)
    drawn = [number for number, name in enumerate(sheet.coefficients, 1) for _ in range(2 if name else 1)]
    assert sorted(pieces) == drawn


@pytest.mark.parametrize(("name", "why"), REFUSED.items())
def test_program_that_does_not_fit_is_refused_with_the_count(name: str, why: str) -> None:
    with pytest.raises(ProgramError, match=f"program {name}: {why}"):
        ThatSheet(program_named(name))


def test_sheet_names_cables_coefficients_and_speed() -> None:
    lines = [" ".join(line.split()) for line in ThatSheet(program_named("shock")).text().splitlines()]
    assert "1 s of the machine is 20 s of the plant." in lines
    assert "SUM1 -net_force 1470 U1" in lines
    assert "5 SUM1 COEF4 0.7350 M INT2 10" in lines
    assert "6 INT2 INV1 1" in lines


def test_slow_integrators_lead_to_their_jack() -> None:
    program = program_named("dc-motor")
    slower = [replace(each, farad=100e-9) if each.name == "U4" else each for each in program.patch]
    sheet = ThatSheet(replace(program, patch=tuple(slower)))
    assert sheet.slow == ("INT2",)
    assert "INT2 to its jack SLOW" in that_drawing(sheet)
    assert "Also from the output to SLOW: INT2" in sheet.text()


# ---- drawing of a patch: every connection of the program is a wire, and no two wires run on top of each other


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
