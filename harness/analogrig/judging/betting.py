"""Confidence bounds of an event rate from independent plays, whatever the dependence within a play.

A play has ``events`` in an exposure of ``exposure`` samples, and at most ``most`` events. If the rate, mean events over
mean exposure, is not below ``rate``, the play is a game that cannot be won on average: a stake pays
rate x exposure - events. The wealth of a gambler who plays it anyway is a non-negative supermartingale. By Ville's
inequality it ever reaches 1 / error with probability ``error`` at most. A rate is excluded once the wealth against it
has done so, whenever one stops (Waudby-Smith and Ramdas, Estimating means of bounded random variables by betting,
Journal of the Royal Statistical Society B 86, 2024). Sixteen gamblers with fixed stakes share the capital. Their
average wealth does not depend on the order of the plays.

Nothing is assumed within a play. Plays must be independent, and ``most`` must hold: no bound of a mean exists without a
bound of the tail (Bahadur and Savage, Annals of Mathematical Statistics 27, 1956). What it costs:
harness/docs/decisions/049-betting.md.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analogrig.judging.statistics import Decision, check_counts, rising_root
from analogrig.wording import number_of

_ORDER = np.arange(16.0)
_CAPITAL: NDArray[np.float64] = 1.0 / ((_ORDER + 1.0) * (_ORDER + 2.0))
"""(16,) initial capital of each gambler; their sum is below 1."""

_STAKES: NDArray[np.float64] = 31.0 / 32.0 * np.exp2(-_ORDER)
"""(16,) stakes, in parts of the largest that cannot ruin. The first grows fastest where nothing happens, and survives a
play full of events; the last ones suit many events."""


def log_growth_below(rate: float, events: ArrayLike, exposure: ArrayLike, most: int) -> NDArray[np.float64]:
    """Growth (..., 16) of the logarithm of each wealth by a play, in the game against a rate of ``rate`` or more."""
    return _log_growth(rate * np.asarray(exposure) - np.asarray(events), most * (1.0 - rate))


def log_growth_above(rate: float, events: ArrayLike, exposure: ArrayLike, longest: int) -> NDArray[np.float64]:
    """Growth (..., 16) of the logarithm of each wealth by a play, in the game against a rate of ``rate`` or less."""
    return _log_growth(np.asarray(events) - rate * np.asarray(exposure), rate * longest)


def _log_growth(gain: NDArray[np.float64], largest_loss: float) -> NDArray[np.float64]:
    with np.errstate(divide="ignore"):  # more events than ``most``: ruin
        return np.asarray(np.log1p(np.maximum(gain[..., None] * (_STAKES / largest_loss), -1.0)))


def log_wealth(growth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithm (...) of the joint wealth of gamblers whose own have grown by ``growth`` (..., 16) since the start."""
    largest = np.maximum(growth.max(axis=-1), -sys.float_info.max)
    return np.asarray(largest + np.log(np.exp(growth - largest[..., None]) @ _CAPITAL))


def quiet_plays(rate: float, confidence: float, most: int, exposure: float) -> int:
    """Fewest plays without an event, of ``exposure`` each, that show a rate below ``rate``."""
    growth, limit = log_growth_below(rate, 0.0, exposure, most), -math.log1p(-confidence)
    return math.ceil(rising_root(lambda plays: float(log_wealth(plays * growth)) - limit))


@dataclass
class BettingSequence:
    """Two one-sided betting confidence sequences of a rate. ValueError: a value is out of range."""

    confidence: float
    """Confidence of each side; as an interval they are wrong twice as often."""
    most: int
    """Largest number of events that a play can have."""
    longest: int
    """Largest exposure that a play can have."""
    plays: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Number of plays by events and exposure."""

    def __post_init__(self) -> None:
        if not 0.0 < self.confidence < 1.0:
            raise ValueError(f"confidence must be between 0 and 1, not {self.confidence:g}")
        if not (self.most >= 1 and self.longest >= 1):
            raise ValueError("a play must be able to have an event and an exposure")

    def add(self, events: int, exposure: int) -> None:
        """Add a play."""
        check_counts(events, exposure)
        self.plays[events, exposure] += 1

    @property
    def events(self) -> int:
        return sum(events * times for (events, _), times in self.plays.items())

    @property
    def exposure(self) -> int:
        return sum(exposure * times for (_, exposure), times in self.plays.items())

    @property
    def broken(self) -> str:
        """Observation that contradicts ``most``, in words; empty if there is none. Nothing is certified then."""
        most = max((events for events, _ in self.plays), default=0)
        return f"{number_of(most, 'alarm')} in a play that can have {self.most}" if most > self.most else ""

    def decision(self, rate: float) -> Decision:
        """Decision whether the true rate is below or above ``rate``."""
        if self._log_below(rate) >= self._limit:
            return Decision.BELOW
        return Decision.ABOVE if self._log_above(rate) >= self._limit else Decision.OPEN

    @property
    def bounds(self) -> tuple[float, float]:
        """Rates at which the wealth reaches 1 / error, from below and from above; 0 and 1 where it never does."""
        low, high = 0.0, 1.0
        if self.events:
            low = 1.0 / rising_root(lambda inverse: self._log_above(1.0 / inverse) - self._limit)
        if any(exposure > events for events, exposure in self.plays) and not self.broken:
            odds = rising_root(lambda odds: self._log_below(odds / (1.0 + odds)) - self._limit)
            high = odds / (1.0 + odds)
        return min(low, 1.0), high

    def needed(self, rate: float) -> float:
        """Number of plays like those so far that show a rate below ``rate``; infinite if none do."""
        growth, times = self._growth_below(rate)
        mean = times @ growth / times.sum()
        if not mean.max() > 0.0:
            return math.inf
        return math.ceil(rising_root(lambda plays: float(log_wealth(plays * mean)) - self._limit))

    @property
    def basis(self) -> str:
        """Assumption behind the bounds, as a noun phrase."""
        return f"any dependence within a play, and at most {number_of(self.most, 'alarm')} in each"

    @property
    def _limit(self) -> float:
        return -math.log1p(-self.confidence)

    def _growth_below(self, rate: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        events, exposure, times = self._columns()
        return log_growth_below(rate, events, exposure, self.most), times

    def _log_below(self, rate: float) -> float:
        if self.broken:
            return -math.inf
        growth, times = self._growth_below(rate)
        return float(log_wealth(times @ growth))

    def _log_above(self, rate: float) -> float:
        events, exposure, times = self._columns()
        return float(log_wealth(times @ log_growth_above(rate, events, exposure, self.longest)))

    def _columns(self) -> NDArray[np.float64]:
        """(3, k): events, exposure, and number of such plays."""
        rows = sorted((*play, times) for play, times in self.plays.items())  # equal plays, equal bytes
        return np.array(rows, np.float64).reshape(-1, 3).T
