"""The thesis's experiments once more, with numpy and scipy in double precision: what claims.json is held against.

Nothing of harness.thesis is used here, nor the C: plants come from scipy's discretisation, the recursion is Equ 3.19
and 3.20 as they are printed, the triggers follow sections 4.4.2 and 4.4.3.
"""

from __future__ import annotations

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
    """a1, a2, b0, b1 by scipy's zero-order hold."""
    num, den, _ = cont2discrete(([1.0], [mass_kg, damping_n_s_per_m, stiffness_n_per_m]), PERIOD_S)
    return [float(x) for x in (den[1], den[2], num[0][1], num[0][2])]


def square(n: int, high: float, low: float) -> Signal:
    return np.where(np.arange(n) % 100 < 50, high, low)


def arx(u: Signal, theta: Sequence[float]) -> Signal:
    """y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k-1) + b1 u(k-2), from rest."""
    a1, a2, b0, b1 = theta
    y = np.zeros(len(u) + 2)
    past = np.concatenate([[0.0, 0.0], u])
    for k in range(2, len(y)):
        y[k] = -a1 * y[k - 1] - a2 * y[k - 2] + b0 * past[k - 1] + b1 * past[k - 2]
    return y[2:]


def suspension(u: Signal) -> Signal:
    """The displacement of the profile's suspension: its state goes on where a parameter jumps."""
    y, state = np.empty(len(u)), np.zeros(2)
    for k in range(len(u)):
        if k in PROFILE:
            mass, damping, stiffness = PROFILE[k]
            a = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]])
            phi, gamma, *_ = cont2discrete((a, np.array([[0.0], [1.0 / mass]]), np.eye(2), np.zeros((2, 1))), PERIOD_S)
        y[k] = state[0]
        state = phi @ state + gamma[:, 0] * u[k]
    return y


class Rls:
    """Equ 3.19 and 3.20, with the reset and the trigger of the thesis."""

    def __init__(
        self, kind: str = "none", ceiling: float = math.inf, *, hold_off_n: int = 4, warm_up_n: int = 50
    ) -> None:
        self.kind, self.ceiling, self.hold_off_n, self.warm_up_n = kind, ceiling, hold_off_n, warm_up_n

    def run(self, u: Signal, y: Signal) -> tuple[Signal, list[int]]:
        """The estimates (n, 4) and the samples with an alarm."""
        theta, p = np.zeros(4), 10.0 * np.eye(4)
        out, alarms = np.zeros((len(u), 4)), []
        quiet, total, count, begin = self.warm_up_n, 0.0, 0, 2
        for k in range(len(u)):
            out[k] = theta
            if k < begin:
                continue  # the equation reaches back by two samples, to none of before an alarm
            phi = np.array([-y[k - 1], -y[k - 2], u[k - 1], u[k - 2]])
            error = y[k] - phi @ theta
            gain = p @ phi / (1.0 + phi @ p @ phi)
            theta = theta + gain * error
            p = p - np.outer(gain, phi @ p)
            p = (p + p.T) / 2.0
            if quiet:
                quiet -= 1
            else:
                total, count = total + error, count + 1
                statistic = abs(error) if self.kind == "prediction-error" else abs(total / count)
                if self.kind != "none" and statistic >= self.ceiling:
                    alarms.append(k)
                    p, quiet, total, count, begin = 10.0 * np.eye(4), self.hold_off_n, 0.0, 0, k + 3
                    if self.kind == "prediction-error":
                        theta = np.zeros(4)
            out[k] = theta
        return out, alarms


def latencies(alarms: Sequence[int], n: int) -> list[int | None]:
    """Of each change, to the first alarm before the next."""
    ends = [*CHANGES[1:], n]
    return [
        next((k - start for k in alarms if start < k <= end), None) for start, end in zip(CHANGES, ends, strict=True)
    ]


def damping_ratio(mass_kg: float, damping_n_s_per_m: float, stiffness_n_per_m: float) -> float:
    return damping_n_s_per_m / (2.0 * math.sqrt(stiffness_n_per_m * mass_kg))


def least_squares(u: Signal, y: Signal) -> Signal:
    """a1, a2, b0, b1, d from all equations at once (Equ 3.17)."""
    phi = np.stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones(len(u) - 2)], axis=1)
    return np.asarray(np.linalg.lstsq(phi, y[2:], rcond=None)[0])
