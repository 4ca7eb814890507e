"""Formulas of a program file: parsed by a whitelist, evaluated on numbers and arrays, checked for units.

Nothing is executed: Python's parser builds a tree, and only the nodes known here are taken over from it.
"""

from __future__ import annotations

import ast
import difflib
import keyword
import math
import operator
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from analogrig_emulator.exceptions import Edit, ProgramError
from analogrig_emulator.machine.units import NUMBER, Unit

_MOST_CHARACTERS = 1000
_MOST_PARTS = 400
_DEEPEST = 40
_MOST_POWER = 8
_OPERATOR_WORDS = frozenset({"and", "or", "not", "if", "else", "True", "False", "None"})
"""Python's keywords that make expressions, and can be no names. The others can, such as ``lambda``."""
_WORDS = re.compile(rf"\b(?:{'|'.join(keyword.kwlist)})\b")
_LARGEST = 1e100
_LEAST = 1e-100

Law = Callable[[Mapping[str, Any]], Any]
"""Formula as a function of the values by name, numbers or arrays."""

Tables = Mapping[str, Callable[[Any], Any]]
"""Functions of one argument that the file gives."""

TableUnits = Mapping[str, tuple[Unit | None, Unit | None]]
"""Units of argument and value of each table."""

Units = Mapping[str, Unit | None]

CONSTANTS: Mapping[str, float] = MappingProxyType({"pi": math.pi})
"""Numbers with a name."""


class FormulaFunction(NamedTuple):
    """Function of the formulas: number of arguments, and law."""

    arguments: int
    law: Callable[..., Any]


def _root(x: Any) -> Any:
    """Square root; 0 below 0, where rounding in a solver may lead."""
    return np.sqrt(np.maximum(x, 0.0))


FUNCTIONS: Mapping[str, FormulaFunction] = MappingProxyType(
    {
        "max": FormulaFunction(2, np.maximum),
        "min": FormulaFunction(2, np.minimum),
        "abs": FormulaFunction(1, np.abs),
        "sqrt": FormulaFunction(1, _root),
        "sin": FormulaFunction(1, np.sin),
        "cos": FormulaFunction(1, np.cos),
        "tan": FormulaFunction(1, np.tan),
        "exp": FormulaFunction(1, np.exp),
        "log": FormulaFunction(1, np.log),
        "tanh": FormulaFunction(1, np.tanh),
    }
)
"""Functions by name. The last six act on parameters alone: no element of the machine computes them."""

_OPERATORS: Mapping[type, tuple[str, Callable[[Any, Any], Any]]] = MappingProxyType(
    {
        ast.Add: ("+", operator.add),
        ast.Sub: ("-", operator.sub),
        ast.Mult: ("*", operator.mul),
        ast.Div: ("/", operator.truediv),
    }
)


TABLED: Mapping[str, Callable[[Any], Any]] = MappingProxyType(
    {
        **{name: FUNCTIONS[name].law for name in ("sin", "cos", "tan", "exp", "log", "tanh")},
        "sign": np.sign,
        "sgn": np.sign,
        "sat": lambda x: np.clip(x, -1.0, 1.0),
        "step": lambda x: np.heaviside(x, 0.5),
        "atan": np.arctan,
        "arctan": np.arctan,
        "sinh": np.sinh,
        "cosh": np.cosh,
    }
)
"""Functions that a table of points stands for where a signal is their argument."""

_SIZES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
_STEP = 0.02
"""Half the width of a jump in a table, in its size."""


def function_edits(name: str) -> list[Edit]:
    """Tables of points in place of a function, for arguments of several sizes, the smallest first."""
    if name not in TABLED:
        return []
    new = f"{name}_table" if name in FUNCTIONS else name
    edits: list[Edit] = []
    for size in _SIZES:
        low = 0.02 * size if name == "log" else -size
        places = np.linspace(low, size, 17)
        if name in ("sign", "sgn", "step", "sat"):
            bend = 1.0 if name == "sat" else _STEP * size
            places = np.array([-size, -bend, bend, size]) if bend < size else np.array([-size, size])
        with np.errstate(all="ignore"):
            points = [[float(f"{x:.4g}"), float(f"{TABLED[name](x):.4g}")] for x in places]
        if max(abs(y) for _, y in points) > _LARGEST:
            break
        edit: dict[tuple[str, ...], Any] = {("functions", new): {"points": points}}
        if new != name:
            edit["equations",] = {f"{name}(": f"{new}("}
        edits.append(edit)
    return edits


@dataclass(frozen=True)
class Formula(ABC):
    """Part of a formula, or all of it; text: as Python writes it."""

    text: str

    def __str__(self) -> str:
        return self.text

    @property
    def parts(self) -> tuple[Formula, ...]:
        """Formulas of which this one is made."""
        return ()

    def names(self) -> Iterator[str]:
        """Names of quantities, parameters and constants, in order."""
        for part in self.parts:
            yield from part.names()

    def divisors(self) -> Iterator[str]:
        """Names by which the formula divides, in order."""
        for part in self.parts:
            yield from part.divisors()

    @abstractmethod
    def law(self, tables: Tables) -> Law:
        """Function that computes the formula."""

    @abstractmethod
    def unit(self, units: Units, tables: TableUnits) -> Unit | None:
        """Unit; None where a name without unit, or the number 0, leaves it open.

        Raises ProgramError naming the two parts that do not fit.
        """


@dataclass(frozen=True)
class Number(Formula):
    """Number as written."""

    value: float

    def law(self, tables: Tables) -> Law:  # noqa: ARG002
        return lambda _: self.value

    def unit(self, units: Units, tables: TableUnits) -> Unit | None:  # noqa: ARG002
        return NUMBER if self.value else None


@dataclass(frozen=True)
class Name(Formula):
    """Name of a quantity, a parameter or a constant."""

    def names(self) -> Iterator[str]:
        yield self.text

    def law(self, tables: Tables) -> Law:  # noqa: ARG002
        if self.text in CONSTANTS:
            return lambda _: CONSTANTS[self.text]
        return operator.itemgetter(self.text)

    def unit(self, units: Units, tables: TableUnits) -> Unit | None:  # noqa: ARG002
        return units.get(self.text, NUMBER)


@dataclass(frozen=True)
class Negative(Formula):
    """Formula with a minus before it."""

    of: Formula

    @property
    def parts(self) -> tuple[Formula, ...]:
        return (self.of,)

    def law(self, tables: Tables) -> Law:
        inner = self.of.law(tables)
        return lambda values: -inner(values)

    def unit(self, units: Units, tables: TableUnits) -> Unit | None:
        return self.of.unit(units, tables)


@dataclass(frozen=True)
class Operation(Formula):
    """Sum, difference, product or quotient; sign: + - * or /."""

    sign: str
    left: Formula
    right: Formula

    @property
    def parts(self) -> tuple[Formula, ...]:
        return self.left, self.right

    def law(self, tables: Tables) -> Law:
        law = next(law for sign, law in _OPERATORS.values() if sign == self.sign)
        one, other = self.left.law(tables), self.right.law(tables)
        return lambda values: law(one(values), other(values))

    def unit(self, units: Units, tables: TableUnits) -> Unit | None:
        one, other = self.left.unit(units, tables), self.right.unit(units, tables)
        if self.sign in "+-":
            return _same_unit(self.left, one, self.right, other)
        if one is None or other is None:
            return None
        return one * other if self.sign == "*" else one / other

    def divisors(self) -> Iterator[str]:
        yield from super().divisors()
        if self.sign == "/":
            yield from self.right.names()


@dataclass(frozen=True)
class Power(Formula):
    """Integer power."""

    base: Formula
    power: int

    @property
    def parts(self) -> tuple[Formula, ...]:
        return (self.base,)

    def law(self, tables: Tables) -> Law:
        base, power = self.base.law(tables), self.power
        return lambda values: base(values) ** power

    def unit(self, units: Units, tables: TableUnits) -> Unit | None:
        base = self.base.unit(units, tables)
        return None if base is None else base**self.power


@dataclass(frozen=True)
class FunctionCall(Formula):
    """Function of FUNCTIONS, or one that the file gives, with its arguments."""

    function: str
    arguments: tuple[Formula, ...]

    @property
    def parts(self) -> tuple[Formula, ...]:
        return self.arguments

    def law(self, tables: Tables) -> Law:
        function = tables[self.function] if self.function in tables else FUNCTIONS[self.function].law
        inner = [each.law(tables) for each in self.arguments]
        return lambda values: function(*[each(values) for each in inner])

    def unit(self, units: Units, tables: TableUnits) -> Unit | None:
        argument = self.arguments[0]
        unit = argument.unit(units, tables)
        if self.function in ("max", "min"):
            other = self.arguments[1]
            return _same_unit(argument, unit, other, other.unit(units, tables))
        if self.function in ("abs", "sqrt"):
            return unit if unit is None or self.function == "abs" else unit.root()
        expected, result = tables.get(self.function, (NUMBER, NUMBER))
        if unit is not None and expected is not None and not unit.matches(expected):
            raise ProgramError(f"{self}: the argument is in {unit.text}, not in {expected.text}; correct a unit")
        return result


def _same_unit(left: Formula, one: Unit | None, right: Formula, other: Unit | None) -> Unit | None:
    if one is None or other is None:
        return one or other
    if not one.matches(other):
        cure = "make both units the same"
        if one.exponents == other.exponents:
            cure = "the dimension is the same, the size is not: write one unit for all, such as m and no mm"
        raise ProgramError(f"{left} is in {one.text} and {right} in {other.text}; {cure}")
    return one


def parse_formula(text: str, tables: Iterable[str] = ()) -> Formula:
    """Formula of names, numbers, + - * / **, brackets, FUNCTIONS and tables.

    Raises ProgramError naming the part that is not allowed.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ProgramError(f"formula of {len(text)} characters; write at most {_MOST_CHARACTERS}, name parts of it")
    if not text.strip():
        raise ProgramError("the formula is missing; write for instance (k*i - d*omega) / J")
    readable = _WORDS.sub(_as_name, text.strip())
    try:
        tree = ast.parse(readable, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as cause:
        raise ProgramError(_malformed(text.strip(), cause)) from None
    _check_size(tree)
    return _Reading(readable, frozenset(tables)).formula(tree)


def _as_name(word: re.Match[str]) -> str:
    """Spell a keyword with a bold first letter: no keyword to Python's parser, which reads it as the plain letter."""
    name = word[0]
    if name in _OPERATOR_WORDS:
        return name
    return chr(ord("\N{MATHEMATICAL BOLD SMALL A}") + ord(name[0]) - ord("a")) + name[1:]


def _malformed(text: str, cause: Exception) -> str:
    if "'" in text:
        return "a derivative stands within a formula; name its right side as a signal, and use that on both sides"
    if word := next((each for each in _WORDS.findall(text) if each in _OPERATOR_WORDS), None):
        return f"{word!r} is a reserved word and no name; choose another name"
    at = f" (character {cause.offset})" if isinstance(cause, SyntaxError) and cause.offset else ""
    return f"{text[:60]!r} is no formula{at}; write for instance (k*i - d*omega) / J"


def _check_size(tree: ast.expr) -> None:
    count, fringe = 0, [(tree, 1)]
    while fringe:
        node, depth = fringe.pop()
        count += 1
        if count > _MOST_PARTS or depth > _DEEPEST:
            raise ProgramError(
                f"formula of more than {_MOST_PARTS} parts or {_DEEPEST} levels; name parts of it as signals"
            )
        fringe += [(child, depth + 1) for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]


@dataclass(frozen=True)
class _Reading:
    """Translation of Python's tree into a Formula. text: what Python parsed."""

    text: str
    tables: frozenset[str]

    def formula(self, node: ast.expr) -> Formula:
        match node:
            case ast.Name(id=name):
                return Name(name)
            case ast.Constant(value=value):
                return self._number(node, value)
            case ast.UnaryOp(op=op, operand=operand):
                return self._signed(node, op, self.formula(operand))
            case ast.BinOp():
                return self._operation(node)
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(node, name, arguments)
        raise _not_allowed(node)

    def _number(self, node: ast.expr, value: object) -> Number:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ProgramError(f"{ast.unparse(node)[:40]} is no number")
        written = ast.get_source_segment(self.text, node) or ""
        if not abs(value) <= _LARGEST:
            raise ProgramError(f"number {written[:20]} exceeds {_LARGEST:g}; scale the quantities")
        if abs(value) < _LEAST and re.search("[1-9]", re.split("[eE]", written)[0]):
            raise ProgramError(f"number {written[:20]} is smaller than {_LEAST:g}; write 0, or scale the quantities")
        return Number(ast.unparse(node), float(value))

    def _signed(self, node: ast.expr, op: ast.unaryop, operand: Formula) -> Formula:
        if isinstance(op, ast.UAdd):
            return operand
        if isinstance(op, ast.USub):
            return Negative(ast.unparse(node), operand)
        raise _not_allowed(node)

    def _operation(self, node: ast.BinOp) -> Formula:
        if isinstance(node.op, ast.BitXor):
            raise ProgramError("^ is no operator here; write ** for a power")
        if isinstance(node.op, ast.Pow):
            return Power(ast.unparse(node), self.formula(node.left), _power(node.right))
        if type(node.op) not in _OPERATORS:
            raise _not_allowed(node)
        sign, _ = _OPERATORS[type(node.op)]
        return Operation(ast.unparse(node), sign, self.formula(node.left), self.formula(node.right))

    def _call(self, node: ast.expr, name: str, arguments: list[ast.expr]) -> Formula:
        if name not in self.tables and name not in FUNCTIONS:
            known = [*FUNCTIONS, *sorted(self.tables)]
            raise ProgramError(
                f"unknown function {name!r}",
                edits=function_edits(name) or spellings(name, known, "("),
                otherwise=f"there are {', '.join(known)}; write others as points, [functions.NAME]",
            )
        wanted = 1 if name in self.tables else FUNCTIONS[name].arguments
        if len(arguments) != wanted:
            raise ProgramError(f"{name} takes {wanted} argument{'s' * (wanted > 1)}, not {len(arguments)}")
        return FunctionCall(ast.unparse(node), name, tuple(self.formula(each) for each in arguments))


def _not_allowed(node: ast.expr) -> ProgramError:
    return ProgramError(
        f"{ast.unparse(node)[:40]!r} is not allowed; there are names, numbers, + - * / ** and {', '.join(FUNCTIONS)}"
    )


def _power(node: ast.expr) -> int:
    sign, inner = (-1, node.operand) if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) else (1, node)
    power = inner.value if isinstance(inner, ast.Constant) else None
    if isinstance(power, bool) or not isinstance(power, int) or power > _MOST_POWER:
        raise ProgramError(
            f"power {ast.unparse(node)[:20]}: write an integer from {-_MOST_POWER} to {_MOST_POWER}, or sqrt()"
        )
    return sign * power


def constant_value(formula: Formula, tables: Tables) -> float:
    """Value of a formula of numbers alone. Raises ProgramError naming a part without a value."""
    for part in formula.parts:
        number = constant_value(part, tables)
        if isinstance(formula, FunctionCall) and formula.function == "sqrt" and number < 0.0:
            raise ProgramError(f"{formula} is the root of a negative number")
    try:
        with np.errstate(all="ignore"):
            number = float(formula.law(tables)({}))
    except (ArithmeticError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ProgramError(f"{formula} is no finite number")
    return number


def check_constants(formula: Formula) -> None:
    """Raise ProgramError for a part of numbers alone without a value, and for a division by 0."""
    if all(name in CONSTANTS for name in formula.names()):
        constant_value(formula, {})
        return
    for part in formula.parts:
        check_constants(part)
    if isinstance(formula, Operation) and formula.sign == "/":
        divisor = formula.right
        if all(name in CONSTANTS for name in divisor.names()) and constant_value(divisor, {}) == 0.0:
            raise ProgramError(f"{formula} divides by zero")


def spellings(name: str, known: Iterable[str], end: str = "") -> list[Edit]:
    """Known names that an unknown one in the equations may stand for, the nearest first; end: what follows the name."""
    return [{("equations",): {name + end: near + end}} for near in difflib.get_close_matches(name, list(known), 2)]


def suggestion(name: str, known: Iterable[str]) -> str:
    """End of an error message about an unknown name: the nearest known one, or all of them."""
    names = list(known)
    near = difflib.get_close_matches(name, names, 1)
    return f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(names) or 'none'}"
