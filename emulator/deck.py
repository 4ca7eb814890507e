"""SPICE decks read into circuits: the subset that analogue computers need, and that spice.py writes.

    R, C (IC=)           resistors, capacitors
    V                    DC: a constant; PULSE, PWL: an input whose level steps
    X                    subcircuits of the deck, nested, with parameters; and those of spice.LIBRARY: op-amps,
                         pots, diode limiters, switches
    .param               numbers, names, + - * / and parentheses (expression.py)
    .ic, .tran ... uic   initial conditions; sample period and length of the run
    .subckt .ends .end   and .save, .options, .print, .plot, .title, which change nothing here

Everything else is refused by name. Nothing in a deck is executed, and no file is included. A name that is known twice
means what it means to ngspice: case does not count, gnd is 0, the first line is the title.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .circuit import (
    GROUND,
    Capacitor,
    Circuit,
    CurrentSource,
    DiodeLimiter,
    Element,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
)
from .deck_text import MAX_NESTING, Card, Definition, located, parse
from .engine import Engine
from .errors import CircuitError, EmulatorError
from .excitation import TICKS_PER_SAMPLE, Edges
from .expression import Budget, Scope
from .nodal import Nodal
from .opamp import OpAmpModel
from .pot import checked_dial
from .spice import LIBRARY, LIMITLESS, Accuracy, to_spice

__all__ = ["MAX_ELEMENTS", "Deck", "read_deck"]

MAX_ELEMENTS = 1000
"""Elements of an expanded deck; the engine takes far fewer."""

MAX_WORK = 50_000
"""Cards and parameters looked at while a deck is expanded."""

MAX_SAMPLES = 10_000_000
MAX_EDGES = 1_000_000

LONGEST_STEP_S = 1e-9
"""Rise time up to which a source counts as stepping."""

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

Step = tuple[float, float]
"""(instant in s, level from then on)."""


@dataclass(frozen=True, eq=False)
class Deck:
    """A circuit and what is played on it; the arguments of to_spice, which say more about them.

    samples: 0 when the deck has no .tran.
    """

    circuit: Circuit
    samples: int = 0
    sample_rate_hz: float = 20e3
    edges: Mapping[str, Edges] = field(default_factory=dict)
    turns: Sequence[tuple[int, Mapping[str, float]]] = ()
    initial_v: Mapping[str, float] = field(default_factory=dict)
    title: str = ""

    @classmethod
    def load(cls, path: Path) -> Deck:
        """The deck in a file. Raises what read_deck raises, and CircuitError for a file that cannot be read."""
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as cause:
            raise CircuitError(f"{path}: {cause.strerror or cause}") from cause
        return read_deck(text, str(path))

    def text(self, nodes: Sequence[str] | None = None, accuracy: Accuracy | None = None) -> str:
        """The same as a deck for ngspice; nodes, accuracy: as for to_spice."""
        return to_spice(
            self.circuit,
            samples=self.samples,
            sample_rate_hz=self.sample_rate_hz,
            edges=self.edges,
            turns=self.turns,
            initial_v=self.initial_v,
            nodes=nodes,
            accuracy=accuracy,
            title=self.title,
        )

    def volts(self, nodes: Sequence[str] | None = None) -> NDArray[np.float64]:
        """What the engine makes of it: (samples, nodes) in V, every node of the circuit when none are named.

        Raises CircuitError, PotError, EngineError.
        """
        nodal = Nodal(self.circuit)
        dials: dict[str, float] = {}
        system = nodal.at(dials)
        engine = Engine(system, self.circuit.nodes if nodes is None else nodes, self.sample_rate_hz)
        engine.state = np.array([self.initial_v.get(state, 0.0) for state in system.states])
        blocks = []
        for sample, turned in [*sorted(self.turns, key=lambda turn: turn[0]), (self.samples - 1, {})]:
            blocks.append(self._run(engine, sample + 1 - engine.recorded))
            dials |= turned
            engine.set_system(nodal.at(dials))
        return np.concatenate(blocks)

    def _run(self, engine: Engine, samples: int) -> NDArray[np.float64]:
        start, stop = engine.window(samples)
        edges = {}
        for name, train in self.edges.items():
            first, last = np.searchsorted(train.ticks, (start, stop))
            edges[name] = Edges(train.ticks[first:last], train.levels_v[first:last])
        return engine.run(samples, edges)


def read_deck(text: str, name: str = "deck") -> Deck:
    """The deck of a text; name: of its file, for the errors.

    Raises CircuitError (PotError for a dial off its track) that names file, line, element and node: for a card or a
    value that is not understood, floating nodes, an op-amp without feedback, a singular circuit, subcircuits that
    contain themselves, and whatever exceeds the limits of this module or of the engine.
    """
    title, top = parse(text, name)
    reading = _Reading(name, top)
    reading.read_run()
    reading.expand(_Place(top, reading.scope(top.parameters)))
    return reading.finished(title)


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
class _Found:
    """An element as expanded; its name is that of its card, after those of the subcircuits around it."""

    element: Element
    card: Card
    path: tuple[str, ...]
    steps: tuple[Step, ...] | None = None
    """Levels of an input."""
    dial_node: str | None = None
    """Of a pot that is turned."""
    initial_v: float | None = None


class _Reading:
    """One deck on its way to a circuit."""

    def __init__(self, name: str, top: Definition) -> None:
        self._name = name
        self._top = top
        self._budget = Budget(MAX_WORK)
        self._found: list[_Found] = []
        self._cards: set[tuple[str, ...]] = set()
        self._nodes: dict[tuple[str, ...], str] = {}
        self._owners: dict[str, tuple[str, ...]] = {}
        self._initial: dict[str, tuple[Card, float]] = {}
        self._samples = 0
        self._period_s = 1.0 / 20e3

    def scope(
        self, texts: Mapping[str, str], outer: Scope | None = None, given: Mapping[str, float] | None = None
    ) -> Scope:
        return Scope(texts, self._budget, outer, given or {})

    @property
    def _stop_s(self) -> float:
        return (self._samples - 1) * self._period_s

    # ---- the run

    def read_run(self) -> None:
        """.tran, which the sources need to be known."""
        scope = self.scope(self._top.parameters)
        runs = [card for card in self._top.cards if card.kind == ".tran"]
        for card in runs:
            with located(self._name, card):
                if card is not runs[0]:
                    raise CircuitError("there is a .tran already")
                self._read_tran(card.fields()[0][1:], scope)

    def _read_tran(self, words: list[str], scope: Scope) -> None:
        if "uic" not in (word.lower() for word in words):
            raise CircuitError("needs uic: the machine starts from its initial conditions, not from a DC solution")
        times_s = [scope.evaluate(word) for word in words if word.lower() != "uic"]
        if not 2 <= len(times_s) <= 4 or (len(times_s) > 2 and times_s[2]):
            raise CircuitError("expected: sample period, end, 0, longest step, uic")
        if not times_s[0] > 0 or not times_s[1] >= 0:
            raise CircuitError("the sample period must be positive, and the end not negative")
        if times_s[1] / times_s[0] > MAX_SAMPLES:
            raise CircuitError(f"has more than {MAX_SAMPLES} samples")
        self._period_s = times_s[0]
        self._samples = round(times_s[1] / times_s[0]) + 1

    # ---- expanding

    def expand(self, place: _Place) -> None:
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
                self._initial[target[2:-1]] = card, place.scope.evaluate(text)
        elif card.kind not in _IGNORED and (card.kind != ".tran" or place.path):
            raise CircuitError("is not supported" + (" within a subcircuit" if place.path else ""))

    def _keep(self, place: _Place, card: Card, element: Element, **more: object) -> None:
        if len(self._found) >= MAX_ELEMENTS:
            raise CircuitError(f"the circuit has more than {MAX_ELEMENTS} elements")
        self._found.append(replace(_Found(element, card, place.path), **more))  # type: ignore[arg-type]

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
        dc, shape, points = _split_source(words[3:])
        if shape is None:
            self._keep(place, card, kind(name, plus, minus, place.scope.evaluate(dc)))
            return
        numbers = [place.scope.evaluate(point) for point in points]
        steps = _pwl(numbers) if shape == "pwl" else _pulse(numbers, self._stop_s)
        self._keep(place, card, kind(name, plus, minus), steps=tuple(steps))

    def _add_instance(self, place: _Place, card: Card, words: list[str], values: dict[str, str]) -> None:
        words = [word for word in words if word.lower() != "params:"]
        if len(words) < 2:
            raise CircuitError("needs nodes and the name of a subcircuit")
        name = words[-1].lower()
        seen = place.lookup(name)
        if name in LIBRARY and (seen is None or seen[0].signature == _OURS[name].signature):
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
        self.expand(
            _Place(
                definition,
                self.scope(definition.parameters, home.scope, given),
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

    # ---- the library

    def _add_ours(self, place: _Place, card: Card, words: list[str], values: dict[str, str]) -> None:
        ours = _OURS[words[-1].lower()]
        scope = self.scope(ours.parameters, None, self._given(place, values, ours))
        given = {name: scope.value_of(name, 0) for name in ours.parameters}
        nodes = self._nodes_of(place, words[1:-1], len(ours.ports))
        name = _joined(place.path, words[0])
        match ours.name:
            case "opamp" | "opamp_without_pole":
                plus, minus, out = nodes
                self._keep(place, card, OpAmp(name, plus, minus, out, _model(given)))
            case "pot":
                top, wiper, bottom = nodes
                self._keep(place, card, Pot(name, top, wiper, bottom, given["track"], given["dial"]))
            case "turned_pot":
                top, wiper, bottom, dial = nodes
                self._keep(place, card, Pot(name, top, wiper, bottom, given["track"], 0.0), dial_node=dial)
            case "diode_limiter":
                a, b = nodes
                limiter = DiodeLimiter(name, a, b, given["threshold"], given["on"], given["off"])
                self._keep(place, card, limiter)
            case "switch":
                a, b = nodes
                if given["closed"] not in {0.0, 1.0}:
                    raise CircuitError(f"closed must be 0 or 1, got {given['closed']:g}")
                self._keep(place, card, Switch(name, a, b, given["on"], given["off"], closed=given["closed"] == 1.0))
            case "time_points":
                pass

    # ---- nodes

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

    # ---- the circuit

    def finished(self, title: str) -> Deck:
        """The deck, checked."""
        dials, found = self._dials_apart()
        names = _names(found)
        turns: dict[int, dict[str, float]] = {}
        elements: list[Element] = []
        for item, name in zip(found, names, strict=True):
            element = replace(item.element, name=name)
            if item.dial_node is not None and isinstance(element, Pot):
                with located(self._name, item.card):
                    element = self._set_up(element, item, dials, turns)
            elements.append(element)
        circuit = self._checked(elements, {name: item.card for item, name in zip(found, names, strict=True)})
        return Deck(
            circuit,
            samples=self._samples,
            sample_rate_hz=_rate_hz(self._period_s),
            edges={name: self._edges(item) for item, name in zip(found, names, strict=True) if item.steps is not None},
            turns=sorted(turns.items()),
            initial_v=self._initial_v(found, names),
            title=title,
        )

    def _dials_apart(self) -> tuple[dict[str, _Found], list[_Found]]:
        """The sources that turn pots, by node, and everything else."""
        wanted = {item.dial_node for item in self._found} - {None}
        dials, others = {}, []
        for item in self._found:
            source = item.element
            if isinstance(source, VoltageSource) and source.plus in wanted and source.minus == GROUND:
                dials[source.plus] = item
            else:
                others.append(item)
        return dials, others

    def _set_up(self, pot: Pot, item: _Found, dials: Mapping[str, _Found], turns: dict[int, dict[str, float]]) -> Pot:
        """The pot at its first dial; its later ones go to turns."""
        source = dials.get(item.dial_node or "")
        if source is None or source.steps is None:
            raise CircuitError(f"node {item.dial_node}, its dial, needs a PULSE or PWL source to ground")
        (_, first), *later = source.steps
        for instant_s, dial in later:
            sample = round(instant_s / self._period_s)
            if abs(instant_s - sample * self._period_s) > LONGEST_STEP_S:
                raise CircuitError(f"is turned at {instant_s:g} s, which is not an instant of a sample")
            if sample < self._samples:
                turns.setdefault(sample, {})[pot.name] = checked_dial(dial, pot.name)
        return replace(pot, dial=first)

    def _edges(self, item: _Found) -> Edges:
        instants_s, levels_v = np.array(item.steps).T
        ticks = np.rint(instants_s * (TICKS_PER_SAMPLE / self._period_s)).astype(np.int64)
        lasting = np.append(ticks[1:] > ticks[:-1], True)
        kept = lasting & (ticks <= max(self._samples - 1, 0) * TICKS_PER_SAMPLE)
        return Edges(ticks[kept], np.ascontiguousarray(levels_v[kept]))

    def _initial_v(self, found: Sequence[_Found], names: Sequence[str]) -> dict[str, float]:
        """Volts by state: a capacitor's IC, else the difference of what .ic says of its nodes; an op-amp's own node."""
        of_node: dict[str, float] = {}
        of_amp: dict[str, float] = {}
        amps = {_state_node(item): name for item, name in zip(found, names, strict=True) if _has_state(item.element)}
        for target, (card, volts) in self._initial.items():
            key = tuple(target.split("."))
            if target in amps:
                of_amp[amps[target]] = volts
            elif key in self._nodes:
                of_node[self._nodes[key]] = volts
            else:
                with located(self._name, card):
                    raise CircuitError(f"no node is called {target!r}")
        return of_amp | {
            name: volts
            for item, name in zip(found, names, strict=True)
            if isinstance(item.element, Capacitor) and (volts := _initial_of(item, item.element, of_node))
        }

    def _checked(self, elements: Sequence[Element], cards: Mapping[str, Card]) -> Circuit:
        try:
            circuit = Circuit(elements)
            Nodal(circuit).at({})
        except EmulatorError as error:
            line = f":{cards[error.element].line}" if error.element in cards else ""
            raise type(error)(f"{self._name}{line}: {error}") from error
        return circuit


def _library() -> dict[str, Definition]:
    _, top = parse("title\n" + "\n".join(LIBRARY.values()), "library")
    return top.inner


_OURS: Mapping[str, Definition] = _library()


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


def _names(found: Sequence[_Found]) -> list[str]:
    """The names of the elements: without the letter and _ that to_spice puts before them, where that is clear."""
    full = [item.element.name for item in found]
    short = [_joined([_bare(part) for part in item.path], _bare(item.card.head)) for item in found]
    counts = Counter(name.lower() for name in short)
    return [brief if counts[brief.lower()] == 1 else name for brief, name in zip(short, full, strict=True)]


def _bare(name: str) -> str:
    return name[2:] if name[1:2] == "_" and len(name) > 2 else name


def _split_source(words: Sequence[str]) -> tuple[str, str | None, Sequence[str]]:
    """The constant level, the shape and the shape's numbers."""
    dc = "0"
    while words:
        word = words[0].lower()
        if word in {"pulse", "pwl"}:
            return dc, word, words[1:]
        if word == "dc":
            words = words[1:]
        elif word.isalpha():
            raise CircuitError(f"{word.upper()} sources are not supported; there are DC, PULSE and PWL")
        dc, words = (words[0] if words else "0"), words[1:]
    return dc, None, ()


def _pwl(numbers: Sequence[float]) -> Iterator[Step]:
    """Raises CircuitError where the level ramps instead of stepping."""
    points = list(zip(numbers[::2], numbers[1::2], strict=False))
    if not points or len(numbers) % 2 or points[0][0] < 0:
        raise CircuitError("PWL needs pairs of an instant, from 0 s on, and a level")
    yield 0.0, points[0][1]
    for (start_s, before), (stop_s, after) in pairwise(points):
        if stop_s <= start_s:
            raise CircuitError(f"PWL: {stop_s:g} s does not come after {start_s:g} s")
        if before != after:
            _check_step(stop_s - start_s)
            yield start_s, after


def _pulse(numbers: Sequence[float], stop_s: float) -> Iterator[Step]:
    if not 5 <= len(numbers) <= 7:
        raise CircuitError("PULSE needs two levels, delay, rise, fall, and may have width and period")
    low, high, delay_s, rise_s, fall_s = numbers[:5]
    width_s = numbers[5] if len(numbers) > 5 else math.inf
    period_s = numbers[6] if len(numbers) > 6 else math.inf
    _check_step(rise_s)
    _check_step(fall_s)
    if delay_s < 0 or width_s < 0 or not period_s >= rise_s + width_s + fall_s:
        raise CircuitError(
            "PULSE: its delay and width must not be negative, and its period must hold rise, width and fall"
        )
    if 2 * (stop_s - delay_s) / period_s > MAX_EDGES:
        raise CircuitError(f"PULSE has more than {MAX_EDGES} edges")
    yield 0.0, low
    cycle = 0
    while (start_s := delay_s + (cycle * period_s if cycle else 0.0)) <= stop_s:
        yield start_s, high
        if start_s + rise_s + width_s <= stop_s:
            yield start_s + rise_s + width_s, low
        cycle += 1


def _check_step(rise_s: float) -> None:
    if not 0 < rise_s <= LONGEST_STEP_S:
        raise CircuitError(f"a source must step: within {LONGEST_STEP_S:g} s, but not in 0 s; got {rise_s:g} s")


def _model(given: Mapping[str, float]) -> OpAmpModel:
    """An op-amp of the parameters of LIBRARY's op-amps."""
    values = {name: math.copysign(math.inf, v) if abs(v) >= LIMITLESS else v for name, v in given.items()}
    return OpAmpModel(
        avol=values["avol"],
        gbw_hz=values.get("gbw", math.inf),
        slew_v_per_s=values.get("slew", math.inf),
        swing_v=(values.get("swing_low", -math.inf), values.get("swing_high", math.inf)),
        rout_ohm=values["rout"],
        vos_v=values["vos"],
    )


def _has_state(element: Element) -> bool:
    return isinstance(element, OpAmp) and element.model.has_state


def _state_node(item: _Found) -> str:
    """The node in the op-amp's subcircuit that holds its state, as ngspice calls it."""
    return ".".join((*item.path, item.card.head, "state")).lower()


def _initial_of(item: _Found, capacitor: Capacitor, of_node: Mapping[str, float]) -> float:
    if item.initial_v is not None:
        return item.initial_v
    return of_node.get(capacitor.a, 0.0) - of_node.get(capacitor.b, 0.0)


def _rate_hz(period_s: float) -> float:
    """The rate of that period, and of the rates that have it the roundest."""
    rounded = float(f"{1.0 / period_s:.12g}")
    return rounded if 1.0 / rounded == period_s else 1.0 / period_s
