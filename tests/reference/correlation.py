"""Serial correlation of the innovations of the reference estimator, and the second reading of them that it requires."""

from __future__ import annotations

GAIN, DRIFT = 0.4945, 1.1305
"""Terms of the sum: GAIN z^2 - DRIFT, a multiple of the log-likelihood ratio of a variance 7.1 times as large."""

CORRELATED, SMOOTH = 0.012, 0.62
"""Squares of the partial correlations from which on there is a second reading, and square of the first beyond which
there is none."""

SHARE_WARM, SHARE = 0.5, 0.04
"""Share of a block in a partial correlation, before the trigger is armed and later."""

LOAD, PARTIAL_MAX = 1.05, 0.98
LEVERAGE = 25.0
RESTING_N = 4
"""Blocks from one with products to the next without a second reading."""

NEAR = 0.003
"""Relative distance from a threshold at which rounding may decide."""


def cusum(before: float, innovation: float, variance: float) -> float:
    """Cumulative sum of the terms, at least zero."""
    return max(0.0, before + GAIN * innovation * innovation / variance - DRIFT)


class ReferenceCorrelation:
    """Partial correlations of the innovations at lags 1 and 2, and the sums of both readings."""

    def __init__(self) -> None:
        self._partial = [0.0, 0.0]
        self._turn = 0
        self._lag = 0
        """Lag of this block; 0: its innovations have no products."""
        self._reads = False
        """True if the innovations have a second reading."""
        self._product = 0.0
        self.is_doubtful = False
        """True if rounding may have decided whether there is a second reading."""
        self.forget()

    @property
    def is_smooth(self) -> bool:
        """True if the innovations are the slow residual of a poor model."""
        return self._partial[0] ** 2 > SMOOTH

    def forget(self) -> None:
        """Forget the last innovations: the next one does not follow them."""
        self._last, self.lead = [0.0, 0.0], 0.0

    def restart_products(self) -> None:
        """Begin the products of a block anew."""
        self._product = 0.0

    def enter(self, e: float, statistic: float, variance: float, scale: float, *, counts: bool, held: bool) -> float:
        """Enter an innovation, and return the smaller sum of both readings.

        :param statistic: the smaller sum before it.
        :param variance: of the innovation, in noise variances.
        :param scale: variance that the trigger expects of the noise.
        :param counts: the block is not complete.
        :param held: the sums are held at zero.
        """
        first, second = self._partial
        forward, backward = e - first * self._last[0], self._last[1] - first * self._last[0]
        if counts and self._lag == 1:
            self._product += e * self._last[0] / variance
        elif counts and self._lag == 2:
            self._product += forward * backward / variance
        if self._lag:
            self._last = [e, self._last[0]]
        if held:
            return 0.0
        if not self._reads:
            return cusum(statistic, e, variance * scale)
        left = (1.0 - first**2) * (1.0 - second**2)
        spread = 1.0 + LEVERAGE * (1.0 - 1.0 / variance)
        one = cusum(statistic + max(self.lead, 0.0), e, variance * scale)
        other = cusum(statistic + max(-self.lead, 0.0), forward - second * backward, variance * scale * left * spread)
        self.lead = one - other
        return min(one, other)

    def follow(self, mean: float, noise_variance: float, block_n: int, *, armed: bool) -> None:
        """Improve the partial correlation of a complete block, whose innovations have this mean square."""
        if not self._lag:
            return
        k = self._lag - 1
        left = 1.0 - self._partial[0] ** 2 if k else 1.0
        error = self._product / block_n - LOAD * left * mean * self._partial[k]
        change = (SHARE if armed else SHARE_WARM) * error / max(mean, noise_variance)
        self._partial[k] = max(-PARTIAL_MAX, min(self._partial[k] + change, PARTIAL_MAX))

    def restart(self) -> None:
        """Begin a block."""
        squares = self._partial[0] ** 2 + self._partial[1] ** 2
        near = min(abs(squares / CORRELATED - 1.0), abs(self._partial[0] ** 2 / SMOOTH - 1.0))
        self.is_doubtful |= near < NEAR
        if not self._reads:
            self.forget()
        self._reads = squares > CORRELATED and not self.is_smooth
        self._turn = (self._turn + 1) % RESTING_N
        rests = not self._reads and self._turn > 0
        self._lag = 0 if rests else 2 if self._reads and self._turn % 2 else 1
