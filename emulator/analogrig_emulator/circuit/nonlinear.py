"""Non-linear computing elements: multiplier and diode function generator.

Their inputs draw no current and their outputs are voltages against ground. Each law is that of an ideal element.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from analogrig_emulator.circuit.part import GROUND, Part


@dataclass(frozen=True)
class Multiplier(Part):
    """Four-quadrant multiplier: v(out) = v(x) v(y) / scale_v.

    scale_v: 10 V in a usual machine. A negative scale is a differential x input with its two ends exchanged. The same
    node at both inputs makes a squarer.
    """

    finite: ClassVar[tuple[str, ...]] = ("scale_v",)

    x: str
    y: str
    out: str
    scale_v: float = 10.0

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.x, self.y, self.out

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.out, GROUND),)

    @property
    def rigid_bonds(self) -> tuple[tuple[str, str], ...]:
        return self.bonds


@dataclass(frozen=True)
class Function(Part):
    """Diode function generator: v(out) is a function of v(x) in straight pieces.

    breakpoints: at least two pairs (v(x), v(out)) in V, with v(x) ascending. The first and the last piece go on beyond
    the ends.
    """

    x: str
    out: str
    breakpoints: tuple[tuple[float, float], ...]

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.x, self.out

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.out, GROUND),)

    @property
    def rigid_bonds(self) -> tuple[tuple[str, str], ...]:
        return self.bonds
