"""Codes of simulated plants for the statistics: exact, many trials at once, independent of the emulator.

M x'' + B x' + K x = F with a force that toggles at any instants; only the displacement and the reading of the force are
disturbed (an output-error plant): 12-bit rounding and 1 LSB of white noise on each channel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PERIOD_S = 0.01
"""Problem time between samples."""
CODES = 4096
NOISE_LSB = 1.0
VARIANCE_LSB2 = NOISE_LSB**2 + 1.0 / 12.0
"""Variance of the displacement: noise and rounding."""
DISPLACEMENT_RANGE_M = 0.1996
"""On 10 V (facts, section 1)."""


@dataclass(frozen=True)
class Mechanics:
    """A plant and the force that drives it over the whole range of the generator."""

    mass_kg: float
    damping_n_s_per_m: float
    stiffness_n_per_m: float
    force_range_n: float

    def scaled(self, parameter: str, factor: float) -> Mechanics:
        """The plant with its "M", "B" or "K" times a factor."""
        name = {"M": "mass_kg", "B": "damping_n_s_per_m", "K": "stiffness_n_per_m"}[parameter]
        return replace(self, **{name: getattr(self, name) * factor})

    def slowed(self, factor: float) -> Mechanics:
        """The plant, so many times slower and as stiff."""
        return replace(self, mass_kg=self.mass_kg * factor**2, damping_n_s_per_m=self.damping_n_s_per_m * factor)

    def poles(self) -> tuple[complex, complex]:
        """Per second."""
        half = self.damping_n_s_per_m / (2.0 * self.mass_kg)
        root = np.sqrt(complex(half**2 - self.stiffness_n_per_m / self.mass_kg))
        return complex(-half + root), complex(-half - root)

    def transition(self, span_n: float) -> Array:
        """(2, 2): (x, v) after so many sample periods without force, from (x, v)."""
        first, second = self.poles()
        a, b = np.exp(first * span_n * PERIOD_S), np.exp(second * span_n * PERIOD_S)
        product, gap = first * second, first - second
        rows = [[first * b - second * a, a - b], [product * (b - a), first * a - second * b]]
        return np.asarray((np.array(rows) / gap).real)

    def response(self, span_n: Array) -> Array:
        """(2, ...): (x, v) per newton that has acted for so many sample periods, from rest."""
        first, second = self.poles()
        a, b = np.exp(first * span_n * PERIOD_S), np.exp(second * span_n * PERIOD_S)
        gap = first - second
        x = 1.0 + (second * a - first * b) / gap
        v = first * second * (a - b) / gap
        return np.asarray(np.array([x, v]).real / self.stiffness_n_per_m)


FRONT = Mechanics(115.0, 3021.0, 24500.0, 2940.0)
SHOCK = Mechanics(2.0, 900.0, 12250.0, 1470.0)
LIGHT = Mechanics(30.0, 2123.0, 20000.0, 2940.0)


def random_plants(count: int, seed: int) -> list[Mechanics]:
    """Plants that the analogue computer can take on: M, K and the damping ratio drawn evenly on a logarithmic scale.

    The static displacement is at most that of 90 % of the range.
    """
    rng = np.random.default_rng(seed)
    mass = np.exp(rng.uniform(np.log(30.0), np.log(150.0), count))
    stiffness = np.exp(rng.uniform(np.log(17000.0), np.log(30000.0), count))
    damping = np.exp(rng.uniform(np.log(0.4), np.log(1.2), count)) * 2.0 * np.sqrt(stiffness * mass)
    return [Mechanics(m, b, k, 2940.0) for m, b, k in zip(mass, damping, stiffness, strict=True)]


def plants_of_any_speed(count: int, seed: int) -> list[tuple[Mechanics, float]]:
    """Plants of ``random_plants`` at other speeds, each with a half period of the excitation, in samples.

    The larger pole lies between 0.3 and 0.999, its logarithm evenly on a logarithmic scale. The half period is in
    proportion to the time constant, as for the front suspension, within 10 and 500 samples.
    """
    rng = np.random.default_rng([seed, 1])
    usual = _decay(FRONT)
    decays = np.exp(rng.uniform(np.log(-np.log(0.999)), np.log(-np.log(0.3)), count))
    drawn = [
        (plant.slowed(_decay(plant) / decay), decay)
        for plant, decay in zip(random_plants(count, seed), decays.tolist(), strict=True)
    ]
    return [(plant, float(np.clip(np.rint(50.0 * usual / decay), 10.0, 500.0))) for plant, decay in drawn]


def _decay(plant: Mechanics) -> float:
    """Negative logarithm of the magnitude of the larger pole, per sample."""
    return -max(pole.real for pole in plant.poles()) * PERIOD_S


@dataclass(frozen=True)
class Excitation:
    """A square wave between 0 and a part of the force range, its edges at instants in the time of the samples."""

    part_of_range: float = 1.0
    half_period_n: float = 50.0
    on_samples: bool = True
    """Edges come at sampling instants, and the sample there has the new level; else anywhere between them."""
    drift_ppm: float = 0.0

    def first_edges(self, rng: np.random.Generator, trials: int) -> Array:
        """(trials,) instants of a first edge, in samples, evenly distributed over a half period."""
        instants = rng.uniform(0.0, self.half_period_n, trials)
        return np.floor(instants) if self.on_samples else instants


@dataclass(frozen=True, eq=False)
class Trials:
    """t runs of n samples in each of which the plant may change once."""

    u: Array
    """(t, n) codes of force."""
    y: Array
    """(t, n) codes of displacement."""
    onset: NDArray[np.int64]
    """(t,) the last sample before the change can be seen; n where there is none."""
    information: Array
    """(t, n): I of analogrig.judging.information up to each sample; 0 as long as nothing has changed."""


@dataclass(frozen=True, eq=False)
class _Force:
    """The level at each sample and, where an edge comes before the next one, what is left of the interval after it."""

    level_n: Array
    rest_n: Array
    step_n: Array

    @classmethod
    def of(cls, excitation: Excitation, first: Array, samples: int, force_n: float) -> _Force:
        """(samples, t) each."""
        half = excitation.half_period_n * (1.0 + excitation.drift_ppm * 1e-6)
        edges = np.floor((np.arange(samples + 1.0)[:, None] - first) / half) + 1.0
        level = (edges % 2.0) * force_n
        instant = first + edges[:-1] * half
        return cls(level[:-1], np.arange(1.0, samples + 1.0)[:, None] - instant, np.diff(level, axis=0))


def motion(plants: tuple[Mechanics, Mechanics], onset: NDArray[np.int64], force: _Force) -> Array:
    """(samples, t) metres, from rest: the first plant up to sample ``onset``, the second from there."""
    transitions = np.stack([plant.transition(1.0) for plant in plants])
    driven = np.stack([_driven(plant, force) for plant in plants])
    samples, trials = force.level_n.shape
    out = np.empty((samples, trials))
    x, v = np.zeros(trials), np.zeros(trials)
    lane = np.arange(trials)
    for k in range(samples):
        out[k] = x
        now = (k >= onset).astype(np.intp)
        (xx, xv), (vx, vv) = transitions[now].transpose(1, 2, 0)
        dx, dv = driven[now, :, k, lane].T
        x, v = xx * x + xv * v + dx, vx * x + vv * v + dv
    return out


def _driven(plant: Mechanics, force: _Force) -> Array:
    """(2, samples, t): what the force of each interval adds to (x, v) at its end."""
    out = plant.response(np.ones(1))[:, :, None] * force.level_n
    at = np.nonzero(force.step_n)
    out[:, at[0], at[1]] += plant.response(force.rest_n[at]) * force.step_n[at]
    return np.asarray(out)


def simulate(
    plants: tuple[Mechanics, Mechanics], onset: NDArray[np.int64], excitation: Excitation, samples: int, seed: int
) -> Trials:
    """Responses of as many trials as there are onsets."""
    rng = np.random.default_rng(seed)
    force_n = plants[0].force_range_n
    first = excitation.first_edges(rng, len(onset))
    force = _Force.of(excitation, first, samples, force_n * excitation.part_of_range)
    x = motion(plants, onset, force)
    information = np.zeros_like(x)
    if (onset < samples).any():
        unchanged = motion((plants[0], plants[0]), onset, force)
        seen = (x - unchanged) * (CODES / DISPLACEMENT_RANGE_M)
        information = np.cumsum(seen**2, axis=0) / (2.0 * VARIANCE_LSB2)
    return Trials(
        u=_codes(force.level_n.T, force_n, rng),
        y=_codes(x.T, DISPLACEMENT_RANGE_M, rng),
        onset=onset,
        information=np.ascontiguousarray(information.T),
    )


def _codes(signal: Array, full_range: float, rng: np.random.Generator) -> Array:
    return np.round(signal * (CODES / full_range) + rng.normal(0.0, NOISE_LSB, signal.shape))


def cramer_rao(plant: Mechanics, excitation: Excitation, samples: int, seed: int, trials: int) -> Array:
    """(3,) relative standard deviations of M, B and K that no unbiased estimator from rest can better.

    Each from the mean Fisher information of so many trials, with derivatives of the motion by central differences.
    """
    rng = np.random.default_rng(seed)
    force = _Force.of(excitation, excitation.first_edges(rng, trials), samples, plant.force_range_n)
    never = np.full(trials, samples)
    step = 1e-4
    slopes = []
    for name in "MBK":
        high, low = (motion((p, p), never, force) for p in (plant.scaled(name, 1 + step), plant.scaled(name, 1 - step)))
        slopes.append((high - low) / (2.0 * step) * (CODES / DISPLACEMENT_RANGE_M))
    fisher = np.einsum("ikt,jkt->tij", np.array(slopes), np.array(slopes)) / VARIANCE_LSB2
    return np.asarray(np.sqrt(np.mean(np.linalg.inv(fisher).diagonal(axis1=1, axis2=2), axis=0)))
