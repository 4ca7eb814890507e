"""Shipped program files, and the circuits that solve them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from analogrig_emulator import (
    PROGRAMS,
    DiodeLimiter,
    Element,
    OpAmpModel,
    PatchedProgram,
    ProgramCircuit,
    SuspensionProgram,
    load_patch,
)

FOLDER = Path(__file__).parents[2] / "fixtures" / "programs"
FILES = sorted(path.stem for path in FOLDER.glob("*.toml"))


def program_of(name: str) -> PatchedProgram:
    """Compile a shipped program, also one that is wired by hand."""
    return load_patch(FOLDER / f"{name}.toml")


@dataclass(frozen=True)
class LimitedSuspension(SuspensionProgram):
    """Front suspension with a diode limiter from the summer's input to -e_x: a spring of 60 kN/m beyond 0.1 m."""

    def netlist(self, models: Sequence[OpAmpModel]) -> list[Element]:
        on_ohm = 100e3 * 2940.0 / 0.1996 / 60e3
        return [*super().netlist(models), DiodeLimiter("STOP", "s1", "u3", 1.0 / 0.1996, on_ohm, 1e9)]


BY_HAND = {**PROGRAMS, "limited": LimitedSuspension("limited", 115.0, 3021.0, 24500.0, force_n=2940.0)}


def circuit_of(name: str) -> ProgramCircuit:
    """Circuit wired by hand, or that of a compiled program."""
    return BY_HAND[name] if name in BY_HAND else program_of(name)
