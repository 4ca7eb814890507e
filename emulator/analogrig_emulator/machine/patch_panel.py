"""Checks of a patch panel, and the cords into each amplifier.

A Circuit may be any netlist, including a comparator. On an analogue computer every amplifier has feedback on a summing
junction, and every cord leads from an output to an input; this module rejects all else.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from analogrig_emulator.circuit.circuit import Circuit, Element, Ways, label, leads, neighbours
from analogrig_emulator.circuit.components import is_part_of
from analogrig_emulator.circuit.elements import GROUND, Capacitor, CurrentSource, OpAmp, Pot
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.exceptions import CircuitError


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
    wires = tuple([(type(element), element.name, element.nodes) for element in circuit.elements])
    return _patches(_Wiring(wires, circuit))


@dataclass(frozen=True)
class _Wiring:
    """Circuit compared by its wiring alone, as a cache key."""

    wires: tuple[tuple[type, str, tuple[str, ...]], ...]
    circuit: Circuit = field(compare=False)


@functools.lru_cache(maxsize=64)
def _patches(panel: _Wiring) -> dict[str, Patch]:
    circuit = panel.circuit
    amps, ends = circuit.of(OpAmp), [nodes for _, _, nodes in panel.wires]
    drivers = _drivers(circuit)
    passive = neighbours(bond for element in circuit.elements if element.output is None for bond in element.bonds)
    _check_ends(circuit, ends, drivers)
    _check_feeds(circuit, ends, drivers, passive)
    _check_feedback(circuit, passive, drivers | {GROUND})
    parts: dict[str, list[Element]] = {amp.minus: [] for amp in amps}
    for element, nodes in zip(circuit.elements, ends, strict=True):
        for node in parts.keys() & nodes:
            parts[node].append(element)
    found = {amp.name: _patch(circuit, amp, parts[amp.minus]) for amp in amps}
    for amp in amps:
        if amp.plus == GROUND and not found[amp.name].inputs:
            raise CircuitError(f"{label(amp)}: nothing feeds its input at node {amp.minus}")
    return found


def _drivers(circuit: Circuit) -> set[str]:
    """Nodes driven by an output."""
    holder: dict[str, Element] = {}
    for element in circuit.elements:
        node = element.output
        if node is not None and holder.setdefault(node, element) is not element:
            raise CircuitError(
                f"{label(element)}: its output at node {node} is joined to that of {label(holder[node])}"
            )
    return set(holder)


def _check_ends(circuit: Circuit, ends: Sequence[tuple[str, ...]], drivers: set[str]) -> None:
    """Raise CircuitError for a node with one end, unless that is an output."""
    once, again = {GROUND, *drivers}, {GROUND, *drivers}
    for nodes in ends:
        for node in nodes:
            (again if node in once else once).add(node)
    is_open = once - again
    for element in circuit.elements if is_open else ():
        for node in element.nodes:
            if node in is_open:
                raise CircuitError(f"{label(element)}: {_open_end(element, node)}")


def _open_end(element: Element, node: str) -> str:
    if isinstance(element, Pot) and node == element.wiper:
        return f"its wiper, node {node}, is left open"
    if isinstance(element, Pot) and node == element.bottom:
        return f"its bottom, node {node}, is left open"
    return f"nothing feeds its node {node}"


def _check_feeds(circuit: Circuit, ends: Sequence[tuple[str, ...]], drivers: set[str], passive: Ways) -> None:
    """Raise CircuitError for passive elements that neither reach an output nor ground an input."""
    drivers = drivers.union(*(source.nodes for source in circuit.of(CurrentSource)))
    rests = {amp.plus for amp in circuit.of(OpAmp)}
    held = drivers | {amp.minus for amp in circuit.of(OpAmp)} | {GROUND}
    fed = set(held)
    for element, nodes in zip(circuit.elements, ends, strict=True):
        for node in nodes:
            if node in fed:
                continue
            fed.add(node)
            if not leads(node, passive, drivers, held) and not all(
                leads(node, passive, goals, held) for goals in ({GROUND}, rests)
            ):
                raise CircuitError(f"{label(element)}: nothing feeds its node {node}")


def _check_feedback(circuit: Circuit, passive: Ways, borders: set[str]) -> None:
    """Raise CircuitError for an amplifier without feedback of its own."""
    computing: tuple[Multiplier | Function, ...] = (*circuit.of(Multiplier), *circuit.of(Function))
    for amp in circuit.of(OpAmp):
        fed_back = {amp.out, *(part.out for part in computing if amp.out in part.nodes[:-1])}
        if amp.minus != amp.out and not leads(amp.minus, passive, fed_back, borders):
            raise CircuitError(f"{label(amp)}: no feedback leads from its output, node {amp.out}, to node {amp.minus}")


def _patch(circuit: Circuit, amp: OpAmp, parts: Iterable[Element]) -> Patch:
    """Patch of an amplifier with these parts at its junction."""
    capacitors = tuple(part.name for part in circuit.of(Capacitor) if {part.a, part.b} == {amp.minus, amp.out})
    inputs = () if amp.minus == amp.out else tuple(part.name for part in parts if _is_input(circuit, amp, part))
    return Patch(amp.name, amp.minus, amp.out, inputs, capacitors)


def _is_input(circuit: Circuit, amp: OpAmp, part: Element) -> bool:
    """True if a part at the junction also connects to something other than the amplifier's own output."""
    if part.output is not None or isinstance(part, Capacitor) or is_part_of(part, amp.name):
        return False
    own = {amp.minus, amp.out}
    return any(leads(node, circuit.ways, {GROUND}, own) for node in part.nodes if node not in own and node != GROUND)
