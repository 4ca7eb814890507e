"""Program compiled from equations: computing elements as patched, and their netlist."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.elements import OpAmp
from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.exceptions import PotError, ProgramError
from analogrig_emulator.machine.program_circuit import PotRow, ProgramCircuit, Scale, Scales
from analogrig_emulator.machine.program_file import Equations
from analogrig_emulator.machine.stages import Cord, PatchStage, StageKind, Stages
from analogrig_emulator.machine.trial import Reach

MACHINE_V = 10.0
"""Voltage of full scale, of the reference, and scale of the multipliers."""


@dataclass(frozen=True)
class PatchedCord:
    """Cord as patched: node and sign of its source there, coefficient for the file's values, gain of its resistor.

    pot: its pot, if it has one; per_unit: coefficient of that pot by product of the cord's factors.
    """

    cord: Cord
    node: str
    sign: int
    coefficient: float
    gain: float
    resistor: str
    pot: str = ""
    per_unit: float = 0.0


@dataclass(frozen=True)
class PatchedElement:
    """Computing element as patched: name, node of its output, sign and full scale there, and cords.

    farad: capacitor of an integrator, else 0.
    """

    name: str
    stage: PatchStage
    node: str
    sign: int
    full: float
    cords: tuple[PatchedCord, ...]
    farad: float = 0.0


@dataclass(frozen=True)
class PatchedProgram(ProgramCircuit):
    """Program compiled from equations.

    patch: computing elements in the order of the diagram; inverters: names of the last amplifiers, by quantity;
    input_nodes: node by input; reach: range in the trial play by quantity; ideal: by amplifier and name, elements that
    replace those of the same names if the amplifier is ideal, None for none.
    """

    equations: Equations
    stages: Stages
    fulls: Mapping[str, float]
    reach: Mapping[str, Reach]
    patch: tuple[PatchedElement, ...]
    inverters: Mapping[str, str]
    input_nodes: Mapping[str, str]
    elements: tuple[Element, ...]
    ideal: Mapping[str, Mapping[str, Element | None]]

    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.equations.name

    @property
    def channels(self) -> tuple[str, ...]:
        return self.equations.channels

    @functools.cached_property
    def places(self) -> Mapping[str, tuple[str, int]]:
        """Node and sign there of every quantity."""
        elements = {each.stage.name: (each.node, each.sign) for each in self.patch}
        return elements | {name: (node, 1) for name, node in self.input_nodes.items()}

    @functools.cached_property
    def scales(self) -> Scales:
        return Scales(
            self.equations.speed,
            {name: Scale(*self.places[name], self.fulls[name]) for name in self.equations.quantities},
        )

    @functools.cached_property
    def values(self) -> dict[str, float]:
        return {name: row.value for name, row in self.equations.parameters.items() if row.pot}

    @functools.cached_property
    def _cords(self) -> dict[str, PatchedCord]:
        return {cord.pot: cord for element in self.patch for cord in element.cords if cord.pot}

    @functools.cached_property
    def pots(self) -> Mapping[str, PotRow]:
        return {
            pot: PotRow(
                cord.resistor,
                tuple([name for name in self.stages.parameters_of(cord.cord.factors) if name in self.values]),
            )
            for pot, cord in self._cords.items()
        }

    def pot_coefficient(self, pot: str, values: Mapping[str, float]) -> float:
        cord = self._cords[pot]
        try:
            return cord.per_unit * self.stages.factor(cord.cord.factors, self.equations.values | dict(values))
        except ProgramError as cause:
            raise PotError(f"pot {pot}: {cause}") from cause

    @property
    def is_linear(self) -> bool:
        return self.stages.is_linear

    @property
    def amplifiers(self) -> int:
        return sum(1 for element in self.elements if isinstance(element, OpAmp))

    @property
    def integrators(self) -> tuple[str, ...]:
        return tuple(each.name for each in self.patch if each.stage.kind is StageKind.INTEGRATOR)

    def netlist(self, models: Sequence[OpAmpModel]) -> list[Element]:
        given = dict(zip((each.name for each in self.elements if isinstance(each, OpAmp)), models, strict=True))
        ideal: dict[str, Element | None] = {}
        for amp, parts in self.ideal.items():
            if not given[amp].has_state:
                ideal |= parts
        elements = [ideal.get(each.name, each) for each in self.elements]
        return [replace(each, model=given[each.name]) if isinstance(each, OpAmp) else each for each in elements if each]
