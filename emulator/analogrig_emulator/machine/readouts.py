"""Readouts of the analogue computer: coefficients of pots, and overload lamps.

An operator reads a coefficient in POT SET: the wiper voltage under load with the top of the pot on the reference.

An amplifier's lamp lights when its output has been unable to follow, at its swing or at its slew rate, for a delay
without a break: then its junction is off virtual ground, by more than slew / (2 pi GBW) (0.7 V for a TL07x). Amplifiers
without such limits have a lamp that stays dark.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import Circuit, Element
from analogrig_emulator.circuit.components import is_part_of
from analogrig_emulator.circuit.elements import GROUND, VoltageSource
from analogrig_emulator.circuit.nodal import Nodal
from analogrig_emulator.circuit.pot import END_FRACTION
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Kink
from analogrig_emulator.exceptions import EngineError, PotError
from analogrig_emulator.machine.relays import REFERENCE_V, move_ends

LAMP_DELAY_S = 10e-6
"""Time without virtual ground after which an amplifier's lamp lights, in s."""

_BISECTIONS = 53

_TOLERANCE = 2 * END_FRACTION
"""Largest error of a coefficient, from the track left at the end stops."""


@dataclass(frozen=True)
class PotReading:
    """A pot on the reference.

    nodal: circuit of POT SET with the top of the pot there; wiper: node at which the wiper is patched; dials, closed:
    pots and switches; levels_v: level of each input.
    """

    pot: str
    nodal: Nodal
    wiper: str
    dials: Mapping[str, float]
    closed: Mapping[str, bool]
    levels_v: Mapping[str, float]

    def coefficient(self, dial: float) -> float:
        """Coefficient with the pot at a dial."""
        system = self.nodal.at({**self.dials, self.pot: dial}, self.closed)
        levels_v = np.array([self.levels_v[name] for name in system.inputs])
        return system.rest(levels_v).volts[self.wiper] / REFERENCE_V

    def dial_of(self, coefficient: float) -> float:
        """Dial at which the pot has the coefficient. Raises PotError beyond the track."""
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.coefficient(middle) < coefficient else (low, middle)
        reached = self.coefficient(high)
        if not abs(reached - coefficient) <= _TOLERANCE:
            raise PotError(
                f"pot {self.pot}: coefficient {coefficient:.6g} is beyond the track, which ends at {reached:.6g}"
            )
        return high


def on_reference(circuit: Circuit, pot: str, top: str) -> Circuit:
    """Circuit of POT SET with the top of a pot on the reference instead of the node `top`."""
    elements = [
        move_ends(element, top, "reference") if _belongs(element, pot) else element for element in circuit.elements
    ]
    return Circuit([*elements, VoltageSource("reference", "reference", dc_v=REFERENCE_V)])


def terminal(circuit: Circuit, pot: str, end: str) -> str:
    """Node at which an end of a pot is patched: where the parts added by fit() meet other elements."""
    own = [element for element in circuit.elements if _belongs(element, pot)]
    bonds = [bond for element in own if element.name != pot for bond in element.bonds]
    patched = {GROUND, *(node for element in circuit.elements if element not in own for node in element.nodes)}
    reached: list[str] = [next(getattr(element, end) for element in own if element.name == pot)]
    for node in reached:
        fresh = {other for bond in bonds if node in bond for other in bond}
        reached += sorted(fresh.difference(reached, {GROUND}))
    return next(node for node in reached if node in patched)


def _belongs(element: Element, pot: str) -> bool:
    return element.name == pot or is_part_of(element, pot)


def lamp_delay_ticks(lamp_delay_s: float, sample_rate_hz: float) -> int:
    """Delay of the lamps in ticks. Raises EngineError for one out of range."""
    if not 0 <= lamp_delay_s < math.inf:
        raise EngineError(f"lamp_delay_s must be finite and not negative, got {lamp_delay_s!r}")
    return round(lamp_delay_s * sample_rate_hz * TICKS_PER_SAMPLE)


def lamp_samples(
    amplifiers: Iterable[str], kinks: Iterable[Kink], overdue_ticks: NDArray[np.int64]
) -> dict[str, int | None]:
    """First sample by amplifier with its lamp lit, None while it is dark, from the overdue ticks of each kink."""
    lamps: dict[str, int | None] = dict.fromkeys(amplifiers)
    for kink, tick in zip(kinks, overdue_ticks.tolist(), strict=True):
        if tick >= 0 and kink.element in lamps:
            sample, before = -(-tick // TICKS_PER_SAMPLE), lamps[kink.element]
            lamps[kink.element] = sample if before is None else min(sample, before)
    return lamps
