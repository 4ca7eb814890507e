"""Trial play of a program: its equations under square waves, for the range of every quantity.

The inputs switch between their trial levels, the first with the program's period, each further one with twice the
period of the one before: every combination of levels occurs. The parameters take their values, then each in turn the
ends of its range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.errors import ProgramError
from analogrig_emulator.machine.program_file import Equations, at_place
from analogrig_emulator.machine.stages import StageKind, Stages

_MOST_INPUTS = 4
_LEAST_HALVES = 4

_POINTS = 200
"""Instants per half period at which quantities are taken."""

_MOST_EVALUATIONS = 20_000
_TOLERANCE = 1e-5
_LARGEST = 1e30
_LEAST_GROWTH = 1e-6
"""Least real part of a growing mode, in magnitudes of the fastest one: less may be the rounding of an integrator."""
_States = NDArray[np.float64]
"""(states, settings)"""


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
    every = list(settings(equations))
    for values in every:
        _check_rest(stages, values)
    found: dict[str, Reach] = {}
    with np.errstate(all="ignore"):
        inputs, states = _played(stages, every)
        for values, played in zip(every, states.T, strict=True):
            quantities = inputs | dict(zip(equations.states, played, strict=True))
            stages.add_signals(quantities, values)
            for name, each in quantities.items():
                found[name] = found.get(name, Reach()).with_values(each)
    _check_domains(stages, found)
    return found


def _played(
    stages: Stages, every: Sequence[Mapping[str, float]]
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64]]:
    """Inputs (instants,) by name, and states (instants, states, settings)."""
    equations = stages.equations
    solve = _solved_linear if stages.is_linear else _solved
    slopes = equations.slopes()
    instants_s = np.linspace(0.0, 0.5 * equations.period_s, _POINTS)
    parameters = {name: np.array([values[name] for values in every]) for name in equations.parameters}
    levels = _levels(equations)
    state = np.zeros((len(equations.states), len(every)))
    stretches: list[NDArray[np.float64]] = []
    for half in range(_half_periods(equations)):
        known = parameters | {name: each[half] for name, each in levels.items()}
        stretch = solve(slopes, known, state, instants_s)
        state = stretch[-1]
        stretches.append(stretch)
        _check_bounded(equations, every, stretches, ~(np.abs(state) < _LARGEST))
    if stages.is_linear:
        first = {name: each[0] for name, each in levels.items()}
        is_unstable = _is_unstable(_system(slopes, parameters | first, state))
        growth = np.abs(stretches[-1]).max(axis=0) / np.maximum(np.abs(stretches[1]).max(axis=0), 1.0 / _LARGEST)
        _check_bounded(equations, every, stretches, is_unstable & (growth == growth.max(axis=0)))
    inputs = {name: np.repeat(each, _POINTS) for name, each in levels.items()}
    return inputs, np.concatenate(stretches)


def _half_periods(equations: Equations) -> int:
    """Half periods with every combination of levels. Raises ProgramError for too many inputs."""
    count = len(equations.inputs)
    if count > _MOST_INPUTS:
        raise ProgramError(
            f"inputs: {count} of them; the trial play combines the levels of at most {_MOST_INPUTS}: make the others"
            " parameters"
        )
    return max(1 << count, _LEAST_HALVES)


def _levels(equations: Equations) -> dict[str, NDArray[np.float64]]:
    """Level of each input in each half period."""
    halves = np.arange(_half_periods(equations))
    return {
        name: np.array(quantity.trial)[1 - (halves >> place) % 2]
        for place, (name, quantity) in enumerate(equations.inputs.items())
    }


def _is_unstable(system: NDArray[np.float64]) -> NDArray[np.bool_]:
    """True for each setting with a growing mode, (settings,); integrators have none."""
    modes = np.linalg.eigvals(system[:, :-1, :-1])
    return np.asarray(modes.real.max(axis=1) > _LEAST_GROWTH * np.abs(modes).max(axis=1))


def _check_bounded(
    equations: Equations,
    every: Sequence[Mapping[str, float]],
    stretches: Sequence[NDArray[np.float64]],
    grows: NDArray[np.bool_],
) -> None:
    """Raise ProgramError if a state grows without end, (states, settings)."""
    if not grows.any():
        return
    at, place = (int(each[0]) for each in np.nonzero(grows))
    name, values = list(equations.states)[at], every[place]
    changed = [f"{key} = {value:g}" for key, value in values.items() if value != equations.values[key]]
    where = f" with {', '.join(changed)}" if changed else ""
    column = np.abs(np.concatenate(stretches)[:, at, place])
    last = int(np.flatnonzero(column < _LARGEST)[-1])
    reached = f"reaches {column[last]:.3g}"
    if last + 1 < len(column):
        last, reached = last + 1, f"exceeds {_LARGEST:g}"
    at_s = 0.5 * equations.period_s * (last // _POINTS + last % _POINTS / (_POINTS - 1))
    raise ProgramError(
        f"the trial play grows without end: state {name} {reached} at {at_s:.3g} s{where}; the plant is unstable: "
        "correct a sign or a value, or a divisor that comes near zero"
    )


def _check_rest(stages: Stages, values: Mapping[str, float]) -> None:
    """Raise ProgramError for a coefficient that is not positive, and for a divisor that is zero at rest."""
    for stage in stages.stages:
        with at_place(stage.place):
            for cord in stage.cords:
                stages.factor(cord.factors, values)
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


_Slopes = Callable[[Mapping[str, Any], _States], _States]


def _system(slopes: _Slopes, known: Mapping[str, Any], state: _States) -> NDArray[np.float64]:
    """Matrices (settings, n + 1, n + 1) of linear equations, for the states and 1."""
    n, count = state.shape
    constant = slopes(known, np.zeros_like(state))
    system = np.zeros((count, n + 1, n + 1))
    system[:, :n, n] = constant.T
    for i in range(n):
        unit = np.zeros_like(state)
        unit[i] = 1.0
        system[:, :n, i] = (slopes(known, unit) - constant).T
    if not np.isfinite(system).all():
        raise ProgramError("trial play: a coefficient is not finite; change a value or range of a parameter")
    return system


def _solved_linear(
    slopes: _Slopes, known: Mapping[str, Any], state: _States, instants_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Exact solution by matrix exponentials, for equal steps: (instants, states, settings)."""
    from scipy.linalg import expm

    n, count = state.shape
    system = _system(slopes, known, state)
    step = expm(system * (instants_s[1] - instants_s[0]))
    rows = [np.concatenate((state, np.ones((1, count))))]
    for _ in instants_s[1:]:
        rows.append(np.einsum("sij,js->is", step, rows[-1]))
    return np.array(rows)[:, :n]


def _solved(
    slopes: _Slopes, known: Mapping[str, Any], state: _States, instants_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Numerical solution, with at most _MOST_EVALUATIONS of the slopes: (instants, states, settings)."""
    from scipy.integrate import RK45

    def flat(_: float, states: NDArray[np.float64]) -> NDArray[np.float64]:
        return slopes(known, states.reshape(state.shape)).ravel()

    solver = RK45(flat, 0.0, state.ravel(), instants_s[-1], rtol=_TOLERANCE, atol=_TOLERANCE**2)
    rows, at = [state.ravel()], 1
    while at < len(instants_s):
        solver.step()
        if solver.status == "failed" or not (np.abs(solver.y) < _LARGEST).all():
            rows += [np.full(state.size, np.nan)] * (len(instants_s) - at)
            break
        if solver.nfev > _MOST_EVALUATIONS:
            raise ProgramError(
                f"trial play: stiff, more than {_MOST_EVALUATIONS} evaluations in half a period of "
                f"{2 * instants_s[-1]:g} s; write a shorter period_s, or change a parameter"
            )
        dense = solver.dense_output()
        while at < len(instants_s) and instants_s[at] <= solver.t:
            rows.append(dense(instants_s[at]))
            at += 1
    return np.array(rows).reshape(-1, *state.shape)
