"""The likelihood of a change of the plant at every sample at once: a Kalman filter with the plant as it was runs
forwards, an information filter with the plant as it then is runs backwards, and at each instant they are joined by the
state (displacement and velocity), which goes through a change without a jump (two filters; Fraser and Potter 1969).

What is not known enters linearly, about its best value so far, and is carried along in columns: the offset of the
displacement and the place of the edges, which both plants share, and of each plant the offset of the force and the
logarithms of M, B, K. The sampled force does not tell where between two samples an edge came: beside its mean place,
how far it may be off is noise that disturbs the state there.
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
"""Unknowns that both plants share, and those of each: a filter has 1 + COMMON + OWN columns, the first one known."""

_EDGE = 30.0
"""A step of the force is an edge, in rms of its noise."""
_DIFFUSE = 1e6
"""Variance of the state at the first sample, in that of the noise."""
_VANISHED = 1e-14
_STEP = 1e-4
"""Of a logarithm of M, B or K, for a derivative; of a place in a sample period it is a hundred times that."""
_PLACES = (np.arange(8) + 0.5) / 4.0 - 1.0
"""Over a range of half width 1: the middles of eight parts."""


@dataclass(frozen=True, eq=False)
class Signals:
    """n consecutive samples, without a gap in time, of force and displacement."""

    force_n: Array
    """(n,) newtons."""
    displacement_m: Array
    """(n,) metres."""
    valid: NDArray[np.bool_]
    """(n,): the displacement was measured, not clipped or lost."""
    period_s: float
    """Problem time between samples."""
    noise_n: float
    """rms of the noise of the force, quantisation included."""
    noise_m: float
    """rms of the noise of the displacement, quantisation included."""

    @classmethod
    def of(
        cls, codes: NDArray[np.uint16], clipped: NDArray[np.bool_], channels: Mapping[str, Channel], period_s: float
    ) -> Self:
        """Of codes and clipped (n, 4), columns as CHANNELS."""
        columns = {name: channels[name].physical(codes[:, CHANNELS.index(name)]) for name in MEASURED}
        noise_n, noise_m = (
            (channels[name].noise_lsb ** 2 + QUANTISATION_VARIANCE_LSB2) ** 0.5 * abs(channels[name].lsb)
            for name in MEASURED
        )
        valid = ~missing_to_device(clipped)
        return cls(columns["force"], columns["displacement"], valid, period_s, noise_n, noise_m)

    def part(self, first: int, end: int) -> Signals:
        """The samples first <= k < end."""
        return replace(
            self,
            force_n=self.force_n[first:end],
            displacement_m=self.displacement_m[first:end],
            valid=self.valid[first:end],
        )

    def __len__(self) -> int:
        return len(self.valid)

    @functools.cached_property
    def edges_n(self) -> Array:
        """(n,) newtons: the step of the force in the period after each sample, where it is an edge, otherwise 0."""
        steps = np.append(np.diff(self.force_n), 0.0)
        return np.where(np.abs(steps) < _EDGE * self.noise_n, 0.0, steps)


@dataclass(frozen=True)
class EdgePlace:
    """Where in a sample period the edges of the force come: around a mean place (0..1), evenly within a half width."""

    mean: float
    half_width: float


ANYWHERE = EdgePlace(0.5, 0.5)


@dataclass(frozen=True, eq=False)
class PlantModel:
    """One plant from sample to sample. Displacement in the rms of its noise, velocity in that per sample.

    Derivatives are by the logarithms of M, B, K.
    """

    transition: Array
    """(2, 2)"""
    response: Array
    """(2,) per newton that is held."""
    edge: Array
    """(2,) per newton of an edge, on average over its places."""
    edge_covariance: Array
    """(2, 2) of that."""
    edge_by_place: Array
    """(2,)"""
    transition_by: Array
    """(3, 2, 2)"""
    response_by: Array
    """(3, 2)"""
    edge_by: Array
    """(3, 2)"""

    @classmethod
    def of(cls, plant: Plant, edges: EdgePlace, signals: Signals) -> Self:
        """For the period and the noise of ``signals``."""
        transition, response = _sampled(plant, 1.0, signals)
        places = np.clip(edges.mean + edges.half_width * _PLACES, 0.0, 1.0)
        late = np.array([_sampled(plant, 1.0 - place, signals)[1] for place in places.tolist()])
        beside = np.clip([edges.mean - 100.0 * _STEP, edges.mean + 100.0 * _STEP], 0.0, 1.0)
        ends = [_sampled(plant, 1.0 - place, signals)[1] for place in beside.tolist()]
        moved = [plant.scaled(name, 1.0 + _STEP) for name in PARAMETERS]
        sampled = [_sampled(each, 1.0, signals) for each in moved]
        middle = _sampled(plant, 1.0 - edges.mean, signals)[1]
        return cls(
            transition=transition,
            response=response,
            edge=late.mean(axis=0),
            edge_covariance=np.cov(late.T, bias=True),
            edge_by_place=(ends[1] - ends[0]) / (beside[1] - beside[0]),
            transition_by=np.array([each[0] - transition for each in sampled]) / _STEP,
            response_by=np.array([each[1] - response for each in sampled]) / _STEP,
            edge_by=np.array([_sampled(each, 1.0 - edges.mean, signals)[1] - middle for each in moved]) / _STEP,
        )

    def inputs(self, signals: Signals, offset: float) -> Array:
        """(n, 2): what the force does to the state in the period after each sample.

        :param offset: of the force, in the rms of its noise.
        """
        force = (signals.force_n + offset * signals.noise_n)[:, None]
        return np.asarray(self.response * force + self.edge * signals.edges_n[:, None])

    def disturbances(self, signals: Signals) -> Array:
        """(n, 2, 2): covariance of what is not known of that."""
        noise = signals.noise_n**2 * np.outer(self.response, self.response)
        return np.asarray(noise + signals.edges_n[:, None, None] ** 2 * self.edge_covariance)


def _sampled(plant: Plant, part: float, signals: Signals) -> tuple[Array, Array]:
    """Transition (2, 2) and response (2,) over a part of a sample period."""
    if part <= 0.0:
        return np.eye(2), np.zeros(2)
    period_s = signals.period_s
    sampled = SampledPlant.of(plant, part * period_s)
    (xx, xv, vx, vv), (xf, vf) = sampled.transition, sampled.response
    transition = np.array([[xx, xv / period_s], [vx * period_s, vv]])
    return transition, np.array([xf, vf * period_s]) / signals.noise_m


@dataclass(frozen=True, eq=False)
class Columns:
    """What drives a filter and what it is to explain; c columns, the first known, the others per unit of an unknown."""

    inputs: Array
    """(n, 2, c): of the state, in the period after each sample."""
    measured: Array
    """(n, c): the displacement."""

    @classmethod
    def of(cls, model: PlantModel, signals: Signals, course: Array, offsets: tuple[float, float]) -> Self:
        """About a course of the state (n, 2) and offsets of displacement and force, in the rms of their noise."""
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
        return cls(inputs, measured)


@dataclass(frozen=True, eq=False)
class Forwards:
    """What the samples up to each one say, itself included."""

    state: Array
    """(n, 2, c): the columns of the state's mean."""
    covariance: Array
    """(n, 2, 2)"""
    misfit: Array
    """(n, c, c): the quadratic form of what is left of the samples, in their noise."""
    log: Array
    """(n,): sum of the logarithms of the innovations' variances."""
    innovation: Array
    """(n, c): in their standard deviation; 0 for a sample that is none."""

    @classmethod
    def of(cls, model: PlantModel, signals: Signals, columns: Columns) -> Self:
        """A Kalman filter that begins with any state."""
        weight = signals.valid.astype(np.float64)
        gain, size, covariance = _gains(model, weight, model.disturbances(signals))
        kept = np.tile(np.eye(2), (len(signals), 1, 1))
        kept[:, :, 0] -= gain
        entering = _after_first(columns.inputs[:-1])
        taken = gain[:, :, None] * columns.measured[:, None, :]
        state = scan(kept @ model.transition, kept @ entering + taken)
        predicted = _after_first(model.transition @ state[:-1]) + entering
        innovation = columns.measured - predicted[:, 0, :]
        innovation *= np.sqrt(weight / size)[:, None]
        misfit = np.cumsum(innovation[:, :, None] * innovation[:, None, :], axis=0)
        return cls(state, covariance, misfit, np.cumsum(np.log(size)), innovation)


@dataclass(frozen=True, eq=False)
class Backwards:
    """What the samples after each one say of the state there, itself not included: x' information x - 2 x' vector."""

    vector: Array
    """(n, 2, c)"""
    information: Array
    """(n, 2, 2)"""
    misfit: Array
    """(n, c, c)"""
    log: Array
    """(n,)"""

    @classmethod
    def of(cls, model: PlantModel, signals: Signals, columns: Columns) -> Self:
        """An information filter that begins, at the end, knowing nothing."""
        weight = signals.valid.astype(np.float64)
        disturbances = model.disturbances(signals)[:-1]
        known = _informations(model, weight, disturbances)  # at the sample after each, that one included
        inner = np.eye(2) + known @ disturbances
        softened = disturbances @ np.linalg.inv(inner)
        back = model.transition.T @ (np.eye(2) - known @ softened)
        inputs, measured = columns.inputs[:-1], columns.measured[1:]
        pushed = known @ inputs
        own = np.zeros_like(pushed)
        own[:, 0, :] = weight[1:, None] * measured
        vector = scan(back[::-1], (back @ (own - pushed))[::-1])[::-1]
        whole = _before_last(vector[1:]) + own
        cross = _turned(whole) @ inputs
        left = whole - pushed
        squares = weight[1:, None, None] * measured[:, :, None] * measured[:, None, :]
        squares += _turned(inputs) @ pushed - cross - _turned(cross) - _turned(left) @ softened @ left
        return cls(
            _before_last(vector),
            _before_last(back @ known @ model.transition),
            _before_last(np.cumsum(squares[::-1], axis=0)[::-1]),
            _before_last(np.cumsum(np.log(np.linalg.det(inner))[::-1])[::-1]),
        )


def joined(state: Array, covariance: Array, vector: Array, information: Array) -> tuple[Array, Array]:
    """What the two filters say of each other where they meet: the quadratic form (m, c, c) and the logarithm (m,).

    state, vector (m, 2, c) over the columns of both; covariance, information (m, 2, 2).
    """
    inner = np.eye(2) + information @ covariance
    left = vector - information @ state
    cross = _turned(state) @ vector
    form = _turned(state) @ information @ state - cross - _turned(cross)
    form -= _turned(left) @ covariance @ np.linalg.inv(inner) @ left
    return form, np.log(np.linalg.det(inner))


def scan(factors: Array, terms: Array) -> Array:
    """s(k) = factors(k) s(k-1) + terms(k) from s(-1) = 0; (n, 2, 2) and (n, 2, c) to (n, 2, c). By doubling."""
    factors, sums, shift = factors.copy(), terms.copy(), 1
    factors[:1] = 0.0
    while shift < len(sums) and np.abs(factors).max() > _VANISHED:
        sums[shift:] += factors[shift:] @ sums[:-shift]
        factors[shift:] = factors[shift:] @ factors[:-shift]
        factors[:shift] = 0.0
        shift *= 2
    return sums


def _gains(model: PlantModel, weight: Array, disturbances: Array) -> tuple[Array, Array, Array]:
    """Of each sample the gain (n, 2), the innovation's variance (n,), and the covariance with it taken in (n, 2, 2).

    In plain floats, since a 2 x 2 product takes numpy ten times as long.
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
    table = np.array(rows)
    return table[:, :2], table[:, 2], table[:, 3:].reshape(-1, 2, 2)


def _informations(model: PlantModel, weight: Array, disturbances: Array) -> Array:
    """(n - 1, 2, 2): what the samples from the next one on say of the state at that next one."""
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


def _turned(matrices: Array) -> Array:
    return np.swapaxes(matrices, 1, 2)


def _after_first(rows: Array) -> Array:
    return np.concatenate([np.zeros_like(rows[:1]), rows])


def _before_last(rows: Array) -> Array:
    return np.concatenate([rows, np.zeros_like(rows[:1])])
