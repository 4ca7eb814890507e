"""Trial play of a program: its equations under square waves, for the range of every quantity.

The inputs switch between their trial levels, the first with the program's period, each further one with twice the
period of the one before. The parameters take their values, then each in turn the ends of its range.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.errors import ProgramError
from analogrig_emulator.machine.program_file import Equations
from analogrig_emulator.machine.stages import StageKind, Stages

_HALF_PERIODS = 6
_POINTS = 200
"""Instants per half period at which quantities are taken."""

_MOST_EVALUATIONS = 20_000
_DIVERGED = 1e30
_LINEAR = (StageKind.SUMMER, StageKind.INTEGRATOR)

_States = NDArray[np.float64]
_Slopes = Callable[[Mapping[str, float], _States], _States]


@dataclass(frozen=True)
class Reach:
    """Least and greatest value of a quantity in the trial play."""

    low: float = np.inf
    high: float = -np.inf

    @property
    def peak(self) -> float:
        """Greatest magnitude."""
        return max(abs(self.low), abs(self.high))

    def with_values(self, values: NDArray[np.float64]) -> Reach:
        """Reach of these values too."""
        return Reach(min(self.low, float(np.min(values))), max(self.high, float(np.max(values))))


def settings(equations: Equations) -> Iterator[dict[str, float]]:
    """Parameters of the trial plays."""
    yield equations.values
    for name, parameter in equations.parameters.items():
        for value in dict.fromkeys((parameter.low, parameter.high)):
            if value != parameter.value:
                yield equations.values | {name: value}


def reaches(stages: Stages) -> dict[str, Reach]:
    """Reach of every quantity and stage, but integrators' inputs.

    Raises ProgramError if the equations have no bounded solution, or a stage none at all.
    """
    equations = stages.equations
    found: dict[str, Reach] = {}
    solve = _solver(equations, is_linear=all(stage.kind in _LINEAR for stage in stages.stages))
    for values in settings(equations):
        _check_rest(stages, values)
        with np.errstate(all="ignore"):
            quantities = _trajectory(equations, values, solve)
            stages.add_signals(quantities, values)
        for name, each in quantities.items():
            if not np.isfinite(each).all():
                raise ProgramError(f"trial play: {name} is not finite{_with(equations, values)}")
            found[name] = found.get(name, Reach()).with_values(each)
    _check_domains(stages, found)
    return found


_Solve = Callable[[Mapping[str, float], _States, NDArray[np.float64]], NDArray[np.float64]]
"""States at instants in s, from the state at the first: (instants, states)."""


def _trajectory(equations: Equations, values: Mapping[str, float], solve: _Solve) -> dict[str, NDArray[np.float64]]:
    """Inputs and states at every instant of a trial play."""
    instants_s = np.linspace(0.0, 0.5 * equations.period_s, _POINTS)
    state = np.zeros(len(equations.states))
    inputs: dict[str, list[NDArray[np.float64]]] = {name: [] for name in equations.inputs}
    states = []
    for half in range(_HALF_PERIODS):
        levels = {
            name: quantity.trial[1 - (half >> place) % 2]
            for place, (name, quantity) in enumerate(equations.inputs.items())
        }
        try:
            stretch = solve({**values, **levels}, state, instants_s)
        except (ArithmeticError, ValueError) as cause:
            raise ProgramError(
                f"trial play: {cause}{_with(equations, values)}; change a parameter, the trial levels of an input, "
                "or a divisor that comes near zero"
            ) from None
        _check_bounded(equations, values, stretch)
        state = stretch[-1]
        states.append(stretch)
        for name, level in levels.items():
            inputs[name].append(np.full(_POINTS, level))
    table = np.concatenate(states)
    return {name: np.concatenate(each) for name, each in inputs.items()} | {
        name: table[:, i] for i, name in enumerate(equations.states)
    }


def _check_bounded(equations: Equations, values: Mapping[str, float], stretch: NDArray[np.float64]) -> None:
    for name, column in zip(equations.states, stretch.T, strict=True):
        if not (np.abs(column) < _DIVERGED).all():
            raise ProgramError(
                f"trial play: state {name} grows without bound{_with(equations, values)}; correct a sign or a value"
            )


def _check_rest(stages: Stages, values: Mapping[str, float]) -> None:
    """Raise ProgramError for a divisor that is zero at rest."""
    levels = {name: np.float64(quantity.trial[1]) for name, quantity in stages.equations.inputs.items()}
    quantities: dict[str, Any] = levels | dict.fromkeys(stages.equations.states, np.float64(0.0))
    stages.add_signals(quantities, values)
    for stage in stages.stages:
        if stage.kind is StageKind.QUOTIENT and quantities[stage.cords[1].source] == 0:
            raise ProgramError(
                f"{stage.place}: {stage.name} divides by {stage.cords[1].source}, which is zero at rest; "
                "add an offset to it, or multiply the equation by it"
            )


def _check_domains(stages: Stages, found: Mapping[str, Reach]) -> None:
    """Raise ProgramError for a divisor that reaches zero and a root of negative values."""
    for stage in stages.stages:
        if stage.kind is StageKind.QUOTIENT:
            divisor = found[stage.cords[1].source]
            if divisor.low <= 0 <= divisor.high:
                raise ProgramError(
                    f"{stage.place}: {stage.name} divides by {stage.cords[1].source}, which reaches zero in the trial "
                    f"play ({divisor.low:g} to {divisor.high:g}); add an offset to it, or multiply the equation by it"
                )
        if stage.kind is StageKind.ROOT:
            radicand = found[stage.cords[0].source]
            if radicand.low < -1e-6 * radicand.high:
                raise ProgramError(
                    f"{stage.place}: {stage.name} takes the root of negative values in the trial play "
                    f"(down to {radicand.low:g}); write sqrt(max(0, ...))"
                )


def _with(equations: Equations, values: Mapping[str, float]) -> str:
    changed = [f"{name} = {value:g}" for name, value in values.items() if value != equations.values[name]]
    return f" with {', '.join(changed)}" if changed else ""


def _solver(equations: Equations, *, is_linear: bool) -> _Solve:
    slopes = equations.slopes()
    return (
        (lambda known, state, instants_s: _solved_linear(slopes, known, state, instants_s))
        if is_linear
        else (lambda known, state, instants_s: _solved(slopes, known, state, instants_s))
    )


def _solved_linear(
    slopes: _Slopes, known: Mapping[str, float], state: _States, instants_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Exact solution by a matrix exponential, for equal steps."""
    from scipy.linalg import expm

    n = len(state)
    constant = slopes(known, np.zeros(n))
    system = np.zeros((n + 1, n + 1))
    system[:n, n] = constant
    for i, unit in enumerate(np.eye(n)):
        system[:n, i] = slopes(known, unit) - constant
    if not np.isfinite(system).all():
        raise ArithmeticError("a coefficient is not finite")
    step = expm(system * (instants_s[1] - instants_s[0]))
    rows = [np.append(state, 1.0)]
    for _ in itertools.islice(instants_s, 1, None):
        rows.append(step @ rows[-1])
    return np.array(rows)[:, :n]


def _solved(
    slopes: _Slopes, known: Mapping[str, float], state: _States, instants_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Numerical solution, with at most _MOST_EVALUATIONS of the slopes."""
    from scipy.integrate import LSODA

    solver = LSODA(lambda _, states: slopes(known, states), 0.0, state, instants_s[-1], rtol=1e-8, atol=1e-12)
    rows, at = [state], 1
    while at < len(instants_s):
        message = solver.step()
        if solver.status == "failed" or solver.nfev > _MOST_EVALUATIONS:
            raise ArithmeticError(message or f"more than {_MOST_EVALUATIONS} evaluations for half a period: too stiff")
        dense = solver.dense_output()
        while at < len(instants_s) and instants_s[at] <= solver.t:
            rows.append(dense(instants_s[at]))
            at += 1
    return np.array(rows)
