"""Scaling sheet and drawing of a compiled program."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from analogrig_emulator import SuspensionComputer
from analogrig_emulator.machine.drawing import patch_drawing
from analogrig_emulator.machine.program_loader import compile_program, load_patch, parse_program
from analogrig_emulator.machine.sheet import dials, scaling_sheet

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
