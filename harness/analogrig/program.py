"""Program: the plant's equations on the computer, with its channels and parameters. A file, or tables of another file.

Nothing in it is executed: formulas are parsed and checked by the emulator's own parser.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analogrig import config
from analogrig.catalogue import Change
from analogrig.errors import ConfigurationError
from analogrig_emulator import (
    EmulatorError,
    Equations,
    PotError,
    ProgramError,
    ProgramParameter,
    circuit_of,
    equations_of,
)

if TYPE_CHECKING:
    from analogrig_emulator import ProgramCircuit

MAX_CHARACTERS = 65_536
MOST_CHANNELS = 4
"""Inputs of the card."""

_KEYS_OF_CHANGES = ("sample", "set", "ramp_n")

_DIAGNOSES = tuple(change.name.lower() for change in (Change.MASS, Change.DAMPING, Change.STIFFNESS))
"""Parameters in the diagnoses of a device."""

_EXACT = 1e-9


@dataclass(frozen=True, repr=False)
class Program:
    """Equations of a plant with its channels, scales and parameters; programs with equal files are equal.

    ``load`` reads a shipped program by name or a .toml file, and raises ConfigurationError.
    """

    source: str
    """Tables of the file as JSON."""

    def __repr__(self) -> str:
        return f"Program({self.name!r})"

    @classmethod
    def load(cls, name: str | Path) -> Program:
        """Load a shipped program by name, or a user's .toml file.

        :raises ConfigurationError: absent, not TOML, or not a program; names the file, the place and the cure.
        """
        path = config.locate("programs", name)
        return _loaded(config.read_file(path), path)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], where: str) -> Program:
        """Build a program from the tables of its file; ``where`` leads every error.

        :raises ConfigurationError: not a program.
        """
        try:
            equations = equations_of(table)
            source = json.dumps(dict(sorted(table.items())))
            if len(source) > MAX_CHARACTERS:
                raise ProgramError(f"larger than {MAX_CHARACTERS} characters")
            _check_channels(equations)
            _check_words(equations)
        except (EmulatorError, RecursionError) as error:
            raise ConfigurationError(f"{where}: {error}") from error
        return cls(source)

    @classmethod
    def of(cls, value: Any, where: str) -> Program:
        """Program of a scenario's key ``program``: a name, a file, or the tables of one; a Program itself.

        :raises ConfigurationError: it is not one of them.
        """
        if isinstance(value, Program):
            return value
        if isinstance(value, (str, Path)):
            return cls.load(value)
        if isinstance(value, Mapping):
            return cls.from_table(value, where)
        raise ConfigurationError(f"{where}: must be a name, a .toml file, or a table, not {value!r:.80}")

    def as_value(self) -> str | dict[str, Any]:
        """Name of a shipped program, or the tables of another one: ``of`` builds an equal program."""
        if self.name in config.names("programs") and Program.load(self.name) == self:
            return self.name
        tables: dict[str, Any] = json.loads(self.source)
        return tables

    @property
    def equations(self) -> Equations:
        """Equations as the file states them."""
        return _equations(self.source)

    @property
    def circuit(self) -> ProgramCircuit:
        """Circuit that solves the equations.

        :raises ConfigurationError: the machine cannot be patched so; names the term and the cure.
        """
        try:
            return circuit_of(self.equations)
        except EmulatorError as error:
            raise ConfigurationError(f"program {self.name}: {error}") from error

    @property
    def name(self) -> str:
        return self.equations.name

    @property
    def channels(self) -> tuple[str, ...]:
        """Quantities on the card's channels: the input of the plant, its output, and any others."""
        return self.equations.channels

    @property
    def measured(self) -> tuple[str, ...]:
        """Input and output of the plant: the channels that every rig measures and every device receives."""
        return self.channels[:2]

    def unit(self, name: str) -> str:
        """Unit of a channel or a parameter; empty if the file gives none."""
        row = self.equations.quantities.get(name) or self.equations.parameters[name]
        return row.unit.text if row.unit else ""

    @functools.cached_property
    def parameters(self) -> Mapping[str, ProgramParameter]:
        """Parameters that pots show, in the order of the file."""
        return {name: row for name, row in self.equations.parameters.items() if row.pot}

    @functools.cached_property
    def names(self) -> Mapping[str, str]:
        """Parameters by every name that a scenario may give them."""
        aliases = {row.alias: name for name, row in self.parameters.items() if row.alias}
        return {**aliases, **{name: name for name in self.parameters}}

    @functools.cached_property
    def estimates(self) -> tuple[str, ...]:
        """Parameters that follow from a device's model, in the order of the file."""
        return tuple(name for name in self.parameters if name in self.equations.estimates)

    @functools.cached_property
    def diagnosed(self) -> Mapping[str, str]:
        """Parameters by the name that diagnoses give them."""
        return {row.diagnosis: name for name, row in self.parameters.items() if row.diagnosis}

    @functools.cached_property
    def inverse(self) -> frozenset[str]:
        """Parameters by which an equation divides: their pots turn with the reciprocal."""
        lines = (*self.equations.derivatives, *self.equations.definitions)
        return frozenset(name for line in lines for name in line.formula.divisors())

    @functools.cached_property
    def order(self) -> int:
        """Order of the plant for a linear model: its number of states if it is linear, otherwise at most 2."""
        states = len(self.equations.states)
        return states if self.is_linear else min(states, 2)

    @functools.cached_property
    def is_linear(self) -> bool:
        """True if the plant is linear, starts from equilibrium, and its input does not reach its output at once."""
        if not self.circuit.is_linear:
            return False
        rest = np.zeros(len(self.equations.states) + 1)
        driven = np.append(rest[1:], 1.0)
        at_rest, at_once = (self._rates(point, self.equations.values) for point in (rest, driven))
        return not at_rest.any() and not at_once[-1]

    @functools.cached_property
    def settling_s(self) -> float | None:
        """Time in which the slowest mode decays to 1 %, in s of the plant; None unless it is linear and all decay."""
        if not self.is_linear:
            return None
        values = [self.equations.values[name] for name in self.parameters]
        modes = np.linalg.eigvals(self.generators([values])[0, :-1, :-1])
        slowest = -float(modes.real.max())
        return math.log(100.0) / slowest if slowest > _EXACT * float(np.abs(modes).max()) else None

    @functools.lru_cache(maxsize=64)  # noqa: B019 - a program is a value
    def poles(self, values: tuple[float, ...], period_s: float) -> tuple[complex, ...]:
        """Poles in z of a linear plant, sampled every ``period_s`` of the plant; none of one that is not linear.

        :param values: ``parameters``, in order.
        """
        if not self.is_linear:
            return ()
        modes = np.linalg.eigvals(self.generators([values])[0, :-1, :-1])
        return tuple(np.exp(modes * period_s).tolist())

    def values_at(self, coefficients: Mapping[str, float]) -> dict[str, float]:
        """Values of the parameters whose pots have these coefficients under load.

        Least squares of logarithms, as several pots may show one parameter.

        :raises ConfigurationError: a pot stands at 0, or the pots do not determine the values.
        """
        circuit, values = self.circuit, self.equations.values
        names, powers = self._powers
        for pot in circuit.pots:
            if not coefficients[pot] > 0.0:
                raise ConfigurationError(f"program {self.name}: pot {pot} at 0 shows no parameter")
        logs = [math.log(coefficients[pot] / circuit.pot_coefficient(pot, values)) for pot in circuit.pots]
        found = np.linalg.lstsq(powers, np.array(logs), rcond=None)[0]
        return {name: values[name] * math.exp(log) for name, log in zip(names, found, strict=True)}

    @functools.cached_property
    def _powers(self) -> tuple[list[str], NDArray[np.float64]]:
        """Parameters that pots show, and their powers in the coefficients of the pots, (pots, parameters).

        :raises ConfigurationError: a coefficient is no product of powers, or the pots do not determine the values.
        """
        pots = self.circuit.pots
        names = list(dict.fromkeys(name for row in pots.values() for name in row.settings))
        powers = np.array([[self._power(pot, name) for name in names] for pot in pots]).reshape(len(pots), len(names))
        if np.linalg.matrix_rank(powers) < len(names):
            raise ConfigurationError(
                f"program {self.name}: its pots show only products of the parameters {', '.join(names)}:"
                " write one parameter for each product"
            )
        return names, powers

    def _power(self, pot: str, name: str) -> float:
        """Power of a parameter in the coefficient of a pot."""
        circuit, values = self.circuit, self.equations.values
        if name not in circuit.pots[pot].settings:
            return 0.0
        try:
            at = [circuit.pot_coefficient(pot, {**values, name: factor * values[name]}) for factor in (1.0, 2.0, 4.0)]
        except PotError:
            at = [math.nan] * 3
        power, further = math.log2(at[1] / at[0]), math.log2(at[2] / at[1])
        if not math.isclose(power, further, rel_tol=_EXACT, abs_tol=_EXACT):
            raise ConfigurationError(
                f"program {self.name}: the coefficient of pot {pot} is no power of {name}, whose value it cannot show"
            )
        return power

    def _rates(self, point: Any, values: Mapping[str, Any]) -> Any:
        """Rates of the states, and the output, at a point: states and input (n + 1, ...)."""
        equations = self.equations
        first, *others = equations.inputs
        known = {**values, first: point[-1], **dict.fromkeys(others, 0.0)}
        rates = equations.slopes()(known, point[:-1])
        known |= dict(zip(equations.states, point[:-1], strict=True))
        for name, law in equations.signal_laws():
            known[name] = law(known)
        return np.append(rates, np.broadcast_to(known[self.channels[1]], rates.shape[1:])[None], axis=0)

    def generators(self, values: Any) -> Any:
        """Matrices (p, n + 1, n + 1) of a linear plant for parameters (p, m), ``parameters`` in order.

        They give the rates of the states, and in the last row the output, from the states and the input.
        """
        p, n = len(values), len(self.equations.states)
        known = {name: np.full(p, value) for name, value in self.equations.values.items()}
        known |= dict(zip(self.parameters, np.asarray(values, np.float64).T, strict=True))
        columns = [self._rates(np.repeat(unit[:, None], p, axis=1), known) for unit in np.eye(n + 1)]
        return np.stack(columns, axis=2).transpose(1, 0, 2)


@functools.lru_cache(maxsize=64)
def _loaded(data: bytes, path: Path) -> Program:
    return Program.from_table(config.toml_of(data, path), str(path))


@functools.lru_cache(maxsize=64)
def _equations(source: str) -> Equations:
    return equations_of(json.loads(source))


def _check_words(equations: Equations) -> None:
    for name, row in equations.parameters.items():
        if row.alias in _KEYS_OF_CHANGES:
            raise ProgramError(f"parameters.{name}.alias: {row.alias} is a key of scenarios' changes; choose another")
        if row.diagnosis and row.diagnosis not in _DIAGNOSES:
            known, given = ", ".join(_DIAGNOSES), row.diagnosis[:40]
            raise ProgramError(f"parameters.{name}.diagnosis: no device names {given!r}; there are {known}")


def _check_channels(equations: Equations) -> None:
    channels, driven = equations.channels, next(iter(equations.inputs))
    if not 2 <= len(channels) <= MOST_CHANNELS:
        raise ProgramError(f"channels: {len(channels)} of them; name the input, the output and at most two others")
    if channels[0] != driven:
        raise ProgramError(
            f"channels: the first is {channels[0]!r}; name the input that the generator drives, {driven!r}"
        )
