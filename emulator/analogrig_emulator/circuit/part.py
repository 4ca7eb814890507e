"""Common part of all circuit elements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

GROUND = "0"


@dataclass(frozen=True)
class CircuitPart:
    """Common part of all elements: name, and the constraints on the fields."""

    positive: ClassVar[tuple[str, ...]] = ()
    finite: ClassVar[tuple[str, ...]] = ()
    """Fields that must be finite numbers if given."""

    name: str

    @property
    def nodes(self) -> tuple[str, ...]:
        raise NotImplementedError

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        """Pairs of nodes between which the element determines the voltage."""
        raise NotImplementedError

    @property
    def spans(self) -> tuple[tuple[str, str], ...]:
        """Pairs of nodes that must not be the same."""
        return self.bonds

    @property
    def rigid_bonds(self) -> tuple[tuple[str, str], ...]:
        """Bonds whose voltage does not depend on the current."""
        return ()

    @property
    def output(self) -> str | None:
        """Node driven by an output of the element; None for a passive element or a current source."""
        return None

    @property
    def fault(self) -> str | None:
        """Fault of the values together, for an error message."""
        return None
