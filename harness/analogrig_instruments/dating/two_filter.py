"""Likelihood of a plant change at every sample, by two filters (Fraser and Potter 1969).

A Kalman filter with the plant before the change runs forwards; an information filter with the plant after it runs
backwards. At each instant both are joined by the state (displacement and velocity), which is continuous at a change.

Unknowns enter linearly, about their best values so far, as columns that the filters carry. Both plants share the offset
of the displacement and the place of the edges; each has its own offset of the force and logarithms of parameters.
The sampled force does not show where between two samples an edge lies: the deviation from its mean place is process
noise.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from analogrig import Plant, Program
from analogrig.judging import QUANTISATION_VARIANCE_LSB2
from analogrig.plant import discretise
from analogrig.run import INPUT, OUTPUT, Channel, missing_samples

Array = NDArray[np.float64]

COMMON, OWN = 2, 4
"""Number of unknowns that both plants share, and of each. A filter has 1 + COMMON + OWN columns; the first is known."""

_STATES = 2

_EDGE = 30.0
"""Smallest step of the force that counts as an edge, in rms of its noise."""
DIFFUSE = 1e6
"""Variance of the state at the first sample, in units of the noise variance."""
_NEGLIGIBLE = 1e-14
_STEP, _PLACE_STEP = 1e-4, 1e-2
"""Steps of the difference quotients: in a logarithm of a parameter, and in the place of the edges."""
_PLACES = (np.arange(8) + 0.5) / 4.0 - 1.0
"""Middles of eight parts of the range -1..1."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Force and displacement of n consecutive samples without a gap; noise is rms, quantisation included."""

    force_n: Array  # (n,) newtons
    displacement_m: Array  # (n,) metres
    valid: NDArray[np.bool_]
    """(n,): False where the displacement is clipped or lost."""
    period_s: float
    """Problem time between samples."""
    noise_n: float
    noise_m: float

    @classmethod
    def of(
        cls, codes: NDArray[np.uint16], clipped: NDArray[np.bool_], channels: Mapping[str, Channel], period_s: float
    ) -> Self:
        """Signals from ``codes`` and ``clipped``, both (n, c); ``channels``: input and output first."""
        force, displacement = list(channels.values())[:2]
        noise_n, noise_m = (
            (each.noise_lsb**2 + QUANTISATION_VARIANCE_LSB2) ** 0.5 * abs(each.lsb) for each in (force, displacement)
        )
        force_n, displacement_m = force.physical(codes[:, INPUT]), displacement.physical(codes[:, OUTPUT])
        return cls(force_n, displacement_m, ~missing_samples(clipped), period_s, noise_n, noise_m)

    def part(self, first: int, end: int) -> Signals:
        """Return the samples first <= k < end."""
        kept = slice(first, end)
        return replace(
            self, force_n=self.force_n[kept], displacement_m=self.displacement_m[kept], valid=self.valid[kept]
        )

    def __len__(self) -> int:
        return len(self.valid)

    @functools.cached_property
    def edges_n(self) -> Array:
        """(n,) newtons: step of the force in the period after each sample; 0 where it is no edge."""
        steps = np.append(np.diff(self.force_n), 0.0)
        return np.where(np.abs(steps) < _EDGE * self.noise_n, 0.0, steps)


def can_date(program: Program) -> bool:
    """True if the filters know plants of this program: linear, two states, the first of which is the output."""
    states = tuple(program.equations.states)
    return (
        program.is_linear
        and len(states) == _STATES
        and states[0] == program.channels[OUTPUT]
        and len(program.parameters) == OWN - 1
    )


class EdgePlace(NamedTuple):
    """Place of the force's edges in a sample period (0..1): uniform within ``half_width`` of ``mean``."""

    mean: float
    half_width: float


@dataclass(frozen=True, eq=False)
class PlantModel:
    """Motion of a plant over one sample period; or of p plants, with one more axis at the front of each array.

    State: displacement in rms of its noise, velocity in that per sample.
    """

    transition: Array  # (2, 2)
    response: Array  # (2,) per newton of held force
    edge: Array  # (2,) per newton of an edge, mean over its places
    edge_covariance: Array  # (2, 2) of the same

    @classmethod
    def of(cls, plants: Sequence[Plant], edges: EdgePlace, signals: Signals) -> list[Self]:
        """Models for the period and the noise of ``signals``."""
        program, parameters = plants[0].program, np.array([plant.values for plant in plants])
        period_s, noise_m = signals.period_s, signals.noise_m
        units = np.array([[1.0, 1.0 / period_s, 1.0 / noise_m], [period_s, 1.0, period_s / noise_m]])
        places = np.clip(edges.mean + edges.half_width * _PLACES, 0.0, 1.0).tolist()
        parts = [1.0, *(1.0 - at for at in places)]
        whole, *late = units * discretise(program, parameters, [part * period_s for part in parts])
        edge = np.array(late)[:, :, :, 2]
        off = edge - edge.mean(axis=0)
        covariance = np.einsum("pmi,pmj->mij", off, off) / len(places)
        return list(map(cls, whole[:, :, :2], whole[:, :, 2], edge.mean(axis=0), covariance))

    def inputs(self, force_n: Array, edges_n: Array) -> Array:
        """(n, 2) effect of the force and of its edges, both (n,), on the state in the period after each sample."""
        return np.asarray(self.response * force_n[:, None] + self.edge * edges_n[:, None])

    def disturbances(self, noise_n: float, edges_n: Array) -> Array:
        """(n, 2, 2) covariance of the error of ``inputs``."""
        noise = noise_n**2 * self.response[..., :, None] * self.response[..., None, :]
        return np.asarray(noise + edges_n[:, None, None] ** 2 * self.edge_covariance)


@dataclass(frozen=True, eq=False)
class Motion:
    """One plant on the force of a record, with its derivatives by the unknowns."""

    model: PlantModel
    moved: tuple[PlantModel, ...]
    """Models with the logarithm of a parameter raised by one step each."""
    edge_by_place: Array  # (2,)
    signals: Signals
    offsets: tuple[float, float]
    """Offsets of displacement and force, in rms of their noise."""

    @classmethod
    def of(cls, plant: Plant, edges: EdgePlace, signals: Signals, offsets: tuple[float, float] = (0.0, 0.0)) -> Self:
        """Motion of ``plant`` by the force of ``signals``."""
        step = _PLACE_STEP if edges.mean < 0.5 else -_PLACE_STEP
        model, *moved = PlantModel.of(
            [plant, *(plant.scaled(name, 1.0 + _STEP) for name in plant.parameters())], edges, signals
        )
        (later,) = PlantModel.of([plant], edges._replace(mean=edges.mean + step), signals)
        return cls(model, tuple(moved), (later.edge - model.edge) / step, signals, offsets)

    @functools.cached_property
    def force_n(self) -> Array:
        return self.signals.force_n + self.offsets[1] * self.signals.noise_n

    @functools.cached_property
    def disturbances(self) -> Array:
        return self.model.disturbances(self.signals.noise_n, self.signals.edges_n)

    @property
    def measured(self) -> Array:
        """(n, c) displacement in rms of its noise, in columns."""
        measured = np.zeros((len(self.signals), 1 + COMMON + OWN))
        measured[:, 0] = self.signals.displacement_m / self.signals.noise_m - self.offsets[0]
        measured[:, 1] = -1.0
        return measured

    @functools.cached_property
    def known(self) -> Array:
        """(n, 2) effect of the force on the state in the period after each sample."""
        return self.model.inputs(self.force_n, self.signals.edges_n)

    def inputs(self, course: Array) -> Array:
        """(n, 2, c) ``known`` and its derivatives, in columns, about a course of the state (n, 2)."""
        force_n, edges_n, known = self.force_n, self.signals.edges_n, self.known
        following = course @ self.model.transition.T + known
        own = [(course @ each.transition.T + each.inputs(force_n, edges_n) - following) / _STEP for each in self.moved]
        held = np.tile(self.model.response * self.signals.noise_n, (len(force_n), 1))
        columns = [known, np.zeros_like(known), self.edge_by_place * edges_n[:, None], held, *own]
        return np.stack(columns, axis=2)


@dataclass(frozen=True, eq=False)
class ForwardFilter:
    """State at each sample given the samples up to and including it, in c columns."""

    state: Array  # (n, 2, c): mean
    covariance: Array  # (n, 2, 2)
    misfit: Array
    """(n, c, c): quadratic form of the residuals up to each sample, in units of their noise."""
    log: Array
    """(n,): cumulative sum of the logarithms of the innovation variances."""
    innovation: Array
    """(n, c): in standard deviations; 0 where the sample is not valid."""

    @classmethod
    def of(cls, motion: Motion, course: Array) -> Self:
        """Run a Kalman filter with a diffuse initial state; ``course`` as for ``Motion.inputs``."""
        weight, transition = motion.signals.valid.astype(np.float64), motion.model.transition
        predicted = _riccati(DIFFUSE * np.eye(2), transition, _information_of(weight), motion.disturbances)
        size = weight * predicted[:, 0, 0] + 1.0
        gain = predicted[:, :, 0] * (weight / size)[:, None]
        kept = np.tile(np.eye(2), (len(weight), 1, 1))
        kept[:, :, 0] -= gain
        measured, inputs = motion.measured, motion.inputs(course)
        entering = np.concatenate([np.zeros_like(inputs[:1]), inputs[:-1]])
        state = scan(kept @ transition, kept @ entering + gain[:, :, None] * measured[:, None, :])
        entering[1:] += transition @ state[:-1]
        innovation = (measured - entering[:, 0, :]) * np.sqrt(weight / size)[:, None]
        misfit = np.cumsum(innovation[:, :, None] * innovation[:, None, :], axis=0)
        return cls(state, kept @ predicted, misfit, np.cumsum(np.log(size)), innovation)


@dataclass(frozen=True, eq=False)
class BackwardFilter:
    """Cost of the state at each sample given the samples after it: x' information x - 2 x' vector + misfit + log."""

    vector: Array  # (n, 2, c)
    information: Array  # (n, 2, 2)
    misfit: Array  # (n, c, c)
    log: Array  # (n,)

    @classmethod
    def of(cls, motion: Motion, course: Array) -> Self:
        """Run an information filter from zero information after the last sample; parameters as for ForwardFilter."""
        weight, transition = motion.signals.valid.astype(np.float64), motion.model.transition
        disturbances, inputs, measured = motion.disturbances[:-1], motion.inputs(course)[:-1], motion.measured[1:]
        measurements = _information_of(weight)[::-1]
        known = _riccati(measurements[0], transition.T, disturbances[::-1], measurements[1:])[::-1]
        inner = np.eye(2) + known @ disturbances
        softened = disturbances @ np.linalg.inv(inner)
        back = transition.T @ (np.eye(2) - known @ softened)
        pushed = known @ inputs
        own = np.zeros_like(pushed)
        own[:, 0, :] = weight[1:, None] * measured
        vector = np.concatenate([scan(back[::-1], (back @ (own - pushed))[::-1])[::-1], np.zeros_like(own[:1])])
        whole = vector[1:] + own
        cross = _transpose(whole) @ inputs
        left = whole - pushed
        squares = weight[1:, None, None] * measured[:, :, None] * measured[:, None, :]
        squares += _transpose(inputs) @ pushed - cross - _transpose(cross) - _transpose(left) @ softened @ left
        information = np.concatenate([back @ known @ transition, np.zeros((1, 2, 2))])
        return cls(vector, information, _sum_later(squares), _sum_later(np.log(np.linalg.det(inner))))


def join(state: Array, covariance: Array, vector: Array, information: Array) -> tuple[Array, Array]:
    """Cost of joining both filters at m instants: quadratic form (m, c, c) and logarithm of the determinant (m,).

    :param state: (m, 2, c) over the columns of both plants, as is ``vector``.
    :param covariance: (m, 2, 2), as is ``information``.
    """
    inner = np.eye(2) + information @ covariance
    left = vector - information @ state
    cross = _transpose(state) @ vector
    form = _transpose(state) @ information @ state - cross - _transpose(cross)
    form -= _transpose(left) @ covariance @ np.linalg.inv(inner) @ left
    return form, np.log(np.linalg.det(inner))


def scan(factors: Array, terms: Array) -> Array:
    """Solve s(k) = factors(k) s(k-1) + terms(k), s(-1) = 0, by doubling; (n, 2, 2) and (n, 2, c) give (n, 2, c)."""
    factors, sums, shift = factors.copy(), terms.copy(), 1
    factors[:1] = 0.0
    while shift < len(sums) and np.abs(factors).max() > _NEGLIGIBLE:
        sums[shift:] += factors[shift:] @ sums[:-shift]
        factors[shift:] = factors[shift:] @ factors[:-shift]
        factors[:shift] = 0.0
        shift *= 2
    return sums


def _riccati(first: Array, transition: Array, lost: Array, gained: Array) -> Array:
    """Solve S(k+1) = A (S(k)^-1 + lost(k))^-1 A' + gained(k); all but A are (n, 2, 2) and symmetric.

    Plain floats: numpy takes ten times as long for a 2 x 2 product.
    """
    (a, b), (c, d) = transition.tolist()
    p, q, _, r = first.ravel().tolist()
    out = []
    for (pp, pq, _, qq), (dp, dq, _, dr) in zip(
        lost.reshape(-1, 4).tolist(), gained.reshape(-1, 4).tolist(), strict=True
    ):
        out.append((p, q, q, r))
        # (S^-1 + lost)^-1 = (S + det(S) adj(lost)) / det(1 + S lost)
        det = p * r - q * q
        whole = 1.0 + p * pp + 2.0 * q * pq + r * qq + det * (pp * qq - pq * pq)
        p, q, r = (p + det * qq) / whole, (q - det * pq) / whole, (r + det * pp) / whole
        p, q, r = (
            a * a * p + 2.0 * a * b * q + b * b * r + dp,
            a * c * p + (a * d + b * c) * q + b * d * r + dq,
            c * c * p + 2.0 * c * d * q + d * d * r + dr,
        )
    return np.array(out).reshape(-1, 2, 2)


def _information_of(weight: Array) -> Array:
    """(n, 2, 2) information of measurements of the displacement in units of its noise."""
    return weight[:, None, None] * np.diag([1.0, 0.0])


def _sum_later(terms: Array) -> Array:
    """Sums of ``terms`` (n - 1, ...) from each sample on, and 0 for the last sample (n, ...)."""
    return np.concatenate([np.cumsum(terms[::-1], axis=0)[::-1], np.zeros_like(terms[:1])])


def _transpose(matrices: Array) -> Array:
    """Transpose each of the matrices (m, r, c)."""
    return np.swapaxes(matrices, 1, 2)
