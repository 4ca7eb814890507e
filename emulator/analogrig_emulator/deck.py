"""SPICE decks read into circuits: the subset that analogue computers need, and that spice.py writes.

    R, C (IC=)           resistors, capacitors
    V                    DC: a constant; PULSE, PWL: an input whose level steps
    X                    subcircuits of the deck, nested, with parameters; and those of deck_library.py: op-amps,
                         pots, diode limiters, switches
    .param               numbers, names, + - * / and parentheses (expression.py)
    .ic, .tran ... uic   initial conditions; sample period and length of the run
    .subckt .ends .end   and .save, .options, .print, .plot, .title, which change nothing here

Everything else is refused by name. Nothing in a deck is executed, and no file is included. A name that is known twice
means what it means to ngspice: case does not count, gnd is 0, the first line is the title.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .circuit import GROUND, Capacitor, Circuit, Element, OpAmp, Pot, VoltageSource
from .deck_expansion import Expansion, Found, named
from .deck_source import LONGEST_STEP_S
from .deck_text import Definition, located, parse
from .engine import Engine
from .errors import CircuitError, EmulatorError
from .excitation import TICKS_PER_SAMPLE, Edges
from .expression import Budget, Scope
from .nodal import Nodal
from .pot import checked_dial
from .spice import Accuracy, to_spice

__all__ = ["Deck", "read_deck"]

MAX_WORK = 50_000
"""Cards and parameters looked at while a deck is expanded."""

MAX_SAMPLES = 10_000_000

MAX_VALUES = 50_000_000
"""Samples times nodes that are recorded at once: 400 MB."""

MAX_EVENTS = 10_000_000
"""Of one run; some minutes."""

SLICE_SAMPLES = 1000

SHORTEST_PERIOD_S = 1e-12
LONGEST_PERIOD_S = 1e6


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
    def load(cls, path: str | Path) -> Deck:
        """The deck in a file. Raises what read_deck raises, and CircuitError for a file that cannot be read."""
        try:
            text = Path(path).read_text(encoding="utf-8", errors="replace")
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
        recorded = self.circuit.nodes if nodes is None else nodes
        engine = Engine(system, recorded, self.sample_rate_hz)
        engine.state = np.array([self.initial_v.get(state, 0.0) for state in system.states])
        volts = self._room(len(recorded))
        for sample, turned in [*sorted(self.turns, key=lambda turn: turn[0]), (self.samples - 1, {})]:
            self._run(engine, sample + 1, volts)
            dials |= turned
            engine.set_system(nodal.at(dials))
        return volts

    def _room(self, nodes: int) -> NDArray[np.float64]:
        if self.samples * nodes > MAX_VALUES:
            raise CircuitError(
                f"{self.samples} samples of {nodes} nodes: more than {MAX_VALUES} values; name fewer nodes"
            )
        return np.empty((self.samples, nodes))

    def _run(self, engine: Engine, until: int, volts: NDArray[np.float64]) -> None:
        """In slices, which change no bit: between two a run can be interrupted, and one without end be given up."""
        while engine.recorded < until:
            done = engine.recorded
            samples = min(SLICE_SAMPLES, until - done)
            start, stop = engine.window(samples)
            edges = {}
            for name, train in self.edges.items():
                first, last = np.searchsorted(train.ticks, (start, stop))
                edges[name] = Edges(train.ticks[first:last], train.levels_v[first:last])
            volts[done : done + samples] = engine.run(samples, edges)
            if engine.counts.events > MAX_EVENTS:
                raise CircuitError(f"more than {MAX_EVENTS} events in {engine.recorded} samples: it oscillates")


def read_deck(text: str, name: str = "deck") -> Deck:
    """The deck of a text; name: of its file, for the errors.

    Raises CircuitError (PotError for a dial off its track) that names file, line, element and node: for a card or a
    value that is not understood, whatever Circuit refuses, a singular circuit, subcircuits that contain themselves, and
    whatever exceeds the limits of the modules deck_*.py or of the engine.
    """
    title, top = parse(text, name)
    try:
        scope = Scope(top.parameters, Budget(MAX_WORK))
        run = _Run.of(name, top, scope)
        return _Reading(name, run, Expansion(name, top, scope, run.stop_s)).deck(title)
    except EmulatorError as error:
        if _CARD.match(title):
            raise type(error)(f"{error} (line 1 is the title: {title[:40]!r})") from error
        raise


_CARD = re.compile(r"\.[a-z]+\s|[rcvix]\w*(\s+\w+){2,}\s+[-+{.\d]", re.IGNORECASE)
"""What looks like a card, and was perhaps meant as one."""


@dataclass(frozen=True)
class _Run:
    """What .tran says."""

    samples: int = 0
    period_s: float = 1.0 / 20e3

    @property
    def stop_s(self) -> float:
        return (self.samples - 1) * self.period_s

    @property
    def sample_rate_hz(self) -> float:
        """The rate of that period, and of the rates that have it the roundest."""
        rounded = float(f"{1.0 / self.period_s:.12g}")
        return rounded if 1.0 / rounded == self.period_s else 1.0 / self.period_s

    @classmethod
    def of(cls, name: str, top: Definition, scope: Scope) -> _Run:
        run = cls()
        cards = [card for card in top.cards if card.kind == ".tran"]
        for card in cards:
            with located(name, card):
                if card is not cards[0]:
                    raise CircuitError("there is a .tran already")
                run = cls._read(card.fields()[0][1:], scope)
        return run

    @classmethod
    def _read(cls, words: list[str], scope: Scope) -> _Run:
        if "uic" not in (word.lower() for word in words):
            raise CircuitError("needs uic: the machine starts from its initial conditions, not from a DC solution")
        times_s = [scope.evaluate(word) for word in words if word.lower() != "uic"]
        if not 2 <= len(times_s) <= 4 or (len(times_s) > 2 and times_s[2]):
            raise CircuitError("expected: sample period, end, 0, longest step, uic")
        if not times_s[0] > 0 or not times_s[1] >= 0:
            raise CircuitError("the sample period must be positive, and the end not negative")
        if not SHORTEST_PERIOD_S <= times_s[0] <= LONGEST_PERIOD_S:
            raise CircuitError(f"the sample period must be from {SHORTEST_PERIOD_S:g} to {LONGEST_PERIOD_S:g} s")
        if times_s[1] / times_s[0] > MAX_SAMPLES:
            raise CircuitError(f"has more than {MAX_SAMPLES} samples")
        return cls(round(times_s[1] / times_s[0]) + 1, times_s[0])


class _Reading:
    """The elements of a deck on their way to a circuit and what is played on it."""

    def __init__(self, name: str, run: _Run, expansion: Expansion) -> None:
        self._name = name
        self._run = run
        self._expansion = expansion
        self._dials, others = _dials_apart(expansion.found)
        self._found = named(others)
        self._turns: dict[int, dict[str, float]] = {}

    def deck(self, title: str) -> Deck:
        return Deck(
            self._circuit(),
            samples=self._run.samples,
            sample_rate_hz=self._run.sample_rate_hz,
            edges={name: self._edges(item) for name, item in self._found if item.steps is not None},
            turns=sorted(self._turns.items()),
            initial_v=self._initial_v(),
            title=title,
        )

    def _circuit(self) -> Circuit:
        elements = [self._element(name, item) for name, item in self._found]
        try:
            circuit = Circuit(elements)
            Nodal(circuit).at({})
        except EmulatorError as error:
            lines = [f":{item.card.line}" for name, item in self._found if name == error.element]
            raise type(error)(f"{self._name}{''.join(lines[-1:])}: {error}") from error
        return circuit

    def _element(self, name: str, item: Found) -> Element:
        element = replace(item.element, name=name)
        if item.dial_node is not None and isinstance(element, Pot):
            with located(self._name, item.card):
                return self._set_up(element, item.dial_node)
        return element

    def _set_up(self, pot: Pot, dial_node: str) -> Pot:
        """The pot at its first dial; its later ones go to turns."""
        source = self._dials.get(dial_node)
        if source is None or source.steps is None:
            raise CircuitError(f"node {dial_node}, its dial, needs a PULSE or PWL source to ground")
        (_, first), *later = source.steps
        for instant_s, dial in later:
            sample = round(instant_s / self._run.period_s)
            if abs(instant_s - sample * self._run.period_s) > LONGEST_STEP_S:
                raise CircuitError(f"is turned at {instant_s:g} s, which is not an instant of a sample")
            if sample < self._run.samples:
                self._turns.setdefault(sample, {})[pot.name] = checked_dial(dial, pot.name)
        return replace(pot, dial=first)

    def _edges(self, item: Found) -> Edges:
        instants_s, levels_v = np.array(item.steps).T
        ticks = np.rint(instants_s * (TICKS_PER_SAMPLE / self._run.period_s)).astype(np.int64)
        lasting = np.append(ticks[1:] > ticks[:-1], True)
        kept = lasting & (ticks <= max(self._run.samples - 1, 0) * TICKS_PER_SAMPLE)
        return Edges(ticks[kept], np.ascontiguousarray(levels_v[kept]))

    def _initial_v(self) -> dict[str, float]:
        """Volts by state: a capacitor's IC, else the difference of what .ic says of its nodes; an op-amp's own node."""
        of_node: dict[str, float] = {}
        volts: dict[str, float] = {}
        amps = {_state_node(item): name for name, item in self._found if _has_state(item.element)}
        for target, (card, level_v) in self._expansion.initial.items():
            node = self._expansion.node(target)
            if target in amps:
                volts[amps[target]] = level_v
            elif node is not None:
                of_node[node] = level_v
            else:
                with located(self._name, card):
                    raise CircuitError(f"no node is called {target!r}")
        for name, item in self._found:
            if isinstance(item.element, Capacitor) and (level_v := _initial_of(item, item.element, of_node)):
                volts[name] = level_v
        return volts


def _dials_apart(found: Sequence[Found]) -> tuple[dict[str, Found], list[Found]]:
    """The sources that turn pots, by node, and everything else."""
    wanted = {item.dial_node for item in found} - {None}
    dials, others = {}, []
    for item in found:
        source = item.element
        if isinstance(source, VoltageSource) and source.plus in wanted and source.minus == GROUND:
            dials[source.plus] = item
        else:
            others.append(item)
    return dials, others


def _has_state(element: Element) -> bool:
    return isinstance(element, OpAmp) and element.model.has_state


def _state_node(item: Found) -> str:
    """The node in the op-amp's subcircuit that holds its state, as ngspice calls it."""
    return ".".join((*item.path, item.card.head, "state")).lower()


def _initial_of(item: Found, capacitor: Capacitor, of_node: Mapping[str, float]) -> float:
    if item.initial_v is not None:
        return item.initial_v
    return of_node.get(capacitor.a, 0.0) - of_node.get(capacitor.b, 0.0)
