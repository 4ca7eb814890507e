"""Patch sheets for THE ANALOG THING: the cables compute the equations."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from analogrig.config import locate, names
from analogrig_emulator import ProgramError
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.program_loader import load_patch
from analogrig_emulator.machine.that_drawing import that_drawing
from analogrig_emulator.machine.that_sheet import ThatSheet

SVG = "{http://www.w3.org/2000/svg}"
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
