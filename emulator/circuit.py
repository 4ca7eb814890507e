"""A circuit as a netlist: elements with names, between nodes with names. Node "0" is ground.

Elements are frozen; a Circuit is checked once, when it is made, and never changes. Names count without regard to case,
as in SPICE.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias, TypeVar

from .errors import CircuitError
from .opamp import OpAmpModel
from .pot import checked_dial

__all__ = [
    "GROUND",
    "Capacitor",
    "Circuit",
    "CurrentSource",
    "DiodeLimiter",
    "Element",
    "OpAmp",
    "Pot",
    "Resistor",
    "Switch",
    "VoltageSource",
    "label",
]

GROUND = "0"

_NAME = re.compile(r"[A-Za-z0-9_]+")


@dataclass(frozen=True)
class Resistor:
    """ohm between nodes a and b."""

    name: str
    a: str
    b: str
    ohm: float

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.a, self.b

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.a, self.b),)


@dataclass(frozen=True)
class Capacitor:
    """farad between nodes a and b; its state is v(a) - v(b)."""

    name: str
    a: str
    b: str
    farad: float

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.a, self.b

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.a, self.b),)


@dataclass(frozen=True)
class Pot:
    """A track of track_ohm from top to bottom; dial 0 puts the wiper at the bottom, 1 at the top."""

    name: str
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


@dataclass(frozen=True)
class OpAmp:
    """An op-amp; its state, if the model has one, is the voltage behind the output resistance."""

    name: str
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


@dataclass(frozen=True)
class VoltageSource:
    """v(plus) - v(minus): an input of the circuit, or, when dc_v is given, a constant."""

    name: str
    plus: str
    minus: str = GROUND
    dc_v: float | None = None

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.plus, self.minus

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.plus, self.minus),)


@dataclass(frozen=True)
class CurrentSource:
    """A current from node plus through the source to node minus: an input of the circuit [A], or, when dc_a is given, a
    constant. It holds no node at a voltage."""

    name: str
    plus: str
    minus: str = GROUND
    dc_a: float | None = None

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.plus, self.minus

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ()


@dataclass(frozen=True)
class DiodeLimiter:
    """A diode of straight pieces from a to b.

    With v = v(a) - v(b) it passes, in A,

        v / off_ohm + (1 / on_ohm - 1 / off_ohm) max(0, v - threshold_v)

    Two of them back to back, from a to b and from b to a, limit both ways.
    """

    name: str
    a: str
    b: str
    threshold_v: float
    on_ohm: float
    off_ohm: float

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.a, self.b

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.a, self.b),)

    @property
    def excess_siemens(self) -> float:
        """By how much its conductance grows at the threshold."""
        return 1.0 / self.on_ohm - 1.0 / self.off_ohm


@dataclass(frozen=True)
class Switch:
    """on_ohm between nodes a and b when closed, off_ohm when open."""

    name: str
    a: str
    b: str
    on_ohm: float
    off_ohm: float
    closed: bool

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.a, self.b

    @property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        return ((self.a, self.b),)

    def ohm(self, *, closed: bool) -> float:
        """Its resistance in that position."""
        return self.on_ohm if closed else self.off_ohm


Element: TypeAlias = Resistor | Capacitor | Pot | OpAmp | VoltageSource | CurrentSource | DiodeLimiter | Switch
_E = TypeVar("_E", Resistor, Capacitor, Pot, OpAmp, VoltageSource, CurrentSource, DiodeLimiter, Switch)

_LEAST = 1e-100
"""Of ohms and farads, so that no reciprocal of theirs, nor of an end stop's part of a track, overflows."""

_POSITIVE: Mapping[type, tuple[str, ...]] = {
    Resistor: ("ohm",),
    Capacitor: ("farad",),
    Pot: ("track_ohm",),
    DiodeLimiter: ("on_ohm", "off_ohm"),
    Switch: ("on_ohm", "off_ohm"),
}


_FINITE: Mapping[type, tuple[str, ...]] = {
    VoltageSource: ("dc_v",),
    CurrentSource: ("dc_a",),
    DiodeLimiter: ("threshold_v",),
}


@dataclass(frozen=True)
class Circuit:
    """A checked netlist.

    Raises CircuitError for duplicate or malformed names, values that are not positive, an element across a single node,
    nodes that nothing holds at a voltage, and op-amps without feedback; PotError for a dial off its track.
    """

    elements: tuple[Element, ...]

    def __init__(self, elements: Iterable[Element]) -> None:
        object.__setattr__(self, "elements", tuple(elements))
        _check_names(self.elements)
        for element in self.elements:
            _check_element(element)
        _check_nodes(self.elements)
        _check_feedback(self.elements)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Every node but ground, in order of appearance."""
        seen = dict.fromkeys(node for element in self.elements for node in element.nodes)
        return tuple(node for node in seen if node != GROUND)

    @property
    def inputs(self) -> tuple[VoltageSource | CurrentSource, ...]:
        """The sources that are no constants: volts or amperes from outside, in netlist order."""
        sources = (element for element in self.elements if isinstance(element, VoltageSource | CurrentSource))
        return tuple(source for source in sources if constant_of(source) is None)

    def of(self, kind: type[_E]) -> tuple[_E, ...]:
        """The elements of one kind, in netlist order."""
        return tuple(element for element in self.elements if isinstance(element, kind))

    def with_switches(self, closed: Mapping[str, bool]) -> Circuit:
        """The same circuit with the switches named in closed thrown so.

        Raises CircuitError for a switch that is not there.
        """
        known = {switch.name for switch in self.of(Switch)}
        for name in closed:
            if name not in known:
                raise CircuitError(f"no switch is called {name!r}; there are {', '.join(sorted(known)) or 'none'}")
        return Circuit(
            replace(element, closed=closed[element.name])
            if isinstance(element, Switch) and element.name in closed
            else element
            for element in self.elements
        )

    def with_dials(self, dials: Mapping[str, float]) -> Circuit:
        """The same circuit with the pots named in dials set anew. Raises CircuitError for a pot that is not there."""
        known = {pot.name for pot in self.of(Pot)}
        for name in dials:
            if name not in known:
                raise CircuitError(f"no pot is called {name!r}; there are {', '.join(sorted(known)) or 'none'}")
        return Circuit(
            replace(element, dial=dials[element.name])
            if isinstance(element, Pot) and element.name in dials
            else element
            for element in self.elements
        )


def _check_names(elements: tuple[Element, ...]) -> None:
    names: set[str] = set()
    nodes: dict[str, str] = {}
    for element in elements:
        if not _NAME.fullmatch(element.name):
            raise CircuitError(f"element name {element.name!r}: only letters, digits and _ are allowed")
        if element.name.lower() in names:
            raise CircuitError(f"two elements are called {element.name!r}")
        names.add(element.name.lower())
        for node in element.nodes:
            if nodes.get(node.lower()) == node:
                continue
            if not _NAME.fullmatch(node):
                raise CircuitError(f"{label(element)}: node name {node!r}: only letters, digits and _ are allowed")
            if nodes.setdefault(node.lower(), node) != node:
                raise CircuitError(f"{label(element)}: nodes {nodes[node.lower()]!r} and {node!r} differ in case only")


def _check_element(element: Element) -> None:
    for a, b in (element.nodes,) if isinstance(element, CurrentSource) else element.bonds:
        if a == b:
            raise CircuitError(f"{label(element)}: both ends are on node {a}")
    _check_values(element)
    if isinstance(element, Pot):
        checked_dial(element.dial, element.name)
    if isinstance(element, DiodeLimiter | Switch) and element.on_ohm > element.off_ohm:
        raise CircuitError(f"{label(element)}: on_ohm {element.on_ohm!r} exceeds off_ohm {element.off_ohm!r}")


def _check_values(element: Element) -> None:
    for field in _POSITIVE.get(type(element), ()):
        value = getattr(element, field)
        if not (math.isfinite(value) and value > 0):
            raise CircuitError(f"{label(element)}: {field} must be positive and finite, got {value!r}")
        if value < _LEAST:
            raise CircuitError(f"{label(element)}: {field} must be at least {_LEAST:g}, got {value!r}")
    for field in _FINITE.get(type(element), ()):
        value = getattr(element, field)
        if value is not None and not math.isfinite(value):
            raise CircuitError(f"{label(element)}: {field} must be finite, got {value!r}")


def _check_nodes(elements: tuple[Element, ...]) -> None:
    """Every node must have a path to ground that can hold its voltage (found by growing the set of grounded nodes)."""
    neighbours: dict[str, list[str]] = {}
    for element in elements:
        for a, b in element.bonds:
            neighbours.setdefault(a, []).append(b)
            neighbours.setdefault(b, []).append(a)
    grounded, front = {GROUND}, [GROUND]
    while front:
        reached = [node for node in neighbours.get(front.pop(), ()) if node not in grounded]
        grounded.update(reached)
        front += reached
    for element in elements:
        for node in element.nodes:
            if node not in grounded:
                raise CircuitError(f"{label(element)}: node {node} floats: no path to ground holds its voltage")


def _check_feedback(elements: tuple[Element, ...]) -> None:
    """Every op-amp's output must act on one of its own inputs, through whatever elements."""
    acts: dict[str, list[str]] = {}
    for element in elements:
        if isinstance(element, OpAmp):
            pairs = [(element.plus, element.out), (element.minus, element.out)]
        else:
            pairs = [pair for a, b in element.bonds for pair in ((a, b), (b, a))]
        for cause, effect in pairs:
            if GROUND not in {cause, effect}:
                acts.setdefault(cause, []).append(effect)
    for amp in elements:
        if isinstance(amp, OpAmp) and not {amp.plus, amp.minus} & _reached(amp.out, acts):
            raise CircuitError(
                f"{label(amp)}: no feedback: its output, node {amp.out}, acts on neither of its inputs, nodes"
                f" {amp.plus} and {amp.minus}"
            )


def _reached(start: str, acts: Mapping[str, Sequence[str]]) -> set[str]:
    reached, front = {start}, [start]
    while front:
        for effect in acts.get(front.pop(), ()):
            if effect not in reached:
                reached.add(effect)
                front.append(effect)
    return reached


def constant_of(source: VoltageSource | CurrentSource) -> float | None:
    """The level of a source that is a constant [V or A]; None for an input."""
    return source.dc_v if isinstance(source, VoltageSource) else source.dc_a


def label(element: Element) -> str:
    """How errors name an element: kind, name and nodes."""
    return f"{type(element).__name__} {element.name} ({' '.join(element.nodes)})"
