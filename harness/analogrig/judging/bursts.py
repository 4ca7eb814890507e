"""Bounds of event rates that hold although events come in bursts.

Bursts are taken as independent. Each event of a burst is followed by another one with probability 1 - 1/burst, so that
``burst`` is the mean number of events of a burst; 1 makes all events independent. Counts then follow the Polya-Aeppli
distribution (Johnson, Kemp and Kotz, Univariate Discrete Distributions, 2005, section 9.7). Its variance is
2 burst - 1 times its mean. Rare events of a stationary process form such independent bursts, and 1/burst is their
extremal index (Hsing, Huesler and Leadbetter, Probability Theory and Related Fields 78, 1988).

No data replace the assumption on bursts (Bahadur and Savage, Annals of Mathematical Statistics 27, 1956). Why, and what
it costs: harness/docs/decisions/045-bursts.md.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.statistics import check_trials, rising_root
from analogrig.wording import number_of

BURST = 5.0
"""Mean number of false alarms in a burst that every bound of a false-alarm rate covers, unless another is set."""

SIGNIFICANT = 0.01
"""Significance level of the test for overdispersion."""

_DRAWS = 999
"""Number of simulated counts in the test for overdispersion."""

_MOST_BLOCKS = 1000
"""Largest number of blocks in that test; more plays are merged, neighbours with neighbours."""

_SIGMAS, _LEAST_WIDTH = 12.0, 60
"""Half width of a sum over counts: in standard deviations, and in counts. The rest is below 1e-30."""


# ---------------------------------------------------------------------------------------------------- fixed sample size


def upper_count(events: int, confidence: float, burst: float = 1.0) -> float:
    """Upper confidence bound of the expected number of events, one-sided; Garwood's (1936) for ``burst`` 1.

    :raises ValueError: a negative number of events, ``confidence`` not between 0 and 1, or ``burst`` below 1.
    """
    _check(events, confidence, burst)
    return rising_root(lambda mean: 1.0 - confidence - _probabilities(events, mean, burst)[0])


def lower_count(events: int, confidence: float, burst: float = 1.0) -> float:
    """Lower confidence bound of the expected number of events; otherwise as ``upper_count``.

    It is the least one over all bursts of at most ``burst`` events on average: one alarm excludes few rates if it came
    alone. The upper bound rises with the bursts.
    """
    _check(events, confidence, burst)
    if events == 0:
        return 0.0

    def bound(burst: float) -> float:
        return rising_root(lambda mean: _probabilities(events - 1, mean, burst)[1] - (1.0 - confidence))

    at_most = bound(burst)
    if at_most <= bound(1.0 + 0.95 * (burst - 1.0)):  # it falls with the bursts before it rises
        return at_most
    from scipy.optimize import minimize_scalar  # it loads slowly

    least = minimize_scalar(bound, bounds=(1.0, burst), method="bounded", options={"xatol": 0.05}).fun
    return float(min(bound(1.0), least))


def _probabilities(events: int, mean: float, burst: float) -> tuple[float, float]:
    """Probabilities of at most ``events`` events and of more, where ``mean`` are expected.

    k bursts have at most n events if at least k of n independent events are the last one of their burst.
    """
    bursts, chances = _poisson(mean / burst)
    first, as_many, fewer = _last_events(events, burst)
    place = np.clip(bursts - first, 0, len(fewer) - 1)
    return float(chances @ as_many[place]), float(chances @ fewer[place])


@functools.lru_cache(maxsize=2)
def _last_events(events: int, burst: float) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
    """A number k of events, and the probabilities that at least k, k + 1, ... of ``events`` are the last one of their
    burst, and that fewer are. The first ones are 1 and 0, the last ones 0 and 1."""
    first, chances = _binomial(events, 1.0 / burst)
    return first, np.append(np.cumsum(chances[::-1])[::-1], 0.0), np.append(0.0, np.cumsum(chances))


def _poisson(mean: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Counts of a Poisson distribution, and their probabilities."""
    first, last = _likely(mean, mean)
    count = np.arange(first, last + 1)
    log_mean = math.log(mean) if mean > 0.0 else -math.inf
    return count, _normalise(np.cumsum(np.append(0.0, log_mean - np.log(count[1:]))))


def _binomial(trials: int, chance: float) -> tuple[int, NDArray[np.float64]]:
    """First likely count of a binomial distribution, and the probabilities of the counts from there on."""
    first, last = _likely(trials * chance, trials * chance * (1.0 - chance))
    last = min(last, trials)
    count = np.arange(last, first, -1)
    log_odds = math.log(1.0 / chance - 1.0) if chance < 1.0 else -math.inf
    falling = np.cumsum(np.append(0.0, np.log(count / (trials + 1 - count)) + log_odds))
    return first, _normalise(falling[::-1])


def _likely(mean: float, variance: float) -> tuple[int, int]:
    """First and last count that matter."""
    width = int(_SIGMAS * math.sqrt(variance)) + _LEAST_WIDTH
    return max(0, int(mean) - width), int(mean) + width


def _normalise(log_weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Probabilities in proportion to exp(log_weights)."""
    weights = np.exp(log_weights - log_weights.max())
    return np.asarray(weights / weights.sum())


@dataclass(frozen=True)
class Design:
    """Test of fixed length, passed with at most ``allowed`` events. ValueError: a value is out of range."""

    rate: float
    """Claimed upper limit of the rate."""
    confidence: float
    allowed: int = 0
    burst: float = BURST
    """Mean number of events of a burst."""

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < 1.0:
            raise ValueError(f"rate must be between 0 and 1, not {self.rate:g}")
        _check(self.allowed, self.confidence, self.burst)

    @property
    def trials(self) -> int:
        """Fewest trials that prove the claim: the upper bound with ``allowed`` events is at most ``rate``."""
        return math.ceil(upper_count(self.allowed, self.confidence, self.burst) / self.rate)


# ------------------------------------------------------------------------------------------------------- overdispersion


@dataclass(frozen=True)
class Dispersion:
    """Index of dispersion of counts over blocks, with its test against independent events."""

    blocks: int
    events: int
    index: float
    """Variance over mean of the counts, for equal blocks; 1 is expected of independent events."""
    p: float
    """Probability of so large an index if events are independent."""

    @property
    def burst(self) -> float:
        """Mean number of events of a burst by the method of moments; 1 unless the index is significant."""
        return max(1.0, 0.5 * (self.index + 1.0)) if self.p <= SIGNIFICANT else 1.0

    def __str__(self) -> str:
        where = f"{number_of(self.events, 'alarm')} in {number_of(self.blocks, 'block')} of plays"
        if self.events < 2 or self.blocks < 2:
            return f"{where}, too few for a test"
        return f"{where}, index of dispersion {self.index:.3g}, p = {self.p:.2g}"


def dispersion(events: Sequence[int], trials: Sequence[int]) -> Dispersion:
    """Dispersion of the counts of plays of ``trials`` each (Fisher, Biometrics 6, 1950).

    Given their total, counts of independent events are multinomial. The p-value counts such draws with at least the
    observed index (Dwass, Annals of Mathematical Statistics 28, 1957); the draws have a fixed seed.
    """
    counted = np.array([(each, length) for each, length in zip(events, trials, strict=True) if length], np.int64)
    blocks, total = min(len(counted), _MOST_BLOCKS), sum(events)
    if blocks < 2 or total < 2:
        return Dispersion(blocks, total, 1.0, 1.0)
    counted = np.add.reduceat(counted, np.arange(blocks) * len(counted) // blocks)
    share = counted[:, 1] / counted[:, 1].sum()
    drawn = np.random.default_rng(0).multinomial(total, share, size=_DRAWS)
    observed, *indices = (
        (np.vstack((counted[:, 0], drawn)) - total * share) ** 2 @ (1.0 / (total * share)) / (blocks - 1)
    )
    larger = np.count_nonzero(indices >= observed * (1.0 - 1e-12))
    return Dispersion(blocks, total, float(observed), (1 + larger) / (1 + _DRAWS))


@dataclass(frozen=True)
class RateBounds:
    """One-sided confidence bounds of a rate. As one interval, they have twice the error probability."""

    low: float
    high: float
    burst: float
    """Mean number of events of a burst that they cover."""
    basis: str
    """Assumption and data behind ``burst``, as a noun phrase."""


def bound_rate(events: Sequence[int], trials: Sequence[int], confidence: float, burst: float = BURST) -> RateBounds:
    """One-sided bounds of a rate per trial from counts over independent plays.

    They cover bursts of ``burst`` events on average, or larger ones where the dispersion of the counts shows them.

    :raises ValueError: no trials, impossible counts, ``confidence`` not between 0 and 1, or ``burst`` below 1.
    """
    total, length = sum(events), sum(trials)
    check_trials(total, length, confidence)
    found = dispersion(events, trials)
    covered = max(burst, found.burst)
    low, high = (bound(total, confidence, covered) / length for bound in (lower_count, upper_count))
    if found.burst > burst:
        basis = f"bursts of {found.burst:.3g} alarms on average, observed ({found})"
    elif burst > 1.0:
        basis = f"bursts of {burst:g} alarms on average, assumed ({found})"
    else:
        basis = f"independent alarms, assumed ({found})"
    return RateBounds(min(low, 1.0), min(high, 1.0), covered, basis)


def _check(events: int, confidence: float, burst: float) -> None:
    if events < 0:
        raise ValueError(f"there cannot be {number_of(events, 'event')}")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must be between 0 and 1, not {confidence:g}")
    if not 1.0 <= burst < math.inf:
        raise ValueError(f"burst must be 1 or more, not {burst:g}")
