"""Plant: a program with values of its parameters, and its exact discretisation where it is linear.

The harness uses this model for the information bounds and to convert estimates to parameters. It never produces the
samples of a run.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig.config import suggest
from analogrig.datasheet import ModelOrders
from analogrig.program import Program

__all__ = ["MAX_CHANGES", "MAX_SAMPLES", "SampledPlant", "Segment", "discretise", "estimated_parameters"]
"""Names for packages beside the core."""

MAX_SAMPLES = 10_000_000
"""Largest number of samples. A run is kept in memory; tests/soak/test_long_runs.py bounds its size."""

MAX_CHANGES = 1_000
"""Largest number of changes, and of records, in a run. The bounds of each take milliseconds to compute."""

LEAST_PARAMETER, MOST_PARAMETER = 1e-15, 1e15
"""Limits of each parameter in its unit, exclusive."""

BLOCK_SAMPLES = 64
"""Samples that one product of matrices computes."""


@dataclass(frozen=True)
class Plant:
    """Program with values of its parameters, in their order.

    ValueError: a value is not between 1e-15 and 1e15.
    """

    program: Program
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, value in self.parameters().items():
            check_parameter(name, value)

    @classmethod
    def of(cls, program: Program | str, changed: Mapping[str, float] | None = None) -> Plant:
        """Plant with the values of the program, which may be given by its name, but for the ``changed`` ones."""
        program = Program.of(program, "program")
        return cls(program, tuple(row.value for row in program.parameters.values())).changed(changed or {})

    def parameters(self) -> dict[str, float]:
        """Values by name."""
        return dict(zip(self.program.parameters, self.values, strict=True))

    @property
    def overrides(self) -> dict[str, float]:
        """Values that differ from the program's, by name."""
        rows = self.program.parameters.items()
        return {name: value for (name, row), value in zip(rows, self.values, strict=True) if value != row.value}

    def changed(self, values: Mapping[str, float]) -> Plant:
        """The same plant with other values of some parameters, by a name or alias of each.

        :raises ValueError: a parameter is unknown, or a value is out of range.
        """
        names = self.program.names
        for name in values:
            if name in self.program.equations.parameters and name not in names:
                raise ValueError(
                    f"program {self.program.name}: {name} is on no pot (pot = false), so a scenario cannot set it:"
                    " change the program file"
                )
            if name not in names:
                known = ", ".join(self.program.parameters)
                raise ValueError(
                    f"program {self.program.name}: unknown parameter {name!r}{suggest(name, names)} (known: {known})"
                )
        return Plant(
            self.program, tuple((self.parameters() | {names[name]: each for name, each in values.items()}).values())
        )

    def scaled(self, name: str, factor: float) -> Plant:
        """The same plant with the parameter ``name`` multiplied by ``factor``."""
        return self.changed({name: self.parameters()[name] * factor})

    def response(self) -> dict[str, float]:
        """Static gain, and s0, s1, ... of the denominator s^n + ... + s1 s + s0, of a linear plant."""
        matrix = self.program.generators(np.array([self.values]))[0]
        gain = -matrix[-1, :-1] @ np.linalg.solve(matrix[:-1, :-1], matrix[:-1, -1])
        denominator = np.poly(matrix[:-1, :-1])[:0:-1].tolist()
        return {"gain": float(gain)} | {f"s{i}": value for i, value in enumerate(denominator)}

    def interpolate(self, other: Plant, part: float) -> Plant:
        """Plant at the fraction ``part`` (0..1) of a ramp to ``other``, linear in the pots.

        The load of the pots is neglected: it moves a coefficient by at most 2 % if the dials turn linearly.
        """
        inverse = self.program.inverse
        return Plant(
            self.program,
            tuple(
                1.0 / ((1.0 - part) / before + part / after) if name in inverse else before + part * (after - before)
                for name, before, after in zip(self.program.parameters, self.values, other.values, strict=True)
            ),
        )

    def changes_to(self, other: Plant) -> dict[str, tuple[float, float]]:
        """Parameters in which ``other`` differs, as ``{name: (before, after)}``."""
        pairs = zip(self.program.parameters, self.values, other.values, strict=True)
        return {name: (before, after) for name, before, after in pairs if before != after}


def check_parameter(name: str, value: float) -> None:
    """:raises ValueError: the value of a parameter is not between 1e-15 and 1e15."""
    if not LEAST_PARAMETER < value < MOST_PARAMETER:
        limit = f"less than {MOST_PARAMETER:g}" if value > LEAST_PARAMETER else f"more than {LEAST_PARAMETER:g}"
        raise ValueError(f"{name} must be {limit if value > 0.0 else 'more than 0'}, not {value:g}")


@dataclass(frozen=True)
class Segment:
    """Plant from a sample on, until the next segment. Instants are sample indices."""

    start: int
    """First sample, or the likeliest one if estimated from the samples."""
    plant: Plant
    ramp_n: int = 0
    """Samples from ``start`` to the end of the ramp; 0: a jump."""
    start_low: int | None = None
    """Earliest possible ``start``; None: ``start`` is exact."""
    start_high: int | None = None
    """Latest possible ``start``; None: ``start`` is exact."""
    end_low: int | None = None
    """Earliest possible end of the ramp; None: ``ramp_n`` is exact."""
    end_high: int | None = None
    """Latest possible end of the ramp; None: ``ramp_n`` is exact."""
    unseen: str = ""
    """Reason that the change could not be found in the samples; empty otherwise."""
    also: tuple[str, ...] = ()
    """Further parameters that the steps of the pots move a little with the change."""

    def earliest(self) -> Self:
        """The same segment with its change at the earliest possible instants."""
        return self._move_to(self.start_low, self.end_low)

    def latest(self) -> Self:
        """The same segment with its change at the latest possible instants."""
        return self._move_to(self.start_high, self.end_high)

    def _move_to(self, start: int | None, end: int | None) -> Self:
        start = self.start if start is None else start
        ramp_n = self.ramp_n if end is None else max(0, end - start)
        return dataclasses.replace(self, start=start, ramp_n=ramp_n)

    @property
    def is_exact(self) -> bool:
        """True if start and end are known, not estimated from the samples."""
        return self.start_low is None and self.start_high is None and self.end_low is None and self.end_high is None


State = tuple[float, ...]
"""Values of the states of a program, in their order."""


@dataclass(frozen=True)
class SampledPlant:
    """Linear plant discretised by an exact zero-order hold of its input."""

    transition: tuple[State, ...]
    """Transition matrix of the states, row by row."""
    response: State
    """Change of each state per unit of the input."""
    readout: State
    """Factors of the states in the output."""

    @classmethod
    def from_plant(cls, plant: Plant, period_s: float) -> SampledPlant:
        """Discretise with ``period_s`` of problem time (Astrom and Wittenmark, Computer-Controlled Systems, 2.3)."""
        return _sampled(plant, period_s)

    @classmethod
    def from_plants(cls, plants: Sequence[Plant], period_s: float) -> list[SampledPlant]:
        """Discretise many plants of one program at once; equal to ``from_plant`` to the bit."""
        if not plants:
            return []
        sampled = discretise(plants[0].program, np.array([plant.values for plant in plants]), period_s)
        readouts = plants[0].program.generators(np.array([plant.values for plant in plants]))[:, -1, :-1]
        return [
            cls(tuple(tuple(row[:-1]) for row in rows), tuple(row[-1] for row in rows), tuple(readout))
            for rows, readout in zip(sampled.tolist(), readouts.tolist(), strict=True)
        ]

    @property
    def at_rest(self) -> State:
        """State at the start of a record."""
        return (0.0,) * len(self.response)

    def next(self, state: State, driven: float) -> State:
        """State one sample later, with the input ``driven``, in plain floats: numpy takes longer for so few."""
        rows = zip(self.transition, self.response, strict=True)
        return tuple(_product(row, state) + gain * driven for row, gain in rows)

    def output(self, state: State) -> float:
        """Output in a state."""
        return _product(self.readout, state)

    def play(self, state: State, driven: NDArray[np.float64]) -> tuple[NDArray[np.float64], State]:
        """Outputs after each of n inputs, and the state after the last one."""
        out, now = np.empty(len(driven)), np.array(state)
        outputs, states = self._blocks
        for first in range(0, len(driven), BLOCK_SAMPLES):
            inputs = driven[first : first + BLOCK_SAMPLES]
            n = len(inputs)
            known = np.concatenate([now, inputs])
            out[first : first + n] = outputs[:n, : len(known)] @ known
            now = states[n - 1][:, : len(known)] @ known
        return out, tuple(now.tolist())

    @functools.cached_property
    def _blocks(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Outputs (block, n + block) and states (block, n, n + block) after each input, from state and inputs."""
        transition, n = np.array(self.transition), len(self.response)
        states = np.zeros((BLOCK_SAMPLES, n, n + BLOCK_SAMPLES))
        now = np.eye(n, n + BLOCK_SAMPLES)
        for k in range(BLOCK_SAMPLES):
            now = transition @ now
            now[:, n + k] = self.response
            states[k] = now
        return np.array(self.readout) @ states, states


def _product(row: State, state: State) -> float:
    """Scalar product, added from the left: ``sum`` compensates rounding in some versions of Python."""
    total = 0.0
    for factor, value in zip(row, state, strict=True):
        total += factor * value
    return total


@functools.lru_cache(maxsize=64)
def _sampled(plant: Plant, period_s: float) -> SampledPlant:
    """Discretised plant; the trials of a campaign ask for the same few."""
    return SampledPlant.from_plants([plant], period_s)[0]


def discretise(
    program: Program, parameters: NDArray[np.float64], period_s: float | Sequence[float]
) -> NDArray[np.float64]:
    """Discretise plants of a linear program, (p, m) parameters: (p, n, n + 1), the states from states and input.

    :param period_s: duration; of several, the result has one more axis at the front.
    """
    generators = program.generators(parameters)
    generators[:, -1] = 0.0
    matrices = generators * np.asarray(period_s)[..., None, None, None]
    return exponentials(matrices.reshape(-1, *generators.shape[1:])).reshape(matrices.shape)[..., :-1, :]


def exponentials(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix exponentials of (k, n, n), of the same shape. Importing scipy.linalg would take longer than numpy."""
    norms = np.abs(matrices).sum(axis=2).max(axis=1)
    squarings = np.maximum(0, np.frexp(norms)[1] + 4)
    out = np.empty_like(matrices)
    for count in np.unique(squarings).tolist():
        alike = squarings == count
        out[alike] = _exponential(matrices[alike], count)
    return out


def _exponential(matrices: NDArray[np.float64], squarings: int) -> NDArray[np.float64]:
    """Matrix exponentials by scaling, a Taylor series, and squaring; relative error near 1e-15 for these norms."""
    scaled = matrices / 2.0**squarings
    term = result = np.eye(matrices.shape[-1])
    for order in range(1, 13):
        term = term @ scaled / order
        result = result + term
    for _ in range(squarings):
        result = result @ result
    return np.asarray(result)


def estimated_response(
    theta: NDArray[np.floating], model: ModelOrders, input_per_code: float, output_per_code: float, period_s: float
) -> dict[str, NDArray[np.float64]]:
    """Response gain s0 / (s^n + ... + s1 s + s0) of estimates theta (k, p) in codes, n = ``model.na``: (k,) by name.

    The poles of A give the denominator, the static gain the gain. Neither depends on the instant of an edge within a
    sample.

    :param input_per_code: units of the input per code; likewise for the output.
    :param period_s: time between samples.
    """
    order = model.na
    a = theta[:, :order].astype(np.float64)
    with np.errstate(all="ignore"):
        static = theta[:, order : order + model.nb].sum(axis=1, dtype=np.float64) / (1.0 + a.sum(axis=1))
        denominator = np.ones((len(theta), 1), np.complex128)
        for root in (np.log(_poles(a)) / period_s).T:
            denominator = np.pad(denominator, ((0, 0), (0, 1))) - np.pad(denominator, ((0, 0), (1, 0))) * root[:, None]
        gain = static * output_per_code / input_per_code
    return {"gain": gain} | {f"s{i}": denominator[:, order - i].real for i in range(order)}


def estimated_parameters(
    program: Program,
    theta: NDArray[np.floating],
    model: ModelOrders,
    input_per_code: float,
    output_per_code: float,
    period_s: float,
) -> NDArray[np.float64]:
    """Parameters ``program.estimates`` (n, m) of estimates theta (n, p) in codes; NaN if a row describes no such plant.

    The program states which parameters follow from the ``estimated_response``.

    :param model: meaning of theta; all NaN unless its ``na`` is the number of the program's states.
    :param period_s: problem time between samples; others as of ``estimated_response``.
    """
    names = program.estimates
    if model.na != len(program.equations.states) or not names:
        return np.full((len(theta), len(names)), np.nan)
    values = estimated_response(theta, model, input_per_code, output_per_code, period_s)
    with np.errstate(all="ignore"):
        for name, formula in program.equations.estimates.items():
            values[name] = formula.law({})(values)
        out = np.stack([values[name] for name in names], axis=1)
        out[~((out > LEAST_PARAMETER) & (out < MOST_PARAMETER)).all(axis=1)] = np.nan
    return out


def _poles(a: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Roots (n, order) of z^order + a1 z^(order - 1) + ..., from (n, order)."""
    n, order = a.shape
    if order == 2:
        root = np.sqrt((a[:, 0] ** 2 - 4.0 * a[:, 1]).astype(np.complex128))
        return np.stack([(-a[:, 0] + sign * root) / 2.0 for sign in (1.0, -1.0)], axis=1)
    companion = np.tile(np.eye(order, k=-1), (n, 1, 1))
    companion[:, 0] = np.nan_to_num(-a)  # of a row that is not finite, the gain is NaN
    return np.linalg.eigvals(companion).astype(np.complex128)
