"""Plants of the thesis as difference equations, and its time-varying profile."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import freqz, lfilter, lfiltic

from analogrig.plant import AT_REST, Plant, SampledPlant
from analogrig.run import Segment
from analogrig_thesis.texts import Signal

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


REST = np.zeros(2)
"""Two samples at rest."""


class Arx(NamedTuple):
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
    def poles(self) -> list[float]:
        """Real parts of both poles, the larger pole first."""
        return [x.real for x in sorted(np.roots([1.0, self.a1, self.a2]).tolist(), key=abs, reverse=True)]

    @property
    def gain(self) -> float:
        """Static gain, metres per newton."""
        return (self.b0 + self.b1) / (1.0 + self.a1 + self.a2)

    def response(self, u: Signal, past_u: Signal = REST, past_y: Signal = REST) -> Signal:
        """Simulated output (n,) after two inputs and two outputs."""
        b, a = [0.0, self.b0, self.b1], [1.0, self.a1, self.a2]
        return np.asarray(lfilter(b, a, u, zi=lfiltic(b, a, past_y[::-1], past_u[::-1]))[0])

    def frequency_response(self, frequency_hz: Signal) -> NDArray[np.complex128]:
        """G(exp(j w T)) (n,)."""
        b, a = [0.0, self.b0, self.b1], [1.0, self.a1, self.a2]
        return np.asarray(freqz(b, a, 2.0 * math.pi * frequency_hz * PERIOD_S)[1])


def damping_ratio(plant: Plant) -> float:
    """B / (2 sqrt(K M))."""
    return plant.damping_n_s_per_m / (2.0 * math.sqrt(plant.stiffness_n_per_m * plant.mass_kg))


def square(n: int, amplitude: float, period_n: int = 100) -> Signal:
    """Square wave (n,) between ``-amplitude`` and ``amplitude`` that begins high; 100 samples are the thesis's 1 Hz."""
    return np.where(np.arange(n) % period_n < period_n // 2, amplitude, -amplitude)


def stretches(segments: Sequence[Segment], n: int) -> list[tuple[int, int, Plant]]:
    """First sample of each segment, that of the next one or ``n``, and the plant."""
    ends = itertools.pairwise([*(segment.start for segment in segments), n])
    return [(start, end, segment.plant) for (start, end), segment in zip(ends, segments, strict=True)]


def time_varying(u: Signal, segments: Sequence[Segment] = PROFILE, period_s: float = PERIOD_S) -> Signal:
    """Displacement (n,) of a plant whose parameters jump; position and velocity are continuous."""
    y, state = np.empty(len(u)), AT_REST
    for start, end, plant in stretches(segments, len(u)):
        sampled = SampledPlant.from_plant(plant, period_s)
        for k in range(start, end):
            y[k] = state[0]
            state = sampled.next(state, float(u[k]))
    return y


def jumps_in_the_coefficients(u: Signal) -> Signal:
    """Displacement (n,) over the profile if the coefficients of the difference equation jump instead of the plant."""
    inputs, y = np.append(REST, u), REST
    for start, end, plant in stretches(PROFILE, PROFILE_N):
        y = np.append(y, Arx.of(plant).response(u[start:end], inputs[start : start + 2], y[-2:]))
    return y[2:]


def coefficients(segments: Sequence[Segment], n: int) -> Signal:
    """True a1, a2, b0, b1 (n, 4) of each sample, in metres and newtons."""
    return np.concatenate([np.tile(Arx.of(plant), (end - start, 1)) for start, end, plant in stretches(segments, n)])
