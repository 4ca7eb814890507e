"""Plain recursive least squares in double precision, to tell rounding errors of the C from properties of a scheme."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analogrig import EstimatorConfig


class PlainEstimator:
    """Recursion of Equ 3.19 to 3.21, restarted after an alarm as in the C. No whitening, no offset, no random walk."""

    def __init__(self, config: EstimatorConfig) -> None:
        """Start from P0 with ``config``, of which the other fields are not read."""
        self._config = config
        self._past_n = max(config.na, config.nb + config.nk - 1)
        self._warm_up_n, self._pending = config.warm_up_n, self._past_n
        self._theta = np.zeros(config.parameters)
        self._restart()

    def _restart(self) -> None:
        n = self._config.parameters
        self._upper, self._d = np.eye(n), np.full(n, self._config.p0)
        """P in units of the noise variance, as U D U'."""
        self._mean, self._mean_n = 0.0, 0

    def run(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Alarms (sample indices) and the diagonal of P after each of n samples, (n, p)."""
        config, alarms = self._config, []
        diagonals = np.empty((len(u), config.parameters))
        for k in range(len(u)):
            if self._pending:
                self._pending -= 1
            else:
                newest = k - config.nk
                phi = np.array([*-y[k - config.na : k][::-1], *u[newest - config.nb + 1 : newest + 1][::-1]])
                if self._is_alarm(self._update(phi, y[k])):
                    alarms.append(k)
                    self._restart()
                    if config.reset == "all":
                        self._theta[:] = 0.0
                    self._warm_up_n, self._pending = config.hold_off_n, self._past_n
            diagonals[k] = self._upper**2 @ self._d
        return np.array(alarms, np.int64), diagonals

    def _update(self, phi: NDArray[np.float64], target: float) -> float:
        """Enter an equation and return its innovation (Bierman 1977, V.3: P stays positive definite)."""
        innovation = target - float(phi @ self._theta)
        f, gain, alpha = phi @ self._upper, np.zeros(len(phi)), self._config.forgetting
        v = self._d * f
        for j in range(len(phi)):
            before, alpha = alpha, alpha + f[j] * v[j]
            self._d[j] *= before / (alpha * self._config.forgetting)
            column = self._upper[:j, j].copy()
            self._upper[:j, j] -= f[j] / before * gain[:j]
            gain[:j] += column * v[j]
            gain[j] = v[j]
        self._theta += gain / alpha * innovation
        return innovation

    def _is_alarm(self, innovation: float) -> bool:
        if self._warm_up_n:
            self._warm_up_n -= 1
            return False
        statistic = abs(innovation)
        if self._config.trigger == "mean-between-faults":
            self._mean_n += 1
            self._mean += ((statistic if self._config.absolute else innovation) - self._mean) / self._mean_n
            statistic = abs(self._mean)
        return self._config.trigger != "none" and statistic >= (self._config.ceiling or 0.0)
