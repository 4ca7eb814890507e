"""Figures of benchmarks: lines of a table and entries of build/bench.json."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Figure"]


@dataclass(frozen=True)
class Figure:
    """One line of the report.

    ratio: how many times better the value is than what it is compared with. bounds: between which the true value lies,
    as far as the benchmark can tell.
    """

    name: str
    value: float
    unit: str
    compared_with: str = ""
    ratio: float | None = None
    bounds: tuple[float, float] | None = None

    def __str__(self) -> str:
        """A row of the table that is printed."""
        row = f"{self.name:<70} {self.value:>12.4g} {self.unit}"
        if self.bounds is not None:
            row += f" ({self.bounds[0]:.4g} to {self.bounds[1]:.4g})"
        if self.ratio is not None:
            row += f", {self.ratio:.3g} times as good as"
        return f"{row} {self.compared_with}" if self.compared_with else row
