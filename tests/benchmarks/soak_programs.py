"""Soak of the compiler: slopes and plays of random programs against their equations; seeds are printed.

python -m tests.benchmarks.soak_programs [COUNT [FIRST_SEED]]
"""

from __future__ import annotations

import sys

import numpy as np

from analogrig_emulator import Capacitor, PatchedProgram
from analogrig_emulator.errors import ProgramError
from analogrig_emulator.machine.compiler import compile_program
from analogrig_emulator.machine.program_file import parse_program
from tests.emulator.random_programs import random_program
from tests.emulator.test_compiler import assert_play, assert_slopes

_EXACT_LSB, _LAGGING_LSB = 0.05, 1.5
"""Largest difference of a play from scipy's: without and with dividers and roots."""


def _lags(program: PatchedProgram) -> bool:
    """True for a program with dividers or roots: the capacitor in their loops makes them late by microseconds."""
    return any(isinstance(part, Capacitor) and part.farad < 1e-10 for part in program.elements)


def main(count: int = 100, first: int = 0) -> int:
    """Exit status: 1 if a netlist has other slopes or plays than its equations."""
    patched, refused, failed = 0, 0, []
    for seed in range(first, first + count):
        try:
            program = compile_program(parse_program(random_program(seed), f"seed {seed}"))
        except ProgramError as cause:
            refused += 1
            print(f"refused: {cause}", flush=True)
            continue
        try:
            assert_slopes(program, np.random.default_rng(seed))
            assert_play(program, within_lsb=_LAGGING_LSB if _lags(program) else _EXACT_LSB)
            patched += 1
        except AssertionError as cause:
            failed.append(seed)
            print(f"seed {seed}: FAILED: {cause}", flush=True)
    print(f"seeds {first} to {first + count - 1}: {patched} agree, {refused} refused, failed: {failed or 'none'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
