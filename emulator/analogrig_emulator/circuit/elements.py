"""Elements of a circuit: resistors, capacitors, pots, op-amps, sources, diode limiters and switches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.circuit.pot import check_dial

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


@dataclass(frozen=True)
class _TwoEnded(CircuitPart):
    a: str
    b: str

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.a, self.b

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.a, self.b),)


@dataclass(frozen=True)
class Resistor(_TwoEnded):
    """ohm between nodes a and b."""

    positive = ("ohm",)

    ohm: float


@dataclass(frozen=True)
class Capacitor(_TwoEnded):
    """farad between nodes a and b; its state is v(a) - v(b)."""

    positive = ("farad",)

    farad: float

    @property
    def rigid_bonds(self) -> tuple[tuple[str, str], ...]:
        return self.bonds


@dataclass(frozen=True)
class Pot(CircuitPart):
    """A track of track_ohm from top to bottom; dial 0 puts the wiper at the bottom, 1 at the top."""

    positive = ("track_ohm",)

    top: str
    wiper: str
    bottom: str
    track_ohm: float
    dial: float

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.top, self.wiper, self.bottom

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return (self.top, self.wiper), (self.wiper, self.bottom)

    @property
    def fault(self) -> str | None:
        check_dial(self.dial, self.name)
        return None


@dataclass(frozen=True)
class OpAmp(CircuitPart):
    """An op-amp; its state, if the model has one, is the voltage behind the output resistance."""

    plus: str
    minus: str
    out: str
    model: OpAmpModel

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.plus, self.minus, self.out

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        # The inputs draw no current, so they hold no node at a voltage.
        return ((self.out, GROUND),)

    @property
    def output(self) -> str | None:
        return self.out

    @property
    def rigid_bonds(self) -> tuple[tuple[str, str], ...]:
        # Without a pole the loop gain divides the output resistance.
        ohm = self.model.rout_ohm if self.model.has_state else self.model.rout_ohm / self.model.avol
        return () if ohm > 0 else self.bonds


@dataclass(frozen=True)
class _Source(CircuitPart):
    plus: str
    minus: str = GROUND

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.plus, self.minus

    @property
    def constant(self) -> float | None:
        """Constant level in V or A; None for an input of the circuit."""
        raise NotImplementedError


@dataclass(frozen=True)
class VoltageSource(_Source):
    """v(plus) - v(minus): an input of the circuit, or, when dc_v is given, a constant."""

    finite = ("dc_v",)

    dc_v: float | None = None

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.plus, self.minus),)

    @property
    def rigid_bonds(self) -> tuple[tuple[str, str], ...]:
        return self.bonds

    @property
    def output(self) -> str | None:
        return self.minus if self.plus == GROUND else self.plus

    @property
    def constant(self) -> float | None:
        return self.dc_v


@dataclass(frozen=True)
class CurrentSource(_Source):
    """A current from node plus through the source to node minus: an input of the circuit [A], or, when dc_a is given, a
    constant. It determines no voltage."""

    finite = ("dc_a",)

    dc_a: float | None = None

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ()

    @property
    def spans(self) -> tuple[tuple[str, str], ...]:
        return ((self.plus, self.minus),)

    @property
    def constant(self) -> float | None:
        return self.dc_a


@dataclass(frozen=True)
class DiodeLimiter(_TwoEnded):
    """A diode of straight pieces from a to b.

    With v = v(a) - v(b) it passes, in A,

        v / off_ohm + (1 / on_ohm - 1 / off_ohm) max(0, v - threshold_v)

    Two of them back to back, from a to b and from b to a, limit both ways.
    """

    positive = ("on_ohm", "off_ohm")
    finite = ("threshold_v",)

    threshold_v: float
    on_ohm: float
    off_ohm: float

    @property
    def fault(self) -> str | None:
        return _fault_of_resistances(self)

    @property
    def excess_siemens(self) -> float:
        """Increase of the conductance at the threshold, in S."""
        return 1.0 / self.on_ohm - 1.0 / self.off_ohm


@dataclass(frozen=True)
class Switch(_TwoEnded):
    """on_ohm between nodes a and b when closed, off_ohm when open."""

    positive = ("on_ohm", "off_ohm")

    on_ohm: float
    off_ohm: float
    closed: bool

    @property
    def fault(self) -> str | None:
        return _fault_of_resistances(self)

    def ohm(self, *, closed: bool) -> float:
        """Resistance in the given position."""
        return self.on_ohm if closed else self.off_ohm


def _fault_of_resistances(element: DiodeLimiter | Switch) -> str | None:
    if element.on_ohm > element.off_ohm:
        return f"on_ohm {element.on_ohm!r} exceeds off_ohm {element.off_ohm!r}"
    return None
