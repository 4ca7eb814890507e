"""Random programs of two to six states, played by their patches: ideal parts beside scipy, real parts beside ngspice.

python -m tests.bench programs [COUNT [FIRST_SEED]]

Every seed is printed with its figures. The patch has the slopes of the equations at random places, too.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from analogrig_emulator import Circuit, Multiplier
from analogrig_emulator.exceptions import ProgramError
from analogrig_emulator.machine.program_loader import compile_program, parse_program
from tests.emulator.random_programs import random_program
from tests.emulator.real_parts import off_ngspice_lsb
from tests.emulator.test_compiler import assert_slopes, off_equations_lsb

from .figure import Figure

MOST_LSB = 0.05
WORKERS = 2

NOTE = f"""\
Each seed draws a program of one of seven families: general terms (products, cubes, quotients, roots,
dead zones, limits, curves), masses with backlash, relaxation oscillators, saturating control loops,
chaotic flows, dry friction, stops. The square wave of its trial play excites it.

Ideal parts: the largest difference at any channel from the equations of the file, solved by scipy's
DOP853 to 1e-9.

Real parts: the largest difference at any amplifier or multiplier from ngspice, in the tightest
setting with which it reaches the end. The parts are those of the rig `emulator-real`: drawn
resistors, capacitors that leak and absorb, TL07x, AD633 with errors, pole and limits.

Required are {MOST_LSB:g} LSB of 12 bits. Each patch has the slopes of its equations at random places.
"""
"""Paragraphs below the table."""


@dataclass(frozen=True)
class Outcome:
    """Result of one seed. Largest differences are in LSB; refused: the reason of the compiler."""

    seed: int
    refused: str = ""
    states: int = 0
    products: int = 0
    ideal_lsb: float = 0.0
    real_lsb: float = 0.0

    @property
    def agrees(self) -> bool:
        return not self.refused and max(self.ideal_lsb, self.real_lsb) <= MOST_LSB

    def __str__(self) -> str:
        if self.refused:
            return f"seed {self.seed}: refused: {self.refused}"
        return (
            f"seed {self.seed}: {self.states} states, {self.products} multipliers, ideal {self.ideal_lsb:.4f} LSB,"
            f" real {self.real_lsb:.4f} LSB{'' if self.agrees else ': FAILED'}"
        )


def figures(count: str = "100", first: str = "0") -> Iterator[Figure]:
    """Number of programs that agree, and the largest differences."""
    start_s = time.monotonic()
    seeds = range(int(first), int(first) + int(count))
    found = []
    with ProcessPoolExecutor(min(WORKERS, os.cpu_count() or 1)) as pool:
        for outcome in pool.map(outcome_of, seeds):
            print(outcome, flush=True)
            found.append(outcome)
    played = [each for each in found if not each.refused]
    drawn = f"seeds {seeds.start} to {seeds[-1]}, {(time.monotonic() - start_s) / 60.0:.0f} min"
    yield Figure("random programs, drawn", len(found), "", drawn)
    refused = "; ".join(f"seed {each.seed}: {each.refused}" for each in found if each.refused)
    yield Figure("random programs, refused by the compiler", len(found) - len(played), "", refused)
    failed = ", ".join(str(each.seed) for each in played if not each.agrees)
    yield Figure("random programs, in agreement", len(played) - failed.count(",") - bool(failed), "", failed)
    worst = max(played, key=lambda each: each.ideal_lsb)
    yield Figure("ideal parts, largest difference from scipy", worst.ideal_lsb, "LSB", f"seed {worst.seed}")
    worst = max(played, key=lambda each: each.real_lsb)
    yield Figure("real parts, largest difference from ngspice", worst.real_lsb, "LSB", f"seed {worst.seed}")


def outcome_of(seed: int) -> Outcome:
    """Compile and play the program of a seed.

    :raises AssertionError: the patch has other slopes than the equations.
    """
    try:
        program = compile_program(parse_program(random_program(seed), f"seed {seed}"))
    except ProgramError as cause:
        return Outcome(seed, str(cause).removeprefix(f"seed {seed}: "))
    assert_slopes(program, np.random.default_rng(seed))
    states, products = len(program.equations.states), len(Circuit(program.elements).of(Multiplier))
    ideal_lsb = off_equations_lsb(program)
    return Outcome(seed, "", states, products, ideal_lsb, off_ngspice_lsb(program, seed))
