"""Patch sheet for THE ANALOG THING: elements, cables and coefficients of a compiled program.

By the wiki of the-analog-thing.org it has five integrators, four summers, four inverters, two multipliers and eight
coefficients. Inputs have the weights 1 and 10. An integrator has k0 = 1000 per second at weight 1, and a hundredth of
it with SLOW. A summer has four inputs of weight 1 and three of weight 10; the same is assumed of an integrator.
Integrators, summers and inverters invert as in our patches, so signs and scales stay. Multipliers do not invert, and
ours may.

Our integrators have k0 = 10,000 per second and more at weight 1. So all rates are divided by one number, the delay.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from analogrig_emulator.exceptions import ProgramError
from analogrig_emulator.machine.compiler import INPUT_OHM
from analogrig_emulator.machine.patched_program import PatchedElement, PatchedProgram
from analogrig_emulator.machine.sheet import inverters, signed, table
from analogrig_emulator.machine.stages import StageKind

MACHINE = "THE ANALOG THING"

_NAMES = {StageKind.INTEGRATOR: "INT", StageKind.SUMMER: "SUM", StageKind.PRODUCT: "MULT"}
COUNTS = {"INT": 5, "SUM": 4, "INV": 4, "MULT": 2, "COEF": 8}
"""Number of elements by kind."""
_PLURALS = {
    "INT": "integrators",
    "SUM": "summers",
    "INV": "inverters",
    "MULT": "multipliers",
    "COEF": "coefficients",
}
INPUTS = {1: 4, 10: 3}
"""Number of an element's inputs by weight."""
_K0 = 1000.0
_SLOW = 0.01


@dataclass(frozen=True)
class Cable:
    """Connection into an element. coefficient: that on its way, 1 if there is none; pot: its name in our patch."""

    source: str
    coefficient: float
    pot: str
    target: str
    jack: str


class Output(NamedTuple):
    """Output of an element: its quantity with sign, the full scale at 10 V, and its name in our patch."""

    place: str
    quantity: str
    full: float
    name: str


@dataclass(frozen=True)
class ThatSheet:
    """Patch of a program. slow: integrators whose output also leads to their jack SLOW.

    Raises ProgramError that names what is missing, with the count.
    """

    program: PatchedProgram

    def __post_init__(self) -> None:
        for each in self.program.patch:
            if each.stage.kind not in _NAMES:
                raise self._error(f"needs a {each.stage.kind.title}, and {MACHINE} has none")
        counts = Counter(name.rstrip("0123456789") for name in self.places.values())
        counts["COEF"] = sum(cable.coefficient < 1.0 for cable in self.cables)
        for kind, count in COUNTS.items():
            if counts[kind] > count:
                raise self._error(f"needs {counts[kind]} {_PLURALS[kind]}, and {MACHINE} has {count}")
        for (target, jack), count in Counter((cable.target, cable.jack) for cable in self.cables).items():
            if jack.isdecimal() and count > INPUTS[int(jack)]:
                raise self._error(f"needs {count} inputs of weight {jack} at {target}, which has {INPUTS[int(jack)]}")

    def _error(self, text: str) -> ProgramError:
        return ProgramError(f"program {self.program.name}: {text}")

    @functools.cached_property
    def places(self) -> Mapping[str, str]:
        """Element of the machine by the name of ours: {"U2": "INT1"}."""
        counts: Counter[str] = Counter()
        names = {}
        kinds = [(each.name, _NAMES.get(each.stage.kind, "")) for each in self.program.patch]
        for name, kind in [*kinds, *((each.name, "INV") for each in inverters(self.program))]:
            counts[kind] += 1
            names[name] = f"{kind}{counts[kind]}"
        return names

    @property
    def delay(self) -> float:
        """Number by which the machine is slower than ours."""
        return max(self._rate(each) for each in self.program.patch if each.farad)

    @property
    def speed(self) -> float:
        """Seconds of the plant in a second of the machine."""
        return self.program.equations.speed / self.delay

    @property
    def slow(self) -> tuple[str, ...]:
        places = self.places
        return tuple(places[each.name] for each in self.program.patch if each.farad and self._is_slow(each))

    @functools.cached_property
    def cables(self) -> tuple[Cable, ...]:
        """Connections in the order of the patch."""
        return tuple(self._cables())

    def _cables(self) -> Iterator[Cable]:
        nodes = {each.node: self.places[each.name] for each in self.program.patch}
        nodes |= {name.lower(): place for name, place in self.places.items() if place.startswith("INV")}
        nodes |= {node: name for name, node in self.program.input_nodes.items()} | {"refp": "+1", "refm": "-1"}
        for element in self.program.patch:
            weight = 1.0
            if element.farad:
                weight = self._rate(element) / self.delay / (_SLOW if self._is_slow(element) else 1.0)
            sources = [nodes[cord.node] for cord in element.cords]
            if element.stage.kind is StageKind.PRODUCT:
                sources = self._factors(element, nodes)
            for i, cord in enumerate(element.cords):
                coefficient = self.program.pot_coefficient(cord.pot, self.program.values) if cord.pot else 1.0
                cable = Cable(sources[i], coefficient, cord.pot, self.places[element.name], "XY"[i % 2])
                if element.stage.kind is not StageKind.PRODUCT:
                    cable = _weighted(cable, cord.gain * weight)
                yield cable
        for each in inverters(self.program):
            yield Cable(nodes[each.node], 1.0, "", self.places[each.name], "1")

    def _factors(self, element: PatchedElement, nodes: Mapping[str, str]) -> list[str]:
        """Sources of a multiplier; one comes from the other side of an inverter where our multiplier inverts."""
        sources = [nodes[cord.node] for cord in element.cords]
        if math.prod(cord.sign for cord in element.cords) == element.sign:
            return sources
        opposite = {each.node: each.name.lower() for each in inverters(self.program)}
        opposite |= {name: node for node, name in opposite.items()}
        for i, cord in enumerate(element.cords):
            if cord.node in opposite:
                sources[i] = nodes[opposite[cord.node]]
                return sources
        raise self._error(f"needs an inverter before {self.places[element.name]}, and our patch has none there")

    def _rate(self, element: PatchedElement) -> float:
        """Rate of one of our integrators over that of the machine's, both at weight 1."""
        return 1.0 / (INPUT_OHM * element.farad) / _K0

    def _is_slow(self, element: PatchedElement) -> bool:
        return self._rate(element) <= self.delay * _SLOW * (1.0 + 1e-9)

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Coefficient on the way of each cable; empty if there is none."""
        counts = itertools.accumulate(int(cable.coefficient < 1.0) for cable in self.cables)
        return tuple(
            f"COEF{count}" if cable.coefficient < 1.0 else "" for cable, count in zip(self.cables, counts, strict=True)
        )

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Outputs of the elements in use."""
        program, places = self.program, self.places
        own = [(e.name, signed(e.sign, e.stage.name), e.full) for e in program.patch]
        own += [(e.name, signed(-e.sign, e.quantity), program.fulls[e.quantity]) for e in inverters(program)]
        return tuple(Output(places[name], quantity, full, name) for name, quantity, full in own)

    @property
    def head(self) -> tuple[str, str]:
        """Title and speed."""
        return f"{self.program.name} on {MACHINE}", f"1 s of the machine is {self.speed:g} s of the plant."

    def text(self) -> str:
        """Text of the sheet."""
        rows: list[Sequence[str]] = [("cable", "from", "coefficient", "set to", "pot", "to", "jack")]
        for number, (cable, coefficient) in enumerate(zip(self.cables, self.coefficients, strict=True), 1):
            through = (coefficient, f"{cable.coefficient:.4f}", cable.pot or "none") if coefficient else ("", "", "")
            rows.append((str(number), cable.source, *through, cable.target, cable.jack))
        outputs = [("element", "output", "full scale", "in our patch")]
        outputs += [(each.place, each.quantity, f"{each.full:g}", each.name) for each in self.outputs]
        parts = [self.head, ["Elements: 10 V stand for the full scale.", *table(iter(outputs))]]
        parts.append(["Cables; set each coefficient with its cable plugged in", *table(iter(rows))])
        if self.slow:
            parts.append([f"Also from the output to SLOW: {', '.join(self.slow)}"])
        return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _weighted(cable: Cable, weight: float) -> Cable:
    """Cable into the input of this weight; a smaller one than 1 becomes part of the coefficient."""
    power = max(0, math.ceil(math.log10(weight) - 1e-9))
    jack = 10**power
    return replace(cable, jack=str(jack), coefficient=cable.coefficient * weight / jack)
