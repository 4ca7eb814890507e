"""Plants of the thesis as difference equations, and its time-varying profile."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.plant import AT_REST, Plant, SampledPlant, Segment
from analogrig_thesis.document import Signal

PERIOD_S = 0.01
"""Section 4.2: "The system sample rate was 100Hz"."""

SHOCK = Plant(2.0, 900.0, 12250.0)
"""Shock absorber of section 4.2."""
FRONT = Plant(115.0, 3021.0, 24500.0)
"""Front suspension of section 4.4.1."""

PROFILE = (
    Segment(0, FRONT),
    Segment(200, Plant(115.0, 3021.0, 18000.0)),
    Segment(400, Plant(115.0, 3453.0, 18000.0)),
    Segment(500, Plant(115.0, 2123.0, 20000.0)),
    Segment(600, Plant(30.0, 2123.0, 20000.0)),
)
"""Section 4.4.1. Printed with both ends: 0 <= t <= 200, 201 <= t <= 400, ..."""
PROFILE_N = 800
CHANGE_LABELS = ("K↓", "B↑", "B↓, K↑", "M↓")


@dataclass(frozen=True)
class Arx:
    """y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k-1) + b1 u(k-2) (thesis Equ 3.10 with na = nb = 2)."""

    a1: float
    a2: float
    b0: float
    b1: float

    @classmethod
    def of(cls, plant: Plant) -> Arx:
        """Return the zero-order hold of a plant at ``PERIOD_S``, in metres per newton.

        Trace and determinant of the transition matrix are -a1 and a2; b follows from the first two values of the step
        response.
        """
        sampled = SampledPlant.from_plant(plant, PERIOD_S)
        xx, xv, vx, vv = sampled.transition
        first = sampled.next(AT_REST, 1.0)
        second = sampled.next(first, 1.0)
        a1, a2 = -(xx + vv), xx * vv - xv * vx
        return cls(a1, a2, first[0], second[0] + a1 * first[0] - first[0])

    @classmethod
    def scaled(cls, theta: NDArray[np.floating], b_scale: float) -> Arx:
        """Return the first four elements of ``theta`` (p,) with the b's times ``b_scale``."""
        a1, a2, b0, b1 = (float(x) for x in theta[:4])
        return cls(a1, a2, b0 * b_scale, b1 * b_scale)

    @property
    def values(self) -> tuple[float, float, float, float]:
        """a1, a2, b0, b1."""
        return (self.a1, self.a2, self.b0, self.b1)

    @property
    def poles(self) -> list[float]:
        """Real parts of both poles, the larger pole first."""
        return [x.real for x in sorted(np.roots([1.0, self.a1, self.a2]).tolist(), key=abs, reverse=True)]

    @property
    def gain(self) -> float:
        """Static gain, metres per newton."""
        return (self.b0 + self.b1) / (1.0 + self.a1 + self.a2)

    def response(self, u: Signal, before: tuple[Signal, Signal] | None = None) -> Signal:
        """Simulated output (n,).

        :param before: the two inputs and the two outputs before the first sample; zeros if omitted.
        """
        past_u, past_y = before or (np.zeros(2), np.zeros(2))
        inputs, y = [*past_u.tolist(), *u.tolist()], past_y.tolist()
        for k in range(len(u)):
            y.append(-self.a1 * y[k + 1] - self.a2 * y[k] + self.b0 * inputs[k + 1] + self.b1 * inputs[k])
        return np.array(y[2:])

    def frequency_response(self, frequency_hz: Signal) -> NDArray[np.complex128]:
        """G(exp(j w T)) (n,)."""
        z = np.exp(2j * math.pi * frequency_hz * PERIOD_S)
        return np.asarray((self.b0 * z + self.b1) / (z * z + self.a1 * z + self.a2))


def damping_ratio(plant: Plant) -> float:
    """B / (2 sqrt(K M))."""
    return plant.damping_n_s_per_m / (2.0 * math.sqrt(plant.stiffness_n_per_m * plant.mass_kg))


def square(n: int, amplitude: float, period_n: int = 100) -> Signal:
    """Square wave (n,) between ``-amplitude`` and ``amplitude`` that begins high; 100 samples are the thesis's 1 Hz."""
    return np.where(np.arange(n) % period_n < period_n // 2, amplitude, -amplitude)


def stretches(segments: Sequence[Segment], n: int) -> list[tuple[int, int]]:
    """First sample of each segment, and of the next one or ``n``."""
    return list(itertools.pairwise([*(segment.start for segment in segments), n]))


def time_varying(u: Signal, segments: Sequence[Segment] = PROFILE, period_s: float = PERIOD_S) -> Signal:
    """Displacement (n,) of a plant whose parameters jump; position and velocity are continuous."""
    y, state = np.empty(len(u)), AT_REST
    for segment, (start, end) in zip(segments, stretches(segments, len(u)), strict=True):
        sampled = SampledPlant.from_plant(segment.plant, period_s)
        for k in range(start, end):
            y[k] = state[0]
            state = sampled.next(state, float(u[k]))
    return y


def jumps_in_the_coefficients(u: Signal) -> Signal:
    """Displacement (n,) over the profile if the coefficients of the difference equation jump instead of the plant."""
    y, before = np.empty(0), (np.zeros(2), np.zeros(2))
    for segment, (start, end) in zip(PROFILE, stretches(PROFILE, len(u)), strict=True):
        y = np.append(y, Arx.of(segment.plant).response(u[start:end], before))
        before = (u[end - 2 : end], y[-2:])
    return y


def coefficients(segments: Sequence[Segment], n: int) -> Signal:
    """True a1, a2, b0, b1 (n, 4) of each sample, in metres and newtons."""
    out = np.empty((n, 4))
    for segment in segments:
        out[segment.start :] = Arx.of(segment.plant).values
    return out
