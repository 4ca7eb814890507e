"""Parts of the reference estimator that know nothing of samples: delta form, whitening, covariance, in float64.

All follow harness/docs/background/estimator.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Vector = list[float]


def differences(values: Sequence[float]) -> Vector:
    """Values x(k), x(k-1), ... as differences D^n x(k), D^(n-1) x(k-1), ..., x(k-n)."""
    out = list(values)
    for rest in range(len(out) - 1, 0, -1):
        for i in range(rest):
            out[i] -= out[i + 1]
    return out


def to_plain(coefficients: Sequence[float]) -> Vector:
    """Coefficients of such differences as those of the values."""
    out = list(coefficients)
    for n in range(1, len(out)):
        for i in range(n, 0, -1):
            out[i] -= out[i - 1]
    return out


def to_delta(coefficients: Sequence[float]) -> Vector:
    """Coefficients of the values as those of the differences."""
    out = list(coefficients)
    for n in range(len(out) - 1, 0, -1):
        for i in range(n):
            out[i + 1] += out[i]
    return out


class Whitener:
    """Whitening of the noise C(z) e of consecutive equations.

    Innovations algorithm for a moving average that begins with the first equation (Brockwell and Davis, Time Series:
    Theory and Methods, 1991, section 5.3).
    """

    def __init__(self, c: Sequence[float]) -> None:
        self.c = list(c)
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next equation."""
        self.rows: list[tuple[Vector, float]] = []  # gains and variance of the equations before, newest first
        self.past: list[Vector] = []  # whitened equations, newest first

    def _next_gains(self) -> tuple[Vector, float]:
        """Gains of the next equation, and the variance of its whitened noise in variances of e."""
        order = len(self.c)
        taps = [1.0, *self.c]
        gains, covariance = [0.0] * order, [0.0] * (order + 1)
        variance = sum(tap * tap for tap in taps)
        for lag in range(min(order, len(self.rows)), 0, -1):
            covariance[lag] = sum(taps[i] * taps[i + lag] for i in range(order + 1 - lag))
            covariance[lag] -= sum(
                covariance[m] * self.rows[lag - 1][0][m - lag - 1] for m in range(lag + 1, order + 1)
            )
            gains[lag - 1] = covariance[lag] / self.rows[lag - 1][1]
            variance -= covariance[lag] * gains[lag - 1]
        return gains, variance

    def whiten(self, equation: Sequence[float]) -> tuple[Vector, float]:
        """Whitened equation, and the variance of its noise in variances of e."""
        gains, variance = self._next_gains()
        out = list(equation)
        for gain, before in zip(gains, self.past, strict=False):
            out = [x - gain * w for x, w in zip(out, before, strict=True)]
        keep = max(len(self.c), 1)
        self.rows = [(gains, variance), *self.rows][:keep]
        self.past = [out, *self.past][:keep]
        return out, variance

    @property
    def latest(self) -> Vector:
        """Gains of the newest equation."""
        return self.rows[0][0]


class Covariance:
    """P in units of the noise variance, as U D U' / weight (Bierman 1977). Forgetting lowers the weight."""

    def __init__(self, prior: Sequence[float]) -> None:
        self.prior = list(prior)
        self.reset()

    def reset(self) -> None:
        """Set P to P0."""
        n = len(self.prior)
        self.d, self.weight = list(self.prior), 1.0
        self.u = [[float(i == j) for j in range(n)] for i in range(n)]

    def variances(self, forms: NDArray[np.float64]) -> Vector:
        """Variances of linear forms in the parameters, (forms, parameters)."""
        shares: Vector = (np.square(forms @ np.array(self.u)) @ np.array(self.d) / self.weight).tolist()
        return shares

    @property
    def exceeds_prior(self) -> bool:
        """True if ``inflate`` would limit P."""
        return any(d > p * self.weight for d, p in zip(self.d, self.prior, strict=True))

    def inflate(self, factor: float) -> None:
        """Multiply P by this factor, up to the prior."""
        self.d = [min(d * factor / self.weight, p) for d, p in zip(self.d, self.prior, strict=True)]
        self.weight = 1.0

    def measure(self, phi: Sequence[float], variance: float, forgetting: float) -> tuple[Vector, float]:
        """Enter an equation; return its gain and the variance of its innovation (Bierman, V.3; thesis Equ 3.21)."""
        n = len(self.d)
        gain = [0.0] * n
        self.weight *= forgetting
        alpha = self.weight * variance
        for j in range(n):
            f = phi[j] + sum(self.u[i][j] * phi[i] for i in range(j))
            v = self.d[j] * f
            before, alpha = alpha, alpha + f * v
            self.d[j] *= before / alpha
            for i in range(j):
                u = self.u[i][j]
                self.u[i][j] = u - f / before * gain[i]
                gain[i] += u * v
            gain[j] = v
        return [g / alpha for g in gain], alpha / self.weight

    def walk(self, variance: float) -> None:
        """Add variance * I to P (Thornton 1976: modified weighted Gram-Schmidt on (U, I))."""
        n = len(self.d)
        rows = [[*self.u[i], *(float(i == k) for k in range(n))] for i in range(n)]
        weights = [*self.d, *([variance * self.weight] * n)]

        def product(a: Vector, b: Vector) -> float:
            return sum(w * x * y for w, x, y in zip(weights, a, b, strict=True))

        for j in reversed(range(n)):
            norm = product(rows[j], rows[j])
            self.d[j] = norm
            for i in range(j):
                self.u[i][j] = product(rows[i], rows[j]) / norm
                rows[i] = [x - self.u[i][j] * y for x, y in zip(rows[i], rows[j], strict=True)]
        self.inflate(1.0)


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def is_stable(c: Sequence[float]) -> bool:
    """True if all zeros of 1 + c[0] z^-1 + ... are inside the unit circle (Schur and Cohn)."""
    a = list(c)
    while a:
        k = a.pop()
        if abs(k) >= 0.9999:
            return False
        a = [(x - k * y) / (1.0 - k * k) for x, y in zip(a, reversed(a), strict=True)]
    return True
