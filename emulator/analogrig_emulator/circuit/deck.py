"""A circuit together with what is played on it: the engine plays it, ngspice plays its deck."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.excitation import Edges
from analogrig_emulator.circuit.circuit import Circuit
from analogrig_emulator.circuit.nodal import Nodal
from analogrig_emulator.circuit.spice import Accuracy, to_spice
from analogrig_emulator.engine.engine import Engine

__all__ = ["Deck"]


@dataclass(frozen=True, eq=False)
class Deck:
    """A circuit, its excitation and its pot turns.

    samples: number of samples at ``sample_rate_hz``; edges: levels by input, from tick 0 on; turns: (sample, dials by
    pot), effective right after that sample; initial_v: volts by state (capacitor or op-amp), 0 V where not given.
    """

    circuit: Circuit
    samples: int = 0
    sample_rate_hz: float = 20e3
    edges: Mapping[str, Edges] = field(default_factory=dict)
    turns: Sequence[tuple[int, Mapping[str, float]]] = ()
    initial_v: Mapping[str, float] = field(default_factory=dict)
    title: str = ""

    def text(self, nodes: Sequence[str] | None = None, accuracy: Accuracy | None = None) -> str:
        """Return the deck that ngspice runs; nodes, accuracy: as for to_spice."""
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
        """Return the engine's solution: (samples, nodes) in V, for every node of the circuit when none are named.

        Raises CircuitError, PotError, EngineError.
        """
        nodal = Nodal(self.circuit)
        dials: dict[str, float] = {}
        system = nodal.at(dials)
        engine = Engine(system, self.circuit.nodes if nodes is None else nodes, self.sample_rate_hz)
        engine.state = np.array([self.initial_v.get(state, 0.0) for state in system.states])
        stretches = []
        for sample, turned in [*sorted(self.turns, key=lambda turn: turn[0]), (self.samples - 1, {})]:
            samples = sample + 1 - engine.recorded
            if samples > 0:
                start, stop = engine.window(samples)
                stretches.append(
                    engine.run(samples, {name: _within(train, start, stop) for name, train in self.edges.items()})
                )
            dials |= turned
            engine.set_system(nodal.at(dials))
        return np.concatenate(stretches)


def _within(train: Edges, start: int, stop: int) -> Edges:
    """Return the edges of the ticks start <= tick < stop."""
    first, last = np.searchsorted(train.ticks, (start, stop))
    return Edges(train.ticks[first:last], train.levels_v[first:last])
