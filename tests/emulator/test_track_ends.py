"""Pots of compiled programs stay away from the ends of their tracks, so that real parts of any draw can play them."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from analogrig_emulator import COMPONENTS, MULTIPLIERS, PotError, SuspensionComputer
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.program_loader import compile_program, parse_program
from tests.emulator.programs import FILES, program_of
from tests.emulator.test_compiler import assert_slopes

SEEDS = 4

CASES = {
    "a value at the upper stop": ("y' = a*u - y", "a = { value = 1.0 }"),
    "a value just below the upper stop": ("y' = a*u - y", "a = { value = 0.9999 }"),
    "a range up to the upper stop": ("y' = a*u - y", "a = { value = 0.8, range = [0.5, 1.0] }"),
    "a reciprocal at the upper stop": ("y' = (u - y)/T", "T = { value = 1.0 }"),
    "a reciprocal whose least value is at the stop": ("y' = (u - y)/T", "T = { value = 2.0, range = [1.0, 4.0] }"),
    "two parameters at the upper stop": ("y' = a*c*u - y", "a = { value = 0.5 }\nc = { value = 2.0 }"),
    "corners of two ranges": (
        "y' = a*c*u - y",
        "a = { value = 0.5, range = [0.4, 0.625] }\nc = { value = 1.5, range = [1.0, 1.6] }",
    ),
    "a value at the lower stop": ("y' = u - y - b*y", "b = { value = 4e-4 }"),
    "a range down to the lower stop": ("y' = u - y - b*y", "b = { value = 0.01, range = [3e-4, 0.02] }"),
    "a constant at the lower stop": ("y' = u - y + b", "b = { value = 4e-3 }"),
    "a number at the lower stop": ("y' = u - y - 0.00045*y", ""),
    "a wide range": ("y' = u - y - b*y", "b = { value = 0.05, range = [4e-4, 0.1] }"),
    "a summer at the upper stop": ("S = g*u - 0.5*y\ny' = S - y", "g = { value = 1.0 }"),
    "a summer at the upper stop of gain 10": ("S = g*u - 0.5*y\ny' = 0.1*S - y", "g = { value = 10.0 }"),
    "a product at the upper stop": ("y' = a*u*y/10 - y + u", "a = { value = 1.0 }"),
}


def program(equations: str, parameters: str, speed: float = 10.0) -> PatchedProgram:
    signals = "[signals]\nS = { full = 10.0 }\n" if "S = " in equations else ""
    return compile_program(
        parse_program(
            f"name = 'ends'\nspeed = {speed}\nperiod_s = 20.0\nequations = '''\n{equations}\n'''\n"
            "[inputs]\nu = { full = 10.0, trial = [0.0, 1.0] }\n[states]\ny = { full = 10.0 }\n"
            f"{signals}[parameters]\n{parameters}",
            "ends",
        )
    )


@pytest.mark.parametrize("name", CASES)
def test_real_parts_set_every_value_of_a_range(name: str) -> None:
    assert_settable(program(*CASES[name]))


def test_a_fast_integrator_at_the_upper_stop_of_gain_10() -> None:
    assert_settable(program("y' = a*u - 0.5*y", "a = { value = 0.999 }", 1e5))


def assert_settable(patched: PatchedProgram) -> None:
    """Machines of drawn parts set every end of a range; the slopes are those of the equations."""
    assert_slopes(patched, np.random.default_rng(1))
    for seed in range(SEEDS):
        machine = real_machine(patched, seed)
        assert all(0.0 < dial < 1.0 for dial in machine.dials.values())
        for name, row in patched.equations.parameters.items():
            for value in (row.low, row.high):
                assert all(0.0 < dial < 1.0 for dial in machine.dials_for(**{name: value}).values())


def real_machine(patched: PatchedProgram, seed: int) -> SuspensionComputer:
    components = replace(COMPONENTS["polypropylene"], seed=seed, temperature_c=40.0)
    return SuspensionComputer(patched, components=components, multiplier=MULTIPLIERS["ad633"])


@pytest.mark.parametrize(("name", "asked"), [("dc-motor", "k"), ("dc-motor", "J"), ("rc-battery", "R2")])
def test_the_limit_in_an_error_is_one_that_can_be_set(name: str, asked: str) -> None:
    """The stated limit is set, and a value beyond the next digit is not."""
    machine = real_machine(program_of(name), 3)
    row = machine.program.equations.parameters[asked]  # type: ignore[attr-defined]
    for value in (row.low, row.high):
        try:
            machine.dials_for(**{asked: value})
        except PotError as error:
            limit = float(str(error).partition(f"whose {asked} is at ")[2].split(":")[0].split()[1])
            assert limit != value
            machine.dials_for(**{asked: limit})
            with pytest.raises(PotError, match=f"{asked} = .* cannot be set"):
                machine.dials_for(**{asked: limit + 0.5 * (value - limit)})
            return
    pytest.fail("every value can be set")


def test_the_limit_at_the_lower_stop_is_a_least_value() -> None:
    machine = real_machine(program_of("silverbox"), 3)
    with pytest.raises(PotError, match="square = 1 cannot be set on program silverbox, whose square is at least 1.2"):
        machine.dials_for(square=1.0)


SHIPPED = {
    "bump-stop": "5a3204392d78586c",
    "dc-motor": "4ef1e4a5f55c8796",
    "duffing": "1f192a2a5a9077c0",
    "front": "a27c7fd536bb4ff9",
    "pendulum": "2e9a0dccc06e2f49",
    "rc-battery": "9ea8268f635380ef",
    "shock": "73e5f63521e16aad",
    "silverbox": "328347d90b82e073",
    "two-mass": "c9957764ad215ffe",
    "two-tanks": "a14aa7d4d75a3a90",
    "van-der-pol": "a2fa8379e492c661",
}
"""Digest of a patch by program: resistors, capacitors, pots, full scales. Recorded hashes of runs depend on them."""


def digest(patched: PatchedProgram) -> str:
    values = [
        (part.name, part.nodes, getattr(part, "ohm", None), getattr(part, "farad", None)) for part in patched.elements
    ]
    pots = [(pot, patched.pot_coefficient(pot, patched.values)) for pot in patched.pots]
    return hashlib.sha256(repr((values, pots, sorted(patched.fulls.items()))).encode()).hexdigest()[:16]


@pytest.mark.parametrize("name", FILES)
def test_patches_of_shipped_programs_stay(name: str) -> None:
    assert digest(program_of(name)) == SHIPPED[name]
