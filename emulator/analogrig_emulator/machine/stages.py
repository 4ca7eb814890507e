"""Stages of a patch: equations as summers, integrators, multipliers and their cords.

Each equation becomes a sum of terms, number x powers of parameters x signals. Parameters common to all terms of a
derivative stay outside: a summer, one pot, the integrator. So a change of J or L turns one pot.
"""

from __future__ import annotations

import enum
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, assert_never

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.exceptions import ProgramError
from analogrig_emulator.machine.formula import (
    CONSTANTS,
    Formula,
    FunctionCall,
    Name,
    Negative,
    Operation,
    Power,
    constant_value,
    function_edits,
)
from analogrig_emulator.machine.program_file import Equation, Equations, Points, at_place

REFERENCE = "1"
"""Source of a cord from the reference voltage."""

Factors = tuple[tuple[str, int], ...]
"""Parameters, or formulas of parameters alone, each with its power; sorted."""

_Terms = dict[tuple[Factors, tuple[str, ...]], float]
"""Number by factors and signals."""

_MOST_TERMS = 64


class StageKind(enum.Enum):
    """Computing element of a stage.

    letter: first of its name in a patch, U for an amplifier; symbol: in a square of a drawing, empty for a triangle;
    adds: True if its cords have coefficients.
    """

    INTEGRATOR = "integrator", "U", "", True
    SUMMER = "summer", "U", "", True
    RECTIFIER = "half-wave rectifier", "U", "max", False
    PRODUCT = "multiplier", "X", "×", False
    QUOTIENT = "divider", "U", "÷", False
    ROOT = "square root", "U", "√", False
    FUNCTION = "function generator", "D", "f", False

    def __init__(self, title: str, letter: str, symbol: str, adds: bool) -> None:  # noqa: FBT001
        self.title, self.letter, self.symbol, self.adds = title, letter, symbol, adds

    @property
    def has_amplifier(self) -> bool:
        """True if an amplifier puts out the quantity, inverted; otherwise its sign is free."""
        return self.letter == "U"


@dataclass(frozen=True)
class Cord:
    """Connection into a stage: number x factors x source."""

    source: str
    number: float = 1.0
    factors: Factors = ()

    @property
    def text(self) -> str:
        """Term of a formula, with its sign; the number is rounded for people."""
        return self._text("g")

    @property
    def exact_text(self) -> str:
        """Term with all digits of its number."""
        return self._text("")

    def _text(self, digits: str) -> str:
        above = [_power_text(name, power) for name, power in self.factors if power > 0]
        below = [_power_text(name, -power) for name, power in self.factors if power < 0]
        if abs(self.number) != 1:
            above.insert(0, format(abs(self.number), digits))
        if self.source != REFERENCE or not above:
            above.append(self.source if is_atom(self.source) else f"({self.source})")
        divisor = f"/({'*'.join(below)})" if len(below) > 1 else "".join(f"/{each}" for each in below)
        return f"{'-' if self.number < 0 else '+'} {'*'.join(above)}{divisor}"


@dataclass(frozen=True)
class PatchStage:
    """Stage that computes a quantity from its cords.

    An integrator adds its cords and integrates; a summer adds them. Cords of the other kinds have number 1 and no
    factors: rectifier max(0, a), product a b, quotient a / b, root of a, function of a. place: its equation.
    """

    name: str
    kind: StageKind
    cords: tuple[Cord, ...]
    place: str
    function: str = ""


@dataclass(frozen=True, eq=False)
class Stages:
    """Stages of a program, in an order in which they can be computed; composites: formulas of parameters by text."""

    equations: Equations
    stages: tuple[PatchStage, ...]
    composites: Mapping[str, Formula]

    @property
    def is_linear(self) -> bool:
        """True if summers and integrators solve the equations."""
        return all(stage.kind.adds for stage in self.stages)

    def factor(self, factors: Factors, values: Mapping[str, float]) -> float:
        """Product of factors. Raises ProgramError unless it is finite and positive."""
        product = 1.0
        for name, power in factors:
            if name in self.composites:
                with np.errstate(all="ignore"):
                    value = _computed(self.composites[name], values, self.equations.functions)
            else:
                value = values[name]
            if not 0 < value < math.inf:
                raise ProgramError(
                    f"{name} is {value:g} with {_settings(self.composites.get(name), values)}; "
                    "a pot needs it positive: change a value or range, or the sign in the equation"
                )
            product *= float(value) ** power
        return product

    def parameters_of(self, factors: Factors) -> list[str]:
        """Parameters in factors."""
        found: dict[str, None] = {}
        for name, _ in factors:
            inner = self.composites[name].names() if name in self.composites else (name,)
            found |= dict.fromkeys([each for each in inner if each in self.equations.parameters])
        return list(found)

    def add_signals(self, quantities: dict[str, Any], values: Mapping[str, float]) -> None:
        """Add the value of every stage but the integrators to the quantities, which hold inputs and states."""
        quantities.setdefault(REFERENCE, np.float64(1.0))
        for stage in self.stages:
            if stage.kind is not StageKind.INTEGRATOR:
                quantities[stage.name] = self._computed(stage, quantities, values)

    def total(
        self, stage: PatchStage, quantities: Mapping[str, NDArray[np.float64]], values: Mapping[str, float]
    ) -> NDArray[np.float64]:
        """Sum of a stage's cords."""
        terms = [self.factor(cord.factors, values) * cord.number * quantities[cord.source] for cord in stage.cords]
        return np.asarray(sum(terms))

    def _computed(
        self, stage: PatchStage, quantities: Mapping[str, NDArray[np.float64]], values: Mapping[str, float]
    ) -> NDArray[np.float64]:
        a = quantities[stage.cords[0].source] if stage.cords else np.float64(0.0)
        match stage.kind:
            case StageKind.RECTIFIER:
                return np.asarray(np.maximum(0.0, a))
            case StageKind.PRODUCT:
                with np.errstate(all="ignore"):
                    return np.asarray(a * quantities[stage.cords[1].source])
            case StageKind.QUOTIENT:
                with np.errstate(all="ignore"):
                    return np.asarray(a / quantities[stage.cords[1].source])
            case StageKind.ROOT:
                return np.asarray(np.sqrt(np.maximum(a, 0.0)))
            case StageKind.FUNCTION:
                return np.asarray(self.equations.functions[stage.function](a))
            case StageKind.SUMMER | StageKind.INTEGRATOR:
                return self.total(stage, quantities, values)
            case _:
                assert_never(stage.kind)


def stages_of(equations: Equations) -> Stages:
    """Stages that compute a program's equations.

    Raises ProgramError for a formula that no element computes, naming the formula and what to write instead.
    """
    builder = _Builder(equations)
    for line in equations.definitions:
        builder.add_definition(line)
    for line in equations.derivatives:
        builder.add_derivative(line)
    return Stages(equations, tuple(builder.stages.values()), builder.composites)


@dataclass
class _Builder:
    equations: Equations
    stages: dict[str, PatchStage] = field(default_factory=dict)
    composites: dict[str, Formula] = field(default_factory=dict)
    place: str = ""

    def add_definition(self, line: Equation) -> None:
        self.place = line.place
        self._add(line.name, StageKind.SUMMER, self._cords(self._terms(line.formula)))

    def add_derivative(self, line: Equation) -> None:
        self.place = line.place
        cords = self._cords(self._terms(line.formula))
        shared = set.intersection(*(set(cord.factors) for cord in cords)) if len(cords) > 1 else set()
        if shared:
            inner = tuple(
                Cord(cord.source, cord.number, tuple(each for each in cord.factors if each not in shared))
                for cord in cords
            )
            cords = (Cord(self._sum_of(inner), 1.0, tuple(sorted(shared))),)
        self._add(line.name, StageKind.INTEGRATOR, cords)

    def _add(self, name: str, kind: StageKind, cords: tuple[Cord, ...], function: str = "") -> str:
        self.stages.setdefault(name, PatchStage(name, kind, cords, self.place, function))
        return name

    # ---- terms

    def _terms(self, node: Formula) -> _Terms:
        if not any(name in self.equations.quantities for name in node.names()):
            return self._coefficient(node)
        match node:
            case Name():
                return {((), (node.text,)): 1.0}
            case Negative():
                return _scaled(self._terms(node.of), -1.0)
            case Operation():
                return self._combined(node.sign, self._terms(node.left), self._terms(node.right))
            case Power():
                return self._power(self._terms(node.base), node.power)
            case FunctionCall():
                return self._call(node.function, node.arguments)
        raise TypeError(type(node))

    def _combined(self, sign: str, one: _Terms, other: _Terms) -> _Terms:
        match sign:
            case "+":
                return _added(one, other)
            case "-":
                return _added(one, _scaled(other, -1.0))
            case "*":
                return self._product(one, other)
        return self._quotient(one, other)

    def _coefficient(self, node: Formula) -> _Terms:
        """Term of a formula without signals."""
        if all(name in CONSTANTS for name in node.names()):
            with at_place(self.place):
                return {((), ()): constant_value(node, self.equations.functions)}
        match node:
            case Negative():
                return _scaled(self._coefficient(node.of), -1.0)
            case Operation(sign="*" | "/"):
                return self._combined(node.sign, self._coefficient(node.left), self._coefficient(node.right))
            case Power():
                return self._power(self._coefficient(node.base), node.power)
        if not isinstance(node, Name):
            self.composites[node.text] = node
        return {(((node.text, 1),), ()): 1.0}

    def _product(self, one: _Terms, other: _Terms) -> _Terms:
        if len(one) * len(other) > _MOST_TERMS:
            raise ProgramError(
                f"{self.place}: more than {_MOST_TERMS} terms when multiplied out; name parts as signals"
            )
        product: _Terms = {}
        for (factors, signals), number in one.items():
            for (more, others), times in other.items():
                key = _joined(factors, more), tuple(sorted(signals + others))
                product[key] = product.get(key, 0.0) + number * times
        return _cleaned(product)

    def _power(self, base: _Terms, power: int) -> _Terms:
        if power < 0:
            return self._quotient({((), ()): 1.0}, self._power(base, -power))
        result: _Terms = {((), ()): 1.0}
        for _ in range(power):
            result = self._product(result, base)
        return result

    def _quotient(self, above: _Terms, below: _Terms) -> _Terms:
        if not below:
            raise ProgramError(f"{self.place}: a division by zero")
        if len(below) == 1:
            ((factors, signals), number), *_ = below.items()
            if number == 0.0:
                raise ProgramError(f"{self.place}: a division by zero")
            inverse: _Terms = {(tuple((name, -power) for name, power in factors), ()): 1.0 / number}
            if not signals:
                return self._product(above, inverse)
            return self._product(inverse, self._divided(above, self._chain(signals)))
        return self._divided(above, self._signal(below))

    def _divided(self, above: _Terms, divisor: str) -> _Terms:
        """Terms of a quotient with a signal below."""
        outside: _Terms = {((), ()): 1.0}
        if len(above) == 1:
            ((factors, signals), number), *_ = above.items()
            outside, above = {(factors, ()): number}, {((), signals): 1.0}
        dividend = self._signal(above)
        name = self._add(
            f"{_bracketed(dividend)}/{_bracketed(divisor)}", StageKind.QUOTIENT, (Cord(dividend), Cord(divisor))
        )
        return self._product(outside, {((), (name,)): 1.0})

    def _call(self, name: str, arguments: tuple[Formula, ...]) -> _Terms:
        terms = [self._terms(each) for each in arguments]
        if name in ("max", "min"):
            # max(a, b) = a + max(0, b - a); min(a, b) = a - max(0, a - b).
            sign = 1.0 if name == "max" else -1.0
            one, other = terms
            return _added(one, _scaled(self._rectified(_scaled(_added(other, _scaled(one, -1.0)), sign)), sign))
        if name == "abs":
            return _added(_scaled(self._rectified(terms[0]), 2.0), _scaled(terms[0], -1.0))
        source = self._signal(terms[0])
        if name == "sqrt":
            return {((), (self._add(f"sqrt({source})", StageKind.ROOT, (Cord(source),)),)): 1.0}
        if name in self.equations.functions:
            return {((), (self._add(f"{name}({source})", StageKind.FUNCTION, (Cord(source),), name),)): 1.0}
        raise ProgramError(
            f"{self.place}: {name}({source}): no element computes {name} of a signal",
            edits=function_edits(name),
            otherwise="write [functions] with points",
        )

    def _rectified(self, terms: _Terms) -> _Terms:
        if not terms:
            return {}
        source = self._signal(terms)
        return {((), (self._add(f"max(0, {source})", StageKind.RECTIFIER, (Cord(source),)),)): 1.0}

    # ---- signals

    def _signal(self, terms: _Terms) -> str:
        """Name of the stage that computes these terms, made if there is none."""
        cords = self._cords(terms)
        return cords[0].source if cords == (Cord(cords[0].source),) else self._sum_of(cords)

    def _sum_of(self, cords: tuple[Cord, ...]) -> str:
        if cords == (Cord(cords[0].source),):
            return cords[0].source
        name = sum_text(cords)
        if name in self.stages and self.stages[name].cords != cords:
            name = sum_text(cords, exact=True)
        return self._add(name, StageKind.SUMMER, cords)

    def _cords(self, terms: _Terms) -> tuple[Cord, ...]:
        if not terms:
            raise ProgramError(f"{self.place}: the right side is zero; delete this equation and its quantity")
        return tuple(Cord(self._chain(signals), number, factors) for (factors, signals), number in terms.items())

    def _chain(self, signals: tuple[str, ...]) -> str:
        """Name of the product of signals, multiplied from left to right."""
        if not signals:
            return REFERENCE
        name = signals[0]
        for other in signals[1:]:
            product = f"{_bracketed(name)}*{_bracketed(other)}"
            name = self._add(product, StageKind.PRODUCT, (Cord(name), Cord(other)))
        return name


def sum_text(cords: Iterable[Cord], *, exact: bool = False) -> str:
    """Formula of a sum of cords."""
    text = " ".join(cord.exact_text if exact else cord.text for cord in cords)
    return text.removeprefix("+ ").replace("- ", "-", text.startswith("- "))


def _power_text(name: str, power: int) -> str:
    return (name if is_atom(name) else f"({name})") + (f"**{power}" if power != 1 else "")


def is_atom(text: str) -> bool:
    """True if no operator stands outside the brackets of a text."""
    depth = 0
    for sign in text:
        depth += (sign == "(") - (sign == ")")
        if not depth and not (sign.isalnum() or sign in "_)"):
            return False
    return True


def _bracketed(text: str) -> str:
    return text if is_atom(text) or re.fullmatch(r"[\w*]+", text) else f"({text})"


def _joined(one: Factors, other: Factors) -> Factors:
    powers = dict(one)
    for name, power in other:
        powers[name] = powers.get(name, 0) + power
    return tuple(sorted((name, power) for name, power in powers.items() if power))


def _scaled(terms: _Terms, number: float) -> _Terms:
    return {key: number * value for key, value in terms.items()}


def _added(one: _Terms, other: _Terms) -> _Terms:
    total = dict(one)
    for key, number in other.items():
        total[key] = total.get(key, 0.0) + number
    return _cleaned(total)


def _cleaned(terms: _Terms) -> _Terms:
    return {key: number for key, number in terms.items() if number}


def _computed(node: Formula, values: Mapping[str, float], functions: Mapping[str, Points]) -> float:
    try:
        return float(node.law(functions)(values))
    except (ArithmeticError, ValueError):
        return np.nan


def _settings(node: Formula | None, values: Mapping[str, float]) -> str:
    names = [] if node is None else [name for name in node.names() if name in values]
    return ", ".join(f"{name} = {values[name]:g}" for name in dict.fromkeys(names))
