"""Conditions under which the model of the estimator does not fit, and the cause that est_fit names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from tests.estimator_c.est_driver import CAUSES
from tests.estimator_c.plants import CODES, DISPLACEMENT_RANGE_M, FRONT, NOISE_LSB, PERIOD_S, Excitation, simulate

__all__ = ["CAUSES", "CONDITIONS", "Condition", "whitened"]

Array = NDArray[np.float64]

SUBSTEPS = 4
"""Substeps of a sample, for the plant that is not linear."""


FREE = Excitation(on_samples=False, drift_ppm=20.0)
"""Excitation from a generator on a clock of its own."""


@dataclass(frozen=True)
class Condition:
    """A disturbance of the front suspension, and the misfit that should be reported."""

    cause: str
    """One of CAUSES."""
    share: float = 0.95
    """Least share of the runs with this cause after 2,000 samples."""
    excitation: Excitation = FREE
    disturb: Callable[[Array, np.random.Generator], Array] = lambda y, _: y
    """Codes of displacement (t, n) to disturbed ones."""
    hardening: float = 0.0
    """Part of the force of the spring that grows with the third power, at the deflection of the largest force."""

    def play(self, trials: int, samples: int, seed: int) -> tuple[Array, Array]:
        """(t, n) codes of force and of displacement."""
        rng = np.random.default_rng([seed, 2])
        if self.hardening:
            u, y = _hardened(self.hardening, self.excitation, trials, samples, rng)
        else:
            played = simulate((FRONT, FRONT), np.full(trials, samples), self.excitation, samples, seed)
            u, y = played.u, played.y
        return u, np.round(self.disturb(y, rng))


def whitened(x: ArrayLike, c: tuple[float, float]) -> Array:
    """Return x filtered by 1 / (1 + c1 z^-1 + c2 z^-2)."""
    return np.asarray(signal.lfilter([1.0], [1.0, *c], x))


def _hardened(
    part: float, excitation: Excitation, trials: int, samples: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Codes of a plant with a cubic spring, by Runge and Kutta's method; edges come at sampling instants."""
    edges = np.floor((np.arange(samples)[:, None] - excitation.first_edges(rng, trials)) / excitation.half_period_n)
    force = (np.floor(edges) % 2.0) * FRONT.force_range_n
    mass, damping, stiffness = FRONT.mass_kg, FRONT.damping_n_s_per_m, FRONT.stiffness_n_per_m
    most = FRONT.force_range_n / stiffness
    step = PERIOD_S / SUBSTEPS

    def slope(state: Array, pushed: Array) -> Array:
        x, v = state
        spring = stiffness * x * (1.0 - part + part * (x / most) ** 2)
        return np.array([v, (pushed - damping * v - spring) / mass])

    state, out = np.zeros((2, trials)), np.empty((samples, trials))
    for k in range(samples):
        out[k] = state[0]
        for _ in range(SUBSTEPS):
            first = slope(state, force[k])
            second = slope(state + 0.5 * step * first, force[k])
            third = slope(state + 0.5 * step * second, force[k])
            fourth = slope(state + step * third, force[k])
            state = state + step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    codes = [force.T * (CODES / FRONT.force_range_n), out.T * (CODES / DISPLACEMENT_RANGE_M)]
    u, y = (np.round(each + rng.normal(0.0, NOISE_LSB, each.shape)) for each in codes)
    return u, y


def _coloured(codes: float, correlation: float) -> Callable[[Array, np.random.Generator], Array]:
    """Autoregressive noise of first order with this standard deviation."""

    def disturb(y: Array, rng: np.random.Generator) -> Array:
        driven = rng.normal(0.0, codes * np.sqrt(1.0 - correlation**2), y.shape)
        return np.asarray(y + signal.lfilter([1.0], [1.0, -correlation], driven, axis=1))

    return disturb


def _proportional(part: float) -> Callable[[Array, np.random.Generator], Array]:
    """White noise whose standard deviation is this part of the displacement."""
    return lambda y, rng: y * (1.0 + part * rng.normal(0.0, 1.0, y.shape))


def _impulses(codes: float, share: float) -> Callable[[Array, np.random.Generator], Array]:
    """Impulses of either sign on this share of the samples."""
    return lambda y, rng: y + codes * rng.choice([-1.0, 1.0], y.shape) * (rng.random(y.shape) < share)


def _heavy_tails(codes: float, degrees: float) -> Callable[[Array, np.random.Generator], Array]:
    """Noise of Student's t distribution with this standard deviation."""
    scale = codes * np.sqrt(1.0 - 2.0 / degrees)
    return lambda y, rng: y + scale * rng.standard_t(degrees, y.shape)


def _timing(samples: float) -> Callable[[Array, np.random.Generator], Array]:
    """Jitter of the sampling instants with this standard deviation."""
    return lambda y, rng: y + samples * np.gradient(y, axis=1) * rng.normal(0.0, 1.0, y.shape)


def _popcorn(codes: float, dwell_n: float) -> Callable[[Array, np.random.Generator], Array]:
    """Jumps between two levels, this much either side, after ``dwell_n`` samples on average."""
    return lambda y, rng: y + codes * (-1.0) ** np.cumsum(rng.random(y.shape) < 1.0 / dwell_n, axis=1)


def _hum(codes: float, cycles: float) -> Callable[[Array, np.random.Generator], Array]:
    """A sine of this amplitude and of ``cycles`` per sample, at a phase of its own in each trial."""

    def disturb(y: Array, rng: np.random.Generator) -> Array:
        phase = rng.uniform(0.0, 2.0 * np.pi, (len(y), 1))
        return y + codes * np.sin(2.0 * np.pi * cycles * np.arange(y.shape[1]) + phase)

    return disturb


def _drift(codes: float) -> Callable[[Array, np.random.Generator], Array]:
    return lambda y, _: y + codes * np.arange(y.shape[1])


CONDITIONS = {
    "noise, 2 LSB autoregressive 0.9": Condition("noise", share=0.8, disturb=_coloured(2.0, 0.9)),
    "noise, 0.1 % of the displacement": Condition("noise", disturb=_proportional(0.001)),
    "noise, 8 LSB on 1 % of the samples": Condition("noise", disturb=_impulses(8.0, 0.01)),
    "noise, jumps of 3 LSB after 200 samples": Condition("noise", share=0.9, disturb=_popcorn(1.5, 200.0)),
    "noise, Student's t with 3 degrees of freedom": Condition("noise", disturb=_heavy_tails(1.0, 3.0)),
    "noise, jitter of 0.01 samples": Condition("noise", disturb=_timing(0.01)),
    "hum, 1 LSB, 50 Hz": Condition("hum", disturb=_hum(1.0, 50.0 / 20e3)),
    "hum, 1 LSB, 150 Hz": Condition("hum", disturb=_hum(1.0, 150.0 / 20e3)),
    "hum, 3 LSB, 50 Hz": Condition("hum", disturb=_hum(3.0, 50.0 / 20e3)),
    "hum, 10 LSB, 50 Hz": Condition("hum", disturb=_hum(10.0, 50.0 / 20e3)),
    "drift, 0.01 code a sample": Condition("drift", disturb=_drift(0.01)),
    "drift, 0.1 code a sample": Condition("drift", disturb=_drift(0.1)),
    "spring, cubic 1 %": Condition("nonlinear", hardening=0.01),
    "spring, cubic 5 %": Condition("nonlinear", hardening=0.05),
    "spring, cubic 20 %": Condition("nonlinear", hardening=0.2),
    "edges, 190 Hz": Condition("edges", excitation=replace(FREE, half_period_n=20e3 / 380.0)),
    "edges, 100 ppm": Condition("edges", excitation=replace(FREE, drift_ppm=100.0)),
    "excitation, 3 %": Condition("excitation", excitation=replace(FREE, part_of_range=0.03)),
}
