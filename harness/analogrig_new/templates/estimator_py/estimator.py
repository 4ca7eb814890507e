"""Estimator and trigger: recursive least squares with forgetting, and a cumulative sum of squared prediction errors.

y(k) = -a1 y(k-1) - a2 y(k-2) + b1 u(k-1) + b2 u(k-2) + d, for u and y in codes, both through a low-pass filter
1 / (1 - POLE / z)^2, which makes the prediction error nearly white.
"""

import numpy as np

N = 5  # elements of theta: a1, a2, b1, b2, d
POLE = 0.8  # of the filter, twice
FORGETTING = 0.99  # weight of a sample relative to the next one
P0 = 1e4  # covariance of theta before the first sample, in noise variances
NOISE = 1.2  # variance of the prediction error in codes^2: a 12-bit converter with noise of 1 LSB
SETTLE_N = 40  # samples after an alarm or a gap in which the filter still holds older ones
LEARN_N = 70  # samples after an alarm or a gap before the trigger is armed
DRIFT = 3.0  # subtracted from each squared error


class Estimator:
    """Takes one sample after the other; ``ceiling`` is the sum that raises an alarm."""

    datasheet = {
        "theta_n": N,
        "model": {"na": 2, "nb": 2, "nk": 1, "offset": True},
        "innovation": True,
        "statistic": True,
        "armed": True,
    }

    def __init__(self, ceiling=30.0):
        self.ceiling = ceiling
        self.theta = np.zeros(N)
        self.u = self.y = (0.0, 0.0)  # the last two outputs of the filter, the latest first
        self.restart()

    def restart(self):
        """Keep the estimate, and learn it anew."""
        self.p = P0 * np.eye(N)
        self.sum = 0.0
        self.known_n = 0  # samples since the start, an alarm or a gap

    def step(self, u, y, valid):
        answer = {"alarm": False, "innovation": 0.0, "armed": False}
        if valid:
            square, answer["innovation"] = self.update(u, y)
            self.known_n += 1
            answer["armed"] = self.known_n > LEARN_N
            if answer["armed"]:
                self.sum = max(0.0, self.sum + square - DRIFT)
                answer["alarm"] = bool(self.sum > self.ceiling)
        scale = [1.0, 1.0, 1.0, 1.0, (1.0 - POLE) ** 2]  # the filter amplifies a constant
        answer |= {"statistic": self.sum, "theta": self.theta * scale}
        if answer["alarm"] or not valid:
            self.restart()
        return answer

    def update(self, u, y):
        """Improve the estimate; return the squared prediction error over its variance, and the error."""
        x = np.array([-self.y[0], -self.y[1], *self.u, 1.0])
        self.u, self.y = filtered(self.u, u), filtered(self.y, y)
        error = self.y[0] - self.theta @ x
        px = self.p @ x
        power = FORGETTING + px @ x
        if self.known_n >= SETTLE_N:
            self.theta = self.theta + px / power * error
            self.p = (self.p - np.outer(px, px) / power) / FORGETTING
        return error**2 / (NOISE * power), error


def filtered(past, now):
    """The last two outputs of the filter after the sample ``now``."""
    return now + 2.0 * POLE * past[0] - POLE**2 * past[1], past[0]
