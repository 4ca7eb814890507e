"""Random programs of two to six states, played by their patches: ideal parts beside scipy, real parts beside ngspice.

python -m tests.benchmarks programs [COUNT [FIRST_SEED]]

Every seed is printed with its figures. The patch has the slopes of the equations at random places, too.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analogrig.rigs.description import describe
from analogrig.rigs.emulator import EmulatorDescription
from analogrig_emulator import (
    MULTIPLIERS,
    TICKS_PER_SAMPLE,
    Circuit,
    Components,
    Deck,
    Excitation,
    Multiplier,
    OpAmp,
    PatchedProgram,
    SuspensionComputer,
)
from analogrig_emulator.circuit.spice import Accuracy
from analogrig_emulator.errors import CircuitError, ProgramError
from analogrig_emulator.machine.compiler import compile_program
from analogrig_emulator.machine.program_file import parse_program
from tests.emulator.conftest import UnfinishedError, ngspice_in
from tests.emulator.random_programs import random_program
from tests.emulator.test_compiler import LSB_V, RATE_HZ, assert_slopes, levels_v, off_equations_lsb

from .figure import Figure

MOST_LSB = 0.05
REAL_SAMPLES = 120
WORKERS = 2

ACCURACIES = (Accuracy(), Accuracy(reltol=1e-6), Accuracy(reltol=1e-6, trtol=1.0), Accuracy(reltol=1e-5, trtol=1.0))
"""Settings of ngspice, the tightest first."""

NOTE = f"""\
Each seed draws a program with a stable linear part and random terms: products, cubes, dead zones,
absolute values, minima, quotients, roots, curves. The square wave of its trial play excites it.

Ideal parts: the largest difference at any channel from the equations of the file, solved by scipy's
DOP853 to 1e-9. Half of the programs divide by states or take roots of them.

Real parts: the largest difference at any amplifier or multiplier from ngspice, in the tightest
setting with which it reaches the end. The parts are those of the rig `emulator-real`: drawn
resistors, capacitors that leak, TL07x, AD633 with errors, pole and limits. Absorption is left out,
for it would exceed the 64 states of the engine. The largest programs have more than the engine's
256 nodes and branches with real parts. In these only op-amps and multipliers are real.

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
    return Outcome(seed, "", states, products, ideal_lsb, off_ngspice_lsb(program))


def _real_computer(program: PatchedProgram, seed: int) -> SuspensionComputer:
    """Computer with the parts of the rig ``emulator-real``, drawn from the seed, as far as the engine takes them.

    Absorption would exceed its states. If the others are too many, op-amps and multipliers alone are real.
    """
    description = describe("emulator-real")
    assert isinstance(description, EmulatorDescription)
    parts, multiplier = description.computer, MULTIPLIERS[description.computer.multiplier_name]
    real = parts.components_for(seed)
    real = replace(real, dielectric=replace(real.dielectric, absorption=()))
    try:
        return SuspensionComputer(program, opamp=parts.op_amp, multiplier=multiplier, components=real)
    except CircuitError:
        active = Components(op_amps=replace(real.op_amps, bias_a=0.0), multipliers=real.multipliers, seed=seed)
        return SuspensionComputer(program, opamp=parts.op_amp, multiplier=multiplier, components=active)


def off_ngspice_lsb(program: PatchedProgram) -> float:
    """Largest difference of real parts from ngspice at any amplifier and multiplier, in LSB."""
    computer = _real_computer(program, int(program.name.removeprefix("random-")))
    low_v, high_v = levels_v(program)
    # At an edge's own instant ngspice still shows the level before it, so no edge is to fall on a sample.
    edges = Excitation(low_v=low_v, high_v=high_v, clock="free", phase=0.637).edges(
        0, REAL_SAMPLES * TICKS_PER_SAMPLE, RATE_HZ
    )
    deck = Deck(computer.circuit, REAL_SAMPLES, RATE_HZ, {"F": edges})
    amplifiers, multipliers = deck.circuit.of(OpAmp), deck.circuit.of(Multiplier)
    outputs = [each.out for each in amplifiers] + [each.out for each in multipliers]
    return float(np.abs(deck.volts(outputs) - _by_ngspice(deck, outputs)).max() / LSB_V)


def _by_ngspice(deck: Deck, outputs: Sequence[str]) -> NDArray[np.float64]:
    """Voltages by the tightest of the settings with which ngspice reaches the end; it may give up in tight ones.

    :raises AssertionError: there is none.
    """
    for accuracy in ACCURACIES:
        with tempfile.TemporaryDirectory() as folder, contextlib.suppress(UnfinishedError):
            return ngspice_in(Path(folder))(deck.text(outputs, accuracy), outputs, REAL_SAMPLES)
    raise AssertionError(f"ngspice reaches the end with none of {len(ACCURACIES)} settings")
