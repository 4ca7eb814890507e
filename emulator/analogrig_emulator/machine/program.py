"""A program of the analogue computer: what is patched, what its voltages stand for, and what its pots show.

Every program is three tables: its wiring (netlist), its scales (Scales: node, sign and full scale of each quantity) and
its pots (Parameter: which pot shows a parameter, into which resistor, with which coefficient).
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.errors import PotError

CHANNELS = ("force", "displacement", "velocity", "net_force")
"""What the card's four channels read, in order; quantities that every program has."""

SOURCE = "F"
"""Name of every program's input, and its node is "in"."""


@dataclass(frozen=True)
class Quantity:
    """A row of the scaling table: node, sign there, and what 10 V stand for, in N, m or m/s."""

    node: str
    sign: float
    full: float


@dataclass(frozen=True)
class Scales:
    """The scaling table by quantity. time: how much faster the machine runs than what it models."""

    time: float
    quantities: Mapping[str, Quantity]

    def full(self, quantity: str) -> float:
        """What 10 V stand for (N, m, m/s)."""
        return self.quantities[quantity].full

    def volts(self, quantity: str) -> float:
        """Volts per unit (N, m, m/s) of a quantity, on a channel of the card: the node's sign is taken out."""
        return 10.0 / self.quantities[quantity].full

    def volts_at_node(self, quantity: str) -> float:
        """Volts per unit at the quantity's node, the sign included."""
        return self.quantities[quantity].sign * self.volts(quantity)


@dataclass(frozen=True)
class Parameter(ABC):
    """A row of the table of pots.

    pot: its name; load: the resistor that its wiper drives, the far end being at virtual ground; value: of the program.
    """

    pot: str
    load: str
    value: float

    @abstractmethod
    def coefficient(self, value: float) -> float:
        """What the pot has to pass under that load to show a value (kg, N s/m, N/m)."""


@dataclass(frozen=True)
class Mass(Parameter):
    """Of a pot before an integrator of velocity: numerator = time x N per 10 V x R C; full_out: m/s per 10 V."""

    numerator: float
    full_out: float

    def coefficient(self, value: float) -> float:
        return self.numerator / (value * self.full_out)


@dataclass(frozen=True)
class ForceLaw(Parameter):
    """Of a pot before a summer of forces, damper or spring.

    full_in: m/s or m per 10 V at the pot; full_out: N per 10 V of the sum; gain: R / R_feedback of the summer.
    """

    full_in: float
    full_out: float
    gain: float

    def coefficient(self, value: float) -> float:
        return (value * self.full_in / self.full_out) * self.gain


class Program(ABC):
    """A circuit that can be patched on the machine, with its scales and its pots."""

    name: str

    @property
    @abstractmethod
    def scales(self) -> Scales:
        """What the voltages stand for; CHANNELS and whatever else the program shows."""

    @property
    @abstractmethod
    def parameters(self) -> Mapping[str, Parameter]:
        """What the pots show, by the name of the setting ("M_kg"); first mass, damper and spring of the sprung mass."""

    @property
    @abstractmethod
    def amplifiers(self) -> int:
        """How many there are: U1, U2, ..."""

    @property
    @abstractmethod
    def integrators(self) -> tuple[str, ...]:
        """Which of them are integrators."""

    @abstractmethod
    def netlist(self, models: Sequence[OpAmpModel]) -> list[Element]:
        """The diagram, its pots at 0; models: of U1, U2, ..."""

    @functools.cached_property
    def values(self) -> dict[str, float]:
        """The value of every parameter, by the name of the setting."""
        return {name: parameter.value for name, parameter in self.parameters.items()}

    @functools.cached_property
    def channel_nodes(self) -> tuple[str, ...]:
        """The nodes that CHANNELS read."""
        return tuple(self.scales.quantities[channel].node for channel in CHANNELS)

    @functools.cached_property
    def channel_signs(self) -> NDArray[np.float64]:
        """The signs with which they read them: a card's differential input can be wired the other way round."""
        return np.array([self.scales.quantities[channel].sign for channel in CHANNELS])

    def coefficient(self, setting: str, value: float) -> float:
        """What the pot of a setting has to pass under its load for the machine to show the value (kg, N s/m, N/m).

        It may exceed 1, which is for the pot to refuse. Raises PotError for a value that is not positive and finite.
        """
        parameter = self.parameters[setting]
        if not (math.isfinite(value) and value > 0):
            raise PotError(f"pot {parameter.pot}: {setting} must be positive and finite, got {value!r}")
        return parameter.coefficient(value)
