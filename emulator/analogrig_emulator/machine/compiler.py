"""Compiler from equations to a patch: amplitude and time scaling, pots, polarities, netlist.

Scaling as an operator does it: 10 V stand for the full scale of a quantity, from the file or 1.2 times its peak in the
trial play. No quantity may exceed 12 V in that play. A cord of coefficient up to 1 is a pot into 100k, up to 10 a pot
into 10k, and beyond that it is refused. Coefficients suffice for the range of every parameter. Where a pot would come
near an end of its track, which real parts do not reach, another resistor moves it away.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from typing import assert_never

from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.elements import GROUND, Capacitor, DiodeLimiter, OpAmp, Pot, Resistor, VoltageSource
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.circuit.opamp import IDEAL
from analogrig_emulator.engine.system import Law
from analogrig_emulator.exceptions import Edit, ProgramError, UnfitError
from analogrig_emulator.machine.patched_program import (
    MACHINE_V,
    PatchedCord,
    PatchedElement,
    PatchedProgram,
)
from analogrig_emulator.machine.polarity import cord_sign, inverted, signs_of
from analogrig_emulator.machine.program_circuit import SOURCE
from analogrig_emulator.machine.program_file import Equations
from analogrig_emulator.machine.rehearsal import rehearsed, unfit
from analogrig_emulator.machine.stages import (
    REFERENCE,
    Cord,
    PatchStage,
    StageKind,
    Stages,
    stages_of,
)
from analogrig_emulator.machine.trial import Reach, reaches

LINEAR_V = 12.0
"""Greatest voltage in a trial play: amplifiers are linear up to there."""

INPUT_OHM = 100e3
GAIN_10_OHM = 10e3
INVERTER_OHM = 10e3
TRACK_OHM = 10e3

_CAPACITORS_FARAD = (1e-6, 1e-7, 1e-8, 1e-9)
_LOOP_FARAD = 47e-12
"""Capacitor across an amplifier with a multiplier in its loop: without it the loop rings."""


_BARRED_V = 0.05
"""Voltage beyond zero at which a root's diode conducts: at zero itself it would switch without end at rest."""

_OFF_OHM = 1e15
"""Resistance of an open limiter. 1e12 ohm leaks 1e-7 of a force, which a few impacts enlarge to 0.1 LSB."""

_ON_OHM = 1e3
_HEADROOM = 1.2
_ROUND = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)

_LEAST_COEFFICIENT = 2e-4
"""One winding of a pot's 5000."""

TRACK = (1e-3, 0.995)
"""Coefficients of a pot that real parts of any draw reach: the stops, the wiper and the loads take the rest."""

_GAINS = (1, 10, 0.1, 2, 5, 0.5, 0.2, 20, 0.05, 0.02, 0.01)
"""Gains of an input, in the order in which they are tried: 100k over its resistor."""

_SLOW = 0.1
"""Coefficient with the largest capacitor below which an integrator gains by more speed."""

_MOST_REHEARSALS = 5
_LONGEST_SHOWN = 32
_MOST_CORNERS = 6
_EXACT = 1e-9


def compile_equations(equations: Equations) -> PatchedProgram:
    """Patch that solves the equations.

    Raises ProgramError naming the term that cannot be patched, with edits that may cure it, none of them tried.
    """
    stages = stages_of(equations)
    _check_driven(stages)
    program = _patched(stages, reaches(stages))
    if stages.is_linear or all(row.full is not None for row in equations.states.values()):
        return program
    try:
        return _rescaled(program)
    except UnfitError:
        # A root or quotient whose argument has the wrong sign runs away on amplifiers without limits; real ones clip.
        if any(each.kind in (StageKind.QUOTIENT, StageKind.ROOT) for each in stages.stages):
            return program
        raise


def _patched(stages: Stages, reach: Mapping[str, Reach]) -> PatchedProgram:
    return _Patcher(stages, reach, _Scaling(stages, reach).fulls()).program()


def _rescaled(program: PatchedProgram) -> PatchedProgram:
    """The program with full scales that also hold what its quantities reach on machines of real parts."""
    equations = program.equations
    declared = [name for name, row in (*equations.states.items(), *equations.signals.items()) if row.full is not None]
    for _ in range(_MOST_REHEARSALS):
        most = {
            name: full * (LINEAR_V / MACHINE_V if name in declared else 1.0) for name, full in program.fulls.items()
        }
        beyond = {name: each for name, each in rehearsed(program).items() if each.peak > most[name] * (1 + _EXACT)}
        if not beyond:
            return program
        program = _patched(program.stages, {**program.reach, **beyond})
    raise unfit(program)


def _check_driven(stages: Stages) -> None:
    """Raise ProgramError for a state on which no input and no constant acts: it starts at 0 and stays there."""
    driven = {REFERENCE, *stages.equations.inputs}
    rows = list(stages.stages)
    while found := [row for row in rows if _is_driven(stages, row, driven)]:
        driven |= {row.name for row in found}
        rows = [row for row in rows if row.name not in driven]
    states = [row for row in rows if row.kind is StageKind.INTEGRATOR]
    if states:
        names = ", ".join(row.name for row in states)
        stay = "stays" if len(states) == 1 else "stay"
        raise ProgramError(
            f"{states[0].place}: no input acts on {names}, which {stay} at 0, where states start; "
            "add a term with an input, or delete the line"
        )


def _is_driven(stages: Stages, row: PatchStage, driven: AbstractSet[str]) -> bool:
    """True if a stage leaves 0 while its driven sources do: a product needs all of them, a quotient its dividend."""
    sources = [cord.source in driven for cord in row.cords]
    match row.kind:
        case StageKind.PRODUCT:
            return all(sources)
        case StageKind.QUOTIENT:
            return sources[0]
        case StageKind.FUNCTION:
            return any(sources) or bool(stages.equations.functions[row.function](0.0) != 0.0)
    return any(sources)


@dataclass
class _Scaling:
    """Full scale of every quantity."""

    stages: Stages
    reach: Mapping[str, Reach]
    found: dict[str, float] = field(default_factory=lambda: {REFERENCE: 1.0})

    def fulls(self) -> dict[str, float]:
        equations = self.stages.equations
        for name, quantity in equations.inputs.items():
            self.found[name] = quantity.full or 0.0
        for name, quantity in equations.states.items():
            self.found[name] = self._declared(f"states.{name}", name, quantity.full)
        for stage in self.stages.stages:
            self.found[stage.name] = self._full(stage)
        return self.found

    def _declared(self, place: str, name: str, full: float | None) -> float:
        """Full scale from the file, or from the trial play."""
        peak = self.reach[name].peak
        if full is None:
            if not peak:
                raise ProgramError(
                    f"{place}: {name} stays at 0 in the trial play",
                    edits=[{full_place(self.stages.equations, name): full} for full in (1.0, 0.1, 10.0)],
                    otherwise="raise the trial levels of the inputs, or delete it",
                )
            return _rounded_up(_HEADROOM * peak)
        if peak > full * LINEAR_V / MACHINE_V:
            raise ProgramError(
                f"{place}: {name} reaches {peak:.4g} in the trial play, {peak / full * MACHINE_V:.3g} V at full scale "
                f"{full:g}",
                edits=[self._raised_scales(headroom) for headroom in (1.0, _HEADROOM, 2.0, 4.0)],
                otherwise="lower the trial levels of the inputs, or narrow a range",
            )
        return full

    def _raised_scales(self, headroom: float) -> Edit:
        """Full scales for all quantities that exceed theirs in the trial play."""
        equations = self.stages.equations
        peaks = {
            name: (row.full, self.reach[name].peak)
            for name, row in (*equations.states.items(), *equations.signals.items())
        }
        return {
            full_place(equations, name): _rounded_up(headroom * peak)
            for name, (full, peak) in peaks.items()
            if full is not None and peak > full * LINEAR_V / MACHINE_V
        }

    def _full(self, stage: PatchStage) -> float:
        sources = [self.found[cord.source] for cord in stage.cords]
        match stage.kind:
            case StageKind.INTEGRATOR:
                return self.found[stage.name]
            case StageKind.RECTIFIER | StageKind.PRODUCT:
                return math.prod(sources)
            case StageKind.ROOT:
                return math.sqrt(sources[0])
            case StageKind.SUMMER | StageKind.QUOTIENT | StageKind.FUNCTION:
                declared = self.stages.equations.signals.get(stage.name)
                full = self._declared(stage.place, stage.name, declared.full if declared else None)
                return full if declared and declared.full else self._raised(stage, full, sources)
            case _:
                assert_never(stage.kind)

    def _raised(self, stage: PatchStage, full: float, sources: Sequence[float]) -> float:
        """Full scale raised until no coefficient exceeds 10."""
        if stage.kind is StageKind.QUOTIENT:
            return max(full, _rounded_up(sources[0] / sources[1] / 10.0))
        if stage.kind is StageKind.SUMMER:
            most = [extremes(self.stages, cord, stage.place)[1] * self.found[cord.source] for cord in stage.cords]
            return max(full, _rounded_up(max(most) / 10.0))
        return full


def full_place(equations: Equations, name: str) -> tuple[str, ...]:
    """Place of a quantity's full scale in the file."""
    return "states" if name in equations.states else "signals", name, "full"


def extremes(stages: Stages, cord: Cord, place: str) -> tuple[float, float]:
    """Least and greatest magnitude of a cord's coefficient in the plant's units, over the ranges of parameters."""
    parameters = stages.equations.parameters
    names = stages.parameters_of(cord.factors)
    if len(names) > _MOST_CORNERS:
        raise ProgramError(f"{place}: term {cord.text} has {len(names)} parameters; name parts of it as signals")
    found = []
    for corner in itertools.product(*(dict.fromkeys((parameters[name].low, parameters[name].high)) for name in names)):
        try:
            factor = stages.factor(cord.factors, stages.equations.values | dict(zip(names, corner, strict=True)))
        except ProgramError as cause:
            raise ProgramError(f"{place}: {cause}") from cause
        found.append(abs(cord.number) * factor)
    return min(found), max(found)


class _Patcher:
    """Elements of a patch, stage by stage."""

    def __init__(self, stages: Stages, reach: Mapping[str, Reach], fulls: Mapping[str, float]) -> None:
        self._stages, self._reach, self._fulls = stages, reach, fulls
        rows = stages.stages
        self._divisor_signs = {
            stage.name: 1 if reach[stage.cords[1].source].low > 0 else -1
            for stage in rows
            if stage.kind is StageKind.QUOTIENT
        }
        self._inputs = list(stages.equations.inputs)
        self._signs = signs_of(rows, self._inputs, self._divisor_signs)
        self._nodes: dict[tuple[str, int], str] = {}
        self._elements: list[Element] = []
        self._ideal: dict[str, Mapping[str, Element | None]] = {}
        self._amplifiers: dict[str, int] = {}
        self._inverters: dict[str, int] = {}
        self._uses = Counter(
            name for stage in rows for cord in stage.cords for name in stages.parameters_of(cord.factors)
        )
        """Number of cords by parameter."""
        self._pots: list[str] = []
        self._pot_numbers = itertools.count(1)

    def program(self) -> PatchedProgram:
        rows = self._stages.stages
        inverters = inverted(rows, self._signs, self._divisor_signs)
        self._number(rows, inverters)
        for place, name in enumerate(self._inputs):
            self._elements.append(VoltageSource(SOURCE if not place else f"{SOURCE}{place + 1}", self._nodes[name, 1]))
        references = [(stage, cord) for stage in rows for cord in stage.cords if cord.source == REFERENCE]
        for sign in sorted({self._source_sign(*each) for each in references}, reverse=True):
            name = "REFP" if sign > 0 else "REFM"
            self._nodes[REFERENCE, sign] = name.lower()
            self._elements.append(VoltageSource(name, name.lower(), dc_v=sign * MACHINE_V))
        patch = [self._patched(stage) for stage in rows]
        for name in inverters:
            self._invert(name)
        equations = self._stages.equations
        return PatchedProgram(
            equations=equations,
            stages=self._stages,
            fulls=self._fulls,
            reach=self._reach,
            patch=tuple(patch),
            inverters={name: f"U{self._inverters[name]}" for name in inverters},
            input_nodes={name: self._nodes[name, 1] for name in self._inputs},
            elements=tuple(self._elements),
            ideal=self._ideal,
        )

    # ---- names

    def _number(self, rows: Sequence[PatchStage], inverters: Sequence[str]) -> None:
        """Give every output its node."""
        for place, name in enumerate(self._inputs):
            self._nodes[name, 1] = "in" if not place else f"in{place + 1}"
        counts: Counter[str] = Counter()
        for stage in rows:
            letter = stage.kind.letter
            counts[letter] += 1
            self._nodes[stage.name, self._signs[stage.name]] = f"{letter}{counts[letter]}".lower()
            if stage.kind.has_amplifier:
                self._amplifiers[stage.name] = counts[letter]
        for number, name in enumerate(inverters, len(self._amplifiers) + 1):
            self._inverters[name] = number
            self._nodes[name, -self._signs[name]] = f"u{number}"

    def _pot_name(self, cord: Cord) -> str:
        """Name of the parameter, if it turns this pot alone; else P1, P2, ..."""
        names = self._stages.parameters_of(cord.factors)
        taken = {pot.lower() for pot in self._pots}
        if len(names) == 1 and self._uses[names[0]] == 1 and not _reserved(names[0]) and names[0].lower() not in taken:
            name = names[0]
        else:
            name = f"P{next(self._pot_numbers)}"
        self._pots.append(name)
        return name

    def _source_sign(self, stage: PatchStage, cord: Cord) -> int:
        """Sign at which a cord takes its source."""
        relative = cord_sign(stage.kind, cord.number, self._divisor_signs.get(stage.name, 1))
        return relative * self._signs[stage.name] if relative else self._signs.get(cord.source, 1)

    # ---- stages

    def _patched(self, stage: PatchStage) -> PatchedElement:
        match stage.kind:
            case StageKind.PRODUCT:
                return self._multiplier(stage)
            case StageKind.FUNCTION:
                return self._function(stage)
            case StageKind.INTEGRATOR:
                return self._integrator(stage)
            case StageKind.SUMMER:
                return self._summer(stage)
            case StageKind.RECTIFIER:
                return self._rectifier(stage)
            case StageKind.QUOTIENT | StageKind.ROOT:
                return self._divider_or_root(stage)
            case _:
                assert_never(stage.kind)

    def _summer(self, stage: PatchStage) -> PatchedElement:
        cords = [self._cord(stage, place, self._ratio(stage, cord)) for place, cord in enumerate(stage.cords)]
        number = self._amplifiers[stage.name]
        self._elements.append(Resistor(f"R{number}FB", f"s{number}", f"u{number}", INPUT_OHM))
        return self._amplifier(stage, cords)

    def _integrator(self, stage: PatchStage) -> PatchedElement:
        speed = self._stages.equations.speed
        rates = [speed * self._ratio(stage, cord) for cord in stage.cords]
        most = [
            rate * extremes(self._stages, cord, stage.place)[1] for rate, cord in zip(rates, stage.cords, strict=True)
        ]
        farad = next((each for each in _CAPACITORS_FARAD if max(most) * INPUT_OHM * each <= 1 + _EXACT), None)
        farad = _CAPACITORS_FARAD[-1] if farad is None else farad
        self._check_speed(stage, max(most) * GAIN_10_OHM * farad)
        cords = [self._cord(stage, place, rate * INPUT_OHM * farad) for place, rate in enumerate(rates)]
        number = self._amplifiers[stage.name]
        self._elements.append(Capacitor(f"C{number}", f"s{number}", f"u{number}", farad))
        return replace(self._amplifier(stage, cords), farad=farad)

    def _check_speed(self, stage: PatchStage, coefficient: float) -> None:
        if coefficient > 1 + _EXACT:
            speed = self._stages.equations.speed
            raise ProgramError(
                f"{stage.place}: integrator of {stage.name} needs a coefficient of {10 * coefficient:.3g} with 1 nF, "
                "beyond 10",
                edits=[self._speed_edit(speed / coefficient * each) for each in (1.0, 0.5, 0.1)],
                otherwise=f"lower the speed, or raise the full scale of {stage.name}",
            )

    @staticmethod
    def _speed_edit(most: float) -> Edit:
        """Speed of at most a value, in two digits."""
        step = 10.0 ** (math.floor(math.log10(most)) - 1)
        return {("speed",): float(f"{math.floor(most / step + _EXACT) * step:.2g}")}

    def _rectifier(self, stage: PatchStage) -> PatchedElement:
        number, cord = self._amplifiers[stage.name], stage.cords[0]
        sign = self._source_sign(stage, cord)
        node, junction = self._nodes[cord.source, sign], f"s{number}"
        ends = (node, junction) if sign > 0 else (junction, node)
        name = f"L{number}"
        self._elements.append(DiodeLimiter(name, *ends, 0.0, INPUT_OHM, _OFF_OHM))
        self._elements.append(Resistor(f"R{number}FB", junction, f"u{number}", INPUT_OHM))
        return self._amplifier(stage, [PatchedCord(cord, node, sign, 1.0, 1, name)])

    def _divider_or_root(self, stage: PatchStage) -> PatchedElement:
        """Divider or root: the amplifier settles where its multiplier's product equals the first cord.

        An amplifier without a pole is a summer instead, before an element that divides or takes the root by itself.
        """
        number, dividend = self._amplifiers[stage.name], stage.cords[0]
        sign, junction, out = self._signs[stage.name], f"s{number}", f"u{number}"
        is_root = stage.kind is StageKind.ROOT
        other = stage.name if is_root else stage.cords[1].source
        other_sign = sign if is_root else self._signs[other]
        product_full = self._fulls[stage.name] * self._fulls[other]
        ratio = self._fulls[dividend.source] / product_full
        # Small resistors make the loop fast; a gain of 10 would make the input's too small for its source.
        ohm = INPUT_OHM if self._needs_gain(dividend, ratio, stage.place) else GAIN_10_OHM
        cords = [self._cord(stage, 0, ratio, ohm)]
        # The product must cancel the dividend's current.
        product_sign = -self._source_sign(stage, dividend)
        name, node = f"XU{number}", f"xu{number}"
        scale_v = MACHINE_V * sign * other_sign * product_sign
        divisor = self._nodes[other, other_sign]
        self._elements += [
            Multiplier(name, out, divisor, node, scale_v),
            Resistor(f"R{number}X", node, junction, ohm),
            Capacitor(f"C{number}", junction, out, _LOOP_FARAD),
        ]
        if is_root:  # The diode bars the other root, where the loop would latch up.
            ends = (junction, out) if sign > 0 else (out, junction)
            self._elements.append(DiodeLimiter(f"L{number}", *ends, _BARRED_V, _ON_OHM, _OFF_OHM))
        else:
            self._elements.append(Resistor(f"R{number}FB", junction, out, _OFF_OHM))
            cords.append(PatchedCord(stage.cords[1], divisor, other_sign, 1.0, 1, name))
        law, y = (Law.ROOT, node) if is_root else (Law.QUOTIENT, divisor)
        self._ideal[f"U{number}"] = {
            name: Multiplier(name, node, y, out, scale_v, law=law, sign=sign),
            f"C{number}": None,
            f"L{number}": None,
            f"R{number}FB": None,
            f"U{number}": OpAmp(f"U{number}", GROUND, junction, node, IDEAL),
        }
        return self._amplifier(stage, cords)

    def _needs_gain(self, cord: Cord, ratio: float, place: str) -> bool:
        """True if a resistor for gain 1 does not suffice for a cord with a pot away from the end of its track."""
        most = ratio * extremes(self._stages, cord, place)[1]
        is_fixed = not cord.factors and abs(ratio * abs(cord.number) - 1) <= _EXACT
        return most > (1 + _EXACT if is_fixed or self._stages.equations.stops else TRACK[1])

    def _multiplier(self, stage: PatchStage) -> PatchedElement:
        sign, node = self._output(stage)
        one, other = (self._direct(stage, cord) for cord in stage.cords)
        self._elements.append(
            Multiplier(node.upper(), one.node, other.node, node, MACHINE_V * sign * one.sign * other.sign)
        )
        return PatchedElement(node.upper(), stage, node, sign, self._fulls[stage.name], (one, other))

    def _function(self, stage: PatchStage) -> PatchedElement:
        sign, node = self._output(stage)
        cord = self._direct(stage, stage.cords[0])
        to_x = cord.sign * MACHINE_V / self._fulls[cord.cord.source]
        to_y = sign * MACHINE_V / self._fulls[stage.name]
        points = [(to_x * x, to_y * y) for x, y in self._stages.equations.functions[stage.function].points]
        self._elements.append(Function(node.upper(), cord.node, node, tuple(sorted(points))))
        return PatchedElement(node.upper(), stage, node, sign, self._fulls[stage.name], (cord,))

    def _output(self, stage: PatchStage) -> tuple[int, str]:
        sign = self._signs[stage.name]
        return sign, self._nodes[stage.name, sign]

    def _direct(self, stage: PatchStage, cord: Cord) -> PatchedCord:
        sign = self._source_sign(stage, cord)
        return PatchedCord(cord, self._nodes[cord.source, sign], sign, 1.0, 1, "")

    def _invert(self, name: str) -> None:
        number, sign = self._inverters[name], self._signs[name]
        self._elements += [
            Resistor(f"R{number}_1", self._nodes[name, sign], f"s{number}", INVERTER_OHM),
            Resistor(f"R{number}FB", f"s{number}", f"u{number}", INVERTER_OHM),
            OpAmp(f"U{number}", GROUND, f"s{number}", f"u{number}", IDEAL),
        ]

    def _amplifier(self, stage: PatchStage, cords: Sequence[PatchedCord]) -> PatchedElement:
        number = self._amplifiers[stage.name]
        sign, node = self._output(stage)
        self._elements.append(OpAmp(f"U{number}", GROUND, f"s{number}", node, IDEAL))
        return PatchedElement(f"U{number}", stage, node, sign, self._fulls[stage.name], tuple(cords))

    # ---- cords

    def _ratio(self, stage: PatchStage, cord: Cord) -> float:
        """Volts at the stage by volt at the source, for a coefficient of 1 in the plant's units."""
        return self._fulls[cord.source] / self._fulls[stage.name]

    def _cord(self, stage: PatchStage, place: int, ratio: float, ohm: float = INPUT_OHM) -> PatchedCord:
        """Cord into an amplifier; ratio: coefficient by product of the cord's number and factors; ohm: for gain 1."""
        cord, number = stage.cords[place], self._amplifiers[stage.name]
        least, most = (ratio * each for each in extremes(self._stages, cord, stage.place))
        coefficient = ratio * abs(cord.number) * self._stages.factor(cord.factors, self._stages.equations.values)
        self._check_coefficient(stage, cord, coefficient, most)
        gain = self._gain(cord, coefficient, least, most)
        sign = self._source_sign(stage, cord)
        node, resistor = self._nodes[cord.source, sign], f"R{number}_{place + 1}"
        pot, top = "", node
        if cord.factors or abs(coefficient - gain) > _EXACT:
            pot = self._pot_name(cord)
            node = f"w_{pot}"
            self._elements.append(Pot(pot, top, node, GROUND, TRACK_OHM, 0.0))
        self._elements.append(Resistor(resistor, node, f"s{number}", ohm / gain))
        return PatchedCord(cord, top, sign, coefficient, gain, resistor, pot, ratio * abs(cord.number) / gain)

    def _gain(self, cord: Cord, coefficient: float, least: float, most: float) -> float:
        """Gain of a cord's resistor at which its pot stays away from the ends of the track.

        The pot stays away for the whole range if a gain allows it, else for the file's values.
        """
        usual = 1 if most <= 1 + _EXACT else 10
        if not cord.factors and abs(coefficient - usual) <= _EXACT:
            return usual
        spans = [(coefficient, coefficient)]
        if not self._stages.equations.stops:
            spans.insert(0, (least, most))
        for low, high in spans:
            for gain in (usual, *_GAINS):
                if TRACK[0] * gain <= low and high <= TRACK[1] * gain and most <= gain * (1 + _EXACT):
                    return gain
        return usual

    def _check_coefficient(self, stage: PatchStage, cord: Cord, coefficient: float, most: float) -> None:
        name = _clipped(stage.name)
        what = f"{stage.place}: term {_clipped(cord.text)} of {name}"
        if most > 10 * (1 + _EXACT):
            raise ProgramError(
                f"{what} needs a coefficient of {most:.3g}, and there are 10",
                edits=self._rescaled(stage, most / 10),
                otherwise=f"raise the full scale of {name}, or name parts of the formula as signals",
            )
        if coefficient < _LEAST_COEFFICIENT:
            slowest = self._slow_most(stage)
            slow = f"; the integrator is slow, at most {slowest:.2g} with 1 uF" if slowest < _SLOW else ""
            raise ProgramError(
                f"{what} has a coefficient of {coefficient:.2g}, below one winding of a pot ({_LEAST_COEFFICIENT:g})"
                f"{slow}",
                edits=[*self._faster(stage), *self._rescaled(stage, coefficient / _LEAST_COEFFICIENT)],
                otherwise=f"delete the term, or lower the full scale of {name}",
            )

    def _rescaled(self, stage: PatchStage, times: float) -> list[Edit]:
        """Full scale of so many times the present one, that of the trial play, and those of the trial play for all."""
        equations = self._stages.equations
        rows = {**equations.states, **equations.signals}
        every: list[Edit] = [{full_place(equations, name): None for name, row in rows.items() if row.full is not None}]
        if stage.name not in rows:
            return every
        place = full_place(equations, stage.name)
        return [{place: _rounded_up(self._fulls[stage.name] * times)}, {place: None}, *every]

    def _slow_most(self, stage: PatchStage) -> float:
        """Largest coefficient of an integrator with the largest capacitor; 1 for any other stage."""
        if stage.kind is not StageKind.INTEGRATOR:
            return 1.0
        rates = [self._ratio(stage, cord) * extremes(self._stages, cord, stage.place)[1] for cord in stage.cords]
        return self._stages.equations.speed * max(rates) * INPUT_OHM * _CAPACITORS_FARAD[0]

    def _faster(self, stage: PatchStage) -> list[Edit]:
        """Higher speeds of an integrator: its largest coefficient becomes one, or it moves more in the trial play."""
        if stage.kind is not StageKind.INTEGRATOR:
            return []
        most = self._slow_most(stage)
        usual = self._stages.equations.speed / (most if most < _SLOW else 0.1)
        return [self._speed_edit(usual * each) for each in (1.0, 5.0, 0.3, 50.0, 500.0)]


def _clipped(formula: str) -> str:
    """Formula for a message."""
    return formula if len(formula) <= _LONGEST_SHOWN else f"{formula[:_LONGEST_SHOWN]}..."


def _reserved(name: str) -> bool:
    """True if an element of the patch may be called so."""
    head, rest = name[:1].upper(), name[1:].upper()
    return (
        (head in "UXDRCLPF" and rest[:1].isdigit()) or name.upper() in (SOURCE, "REFP", "REFM") or "XU" in name.upper()
    )


def _rounded_up(value: float) -> float:
    """Next round number."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(step * decade for step in _ROUND if step * decade >= value * (1 - _EXACT))
