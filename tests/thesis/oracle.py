"""Thesis experiments in numpy and scipy in double precision: the reference for claims.json.

Neither analogrig_thesis nor the C is used: scipy discretises the plants, the recursion is Equ 3.19 and 3.20 as printed,
the triggers follow sections 4.4.2 and 4.4.3.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete

Signal = NDArray[np.float64]

PERIOD_S = 0.01
PROFILE = {
    0: (115.0, 3021.0, 24500.0),
    200: (115.0, 3021.0, 18000.0),
    400: (115.0, 3453.0, 18000.0),
    500: (115.0, 2123.0, 20000.0),
    600: (30.0, 2123.0, 20000.0),
}
CHANGES = (200, 400, 500, 600)


def discrete(mass_kg: float, damping_n_s_per_m: float, stiffness_n_per_m: float) -> list[float]:
    """Return a1, a2, b0, b1 by scipy's zero-order hold."""
    num, den, _ = cont2discrete(([1.0], [mass_kg, damping_n_s_per_m, stiffness_n_per_m]), PERIOD_S)
    return [float(x) for x in (den[1], den[2], num[0][1], num[0][2])]


def square(n: int, high: float, low: float) -> Signal:
    return np.where(np.arange(n) % 100 < 50, high, low)


def arx(u: Signal, theta: Sequence[float]) -> Signal:
    """Return y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k-1) + b1 u(k-2) (n,), from rest."""
    a1, a2, b0, b1 = theta
    y = np.zeros(len(u) + 2)
    past = np.concatenate([[0.0, 0.0], u])
    for k in range(2, len(y)):
        y[k] = -a1 * y[k - 1] - a2 * y[k - 2] + b0 * past[k - 1] + b1 * past[k - 2]
    return y[2:]


def suspension(u: Signal) -> Signal:
    """Displacement (n,) over the profile; the state is continuous at a change."""
    y, state = np.empty(len(u)), np.zeros(2)
    for k in range(len(u)):
        if k in PROFILE:
            phi, gamma, *_ = cont2discrete(state_space(*PROFILE[k]), PERIOD_S)
        y[k] = state[0]
        state = phi @ state + gamma[:, 0] * u[k]
    return y


def state_space(mass_kg: float, damping_n_s_per_m: float, stiffness_n_per_m: float) -> tuple[Signal, ...]:
    """State space of position and velocity, driven by the force."""
    a = np.array([[0.0, 1.0], [-stiffness_n_per_m / mass_kg, -damping_n_s_per_m / mass_kg]])
    return a, np.array([[0.0], [1.0 / mass_kg]]), np.eye(2), np.zeros((2, 1))


def lighter_for_a_while(u: Signal, at: int, apart: int, period_s: float) -> Signal:
    """Displacement (n,) of the profile's first plant; from ``at`` on it is the last plant for ``apart`` samples."""
    first, *_, last = (cont2discrete(state_space(*plant), period_s) for plant in PROFILE.values())
    y, state = np.empty(len(u)), np.zeros(2)
    for k in range(len(u)):
        phi, gamma, *_ = last if at <= k < at + apart else first
        y[k] = state[0]
        state = phi @ state + gamma[:, 0] * u[k]
    return y


def kalman(u: Signal, y: Signal, walk: float, nb: int) -> Signal:
    """Kalman estimates (n, p) of a state theta(k+1) = theta(k) + w(k), E(w w') = walk I, with measurement noise 1.

    Textbook form: gain, measurement update by Joseph's formula, time update.
    """
    n = 2 + nb
    theta, p = np.zeros(n), 10.0 * np.eye(n)
    out = np.zeros((len(u), n))
    for k in range(2, len(u)):
        phi = np.array([-y[k - 1], -y[k - 2], *(u[k - 1 - i] for i in range(nb))])
        gain = p @ phi / (phi @ p @ phi + 1.0)
        theta = theta + gain * (y[k] - phi @ theta)
        left = np.eye(n) - np.outer(gain, phi)
        p = left @ p @ left.T + np.outer(gain, gain) + walk * np.eye(n)
        out[k] = theta
    return out


class Rls:
    """Recursion of Equ 3.19 and 3.20 with the thesis's forgetting factor, random walk, reset and triggers."""

    def __init__(
        self,
        kind: str = "none",
        ceiling: float = math.inf,
        *,
        hold_off_n: int = 4,
        warm_up_n: int = 50,
        nb: int = 2,
        offset: bool = False,
        forgetting: float = 1.0,
        random_walk: float = 0.0,
    ) -> None:
        self.kind, self.ceiling, self.hold_off_n, self.warm_up_n = kind, ceiling, hold_off_n, warm_up_n
        self.nb, self.offset, self.forgetting, self.random_walk = nb, offset, forgetting, random_walk
        self.errors: Signal = np.empty(0)

    def run(self, u: Signal, y: Signal) -> tuple[Signal, list[int]]:
        """Return the estimates (n, p) and the samples with an alarm; set ``errors``, the prediction errors (n,)."""
        p0 = np.diag([10.0] * (2 + self.nb) + [1e6] * self.offset)
        theta, p = np.zeros(len(p0)), p0
        out, alarms = np.zeros((len(u), len(p0))), []
        self.errors = np.zeros(len(u))
        quiet, total, count, begin = self.warm_up_n, 0.0, 0, 2
        for k in range(len(u)):
            out[k] = theta
            if k < begin:
                continue  # An equation covers two past samples and must not mix samples from before and after an alarm.
            inputs = [u[k - 1 - i] for i in range(self.nb)]
            phi = np.array([-y[k - 1], -y[k - 2], *inputs, *[1.0] * self.offset])
            error = self.errors[k] = y[k] - phi @ theta
            gain = p @ phi / (self.forgetting + phi @ p @ phi)
            theta = theta + gain * error
            p = (p - np.outer(gain, phi @ p)) / self.forgetting + self.random_walk * np.eye(len(p0))
            p = (p + p.T) / 2.0
            if quiet:
                quiet -= 1
            else:
                total, count = total + error, count + 1
                statistic = abs(error) if self.kind == "prediction-error" else abs(total / count)
                if self.kind != "none" and statistic >= self.ceiling:
                    alarms.append(k)
                    p, quiet, total, count, begin = p0, self.hold_off_n, 0.0, 0, k + 3
                    if self.kind == "prediction-error":
                        theta = np.zeros(len(p0))
            out[k] = theta
        return out, alarms


def physical(theta: Signal, y_per_m: float, u_per_n: float = 1.0) -> Signal:
    """M, B, K (n, 3) from the poles and the static gain of a1, a2, b0, b1 (n, 4); NaN without a suspension."""
    out = np.full((len(theta), 3), np.nan)
    for row, (a1, a2, b0, b1) in zip(out, theta[:, :4], strict=True):
        poles = np.roots([1.0, a1, a2]).astype(complex)
        if b0 + b1 == 0.0 or 0.0 in poles:
            continue
        stiffness = y_per_m / u_per_n * (1.0 + a1 + a2) / (b0 + b1)
        rates = -np.log(poles) / PERIOD_S
        mass = stiffness / (rates[0] * rates[1]).real
        found = mass, mass * rates.sum().real, stiffness
        if min(found) > 0.0:
            row[:] = found
    return out


def errors_of(parameters: Signal, starts: Sequence[int]) -> Signal:
    """Relative errors (n, 3) of M, B, K; the plants of the profile begin at ``starts``."""
    truth = np.empty_like(parameters)
    for start, plant in zip(starts, PROFILE.values(), strict=True):
        truth[start:] = plant
    return parameters / truth - 1.0


def reconverged(error: Signal, starts: Sequence[int], within: float = 0.05) -> list[int | None]:
    """Samples from each change until all errors stay within a bound; the sample of the change is the old plant's."""
    out: list[int | None] = []
    for start, end in zip(starts, [*starts[1:], len(error)], strict=True):
        after = next((k for k in range(start + 1, end) if (np.abs(error[k:end]) <= within).all()), None)
        out.append(None if after is None else after - start)
    return out


def excursions(error: Signal, starts: Sequence[int], beyond: float = 0.5) -> int:
    """Number of times that an estimate leaves the bound around the truth; NaN is outside."""
    count = 0
    for start, end in zip(starts, [*starts[1:], len(error)], strict=True):
        good = np.asarray((np.abs(error[start + 1 : end]) <= beyond).all(axis=1))
        count += sum(1 for before, now in itertools.pairwise(good.tolist()) if before and not now)
    return count


def late_scatter(values: NDArray[np.floating], starts: Sequence[int]) -> Signal:
    """Root mean variance of each column in the second halves of the stretches."""
    values = values.astype(np.float64)
    stretches = zip(starts, [*starts[1:], len(values)], strict=True)
    return np.asarray(np.sqrt(np.mean([values[(a + b) // 2 : b].var(axis=0) for a, b in stretches], axis=0)))


def latencies(alarms: Sequence[int], n: int, starts: Sequence[int] = CHANGES) -> list[int | None]:
    """Samples from each change to the first alarm before the next."""
    ends = [*starts[1:], n]
    return [
        next((k - start for k in alarms if start < k <= end), None) for start, end in zip(starts, ends, strict=True)
    ]


def missed_and_extra(alarms: Sequence[int], n: int, starts: Sequence[int] = CHANGES) -> tuple[int, int]:
    """Changes without an alarm before the next, and alarms that are not the first after a change."""
    missed = latencies(alarms, n, starts).count(None)
    return missed, len(alarms) - len(starts) + missed


def damping_ratio(mass_kg: float, damping_n_s_per_m: float, stiffness_n_per_m: float) -> float:
    return damping_n_s_per_m / (2.0 * math.sqrt(stiffness_n_per_m * mass_kg))


def least_squares(u: Signal, y: Signal) -> Signal:
    """Batch estimate a1, a2, b0, b1, d from all equations at once (Equ 3.17)."""
    phi = np.stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones(len(u) - 2)], axis=1)
    return np.asarray(np.linalg.lstsq(phi, y[2:], rcond=None)[0])
