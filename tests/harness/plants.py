"""Plants of the program front."""

from __future__ import annotations

from analogrig.plant import Plant
from analogrig.program import Program

PROGRAM = Program.load("front")


def front(mass_kg: float = 115.0, damping_n_s_per_m: float = 3021.0, stiffness_n_per_m: float = 24500.0) -> Plant:
    """Suspension M x'' + B x' + K x = F."""
    return Plant(PROGRAM, (mass_kg, damping_n_s_per_m, stiffness_n_per_m))
