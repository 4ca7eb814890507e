"""Program file: the equations of a plant with scales, parameters and units, as TOML.

    name = "dc-motor"
    speed = 10                           # the machine runs 10 times faster than the plant
    channels = ["u", "omega", "i"]       # quantities on the card's channels
    equations = '''
    i' = (u - R*i - k*omega) / L
    omega' = (k*i - d*omega) / J
    '''
    [inputs]
    u = { unit = "V", full = 24.0, trial = [0.0, 20.0] }
    [states]
    i = { unit = "A" }
    omega = { unit = "rad/s", full = 250.0 }
    [parameters]
    R = { value = 1.2, unit = "ohm", range = [0.8, 1.6] }
    [estimates]                          # formulas in gain, s0, s1 and the estimates above
    k = "1 / gain"

A line `x' = ...` is the derivative of a state. A line `S = ...` defines a signal, which `[signals]` may give a unit and
a full scale. The first channel is the input, the second the output of the response that a device estimates:
gain / (... + s1 s + s0) times s0, in the units of the plant. `diagram` names a circuit of the machine that is wired by
hand; the compiler makes one otherwise. Nothing in a file is executed.
"""

from __future__ import annotations

import contextlib
import functools
import graphlib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.exceptions import ProgramError
from analogrig_emulator.machine.formula import (
    CONSTANTS,
    FUNCTIONS,
    Formula,
    Law,
    check_constants,
    parse_formula,
    spellings,
    suggestion,
)
from analogrig_emulator.machine.units import Unit, parse_unit

_MOST_ROWS = 64
"""Most rows of a table, lines of equations and points of a function."""

_MOST_DESCRIPTION = 200
_LARGEST = 1e15
_LEAST = 1e-15
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")
_PROGRAM_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_LINE = re.compile(r"\s*(?P<name>[^=']*?)\s*(?P<primes>'*)\s*=(?P<formula>.*)")
_CIRCUIT_HZ = 200.0
"""Frequency of the machine's usual square wave, from which the trial play takes its period."""


@dataclass(frozen=True)
class Quantity:
    """State, input or signal: unit and full scale, the value of 10 V; None where the file leaves them open.

    trial: levels of an input in the trial play.
    """

    unit: Unit | None = None
    full: float | None = None
    trial: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class ProgramParameter:
    """Parameter: value, least and greatest value for which pots must suffice, and unit.

    pot: True if changes of a run may name it. alias: another name in scenarios. diagnosis: name in the diagnoses of a
    device.
    """

    value: float
    low: float
    high: float
    unit: Unit | None = None
    pot: bool = True
    alias: str = ""
    diagnosis: str = ""


@dataclass(frozen=True)
class Points:
    """Function in straight pieces through points (x, y); x ascends. of, unit: units of x and y."""

    points: tuple[tuple[float, float], ...]
    of: Unit | None = None
    unit: Unit | None = None

    def __call__(self, x: Any) -> Any:
        """Value at x; the first and the last piece go on beyond the ends."""
        at, to, run, rise = self._pieces
        piece = np.searchsorted(at[1:], x, side="right")
        return to[piece] + (x - at[piece]) * rise[piece] / run[piece]

    @functools.cached_property
    def _pieces(self) -> tuple[NDArray[np.float64], ...]:
        """First x and y of each piece, and how far it goes in x and y."""
        at, to = np.array(self.points).T
        return at[:-1], to[:-1], np.diff(at), np.diff(to)


@dataclass(frozen=True)
class Equation:
    """Line of the equations: left side, right side, and number of the line."""

    name: str
    formula: Formula
    line: int

    @property
    def place(self) -> str:
        """Place for error messages."""
        return f"equations, line {self.line}"


@dataclass(frozen=True, eq=False)
class Equations:
    """Program as its file states it.

    speed: speed of the machine relative to the plant. period_s: period of the trial play's square wave, in s of the
    plant. derivatives: equations of the states, in the order of `states`; definitions: those of the signals, in an
    order in which they can be computed. diagram: circuit wired by hand. estimates: formulas of parameters, in order.
    stops: True if the ends of ranges may turn pots to the stops of their tracks, where real parts do not get.
    table: tables of the file.
    """

    name: str
    description: str
    speed: float
    period_s: float
    channels: tuple[str, ...]
    states: Mapping[str, Quantity]
    inputs: Mapping[str, Quantity]
    signals: Mapping[str, Quantity]
    parameters: Mapping[str, ProgramParameter]
    functions: Mapping[str, Points]
    derivatives: tuple[Equation, ...]
    definitions: tuple[Equation, ...]
    diagram: str = ""
    estimates: Mapping[str, Formula] = field(default_factory=dict)
    stops: bool = False
    table: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def run_period_s(self) -> float:
        """Period of a run without a scenario, in s of the plant."""
        return self.speed / _CIRCUIT_HZ

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Inputs, states and signals by name."""
        return {**self.inputs, **self.states, **self.signals}

    @property
    def values(self) -> dict[str, float]:
        """Value of every parameter."""
        return {name: parameter.value for name, parameter in self.parameters.items()}

    def signal_laws(self) -> list[tuple[str, Law]]:
        """Signals with the functions that compute them, in order."""
        return [(each.name, each.formula.law(self.functions)) for each in self.definitions]

    def slopes(self) -> Callable[[Mapping[str, Any], NDArray[np.float64]], NDArray[np.float64]]:
        """Function of parameters and inputs by name, and states (n, ...), that computes dx/dt, in s of the plant.

        Parameters and inputs may be arrays of the shape of one state.
        """
        signals = self.signal_laws()
        laws = [each.formula.law(self.functions) for each in self.derivatives]

        def slopes(known: Mapping[str, Any], states: NDArray[np.float64]) -> NDArray[np.float64]:
            values = {**known, **dict(zip(self.states, states, strict=True))}
            for name, law in signals:
                values[name] = law(values)
            found = np.empty_like(states)
            for i, law in enumerate(laws):
                found[i] = law(values)
            return found

        return slopes


def read_equations(table: Mapping[str, Any]) -> Equations:
    """Program of a file's tables.

    Raises ProgramError that names the place, with edits that may cure it, none of them tried.
    """
    return _Reader(table).equations()


class _Reader:
    """Tables of one file, checked on the way to Equations."""

    _KEYS = (
        "name",
        "description",
        "speed",
        "period_s",
        "channels",
        "equations",
        "inputs",
        "states",
        "signals",
        "parameters",
        "functions",
        "diagram",
        "estimates",
        "stops",
    )

    def __init__(self, table: Mapping[str, Any]) -> None:
        _check_keys("", table, self._KEYS)
        self._table = table
        self.functions = {name: self._points(name, row) for name, row in self._rows("functions")}
        self.inputs = {name: self._input(name, row) for name, row in self._rows("inputs")}
        self.states = {name: self._quantity("states", name, row) for name, row in self._rows("states")}
        self.parameters = {name: self._parameter(name, row) for name, row in self._rows("parameters")}
        self.signals = {name: self._quantity("signals", name, row) for name, row in self._rows("signals")}

    def equations(self) -> Equations:
        if not self.states:
            raise ProgramError("states: there is none; name every quantity that has a derivative")
        if not self.inputs:
            raise ProgramError("inputs: there is none; name the quantity that the generator drives")
        self._check_drive(*next(iter(self.inputs.items())))
        lines = list(self._lines())
        definitions = [line for line, primed in lines if not primed]
        self._complete_signals(definitions)
        derivatives = self._by_state([line for line, primed in lines if primed])
        self._check_names()
        self._check_formulas([*derivatives, *definitions])
        definitions = self._in_order(definitions)
        units = self._check_units(derivatives, definitions)
        self.signals = {name: Quantity(units.get(name), quantity.full) for name, quantity in self.signals.items()}
        speed = _number("speed", self._table.get("speed"), low=_LEAST)
        return Equations(
            name=self._name(),
            description=self._description(),
            speed=speed,
            period_s=_number("period_s", self._table.get("period_s", speed / _CIRCUIT_HZ), low=_LEAST),
            channels=self._channels(),
            states=self.states,
            inputs=self.inputs,
            signals=self.signals,
            parameters=self.parameters,
            functions=self.functions,
            derivatives=tuple(derivatives),
            definitions=tuple(definitions),
            diagram=_text("diagram", self._table.get("diagram", "")),
            estimates=self._estimates(),
            stops=_flag("stops", self._table.get("stops", False)),
            table=self._table,
        )

    @staticmethod
    def _check_drive(name: str, driven: Quantity) -> None:
        low, high = driven.trial
        if not low < high:
            raise ProgramError(
                f"inputs.{name}.trial: [{low:g}, {high:g}] excites nothing; write a lower and a higher level"
            )

    # ---- tables

    def _rows(self, key: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
        rows = self._table.get(key, {})
        if not isinstance(rows, dict):
            raise ProgramError(f"{key}: write a table, [{key}]")
        if len(rows) > _MOST_ROWS:
            raise ProgramError(f"{key}: {len(rows)} rows; the machine takes at most {_MOST_ROWS}")
        for name, row in rows.items():
            place = f"{key}.{name}"
            if not _NAME.fullmatch(name):
                raise ProgramError(f"{key}: name {name!r}: write a letter, then letters, digits or _, at most 32")
            if not isinstance(row, dict):
                raise ProgramError(f'{place}: write a table, for instance {name} = {{ unit = "m" }}')
            yield name, row

    def _input(self, name: str, row: Mapping[str, Any]) -> Quantity:
        place = f"inputs.{name}"
        _check_keys(place, row, ("unit", "full", "trial"))
        if "full" not in row:
            raise ProgramError(f"{place}: full is missing; give the value that 10 V of the generator stand for")
        full = _number(f"{place}.full", row["full"], low=_LEAST)
        low, high = _pair(f"{place}.trial", row.get("trial", [0.0, full]))
        if max(abs(low), abs(high)) > full:
            raise ProgramError(f"{place}.trial: [{low:g}, {high:g}] exceeds the full scale {full:g}; raise full")
        return Quantity(_unit(place, row), full, (low, high))

    def _quantity(self, key: str, name: str, row: Mapping[str, Any]) -> Quantity:
        place = f"{key}.{name}"
        _check_keys(place, row, ("unit", "full"))
        full = _number(f"{place}.full", row["full"], low=_LEAST) if "full" in row else None
        return Quantity(_unit(place, row), full)

    def _parameter(self, name: str, row: Mapping[str, Any]) -> ProgramParameter:
        place = f"parameters.{name}"
        _check_keys(place, row, ("value", "range", "unit", "pot", "alias", "diagnosis"))
        if "value" not in row:
            raise ProgramError(f"{place}: value is missing")
        value = _number(f"{place}.value", row["value"], low=_LEAST)
        low, high = _pair(f"{place}.range", row.get("range", [value, value]))
        if low < _LEAST:
            raise ProgramError(f"{place}.range: {low:g} is not positive; write the sign into the equation")
        if not low <= value <= high:
            raise ProgramError(f"{place}: value {value:g} lies outside its range [{low:g}, {high:g}]")
        pot = _flag(f"{place}.pot", row.get("pot", True))
        alias, diagnosis = (_text(f"{place}.{key}", row.get(key, "")) for key in ("alias", "diagnosis"))
        if alias and not _NAME.fullmatch(alias):
            raise ProgramError(f"{place}.alias: {alias[:40]!r}: write a letter, then letters, digits or _, at most 32")
        return ProgramParameter(value, low, high, _unit(place, row), pot, alias, diagnosis)

    def _points(self, name: str, row: Mapping[str, Any]) -> Points:
        place = f"functions.{name}"
        _check_keys(place, row, ("points", "of", "unit"))
        rows = row.get("points")
        if not (isinstance(rows, list) and 2 <= len(rows) <= _MOST_ROWS):
            raise ProgramError(f"{place}.points: write 2 to {_MOST_ROWS} pairs [[x, y], ...]")
        points = tuple(_two_numbers(f"{place}.points[{i}]", each) for i, each in enumerate(rows))
        for i, ((before, _), (after, _)) in enumerate(itertools.pairwise(points), 1):
            if not after > before:
                raise ProgramError(f"{place}.points[{i}]: x {after:g} does not exceed {before:g}; sort the points by x")
        return Points(points, _unit(place, row, "of"), _unit(place, row))

    def _name(self) -> str:
        name = _text("name", self._table.get("name"))
        if not _PROGRAM_NAME.fullmatch(name):
            raise ProgramError(f"name {name[:40]!r}: write letters, digits, - and _, at most 64")
        return name

    def _description(self) -> str:
        text = _text("description", self._table.get("description", ""))
        if text and not (text.isprintable() and len(text) <= _MOST_DESCRIPTION):
            raise ProgramError(f"description: write one line of at most {_MOST_DESCRIPTION} printable characters")
        return text

    def _channels(self) -> tuple[str, ...]:
        known = [*self.inputs, *self.states, *self.signals]
        channels = self._table.get("channels", [*self.inputs, *self.states])
        if not (isinstance(channels, list) and channels and all(isinstance(each, str) for each in channels)):
            raise ProgramError('channels: write a list of quantities, for instance ["u", "omega"]')
        for at, name in enumerate(channels):
            if name not in known:
                raise ProgramError(f"channels: unknown quantity {name!r}{suggestion(name, known)}")
            if name in channels[:at]:
                raise ProgramError(f"channels: {name!r} stands there twice")
        return tuple(channels)

    # ---- equations

    def _lines(self) -> Iterator[tuple[Equation, bool]]:
        """Equations in order, each with True for a derivative."""
        text = _text("equations", self._table.get("equations"))
        lines = text.splitlines()
        if sum(1 for line in lines if line.strip()) > 2 * _MOST_ROWS:
            raise ProgramError(f"equations: more than {2 * _MOST_ROWS} lines")
        for number, line in enumerate(lines, 1):
            line = line.partition("#")[0]  # noqa: PLW2901 - without its comment
            if line.strip():
                yield self._line(number, line)

    def _line(self, number: int, line: str) -> tuple[Equation, bool]:
        with at_place(f"equations, line {number}"):
            match = _LINE.fullmatch(line)
            if not match or not _NAME.fullmatch(match["name"]):
                raise ProgramError(f"{line.strip()[:60]!r} is no equation; write x' = ... or S = ...")
            if len(match["primes"]) > 1:
                name = match["name"]
                raise ProgramError(f"{name}{match['primes']} is no first derivative; write {name}' = v and v' = ...")
            return Equation(match["name"], parse_formula(match["formula"], self.functions), number), bool(
                match["primes"]
            )

    def _by_state(self, lines: Sequence[Equation]) -> list[Equation]:
        found: dict[str, Equation] = {}
        for line in lines:
            if line.name not in self.states:
                raise ProgramError(
                    f"{line.place}: {line.name}' is the derivative of no state{suggestion(line.name, self.states)}"
                )
            if line.name in found:
                raise ProgramError(f"{line.place}: {line.name}' is given on line {found[line.name].line} already")
            found[line.name] = line
        for name in self.states:
            if name not in found:
                raise ProgramError(f"states.{name}: no equation gives {name}'; write it, or delete the state")
        return [found[name] for name in self.states]

    def _complete_signals(self, definitions: Sequence[Equation]) -> None:
        seen: dict[str, Equation] = {}
        for line in definitions:
            if line.name in self.states:
                raise ProgramError(f"{line.place}: {line.name} is a state; write {line.name}' = for its derivative")
            if line.name in self.inputs or line.name in self.parameters:
                raise ProgramError(f"{line.place}: {line.name} is an input or parameter and needs no equation")
            if line.name in seen:
                raise ProgramError(f"{line.place}: {line.name} is given on line {seen[line.name].line} already")
            seen[line.name] = line
        for name in self.signals:
            if name not in seen:
                raise ProgramError(f"signals.{name}: no equation gives {name}; write it, or delete the signal")
        self.signals = {name: self.signals.get(name, Quantity()) for name in seen}

    def _estimates(self) -> dict[str, Formula]:
        """Formulas of the parameters that a device's model of the response from input to output yields."""
        rows = self._table.get("estimates", {})
        if not isinstance(rows, dict):
            raise ProgramError("estimates: write a table, [estimates]")
        units = self._response_units()
        found: dict[str, Formula] = {}
        for name, text in rows.items():
            with at_place(f"estimates.{name[:40]}"):
                shown = [each for each, row in self.parameters.items() if row.pot]
                if name not in shown:
                    raise ProgramError(f"no pot shows a parameter {name[:40]!r}{suggestion(name, shown)}")
                formula = parse_formula(_text("formula", text))
                check_constants(formula)
                for used in formula.names():
                    if used not in units and used not in CONSTANTS:
                        raise ProgramError(f"unknown name {used[:40]!r}{suggestion(used, units)}")
                if all(used in CONSTANTS for used in formula.names()):
                    raise ProgramError(f"{formula} is the same for every response; write it with {', '.join(units)}")
                units[name] = self.parameters[name].unit
                _check_unit(name, units[name], formula.unit(units, {}))
                found[name] = formula
        return found

    def _response_units(self) -> dict[str, Unit | None]:
        """Units of the response from input to output: of its gain and of the coefficients of its denominator."""
        quantities = {**self.inputs, **self.states, **self.signals}
        below, above = (quantities[name].unit for name in (self._channels() * 2)[:2])
        units = {"gain": None if above is None or below is None else above / below}
        order = len(self.states)
        return units | {f"s{i}": parse_unit("s") ** (i - order) for i in range(order)}

    def _check_names(self) -> None:
        """Raise ProgramError for a name with two meanings."""
        taken = dict.fromkeys(FUNCTIONS, "a function of formulas") | dict.fromkeys(CONSTANTS, "a constant")
        for key in ("functions", "inputs", "states", "parameters", "signals"):
            for name in getattr(self, key):
                if name in taken:
                    raise ProgramError(f"{key}.{name}: this name is {taken[name]} already; choose another")
                taken[name] = f"one of {key}"
        for key, known in (("alias", taken), ("diagnosis", {})):
            for name, row in self.parameters.items():
                word = getattr(row, key)
                if word and word in known:
                    raise ProgramError(f"parameters.{name}.{key}: {word} is {known[word]} already; choose another")
                known[word] = f"the {key} of {name}"

    def _check_formulas(self, lines: Sequence[Equation]) -> None:
        known = [*self.inputs, *self.states, *self.signals, *self.parameters, *CONSTANTS]
        used: set[str] = set()
        for line in lines:
            for name in line.formula.names():
                if name not in known:
                    raise ProgramError(
                        f"{line.place}: unknown name {name[:40]!r}",
                        edits=spellings(name, known),
                        otherwise=f"there are {', '.join(known)}",
                    )
                used.add(name)
        for key, names in (("inputs", self.inputs), ("parameters", self.parameters)):
            for name in names:
                if name not in used:
                    raise ProgramError(f"{key}.{name}: no equation uses it; delete it")

    def _in_order(self, definitions: Sequence[Equation]) -> list[Equation]:
        by_name = {line.name: line for line in definitions}
        needs = {line.name: [name for name in line.formula.names() if name in by_name] for line in definitions}
        try:
            order = list(graphlib.TopologicalSorter(needs).static_order())
        except graphlib.CycleError as cause:
            way = list(reversed(cause.args[1]))
            raise ProgramError(
                f"{by_name[way[0]].place}: algebraic loop {' needs '.join(way)}; solve these equations for one of them"
            ) from None
        return [by_name[name] for name in order]

    def _check_units(self, derivatives: Iterable[Equation], definitions: Iterable[Equation]) -> dict[str, Unit | None]:
        """Units of all names. Raises ProgramError where two sides of an equation, or two terms, differ."""
        units = {name: row.unit for table in (self.inputs, self.states, self.signals) for name, row in table.items()}
        units |= {name: row.unit for name, row in self.parameters.items()}
        functions = {name: (row.of, row.unit) for name, row in self.functions.items()}
        for line in definitions:
            with at_place(line.place):
                found, wanted = line.formula.unit(units, functions), units[line.name]
                _check_unit(line.name, wanted, found)
                units[line.name] = wanted or found
        for line in derivatives:
            with at_place(line.place):
                unit = units[line.name]
                rate = None if unit is None else unit / parse_unit("s")
                _check_unit(f"{line.name}'", rate, line.formula.unit(units, functions))
        return units


def _check_unit(left: str, wanted: Unit | None, found: Unit | None) -> None:
    if wanted is not None and found is not None and not wanted.matches(found):
        raise ProgramError(
            f"{left} is in {wanted.text}, the right side in {found.text}; correct a unit or the equation"
        )


@contextlib.contextmanager
def at_place(place: str) -> Iterator[None]:
    """Put a place before the ProgramErrors of the body."""
    try:
        yield
    except ProgramError as cause:
        raise cause.at(place) from cause


def _check_keys(place: str, table: Mapping[str, Any], known: Sequence[str]) -> None:
    for key in table:
        if key not in known:
            raise ProgramError(f"{place}{': ' if place else ''}unknown key {key[:40]!r}{suggestion(key, known)}")


def _flag(place: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ProgramError(f"{place}: {value!r} is neither true nor false")
    return value


def _number(place: str, value: Any, low: float = -_LARGEST) -> float:
    if value is None:
        raise ProgramError(f"{place} is missing")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ProgramError(f"{place}: {str(value)[:40]!r} is no number")
    if not abs(value) <= _LARGEST:
        raise ProgramError(f"{place}: {str(value)[:40]} is not finite, or exceeds {_LARGEST:g}")
    if value < low:
        what = "negative" if value < 0 else "zero" if value == 0 else "too small"
        raise ProgramError(f"{place}: {value:g} is {what}; it must be positive, at least {low:g}")
    return float(value)


def _two_numbers(place: str, value: Any) -> tuple[float, float]:
    if not (isinstance(value, list) and len(value) == 2):
        raise ProgramError(f"{place}: write two numbers, [low, high]")
    return _number(f"{place}[0]", value[0]), _number(f"{place}[1]", value[1])


def _pair(place: str, value: Any) -> tuple[float, float]:
    low, high = _two_numbers(place, value)
    if low > high:
        raise ProgramError(f"{place}: [{low:g}, {high:g}] descends; write the lower number first")
    return low, high


def _text(place: str, value: Any) -> str:
    if value is None:
        raise ProgramError(f"{place} is missing")
    if not isinstance(value, str):
        raise ProgramError(f"{place}: {str(value)[:40]!r} is no text")
    return value


def _unit(place: str, row: Mapping[str, Any], key: str = "unit") -> Unit | None:
    if key not in row:
        return None
    with at_place(place):
        return parse_unit(_text(key, row[key]))
