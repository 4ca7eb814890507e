"""Pots of the analogue computer: resting places of their wipers, noise of the contacts, dials, and ramps between them.

A panel never changes; a motion is another panel. Wipers rest on the nearest winding, also during a ramp.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from analogrig_emulator.circuit.circuit import Circuit
from analogrig_emulator.circuit.components import Components, contact_of
from analogrig_emulator.circuit.elements import Pot
from analogrig_emulator.circuit.pot import check_dial
from analogrig_emulator.exceptions import PotError

_SLOW_PER_SAMPLE = 5e-5
"""Dial speed per sample below which one piece per sample suffices."""

_MOST_PIECES = 64


@dataclass(frozen=True)
class Ramp:
    """Even motion of a pot from one dial at sample `first` to another at sample `last`."""

    start: float
    goal: float
    first: int
    last: int

    def at(self, sample: float) -> float:
        """Dial at a sample, which may be a fraction."""
        if sample >= self.last:
            return self.goal
        return self.start + (self.goal - self.start) * max(sample - self.first, 0.0) / (self.last - self.first)

    @property
    def pieces(self) -> int:
        """Number of pieces with constant dials per sample; the error goes with speed / pieces^2."""
        speed_per_sample = abs(self.goal - self.start) / (self.last - self.first)
        return min(max(math.ceil(math.sqrt(speed_per_sample / _SLOW_PER_SAMPLE)), 1), _MOST_PIECES)


class Wipers:
    """Wipers of a circuit's pots: resting places, and noise of the contacts."""

    def __init__(self, circuit: Circuit, components: Components) -> None:
        pots = {pot.name: pot for pot in circuit.of(Pot)}
        contacts = {contact_of(name): name for name in pots if contact_of(name) in pots}
        self.pots = {name: components.pots.model(pot.track_ohm) for name, pot in pots.items() if name not in contacts}
        self._contacts = {name: components.contact(pots[name]) for name in contacts.values()}

    def check(self, pot: str) -> None:
        """Raise PotError for an unknown pot."""
        if pot not in self.pots:
            raise PotError(f"no pot is called {pot!r}; there are {', '.join(sorted(self.pots)) or 'none'}")

    def resting(self, dials: Mapping[str, float]) -> dict[str, float]:
        """Dials of the nearest windings. Raises PotError for a dial off its track and an unknown pot."""
        for pot, dial in dials.items():
            self.check(pot)
            check_dial(dial, pot)
        return {pot: self.pots[pot].resting(dial) for pot, dial in dials.items()}

    def contacts_at_rest(self, pots: Iterable[str]) -> dict[str, float]:
        """Dials of the contacts of resting wipers: no resistance."""
        return {contact_of(pot): 1.0 for pot in pots if pot in self._contacts}

    def contacts_moving(self, pot: str, dial: float) -> dict[str, float]:
        """Dial of the contact while the wiper passes a dial."""
        if pot not in self._contacts:
            return {}
        places = self._contacts[pot]
        return {contact_of(pot): 1.0 - float(places[round(dial * (len(places) - 1))])}


class PotPanel(NamedTuple):
    """Dials of a circuit's pots and contacts, and the ramps under way, by pot."""

    wipers: Wipers
    dials: Mapping[str, float]
    ramps: Mapping[str, Ramp] = MappingProxyType({})

    @classmethod
    def of(cls, circuit: Circuit, components: Components) -> PotPanel:
        """Panel with the dials of the netlist."""
        return cls(Wipers(circuit, components), {pot.name: pot.dial for pot in circuit.of(Pot)})

    def turned(self, goals: Mapping[str, float]) -> PotPanel:
        """Panel with pots turned to resting dials at once; their ramps end."""
        ramps = {pot: ramp for pot, ramp in self.ramps.items() if pot not in goals} if self.ramps else {}
        return PotPanel(self.wipers, self.settled(goals), ramps)

    def ramped(self, goals: Mapping[str, float], first: int, ramp_n: int) -> PotPanel:
        """Panel whose pots turn to resting dials from sample `first` on, for ramp_n samples."""
        ramps = {
            pot: Ramp(self.dials[pot], dial, first, first + ramp_n)
            for pot, dial in goals.items()
            if dial != self.dials[pot]
        }
        others = {pot: ramp for pot, ramp in self.ramps.items() if pot not in goals}
        return PotPanel(self.wipers, {**self.dials, **self.wipers.contacts_at_rest(goals)}, {**others, **ramps})

    def stopped(self) -> PotPanel:
        """Panel with every ramp ended at its present dial."""
        if not self.ramps:
            return self
        return PotPanel(self.wipers, {**self.dials, **self.wipers.contacts_at_rest(self.ramps)}, {})

    def settled(self, dials: Mapping[str, float]) -> dict[str, float]:
        """Dials of the panel with some pots at rest at others."""
        return {**self.dials, **dials, **self.wipers.contacts_at_rest(dials)}

    @property
    def next_arrival(self) -> int:
        """Sample of the first ramp's end."""
        return min(ramp.last for ramp in self.ramps.values())

    @property
    def pieces(self) -> int:
        """Pieces with constant dials per sample that the fastest ramp needs."""
        return max(ramp.pieces for ramp in self.ramps.values())

    def during(self, sample: float) -> dict[str, float]:
        """Dials at a sample of the ramps, which may be a fraction."""
        dials = dict(self.dials)
        for pot, ramp in self.ramps.items():
            dials[pot] = self.wipers.pots[pot].resting(ramp.at(sample))
            moves = ramp.first < sample < ramp.last
            dials |= self.wipers.contacts_moving(pot, dials[pot]) if moves else self.wipers.contacts_at_rest([pot])
        return dials

    def at(self, sample: int) -> PotPanel:
        """Panel as the ramps leave it at a sample; those that have arrived end."""
        ramps = {pot: ramp for pot, ramp in self.ramps.items() if ramp.last > sample}
        return PotPanel(self.wipers, self.during(sample), ramps)
