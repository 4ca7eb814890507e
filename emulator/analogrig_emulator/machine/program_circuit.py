"""Program of the analogue computer: wiring, scales and pots.

Every program is three tables: its wiring (netlist), its scales (Scales: node, sign and full scale of each quantity) and
its pots (Parameter: which pot shows a parameter, into which resistor, with which coefficient).
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.elements import Pot, Resistor
from analogrig_emulator.circuit.opamp import IDEAL, OpAmpModel
from analogrig_emulator.exceptions import PotError

CHANNELS = ("force", "displacement", "velocity", "net_force")
"""Quantities on the card's four channels, in order, for a suspension."""

SOURCE = "F"
"""Name of every program's first input, and its node is "in"."""


@dataclass(frozen=True)
class Scale:
    """Row of the scaling table: node, sign there, and full scale, the value of 10 V."""

    node: str
    sign: float
    full: float


@dataclass(frozen=True)
class Scales:
    """Scaling table by quantity. time: speed of the machine relative to the plant."""

    time: float
    quantities: Mapping[str, Scale]

    def full(self, quantity: str) -> float:
        """Full scale of a quantity: value of 10 V."""
        return self.quantities[quantity].full

    def volts(self, quantity: str) -> float:
        """Volts per unit of a quantity, on a channel of the card: the node's sign is taken out."""
        return 10.0 / self.quantities[quantity].full

    def volts_at_node(self, quantity: str) -> float:
        """Volts per unit at the quantity's node, the sign included."""
        return self.quantities[quantity].sign * self.volts(quantity)


@dataclass(frozen=True)
class Parameter(ABC):
    """Row of the pot table.

    pot: name; load: resistor from its wiper to a virtual ground; value: value in the program.
    """

    pot: str
    load: str
    value: float

    @abstractmethod
    def coefficient(self, value: float) -> float:
        """Coefficient under load for a value in kg, N s/m or N/m."""


@dataclass(frozen=True)
class Mass(Parameter):
    """Mass pot before an integrator of velocity: numerator = time x N per 10 V x R C; full_out: m/s per 10 V."""

    numerator: float
    full_out: float

    def coefficient(self, value: float) -> float:
        return self.numerator / (value * self.full_out)


@dataclass(frozen=True)
class ForceLaw(Parameter):
    """Damper or spring pot before a summer of forces.

    full_in: m/s or m per 10 V at the pot; full_out: N per 10 V of the sum; gain: R / R_feedback of the summer.
    """

    full_in: float
    full_out: float
    gain: float

    def coefficient(self, value: float) -> float:
        return (value * self.full_in / self.full_out) * self.gain


class PotRow(NamedTuple):
    """Load of a pot, the resistor from its wiper to a virtual ground, and the parameters that turn it."""

    load: str
    settings: tuple[str, ...]


class ProgramCircuit(ABC):
    """Circuit for the machine, with its scales and pots. Programs never change."""

    name: str

    @property
    @abstractmethod
    def scales(self) -> Scales:
        """Scales of CHANNELS and of any other quantity of the program."""

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Parameters by setting ("M") that turn one pot each, first mass, damper and spring of the sprung mass."""
        return {}

    @property
    def is_linear(self) -> bool:
        """True if amplifiers with resistors and capacitors alone solve it."""
        return True

    @property
    @abstractmethod
    def amplifiers(self) -> int:
        """Number of amplifiers U1, U2, ..."""

    @property
    @abstractmethod
    def integrators(self) -> tuple[str, ...]:
        """Names of the amplifiers that are integrators."""

    @abstractmethod
    def netlist(self, models: Sequence[OpAmpModel]) -> list[Element]:
        """Elements of the diagram with pots at 0; models: op-amp models of U1, U2, ..."""

    def element_names(self, *kinds: type[Element]) -> tuple[str, ...]:
        """Names of the elements of these kinds, in the order of the diagram."""
        return tuple(each.name for each in self.netlist([IDEAL] * self.amplifiers) if isinstance(each, kinds))

    @functools.cached_property
    def values(self) -> dict[str, float]:
        """Value of every parameter by setting."""
        return {name: parameter.value for name, parameter in self.parameters.items()}

    @functools.cached_property
    def pots(self) -> Mapping[str, PotRow]:
        """Pot table by pot."""
        return {row.pot: PotRow(row.load, (name,)) for name, row in self.parameters.items()}

    def pot_ohms(self, elements: Sequence[Element]) -> dict[str, tuple[float, float]]:
        """Track and load in ohm by pot, in elements with the names of the netlist."""
        tracks = {each.name: each.track_ohm for each in elements if isinstance(each, Pot)}
        loads = {each.name: each.ohm for each in elements if isinstance(each, Resistor)}
        return {pot: (tracks[pot], loads[row.load]) for pot, row in self.pots.items()}

    def pot_coefficient(self, pot: str, values: Mapping[str, float]) -> float:
        """Coefficient of a pot under load, for the values of the parameters that turn it.

        It may exceed 1; PotModel.dial rejects that. Raises PotError for a value that is not positive and finite.
        """
        (name,) = self.pots[pot].settings
        return self.coefficient(name, values[name])

    @property
    def channels(self) -> tuple[str, ...]:
        """Quantities on the card's channels, in order."""
        return CHANNELS

    @functools.cached_property
    def channel_nodes(self) -> tuple[str, ...]:
        """Nodes of the channels."""
        return tuple(self.scales.quantities[channel].node for channel in self.channels)

    @functools.cached_property
    def channel_signs(self) -> NDArray[np.float64]:
        """Signs of the channels at their nodes: a card's differential input can be reversed."""
        return np.array([self.scales.quantities[channel].sign for channel in self.channels], dtype=np.float64)

    @functools.cached_property
    def _reversed_channels(self) -> tuple[int, ...]:
        return tuple(i for i, channel in enumerate(self.channels) if self.scales.quantities[channel].sign < 0.0)

    def orient(self, volts: NDArray[np.float64]) -> None:
        """Give the volts of the nodes, (..., channels), the signs of the channels, in place."""
        for channel in self._reversed_channels:  # a product by a row takes four times as long
            np.negative(volts[..., channel], out=volts[..., channel])

    def coefficient(self, setting: str, value: float) -> float:
        """Coefficient under load of the pot of a setting, for a value in kg, N s/m or N/m.

        It may exceed 1; PotModel.dial rejects that. Raises PotError for a value that is not positive and finite.
        """
        parameter = self.parameters[setting]
        if not (math.isfinite(value) and value > 0):
            raise PotError(f"pot {parameter.pot}: {setting} must be positive and finite, got {value!r}")
        return parameter.coefficient(value)
