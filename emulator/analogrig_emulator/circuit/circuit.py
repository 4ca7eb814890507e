"""A circuit as a netlist: elements with names, between nodes with names. Node "0" is ground.

Elements are frozen; a Circuit is checked once, when it is made, and never changes. Names count without regard to case,
as in SPICE.
"""

from __future__ import annotations

import functools
import math
import re
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from numbers import Real
from typing import Any, Never, TypeAlias, TypeVar

from analogrig_emulator.circuit.elements import (
    GROUND,
    Capacitor,
    CurrentSource,
    DiodeLimiter,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
)
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.exceptions import CircuitError

_NAME = re.compile(r"[A-Za-z0-9_]+")


Element: TypeAlias = (
    Resistor | Capacitor | Pot | OpAmp | VoltageSource | CurrentSource | DiodeLimiter | Switch | Multiplier | Function
)
Ways: TypeAlias = Mapping[str, Sequence[str]]
"""Neighbours of each node."""

_T = TypeVar("_T")
_E = TypeVar(
    "_E",
    Resistor,
    Capacitor,
    Pot,
    OpAmp,
    VoltageSource,
    CurrentSource,
    DiodeLimiter,
    Switch,
    Multiplier,
    Function,
)

_LEAST = 1e-100
"""Least ohms and farads: no reciprocal of them, nor of an end stop's part of a track, overflows."""


_KEPT_VARIANTS = 4


@dataclass(frozen=True)
class Circuit:
    """A checked netlist.

    Raises CircuitError for duplicate or malformed names, values that are not positive numbers, an element across
    a single node, floating nodes, loops without resistance, and op-amps without feedback;
    PotError for a dial off its track. The message begins with the element and its nodes.
    """

    elements: tuple[Element, ...]
    nodes: tuple[str, ...] = field(repr=False, compare=False)
    """Every node but ground, in order of appearance."""

    def __init__(self, elements: Iterable[Element]) -> None:
        object.__setattr__(self, "elements", tuple(elements))
        object.__setattr__(self, "nodes", _check_names(self.elements))
        for element in self.elements:
            _check_element(element)
        _check_nodes(self)
        _check_loops(self.elements)
        _check_feedback(self)

    def __reduce__(self) -> tuple[type[Circuit], tuple[tuple[Element, ...]]]:
        """Pickle and copy the netlist alone, not what was computed from it."""
        return Circuit, (self.elements,)

    @functools.cached_property
    def inputs(self) -> tuple[VoltageSource | CurrentSource, ...]:
        """Sources without a constant level: inputs in V or A, in netlist order."""
        return tuple(
            element
            for element in self.elements
            if isinstance(element, VoltageSource | CurrentSource) and element.constant is None
        )

    def of(self, kind: type[_E]) -> tuple[_E, ...]:
        """The elements of one kind, in netlist order."""
        found: tuple[_E, ...] = self._of_kind.get(kind, ())
        return found

    @functools.cached_property
    def _of_kind(self) -> Mapping[type, tuple[Any, ...]]:
        found: defaultdict[type, list[Element]] = defaultdict(list)
        for element in self.elements:
            found[type(element)].append(element)
        return {kind: tuple(elements) for kind, elements in found.items()}

    @functools.cached_property
    def bonds(self) -> tuple[tuple[str, str], ...]:
        """Bonds of all elements, in netlist order."""
        return tuple([bond for element in self.elements for bond in element.bonds])

    @functools.cached_property
    def ways(self) -> Ways:
        """Nodes that bonds of elements join to each node."""
        return neighbours(self.bonds)

    def derive(self, make: Callable[[Circuit], _T]) -> _T:
        """make(self), computed once for each function `make`."""
        if make not in self._derived:
            self._derived[make] = make(self)
        derived: _T = self._derived[make]
        return derived

    @functools.cached_property
    def _derived(self) -> dict[object, Any]:
        return {}

    def with_switches(self, closed: Mapping[str, bool]) -> Circuit:
        """The same circuit with the switches named in closed thrown so.

        Raises CircuitError for a switch that is not there.
        """
        _check_known("switch", closed, self.of(Switch))
        if self.untrimmed is not self:
            return self.untrimmed.with_switches(closed).with_offsets(self._vos_v)
        return self._variant(
            ("switches", *sorted(closed.items())),
            lambda: Circuit(
                replace(element, closed=closed[element.name])
                if isinstance(element, Switch) and element.name in closed
                else element
                for element in self.elements
            ),
        )

    def with_dials(self, dials: Mapping[str, float]) -> Circuit:
        """The same circuit with the pots named in dials set anew. Raises CircuitError for a pot that is not there."""
        _check_known("pot", dials, self.of(Pot))
        if self.untrimmed is not self:
            return self.untrimmed.with_dials(dials).with_offsets(self._vos_v)
        return self._variant(
            ("dials", *sorted(dials.items())),
            lambda: Circuit(
                replace(element, dial=dials[element.name])
                if isinstance(element, Pot) and element.name in dials
                else element
                for element in self.elements
            ),
        )

    @property
    def untrimmed(self) -> Circuit:
        """The circuit that this one is but for input offsets, if with_offsets() made this one; else this one."""
        untrimmed: Circuit = self.__dict__.get("_untrimmed", self)
        return untrimmed

    @property
    def _vos_v(self) -> dict[str, float]:
        return {amp.name: amp.model.vos_v for amp in self.of(OpAmp)}

    def with_offsets(self, vos_v: Mapping[str, float]) -> Circuit:
        """The same circuit with other input offsets, in V, of the op-amps named in vos_v.

        Nothing that does not depend on offsets is checked or computed again. Raises CircuitError for an op-amp that is
        not there, and for an offset that is not finite.
        """
        _check_known("op-amp", vos_v, self.of(OpAmp))
        trimmed = object.__new__(Circuit)
        object.__setattr__(
            trimmed,
            "elements",
            tuple(
                replace(element, model=replace(element.model, vos_v=vos_v[element.name]))
                if isinstance(element, OpAmp) and element.name in vos_v
                else element
                for element in self.elements
            ),
        )
        of_kind = {**self._of_kind, OpAmp: tuple(each for each in trimmed.elements if isinstance(each, OpAmp))}
        trimmed.__dict__.update(_untrimmed=self.untrimmed, _of_kind=of_kind, nodes=self.nodes, inputs=self.inputs)
        return trimmed

    def _variant(self, settings: object, make: Callable[[], Circuit]) -> Circuit:
        """This circuit with other settings: one of the last few, or a new one."""
        if settings not in self._variants:
            variant = make()
            if len(self._variants) >= _KEPT_VARIANTS:
                del self._variants[next(iter(self._variants))]
            self._variants[settings] = variant
        return self._variants[settings]

    @functools.cached_property
    def _variants(self) -> dict[object, Circuit]:
        return {}


def label(element: Element) -> str:
    """Kind, name and nodes of an element, for error messages."""
    return f"{type(element).__name__} {element.name} ({' '.join(element.nodes)})"


def element_error(element: Element, why: str) -> CircuitError:
    """CircuitError about an element; its message begins with the element's label."""
    return CircuitError(f"{label(element)}: {why}", element=element.name)


def unknown_kind_error(element: Never) -> CircuitError:
    """CircuitError for an element of unknown kind. Its type makes mypy check that a match covers every kind."""
    return element_error(element, "no such kind of element is known")


def _check_known(kind: str, names: Iterable[str], elements: Iterable[Element]) -> None:
    known = sorted(element.name for element in elements)
    for name in names:
        if name not in known:
            raise CircuitError(f"no {kind} is called {name!r}; there are {', '.join(known) or 'none'}")


def _check_names(elements: tuple[Element, ...]) -> tuple[str, ...]:
    """Return every node but ground, in order of appearance. Raise CircuitError for a duplicate or malformed name."""
    names: set[str] = set()
    nodes: dict[str, str] = {}
    known = {GROUND}
    for element in elements:
        name = element.name
        if not _NAME.fullmatch(name):
            raise element_error(element, f"element name {name!r}: only letters, digits and _ are allowed")
        name = name.lower()
        if name in names:
            raise element_error(element, f"two elements are called {element.name!r}")
        names.add(name)
        for node in element.nodes:
            if node in known:
                continue
            known.add(node)
            if not _NAME.fullmatch(node):
                raise element_error(element, f"node name {node!r}: only letters, digits and _ are allowed")
            if nodes.setdefault(node.lower(), node) != node:
                raise element_error(element, f"nodes {nodes[node.lower()]!r} and {node!r} differ in case only")
    return tuple(nodes.values())


def _check_element(element: Element) -> None:
    if not isinstance(element, Element):
        raise unknown_kind_error(element)
    for a, b in element.spans:
        if a == b:
            raise element_error(element, f"both ends are on node {a}")
    for name in element.positive:
        value = getattr(element, name)
        if not (_is_finite(value) and value > 0):
            raise element_error(element, f"{name} must be positive and finite, got {value!r}")
        if value < _LEAST:
            raise element_error(element, f"{name} must be at least {_LEAST:g}, got {value!r}")
    for name in element.finite:
        value = getattr(element, name)
        if value is not None and not _is_finite(value):
            raise element_error(element, f"{name} must be finite, got {value!r}")
    if fault := element.fault:
        raise element_error(element, fault)


def _is_finite(value: object) -> bool:
    # Nearly all values are floats, and Real is slow to ask.
    return isinstance(value, (float, Real)) and math.isfinite(value)


def _check_nodes(circuit: Circuit) -> None:
    """Raise CircuitError for a node without a path to ground that determines its voltage."""
    grounded = reachable(GROUND, circuit.ways)
    if grounded.issuperset(circuit.nodes):
        return
    for element in circuit.elements:
        for node in element.nodes:
            if node not in grounded:
                raise element_error(element, f"node {node} floats: no path to ground holds its voltage")


def _check_loops(elements: tuple[Element, ...]) -> None:
    """Raise CircuitError for a loop of rigid bonds: nothing determines the current around it.

    Method: merge the nodes that rigid bonds join (Kruskal's forest).
    """
    joined: dict[str, str] = {}
    for count, element in enumerate(elements):
        for a, b in element.rigid_bonds:
            one, other = _root(a, joined), _root(b, joined)
            if one == other:
                others = ", ".join(_path_names(a, b, elements[:count]))
                raise element_error(
                    element, f"closes a loop without resistance from node {a} to node {b} with {others}"
                )
            joined[one] = other


def _root(node: str, joined: dict[str, str]) -> str:
    while node in joined:
        joined[node] = joined.get(joined[node], joined[node])  # path halving, for the next search
        node = joined[node]
    return node


def _path_names(a: str, b: str, elements: tuple[Element, ...]) -> list[str]:
    """Names of the rigid elements on the path from node a to node b, in order."""
    rigid = [(element.name, bond) for element in elements for bond in element.rigid_bonds]
    ways = neighbours(bond for _, bond in rigid)
    names = {frozenset(bond): name for name, bond in rigid}
    before, front = {a: a}, [a]
    while b not in before:
        node = front.pop()
        fresh = [near for near in ways[node] if near not in before]
        before |= dict.fromkeys(fresh, node)
        front += fresh
    path = [b]
    while path[-1] != a:
        path.append(before[path[-1]])
    return [names[frozenset(pair)] for pair in pairwise(reversed(path))]


def _check_feedback(circuit: Circuit) -> None:
    """Raise CircuitError for an op-amp whose output acts on neither of its inputs."""
    acts = neighbours(bond for bond in circuit.bonds if GROUND not in bond)
    for amp in circuit.of(OpAmp):
        for node in {amp.plus, amp.minus} - {GROUND}:
            acts[node].append(amp.out)
    computing: tuple[Multiplier | Function, ...] = (*circuit.of(Multiplier), *circuit.of(Function))
    for part in computing:
        for node in part.nodes[:-1]:
            acts[node].append(part.out)
    for amp in circuit.of(OpAmp):
        if not leads(amp.out, acts, {amp.plus, amp.minus}):
            raise element_error(
                amp,
                f"no feedback: its output, node {amp.out}, acts on neither of its inputs, nodes"
                f" {amp.plus} and {amp.minus}",
            )


def neighbours(bonds: Iterable[tuple[str, str]]) -> defaultdict[str, list[str]]:
    """The neighbours of each node."""
    ways: defaultdict[str, list[str]] = defaultdict(list)
    for a, b in bonds:
        ways[a].append(b)
        ways[b].append(a)
    return ways


def reachable(start: str, ways: Ways) -> set[str]:
    """Nodes to which ways lead from start."""
    reached, front = {start}, [start]
    while front:
        for node in ways.get(front.pop(), ()):
            if node not in reached:
                reached.add(node)
                front.append(node)
    return reached


def leads(start: str, ways: Ways, goals: Container[str], borders: Container[str] = ()) -> bool:
    """True if ways lead from start to one of the goals, through no border but start."""
    if start in goals:
        return True
    reached, front = {start}, [start]
    for node in front:
        for near in ways.get(node, ()):
            if near in goals:
                return True
            if near not in reached:
                reached.add(near)
                if near not in borders:
                    front.append(near)
    return False
