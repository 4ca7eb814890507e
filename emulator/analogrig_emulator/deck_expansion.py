"""Cards to elements: the subcircuits of a deck expanded, their parameters evaluated, within limits."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from .circuit import GROUND, Capacitor, CurrentSource, Element, Resistor, VoltageSource
from .deck_library import DEFINITIONS, element_of
from .deck_source import Step, split_source, steps
from .deck_text import MAX_NESTING, Card, Definition, located
from .errors import CircuitError
from .expression import Scope

__all__ = ["MAX_ELEMENTS", "Expansion", "Found", "named"]

MAX_ELEMENTS = 1000
"""Elements of an expanded deck; the engine takes far fewer."""

_IGNORED = (".save", ".option", ".options", ".print", ".plot", ".title")

_UNSUPPORTED = {
    "b": "behavioural sources",
    "d": "diodes",
    "e": "controlled sources",
    "f": "controlled sources",
    "g": "controlled sources",
    "h": "controlled sources",
    "j": "transistors",
    "k": "coupled inductors",
    "l": "inductors",
    "m": "transistors",
    "q": "transistors",
    "s": "controlled switches",
    "t": "transmission lines",
    "w": "controlled switches",
}


@dataclass(frozen=True)
class _Place:
    """A subcircuit being expanded: where it is, and what its ports are connected to."""

    definition: Definition
    scope: Scope
    path: tuple[str, ...] = ()
    ports: Mapping[str, str] = field(default_factory=dict)
    outer: _Place | None = None
    """Around its definition: what its names mean."""
    caller: _Place | None = None
    """Around its instance."""

    def lookup(self, name: str) -> tuple[Definition, _Place] | None:
        """The subcircuit of that name that is seen from here, and the place that defines it."""
        place: _Place | None = self
        while place is not None:
            if name in place.definition.inner:
                return place.definition.inner[name], place
            place = place.outer
        return None


@dataclass(frozen=True)
class Found:
    """An element as expanded; its name is that of its card, after those of the subcircuits around it."""

    element: Element
    card: Card
    path: tuple[str, ...]
    steps: tuple[Step, ...] | None = None
    """Levels of an input."""
    dial_node: str | None = None
    """Of a pot that is turned."""
    initial_v: float | None = None


class Expansion:
    """All that the cards of a deck stand for.

    found: its elements, in the order of their cards, those of a subcircuit where its instance is. initial: what .ic
    says, by the name in its v(...), with its card.

    name: of the deck, for the errors; stop_s: until when sources are wanted. Raises CircuitError that names file and
    line.
    """

    def __init__(self, name: str, top: Definition, scope: Scope, stop_s: float) -> None:
        self.initial: dict[str, tuple[Card, float]] = {}
        self.found: list[Found] = []
        self._name = name
        self._stop_s = stop_s
        self._budget = scope.budget
        self._cards: set[tuple[str, ...]] = set()
        self._nodes: dict[tuple[str, ...], str] = {}
        self._owners: dict[str, tuple[str, ...]] = {}
        self._expand(_Place(top, scope))

    def node(self, target: str) -> str | None:
        """The circuit's node of a name as SPICE has it, x1.x2.node, if there is one."""
        return self._nodes.get(tuple(target.split(".")))

    def _expand(self, place: _Place) -> None:
        """Adds the elements of a subcircuit, and of those within it."""
        for card in place.definition.cards:
            with located(self._name, card):
                self._budget.spend()
                self._add(place, card)

    def _add(self, place: _Place, card: Card) -> None:
        if card.kind.startswith("."):
            self._add_command(place, card)
            return
        key = (*place.path, card.head.lower())
        if key in self._cards:
            raise CircuitError("there is a card of this name already")
        self._cards.add(key)
        words, values = card.fields()
        match card.kind:
            case "r":
                self._keep(place, card, self._resistor(place, words, values))
            case "c":
                self._add_capacitor(place, card, words, values)
            case "v" | "i":
                self._add_source(place, card, words, values)
            case "x":
                self._add_instance(place, card, words, values)
            case letter:
                raise CircuitError(f"{_UNSUPPORTED.get(letter, 'cards of this kind')} are not supported")

    def _add_command(self, place: _Place, card: Card) -> None:
        if card.kind == ".ic" and not place.path:
            words, values = card.fields()
            _nothing_more(words[1:], {})
            for target, text in values.items():
                if not re.fullmatch(r"v\([^(),]+\)", target):
                    raise CircuitError(f"expected v(node) = value, not {target}")
                self.initial[target[2:-1]] = card, place.scope.evaluate(text)
        elif card.kind not in _IGNORED and (card.kind != ".tran" or place.path):
            raise CircuitError("is not supported" + (" within a subcircuit" if place.path else ""))

    def _keep(self, place: _Place, card: Card, element: Element, **more: object) -> None:
        if len(self.found) >= MAX_ELEMENTS:
            raise CircuitError(f"the circuit has more than {MAX_ELEMENTS} elements")
        self.found.append(replace(Found(element, card, place.path), **more))  # type: ignore[arg-type]

    def _resistor(self, place: _Place, words: list[str], values: dict[str, str]) -> Resistor:
        value = _value(words, values, "r")
        _nothing_more(words[4:], values)
        a, b = self._nodes_of(place, words[1:3], 2)
        return Resistor(_joined(place.path, words[0]), a, b, place.scope.evaluate(value))

    def _add_capacitor(self, place: _Place, card: Card, words: list[str], values: dict[str, str]) -> None:
        value = _value(words, values, "c")
        initial = values.pop("ic", None)
        _nothing_more(words[4:], values)
        a, b = self._nodes_of(place, words[1:3], 2)
        capacitor = Capacitor(_joined(place.path, words[0]), a, b, place.scope.evaluate(value))
        self._keep(place, card, capacitor, initial_v=None if initial is None else place.scope.evaluate(initial))

    def _add_source(self, place: _Place, card: Card, words: list[str], values: dict[str, str]) -> None:
        _nothing_more([], values)
        plus, minus = self._nodes_of(place, words[1:3], 2)
        kind = VoltageSource if card.kind == "v" else CurrentSource
        name = _joined(place.path, words[0])
        dc, shape, points = split_source(words[3:])
        if shape is None:
            self._keep(place, card, kind(name, plus, minus, place.scope.evaluate(dc)))
            return
        numbers = [place.scope.evaluate(point) for point in points]
        self._keep(place, card, kind(name, plus, minus), steps=steps(shape, numbers, self._stop_s))

    def _add_instance(self, place: _Place, card: Card, words: list[str], values: dict[str, str]) -> None:
        words = [word for word in words if word.lower() != "params:"]
        if len(words) < 2:
            raise CircuitError("needs nodes and the name of a subcircuit")
        name = words[-1].lower()
        seen = place.lookup(name)
        if name in DEFINITIONS and (seen is None or seen[0].signature == DEFINITIONS[name].signature):
            self._add_ours(place, card, words, values)
        elif seen is None:
            raise CircuitError(f"no subcircuit is called {name!r}")
        else:
            self._add_expanded(place, words, values, *seen)

    def _add_expanded(
        self, place: _Place, words: list[str], values: dict[str, str], definition: Definition, home: _Place
    ) -> None:
        around: _Place | None = place
        while around is not None:
            if around.definition is definition:
                raise CircuitError(f"subcircuit {definition.name} contains itself")
            around = around.caller
        if len(place.path) >= MAX_NESTING:
            raise CircuitError(f"subcircuits contain each other more than {MAX_NESTING} deep")
        nodes = self._nodes_of(place, words[1:-1], len(definition.ports))
        given = self._given(place, values, definition)
        self._expand(
            _Place(
                definition,
                Scope(definition.parameters, self._budget, home.scope, given),
                (*place.path, words[0]),
                dict(zip(definition.ports, nodes, strict=True)),
                home,
                place,
            )
        )

    def _given(self, place: _Place, values: dict[str, str], definition: Definition) -> dict[str, float]:
        for name in values:
            if name not in definition.parameters:
                known = ", ".join(definition.parameters) or "none"
                raise CircuitError(f"subcircuit {definition.name} has no parameter {name}; there are {known}")
        return {name: place.scope.evaluate(text) for name, text in values.items()}

    def _add_ours(self, place: _Place, card: Card, words: list[str], values: dict[str, str]) -> None:
        ours = DEFINITIONS[words[-1].lower()]
        scope = Scope(ours.parameters, self._budget, None, self._given(place, values, ours))
        given = {name: scope.value_of(name, 0) for name in ours.parameters}
        nodes = self._nodes_of(place, words[1:-1], len(ours.ports))
        element = element_of(ours.name, _joined(place.path, words[0]), nodes, given)
        if element is not None:
            self._keep(place, card, element, dial_node=nodes[-1] if ours.name == "turned_pot" else None)

    def _nodes_of(self, place: _Place, words: Sequence[str], count: int) -> list[str]:
        if len(words) != count:
            raise CircuitError(f"needs {count} nodes, got {len(words)}")
        return [self._node(place, word) for word in words]

    def _node(self, place: _Place, word: str) -> str:
        lower = word.lower()
        if lower in {GROUND, "gnd"}:
            return GROUND
        if lower in place.ports:
            return place.ports[lower]
        key = (*(part.lower() for part in place.path), lower)
        if key not in self._nodes:
            flat = _joined(place.path, word)
            if self._owners.setdefault(flat.lower(), key) != key:
                raise CircuitError(f"node {flat} is also the node {'.'.join(self._owners[flat.lower()])}: rename one")
            self._nodes[key] = flat
        return self._nodes[key]


def _value(words: list[str], values: dict[str, str], key: str) -> str:
    """The value of a two-terminal element: its fourth word, or what is assigned to key."""
    text = words[3] if len(words) > 3 else values.pop(key, None)
    if text is None:
        raise CircuitError("needs two nodes and a value")
    return text


def _nothing_more(words: Sequence[str], values: Mapping[str, str]) -> None:
    for text in (*words, *values):
        raise CircuitError(f"{text[:40]!r} is not supported here")


def _joined(path: Sequence[str], name: str) -> str:
    return "_".join((*path, name))


def named(found: Sequence[Found]) -> list[tuple[str, Found]]:
    """The elements with their names: without the letter and _ that to_spice puts before them, where that is clear."""
    full = [item.element.name for item in found]
    short = [_joined([_bare(part) for part in item.path], _bare(item.card.head)) for item in found]
    counts = Counter(name.lower() for name in short)
    names = [brief if counts[brief.lower()] == 1 else name for brief, name in zip(short, full, strict=True)]
    return list(zip(names, found, strict=True))


def _bare(name: str) -> str:
    return name[2:] if name[1:2] == "_" and len(name) > 2 else name
