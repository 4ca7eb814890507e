"""Runs that the emulator cannot play: a cubic spring, and converters of more than 16 bits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from analogrig.rigs.emulator import Stream
from analogrig_emulator import PROGRAMS

from .played import (
    CARD,
    DISPLACEMENT,
    FORCE,
    HALF_PERIOD_N,
    HIGH_V,
    LOW_V,
    PARAMETERS,
    Array,
    Change,
    Played,
    accumulate,
)


@dataclass(frozen=True)
class Simulated:
    """Condition that the emulator cannot play: M x'' + B x' + K x (1 + cubic (x / x_full)^2) = F, by Runge and Kutta.

    x_full is the displacement of the linear spring at the largest force. Scales are those of the front suspension on
    the shipped rig's card.
    """

    cubic: float = 0.0
    bits: int = 12
    noise_lsb: float = 1.0
    steps: int = 4
    """Integration steps in a sample period."""

    def play(self, seeds: Sequence[int], samples: int, changes: Sequence[Change | None]) -> Iterator[Played]:
        program, lanes = PROGRAMS["front"], len(seeds)
        lsb = CARD.lsb_v * 2.0 ** (CARD.bits - self.bits)
        phases = np.array([Stream.EXCITATION.generator(seed).uniform() for seed in seeds])
        at_n = np.arange(samples)[:, None] + np.floor(2 * HALF_PERIOD_N * phases)
        volts = np.where(at_n // HALF_PERIOD_N % 2 == 0, HIGH_V, LOW_V)
        force_n = volts / program.scales.volts("force")
        per_m = program.scales.volts("displacement") / lsb[DISPLACEMENT]
        seen = self._motion_m(force_n, changes) * per_m
        seen_unchanged = self._motion_m(force_n, [None] * lanes) * per_m if any(changes) else seen
        low_lsb = CARD.low_v / lsb
        for lane, (seed, change) in enumerate(zip(seeds, changes, strict=True)):
            information = np.zeros(samples)
            if change is not None:
                first = change.sample + 1
                apart = seen[first:, lane] - seen_unchanged[first:, lane]
                information[first:] = accumulate(apart, self.noise_lsb**2)
            noise = self.noise_lsb * Stream.CARD.generator(seed).standard_normal((2, samples))
            u = np.rint(volts[:, lane] / lsb[FORCE] - low_lsb[FORCE] + noise[0])
            y = np.rint(seen[:, lane] - low_lsb[DISPLACEMENT] + noise[1])
            yield Played(u, y, np.ones(samples, np.bool_), information)

    def _motion_m(self, force_n: Array, changes: Sequence[Change | None]) -> Array:
        """Displacement at each sample, of the shape of ``force_n``: (samples, lanes)."""
        samples, lanes = force_n.shape
        program = PROGRAMS["front"]
        parameters = np.tile(np.array(list(program.values.values())[:3])[:, None], lanes)
        bent = self.cubic / (program.scales.full("force") / parameters[2, 0]) ** 2
        h = program.scales.time / CARD.rate_hz / self.steps
        spring = _Spring(parameters, bent)
        out, x, v = np.empty_like(force_n), np.zeros(lanes), np.zeros(lanes)
        for k in range(samples):
            out[k] = x
            for lane, change in enumerate(changes):
                if change is not None and change.sample == k:
                    parameters[PARAMETERS.index(change.parameter), lane] *= change.factor
            for _ in range(self.steps):
                x, v = spring.advanced(x, v, force_n[k], h)
        return out


@dataclass(frozen=True, eq=False)
class _Spring:
    """Plants with a cubic spring."""

    parameters: Array
    """(3, lanes): M, B and K."""
    bent: float
    """Relative rise of the stiffness per square metre."""

    def acceleration(self, x: Array, v: Array, force_n: Array) -> Array:
        mass, damping, stiffness = self.parameters
        return np.asarray((force_n - damping * v - stiffness * x * (1.0 + self.bent * x * x)) / mass)

    def advanced(self, x: Array, v: Array, force_n: Array, h: float) -> tuple[Array, Array]:
        """Displacement and velocity ``h`` seconds later, by the classical method of Runge and Kutta."""
        a1 = self.acceleration(x, v, force_n)
        v2 = v + 0.5 * h * a1
        a2 = self.acceleration(x + 0.5 * h * v, v2, force_n)
        v3 = v + 0.5 * h * a2
        a3 = self.acceleration(x + 0.5 * h * v2, v3, force_n)
        v4 = v + h * a3
        a4 = self.acceleration(x + h * v3, v4, force_n)
        return x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4), v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
