"""Knobs of a bench: the parameters of its program, as the pots that show them can be turned."""

from __future__ import annotations

from dataclasses import dataclass

from analogrig import ConfigurationError, Plant


@dataclass(frozen=True)
class Knob:
    """Parameter of a program with its range."""

    name: str
    unit: str
    low: float
    high: float
    pots: tuple[str, ...]
    """Pots that show it, alone or with others."""

    def check(self, value: float) -> None:
        """:raises ConfigurationError: a value is outside the range."""
        if not self.low <= value <= self.high:
            raise ConfigurationError(
                f"{self.name} must be {self.low:.6g} to {self.high:.6g} {self.unit}, not {value:.6g}"
            )


def knobs_of(plant: Plant) -> dict[str, Knob]:
    """Knobs by name, in the order of the program; a parameter without a range has none."""
    program, values = plant.program, plant.parameters()
    return {
        name: Knob(
            name,
            program.unit(name),
            min(row.low, values[name]),
            max(row.high, values[name]),
            tuple(pot for pot, each in program.circuit.pots.items() if name in each.settings),
        )
        for name, row in program.parameters.items()
        if row.low < row.high
    }
