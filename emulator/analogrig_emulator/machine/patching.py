"""Checks of a patch panel, and the cords into each amplifier.

A Circuit may be any netlist, including a comparator. On an analogue computer every amplifier has feedback on a summing
junction, and every cord leads from an output to an input; this module rejects all else.
"""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from analogrig_emulator.circuit.circuit import (
    Capacitor,
    Circuit,
    CurrentSource,
    Element,
    OpAmp,
    Pot,
    VoltageSource,
    Ways,
    label,
    neighbours,
    reachable,
)
from analogrig_emulator.circuit.components import is_part_of
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.circuit.part import GROUND
from analogrig_emulator.errors import CircuitError


@dataclass(frozen=True)
class Patch:
    """Connections of one amplifier.

    junction: node of its inverting input; out: node of its output; inputs: names of the elements that feed the
    junction, empty for a follower; capacitors: names of those from junction to out. Other elements at the junction,
    such as a leakage or those of is_part_of, belong to the amplifier.
    """

    amplifier: str
    junction: str
    out: str
    inputs: tuple[str, ...]
    capacitors: tuple[str, ...]


def patches(circuit: Circuit) -> dict[str, Patch]:
    """Patch of each amplifier of the circuit, by name.

    Raises CircuitError, naming the element and the node, for two outputs joined, a wiper or an end of an element left
    open, an amplifier without feedback of its own (a loop through other amplifiers does not count), and an input or an
    amplifier that nothing feeds. (Circuit already rejects an open amplifier input: its node floats.)
    """
    return dict(circuit.untrimmed.derive(_patches_by_wiring))


def _patches_by_wiring(circuit: Circuit) -> dict[str, Patch]:
    wires = tuple((type(element), element.name, element.nodes) for element in circuit.elements)
    return _patches(_Wiring(wires, circuit))


@dataclass(frozen=True)
class _Wiring:
    """Circuit compared by its wiring alone, as a cache key."""

    wires: tuple[tuple[type, str, tuple[str, ...]], ...]
    circuit: Circuit = field(compare=False)


@functools.lru_cache(maxsize=64)
def _patches(panel: _Wiring) -> dict[str, Patch]:
    circuit = panel.circuit
    drivers = _drivers(circuit)
    passive = neighbours(bond for element in circuit.elements for bond in _passive_bonds(element))
    _check_ends(circuit)
    _check_feeds(circuit, drivers, passive)
    for amp in circuit.of(OpAmp):
        _check_feedback(circuit, amp, reachable(amp.minus, passive, drivers | {GROUND}))
    found = {amp.name: _patch(circuit, amp) for amp in circuit.of(OpAmp)}
    for amp in circuit.of(OpAmp):
        if amp.plus == GROUND and not found[amp.name].inputs:
            raise CircuitError(f"{label(amp)}: nothing feeds its input at node {amp.minus}")
    return found


def _drivers(circuit: Circuit) -> set[str]:
    """Nodes driven by an output."""
    holder: dict[str, Element] = {}
    for element in circuit.elements:
        node = _output(element)
        if node is not None and holder.setdefault(node, element) is not element:
            raise CircuitError(
                f"{label(element)}: its output at node {node} is joined to that of {label(holder[node])}"
            )
    return set(holder)


def _output(element: Element) -> str | None:
    if isinstance(element, OpAmp | Multiplier | Function):
        return element.out
    if isinstance(element, VoltageSource):
        return element.minus if element.plus == GROUND else element.plus
    return None


def _check_ends(circuit: Circuit) -> None:
    """Raise CircuitError for a node with one end, unless that is an output."""
    ends = Counter(itertools.chain.from_iterable(element.nodes for element in circuit.elements))
    for element in circuit.elements:
        for node in element.nodes:
            if ends[node] == 1 and node not in (GROUND, _output(element)):
                raise CircuitError(f"{label(element)}: {_open_end(element, node)}")


def _open_end(element: Element, node: str) -> str:
    if isinstance(element, Pot) and node == element.wiper:
        return f"its wiper, node {node}, is left open"
    if isinstance(element, Pot) and node == element.bottom:
        return f"its bottom, node {node}, is left open"
    return f"nothing feeds its node {node}"


def _check_feeds(circuit: Circuit, drivers: set[str], passive: Ways) -> None:
    """Raise CircuitError for passive elements that neither reach an output nor ground an input."""
    drivers = drivers | {node for source in circuit.of(CurrentSource) for node in source.nodes}
    rests = {amp.plus for amp in circuit.of(OpAmp)}
    held = drivers | {amp.minus for amp in circuit.of(OpAmp)} | {GROUND}
    fed = set(held)
    for element in circuit.elements:
        for node in element.nodes:
            if node in fed:
                continue
            fed.add(node)
            reached = reachable(node, passive, held)
            if not reached & drivers and not (GROUND in reached and reached & rests):
                raise CircuitError(f"{label(element)}: nothing feeds its node {node}")


def _check_feedback(circuit: Circuit, amp: OpAmp, reached: set[str]) -> None:
    """Raise CircuitError if what the junction reaches is no feedback."""
    computing: tuple[Multiplier | Function, ...] = (*circuit.of(Multiplier), *circuit.of(Function))
    fed_back = {amp.out} | {part.out for part in computing if amp.out in part.nodes[:-1]}
    if amp.minus != amp.out and not fed_back & reached:
        raise CircuitError(f"{label(amp)}: no feedback leads from its output, node {amp.out}, to node {amp.minus}")


def _patch(circuit: Circuit, amp: OpAmp) -> Patch:
    capacitors = tuple(part.name for part in circuit.of(Capacitor) if {part.a, part.b} == {amp.minus, amp.out})
    inputs = () if amp.minus == amp.out else tuple(part.name for part in _inputs(circuit, amp))
    return Patch(amp.name, amp.minus, amp.out, inputs, capacitors)


def _inputs(circuit: Circuit, amp: OpAmp) -> Iterator[Element]:
    """Elements at the junction that also connect to something other than the amplifier's own output."""
    own = {amp.minus, amp.out}
    elsewhere = reachable(GROUND, circuit.ways, own) - own - {GROUND}
    for element in circuit.elements:
        if amp.minus not in element.nodes or isinstance(
            element, OpAmp | VoltageSource | Capacitor | Multiplier | Function
        ):
            continue
        if not is_part_of(element, amp.name) and elsewhere.intersection(element.nodes):
            yield element


def _passive_bonds(element: Element) -> tuple[tuple[str, str], ...]:
    return () if isinstance(element, OpAmp | VoltageSource | Multiplier | Function) else element.bonds
