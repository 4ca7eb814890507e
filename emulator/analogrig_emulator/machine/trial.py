"""Trial play of a program: its equations under square waves, for the range of every quantity.

The inputs switch between their trial levels, the first with the program's period, each further one with twice the
period of the one before: every combination of levels occurs. A second play has the period of a run without a scenario,
where that differs: the machine plays both. The parameters take their values, then each in turn the
ends of its range. The play goes on until the slowest mode that decays has settled: a lightly damped one may build up.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.exceptions import ProgramError
from analogrig_emulator.machine.program_file import Equations, at_place
from analogrig_emulator.machine.stages import StageKind, Stages

_MOST_INPUTS = 4
_LEAST_HALVES = 4
_MOST_HALVES = 400
"""Longest play of linear equations: 20,000 samples of a run at 200 Hz."""

_MOST_SOLVED_HALVES = 40
"""Longest play of equations that are solved numerically."""

_SETTLED = 2e-3
"""Growth of the peaks in a cycle below which a play has settled."""

_DRIFT = 0.9
"""Least growth in the last cycle over that in the first one of a play that drifts, and is not prolonged."""

_POINTS = 200
"""Instants per half period at which quantities are taken."""

_MOST_EVALUATIONS = 20_000
_TOLERANCE = 1e-5
_LATER_TOLERANCE = 1e-3
"""Tolerance after the first play, in peaks of the states: full scales have more headroom than that."""

_LARGEST = 1e30
_EXACT = 1e-9
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
        for inputs, states in _plays(stages, every):
            for values, played in zip(every, states.T, strict=True):
                quantities = inputs | dict(zip(equations.states, played, strict=True))
                stages.add_signals(quantities, values)
                for name, each in quantities.items():
                    found[name] = found.get(name, Reach()).with_values(each)
    _check_domains(stages, found)
    return found


_Inputs = dict[str, NDArray[np.float64]]
"""Inputs (instants,) by name."""


def _plays(stages: Stages, every: Sequence[Mapping[str, float]]) -> Iterator[tuple[_Inputs, NDArray[np.float64]]]:
    """Plays with the period of the program, and with that of a run where it differs and is not too long to solve."""
    equations = stages.equations
    yield _played(equations, every, is_linear=stages.is_linear)
    if not math.isclose(equations.period_s, equations.run_period_s, rel_tol=_EXACT):
        with contextlib.suppress(_StiffError):
            yield _played(replace(equations, period_s=equations.run_period_s), every, is_linear=stages.is_linear)


def _played(
    equations: Equations, every: Sequence[Mapping[str, float]], *, is_linear: bool
) -> tuple[_Inputs, NDArray[np.float64]]:
    """Inputs, and states (instants, states, settings)."""
    solve = _solved_linear if is_linear else _solved
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
    if is_linear:
        first = {name: each[0] for name, each in levels.items()}
        is_unstable = _is_unstable(_system(slopes, parameters | first, state))
        growth = np.abs(stretches[-1]).max(axis=0) / np.maximum(np.abs(stretches[1]).max(axis=0), 1.0 / _LARGEST)
        _check_bounded(equations, every, stretches, is_unstable & (growth == growth.max(axis=0)))
    more = _settling(equations, slopes, parameters | {name: each[0] for name, each in levels.items()}, state, solve)
    states = np.concatenate(stretches)
    later = _prolonged(equations, solve, slopes, parameters, states, more)
    halves = [*range(_half_periods(equations)), *later]
    levels = _levels(equations, _MOST_HALVES)
    inputs = {name: np.repeat(each[halves], _POINTS) for name, each in levels.items()}
    return inputs, np.concatenate([states, *later.values()])


def _settling(
    equations: Equations, slopes: _Slopes, known: Mapping[str, Any], state: _States, solve: Callable[..., Any]
) -> int:
    """Half periods until the slowest mode that decays has settled to 1 %, or the most that are tried."""
    if solve is not _solved_linear:
        return _MOST_SOLVED_HALVES
    modes = np.linalg.eigvals(_system(slopes, known, state)[:, :-1, :-1])
    decay = -modes.real[modes.real < -_LEAST_GROWTH * np.abs(modes).max(axis=1, keepdims=True)]
    halves = math.log(100.0) / (0.5 * equations.period_s * float(decay.min())) if decay.size else 0.0
    return min(math.ceil(halves), _MOST_HALVES)


def _prolonged(
    equations: Equations,
    solve: Callable[..., Any],
    slopes: _Slopes,
    parameters: Mapping[str, Any],
    states: NDArray[np.float64],
    halves: int,
) -> dict[int, NDArray[np.float64]]:
    """Later half periods that raise a peak, by number; none if a state drifts all the time.

    Linear equations are played for so many halves, others until their peaks have settled or solving takes long.
    """
    first, levels = _half_periods(equations), _levels(equations, _MOST_HALVES)
    instants_s = np.linspace(0.0, 0.5 * equations.period_s, _POINTS)
    is_linear = solve is _solved_linear
    flows: dict[tuple[float, ...], tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    low, high, state = states.min(axis=0), states.max(axis=0), states[-1]
    kept: dict[int, NDArray[np.float64]] = {}
    growths: list[NDArray[np.float64]] = []
    peak = np.maximum(high, -low)
    evaluations = 0

    def counted(known: Mapping[str, Any], state: _States) -> _States:
        nonlocal evaluations
        evaluations += 1
        return slopes(known, state)

    for half in range(first, halves):
        if evaluations > _MOST_EVALUATIONS:
            break
        known = {**parameters, **{name: each[half] for name, each in levels.items()}}
        if is_linear:
            key = tuple(float(each[half]) for each in levels.values())
            if key not in flows:
                flows[key] = _flow(slopes, known, state, instants_s)
            stretch = np.einsum("ksij,js->kis", flows[key][0], state) + flows[key][1]
        else:
            tolerance = _LATER_TOLERANCE * peak + _TOLERANCE**2
            stretch = _solved(counted, known, state, instants_s, _LATER_TOLERANCE, tolerance)
        if not (np.abs(stretch[-1]) < _LARGEST).all():
            return {}
        state = stretch[-1]
        if (stretch.max(axis=0) > high * (1.0 + _EXACT)).any() or (stretch.min(axis=0) < low * (1.0 + _EXACT)).any():
            low, high = np.minimum(low, stretch.min(axis=0)), np.maximum(high, stretch.max(axis=0))
            kept[half] = stretch
        if (half + 1) % first == 0:
            growths.append(np.maximum(high, -low) - peak)
            peak = np.maximum(high, -low)
            if not is_linear and (growths[-1] <= _SETTLED * peak).all():
                break
    drifts = len(growths) > 1 and bool(((growths[-1] >= _DRIFT * growths[0]) & (growths[-1] > _SETTLED * peak)).any())
    return {} if drifts else kept


def _flow(
    slopes: _Slopes, known: Mapping[str, Any], state: _States, instants_s: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Exact solution of linear equations: (instants, settings, n, n) for the state, and what is added to it."""
    n = len(state)
    zero = _solved_linear(slopes, known, np.zeros_like(state), instants_s)
    flow = np.empty((len(instants_s), state.shape[1], n, n))
    for i in range(n):
        unit = np.zeros_like(state)
        unit[i] = 1.0
        flow[..., i] = (_solved_linear(slopes, known, unit, instants_s) - zero).transpose(0, 2, 1)
    return flow, zero


def _half_periods(equations: Equations) -> int:
    """Half periods with every combination of levels. Raises ProgramError for too many inputs."""
    count = len(equations.inputs)
    if count > _MOST_INPUTS:
        raise ProgramError(
            f"inputs: {count} of them; the trial play combines the levels of at most {_MOST_INPUTS}: make the others"
            " parameters"
        )
    return max(1 << count, _LEAST_HALVES)


def _levels(equations: Equations, count: int = 0) -> dict[str, NDArray[np.float64]]:
    """Level of each input in each half period: so many, or those of the first play."""
    halves = np.arange(count or _half_periods(equations))
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
                source = stage.cords[0].source
                raise ProgramError(
                    f"{stage.place}: {stage.name} takes the root of negative values in the trial play "
                    f"(down to {radicand.low:g})",
                    edits=[{("equations",): {f"sqrt({source})": f"sqrt(max(0, {source}))"}}],
                    otherwise="take the root of a signal that stays positive",
                )


class _StiffError(ProgramError):
    """The equations take too long to solve."""


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
    slopes: _Slopes,
    known: Mapping[str, Any],
    state: _States,
    instants_s: NDArray[np.float64],
    relative: float = _TOLERANCE,
    absolute: Any = _TOLERANCE**2,
) -> NDArray[np.float64]:
    """Numerical solution, with at most _MOST_EVALUATIONS of the slopes: (instants, states, settings)."""
    from scipy.integrate import RK45

    def flat(_: float, states: NDArray[np.float64]) -> NDArray[np.float64]:
        return slopes(known, states.reshape(state.shape)).ravel()

    atol = np.broadcast_to(absolute, state.shape).ravel()
    solver = RK45(flat, 0.0, state.ravel(), instants_s[-1], rtol=relative, atol=atol)
    rows, at = [state.ravel()], 1
    while at < len(instants_s):
        solver.step()
        if solver.status == "failed" or not (np.abs(solver.y) < _LARGEST).all():
            rows += [np.full(state.size, np.nan)] * (len(instants_s) - at)
            break
        if solver.nfev > _MOST_EVALUATIONS:
            raise _StiffError(
                f"trial play: stiff, more than {_MOST_EVALUATIONS} evaluations in half a period of "
                f"{2 * instants_s[-1]:g} s",
                edits=[{("period_s",): float(f"{2 * instants_s[-1] * each:.2g}")} for each in (0.3, 0.1, 0.03, 0.01)],
                otherwise="write a shorter period_s, or change a parameter",
            )
        if instants_s[at] > solver.t:
            continue
        dense = solver.dense_output()
        while at < len(instants_s) and instants_s[at] <= solver.t:
            rows.append(dense(instants_s[at]))
            at += 1
    return np.array(rows).reshape(-1, *state.shape)
