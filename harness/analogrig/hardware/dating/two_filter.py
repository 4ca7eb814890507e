"""Likelihood of a plant change at every sample, by two filters (Fraser and Potter 1969).

A Kalman filter with the plant before the change runs forwards; an information filter with the plant after it runs
backwards. At each instant both are join by the state (displacement and velocity), which is continuous at a change.

Unknowns enter linearly, about their best values so far, as columns that the filters carry. Both plants share the offset
of the displacement and the place of the edges; each has its own offset of the force and logarithms of M, B, K. The
sampled force does not show where between two samples an edge lies: the deviation from its mean place is process noise.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2
from analogrig.plant import PARAMETERS, Plant, SampledPlant
from analogrig.run import CHANNELS, MEASURED, Channel, missing_to_device

Array = NDArray[np.float64]

COMMON, OWN = 2, 4
"""Number of unknowns that both plants share, and of each. A filter has 1 + COMMON + OWN columns; the first is known."""

_EDGE = 30.0
"""Smallest step of the force that counts as an edge, in rms of its noise."""
_DIFFUSE = 1e6
"""Variance of the state at the first sample, in units of the noise variance."""
_NEGLIGIBLE = 1e-14
_STEP = 1e-4
"""Step in a logarithm of M, B or K for its derivative; a place in a sample period moves by a hundred times that."""
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
        """Signals from ``codes`` and ``clipped``, both (n, 4) with columns as CHANNELS."""
        columns = {name: channels[name].physical(codes[:, CHANNELS.index(name)]) for name in MEASURED}
        noise_n, noise_m = (
            (channels[name].noise_lsb ** 2 + QUANTISATION_VARIANCE_LSB2) ** 0.5 * abs(channels[name].lsb)
            for name in MEASURED
        )
        valid = ~missing_to_device(clipped)
        return cls(columns["force"], columns["displacement"], valid, period_s, noise_n, noise_m)

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


@dataclass(frozen=True)
class EdgePlace:
    """Place of the force's edges in a sample period (0..1): uniform within ``half_width`` of ``mean``."""

    mean: float
    half_width: float


ANYWHERE = EdgePlace(0.5, 0.5)


@dataclass(frozen=True, eq=False)
class PlantModel:
    """Motion of one plant over one sample period, with derivatives by the logarithms of M, B, K (first axis).

    State: displacement in rms of its noise, velocity in that per sample.
    """

    transition: Array  # (2, 2)
    response: Array  # (2,) per newton of held force
    edge: Array  # (2,) per newton of an edge, mean over its places
    edge_covariance: Array  # (2, 2) of the same
    edge_by_place: Array  # (2,)
    transition_by: Array  # (3, 2, 2)
    response_by: Array  # (3, 2)
    edge_by: Array  # (3, 2)

    @classmethod
    def of(cls, plant: Plant, edges: EdgePlace, signals: Signals) -> Self:
        """Model for the period and the noise of ``signals``."""
        transition, response = _discretise(plant, 1.0, signals)
        places = np.clip(edges.mean + edges.half_width * _PLACES, 0.0, 1.0)
        late = np.array([_discretise(plant, 1.0 - place, signals)[1] for place in places.tolist()])
        near = np.clip([edges.mean - 100.0 * _STEP, edges.mean + 100.0 * _STEP], 0.0, 1.0)
        ends = [_discretise(plant, 1.0 - place, signals)[1] for place in near.tolist()]
        moved = [plant.scaled(name, 1.0 + _STEP) for name in PARAMETERS]
        sampled = [_discretise(each, 1.0, signals) for each in moved]
        middle = _discretise(plant, 1.0 - edges.mean, signals)[1]
        return cls(
            transition=transition,
            response=response,
            edge=late.mean(axis=0),
            edge_covariance=np.cov(late.T, bias=True),
            edge_by_place=(ends[1] - ends[0]) / (near[1] - near[0]),
            transition_by=np.array([each[0] - transition for each in sampled]) / _STEP,
            response_by=np.array([each[1] - response for each in sampled]) / _STEP,
            edge_by=np.array([_discretise(each, 1.0 - edges.mean, signals)[1] - middle for each in moved]) / _STEP,
        )

    def inputs(self, signals: Signals, offset: float) -> Array:
        """(n, 2) effect of the force on the state in the period after each sample.

        :param offset: offset of the force, in rms of its noise.
        """
        force = (signals.force_n + offset * signals.noise_n)[:, None]
        return np.asarray(self.response * force + self.edge * signals.edges_n[:, None])

    def disturbances(self, signals: Signals) -> Array:
        """(n, 2, 2) covariance of the error of ``inputs``."""
        noise = signals.noise_n**2 * np.outer(self.response, self.response)
        return np.asarray(noise + signals.edges_n[:, None, None] ** 2 * self.edge_covariance)


def _discretise(plant: Plant, part: float, signals: Signals) -> tuple[Array, Array]:
    """Transition (2, 2) and response (2,) over ``part`` (0..1) of a sample period."""
    if part <= 0.0:
        return np.eye(2), np.zeros(2)
    period_s = signals.period_s
    sampled = SampledPlant.of(plant, part * period_s)
    (xx, xv, vx, vv), (xf, vf) = sampled.transition, sampled.response
    transition = np.array([[xx, xv / period_s], [vx * period_s, vv]])
    return transition, np.array([xf, vf * period_s]) / signals.noise_m


Offsets = tuple[float, float]
"""Offsets of displacement and force, in rms of their noise."""


def _columns(model: PlantModel, signals: Signals, course: Array, offsets: Offsets) -> tuple[Array, Array]:
    """Inputs (n, 2, c) of the state after each sample, and measurements (n, c), about a course of the state (n, 2).

    The first of the c columns is known; the others are per unit of an unknown.
    """
    n = len(signals)
    force = (signals.force_n + offsets[1] * signals.noise_n)[:, None]
    edges = signals.edges_n[:, None]
    inputs = np.zeros((n, 2, 1 + COMMON + OWN))
    inputs[:, :, 0] = model.inputs(signals, offsets[1])
    inputs[:, :, 2] = model.edge_by_place * edges
    inputs[:, :, 3] = model.response * signals.noise_n
    for i in range(len(PARAMETERS)):
        own = course @ model.transition_by[i].T + model.response_by[i] * force
        inputs[:, :, 4 + i] = own + model.edge_by[i] * edges
    measured = np.zeros((n, 1 + COMMON + OWN))
    measured[:, 0] = signals.displacement_m / signals.noise_m - offsets[0]
    measured[:, 1] = -1.0
    return inputs, measured


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
    def of(cls, model: PlantModel, signals: Signals, course: Array, offsets: Offsets) -> Self:
        """Run a Kalman filter with a diffuse initial state; ``course`` and ``offsets`` as for ``_columns``."""
        inputs, measured = _columns(model, signals, course, offsets)
        weight = signals.valid.astype(np.float64)
        gain, size, covariance = _gains(model, weight, model.disturbances(signals))
        kept = np.tile(np.eye(2), (len(signals), 1, 1))
        kept[:, :, 0] -= gain
        entering = _zero_first(inputs[:-1])
        corrected = gain[:, :, None] * measured[:, None, :]
        state = scan(kept @ model.transition, kept @ entering + corrected)
        predicted = _zero_first(model.transition @ state[:-1]) + entering
        innovation = measured - predicted[:, 0, :]
        innovation *= np.sqrt(weight / size)[:, None]
        misfit = np.cumsum(innovation[:, :, None] * innovation[:, None, :], axis=0)
        return cls(state, covariance, misfit, np.cumsum(np.log(size)), innovation)


@dataclass(frozen=True, eq=False)
class BackwardFilter:
    """Cost of the state at each sample given the samples after it: x' information x - 2 x' vector + misfit + log."""

    vector: Array  # (n, 2, c)
    information: Array  # (n, 2, 2)
    misfit: Array  # (n, c, c)
    log: Array  # (n,)

    @classmethod
    def of(cls, model: PlantModel, signals: Signals, course: Array, offsets: Offsets) -> Self:
        """Run an information filter from zero information after the last sample; parameters as for ForwardFilter."""
        inputs, measured = _columns(model, signals, course, offsets)
        weight = signals.valid.astype(np.float64)
        disturbances = model.disturbances(signals)[:-1]
        known = _information(model, weight, disturbances)
        inner = np.eye(2) + known @ disturbances
        softened = disturbances @ np.linalg.inv(inner)
        back = model.transition.T @ (np.eye(2) - known @ softened)
        inputs, measured = inputs[:-1], measured[1:]
        pushed = known @ inputs
        own = np.zeros_like(pushed)
        own[:, 0, :] = weight[1:, None] * measured
        vector = scan(back[::-1], (back @ (own - pushed))[::-1])[::-1]
        whole = _zero_last(vector[1:]) + own
        cross = _transpose(whole) @ inputs
        left = whole - pushed
        squares = weight[1:, None, None] * measured[:, :, None] * measured[:, None, :]
        squares += _transpose(inputs) @ pushed - cross - _transpose(cross) - _transpose(left) @ softened @ left
        return cls(
            _zero_last(vector),
            _zero_last(back @ known @ model.transition),
            _zero_last(np.cumsum(squares[::-1], axis=0)[::-1]),
            _zero_last(np.cumsum(np.log(np.linalg.det(inner))[::-1])[::-1]),
        )


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


def _gains(model: PlantModel, weight: Array, disturbances: Array) -> tuple[Array, Array, Array]:
    """Kalman gain (n, 2), innovation variance (n,) and updated covariance (n, 2, 2) at each sample.

    Plain floats: numpy takes ten times as long for a 2 x 2 product.
    """
    (a, b), (c, d) = model.transition.tolist()
    p, q, r = _DIFFUSE, 0.0, _DIFFUSE
    rows = []
    for w, (pp, pq, _, qq) in zip(weight.tolist(), disturbances.reshape(-1, 4).tolist(), strict=True):
        size = w * p + 1.0
        x, v = w * p / size, w * q / size
        p, q, r = p - x * p, q - x * q, r - v * q
        rows.append((x, v, size, p, q, q, r))
        p, q, r = (
            a * a * p + 2.0 * a * b * q + b * b * r + pp,
            a * c * p + (a * d + b * c) * q + b * d * r + pq,
            c * c * p + 2.0 * c * d * q + d * d * r + qq,
        )
    steps = np.array(rows)
    return steps[:, :2], steps[:, 2], steps[:, 3:].reshape(-1, 2, 2)


def _information(model: PlantModel, weight: Array, disturbances: Array) -> Array:
    """(n - 1, 2, 2) information on the state at each sample but the first, from that sample on."""
    (a, b), (c, d) = model.transition.tolist()
    p = q = r = 0.0
    rows = []
    for w, (pp, pq, _, qq) in zip(weight[:0:-1].tolist(), disturbances[::-1].reshape(-1, 4).tolist(), strict=True):
        p += w
        rows.append((p, q, q, r))
        # (information^-1 + disturbance)^-1 = (information + det(information) adj(disturbance)) / determinant
        det = p * r - q * q
        whole = 1.0 + p * pp + 2.0 * q * pq + r * qq + det * (pp * qq - pq * pq)
        p, q, r = (p + det * qq) / whole, (q - det * pq) / whole, (r + det * pp) / whole
        p, q, r = (
            a * a * p + 2.0 * a * c * q + c * c * r,
            a * b * p + (a * d + b * c) * q + c * d * r,
            b * b * p + 2.0 * b * d * q + d * d * r,
        )
    return np.array(rows[::-1]).reshape(-1, 2, 2)


def _transpose(matrices: Array) -> Array:
    """Transpose each of the matrices (m, r, c)."""
    return np.swapaxes(matrices, 1, 2)


def _zero_first(rows: Array) -> Array:
    return np.concatenate([np.zeros_like(rows[:1]), rows])


def _zero_last(rows: Array) -> Array:
    return np.concatenate([rows, np.zeros_like(rows[:1])])
