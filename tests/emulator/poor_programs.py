"""Advice on drawn programs with poor scales or speeds, followed: `python -m tests.emulator.poor_programs 0:100`."""

from __future__ import annotations

import sys
import time
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from analogrig_emulator import EmulatorError
from analogrig_emulator.machine.compiler import compile_equations
from analogrig_emulator.machine.program_file import read_equations
from analogrig_emulator.machine.program_loader import compile_program, equations_of
from tests.emulator.drawn_plays import show
from tests.emulator.random_programs import random_program
from tests.emulator.test_tried_advice import advised, assert_plays, tomllib_text


def poor_table(seed: int) -> dict[str, Any]:
    """Tables that are refused: at odd seeds for their speed, at even ones for a full scale; worse until they are."""
    return next(table for table in _poorer(seed) if _is_refused(table))


def _poorer(seed: int) -> Iterator[dict[str, Any]]:
    rng = np.random.default_rng(seed)
    table = tomllib.loads(random_program(seed))
    if seed % 2:
        step = float(rng.choice([0.1, 10.0]))
        table["speed"] *= step**2
        while True:
            table["speed"] *= step
            yield table
    good = compile_program(equations_of(table)).scales
    exponents = {name: float(rng.uniform(-1.0, 1.0)) for name in table["states"]}
    for decades in (1.0, 2.0, 3.0, 4.0, 6.0, 8.0):
        for name, exponent in exponents.items():
            table["states"][name]["full"] = float(f"{good.full(name) * 10 ** (decades * exponent):.3g}")
        yield table


def _is_refused(table: Mapping[str, Any]) -> bool:
    try:
        compile_equations(read_equations(table))
    except EmulatorError:
        return True
    return False


def mended(seed: int) -> str:
    """First message for a poor file. Raises AssertionError if there is none, or if its advice does not help."""
    message, program = advised(tomllib_text(poor_table(seed)))
    assert message
    assert_plays(program)
    return message


def main(numbers: str = "0:100") -> int:
    failed = 0
    for seed in range(*map(int, numbers.split(":"))):
        begun_s = time.process_time()
        try:
            text = mended(seed)
        except (AssertionError, EmulatorError) as error:
            failed += 1
            text = f"FAILED: {error}"
        show(f"{seed}: {time.process_time() - begun_s:.1f} s: {text}")
    show(f"{failed} failed")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
