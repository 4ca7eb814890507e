"""Simulated devices that raise false alarms at exactly a given rate, with any dependence within a play.

A kind is the law of the number of alarms of a play that has some. Plays are independent. Each alarm takes ``GAP_N`` of
the samples in which the trigger is armed.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.campaigns.certificate import MOST_LONGER, Question
from analogrig.campaigns.plays import Count
from analogrig.judging.betting import log_growth_above, log_growth_below, log_wealth, quiet_plays

GAP_N = 60
"""Samples between two alarms of a burst: a hold-off."""

MOST = 41
"""Most alarms of a play."""

ARMED_N = (MOST - 1) * (GAP_N + 1) + 1
"""Armed samples of a play without an alarm. A burst of MOST alarms fills a play."""

_NUMBERS = np.arange(1.0, MOST + 1.0)

CHUNK = 250
"""Devices that are simulated together."""

Kind = Callable[[float, NDArray[np.float64]], Any]
"""Weights of the numbers 1 to MOST of alarms of a play that has some, from the mean number over all plays."""


def _poisson(mean: float, n: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.exp(n * math.log(mean) - np.cumsum(np.log(n))))


def _of(size: int) -> Kind:
    return lambda _, n: n == size


def _borel(_: float, n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bursts of five on average in which each alarm is followed by a Poisson number of others."""
    return np.asarray(np.exp((n - 1.0) * np.log(0.8 * n) - 0.8 * n - np.cumsum(np.log(n))))


def _regimes(_: float, n: NDArray[np.float64]) -> NDArray[np.float64]:
    """A tenth of the alarms alone, the others in regimes of five on average."""
    regimes = _poisson(5.0, n) / _poisson(5.0, n).sum()
    return np.asarray(0.1 * (n == 1) + 0.9 * regimes / (regimes @ n))


COVERED: Mapping[str, Kind] = {
    "independent": _poisson,
    "bursts of two": _of(2),
    "bursts of five": _of(5),
    "geometric bursts of five on average": lambda _, n: 0.8**n,
    "rare regimes of five alarms on average, a tenth of the alarms outside": _regimes,
    "at most one alarm in a play": _of(1),
}
"""Kinds of alarms that bursts of five on average cover."""

BEYOND: Mapping[str, Kind] = {
    "bursts of twenty": _of(20),
    "0.8 alarms after each alarm on average, Poisson": _borel,
    "90 % single alarms, 10 % bursts of 41": lambda _, n: 0.9 * (n == 1) + 0.1 * (n == MOST),
    "all alarms in a tenth of the plays": lambda mean, n: _poisson(10.0 * mean, n),
    "all alarms in a thousandth of the plays": lambda mean, n: _poisson(1000.0 * mean, n),
    "alarms to the end of the play from a random instant on": lambda _, n: np.ones_like(n),
    "sizes of bursts with a tail of power 1.5": lambda _, n: n**-1.5,
}
"""Kinds of alarms that they do not cover."""


@dataclass(frozen=True)
class Law:
    """Law of the number of alarms of a play at a given rate per armed sample."""

    kind: Kind
    rate: float

    @functools.cached_property
    def mean(self) -> float:
        """Mean number of alarms of a play: the rate times its mean exposure."""
        mean = self.rate * ARMED_N
        for _ in range(8):  # the exposure depends on the alarms, little
            weights = self._weights(mean)
            chance = mean / float(weights @ _NUMBERS)
            mean = self.rate * (ARMED_N - chance * float(weights @ (ARMED_N - exposure_n(_NUMBERS))))
        return mean

    @property
    def chance(self) -> float:
        """Probability that a play has an alarm."""
        return self.mean / float(self._weights(self.mean) @ _NUMBERS)

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.int64]:
        """Numbers of alarms of plays that have some."""
        return 1 + np.searchsorted(np.cumsum(self._weights(self.mean))[:-1], rng.random(shape), side="right")

    def _weights(self, mean: float) -> NDArray[np.float64]:
        weights = np.asarray(self.kind(mean, _NUMBERS), np.float64)
        return np.asarray(weights / weights.sum())


def exposure_n(alarms: NDArray[Any]) -> NDArray[Any]:
    """Armed samples of plays with so many alarms."""
    return np.asarray(ARMED_N - GAP_N * np.maximum(alarms - 1, 0))


@dataclass(frozen=True)
class Betted:
    """Plays until the test by betting certifies and refutes each simulated device; infinite where it does not."""

    certified: NDArray[np.float64]
    refuted: NDArray[np.float64]


def bet(law: Law, far: float, confidences: Sequence[float], devices: int) -> list[Betted]:
    """Outcomes of tests by betting of so many devices, one for each confidence; a fixed seed.

    All of them go on until the one of the highest confidence gives up.
    """
    rng, plays = np.random.default_rng(0), MOST_LONGER * quiet_plays(far, max(confidences), MOST, ARMED_N)
    parts = [_bet(law, far, confidences, rng, int(plays)) for _ in range(-(-devices // CHUNK))]
    return [
        Betted(*(np.concatenate(column)[:devices] for column in zip(*each, strict=True)))
        for each in zip(*parts, strict=True)
    ]


def _bet(
    law: Law, far: float, confidences: Sequence[float], rng: np.random.Generator, plays: int
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Only plays with an alarm are drawn. Between two of them the wealth against a high rate only grows."""
    mean = plays * law.chance
    places = np.cumsum(rng.geometric(law.chance, (CHUNK, int(mean + 8.0 * math.sqrt(mean) + 20.0))), axis=1)
    alarms, device, number = law.draw(rng, places.shape), np.arange(CHUNK), np.arange(MOST + 1)
    quiet = (np.minimum(places, plays + 1) - 1 - np.arange(places.shape[1]))[..., None]
    growth = log_growth_below(far, number, exposure_n(number), MOST)
    before = np.cumsum(growth[alarms], axis=1) - growth[alarms]
    high = log_wealth(before + quiet * growth[0])
    loss = log_growth_above(far, number, exposure_n(number), ARMED_N)
    low = np.where(places <= plays, log_wealth(np.cumsum(loss[alarms], axis=1) + quiet * loss[0]), -np.inf)
    found = []
    for limit in (-math.log1p(-each) for each in confidences):
        first, last = (high >= limit).argmax(axis=1), (low >= limit).argmax(axis=1)
        needed = first + _least_quiet(before[device, first], growth[0], limit, plays)
        certified = np.where(high[device, first] >= limit, needed, np.inf)
        found.append((certified, np.where(low[device, last] >= limit, places[device, last], np.inf)))
    return found


def _least_quiet(
    before: NDArray[np.float64], growth: NDArray[np.float64], limit: float, plays: int
) -> NDArray[np.float64]:
    """Fewest plays without an alarm after which the joint wealth is enough, by bisection."""
    low, high = np.zeros(len(before)), np.full(len(before), float(plays))
    for _ in range(math.ceil(math.log2(plays)) + 1):
        middle = np.floor(0.5 * (low + high))
        enough = log_wealth(before + middle[:, None] * growth) >= limit
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return high


class SimulatedPlays:
    """Counts of the plays of one simulated device, in place of workers that play."""

    def __init__(self, question: Question, kind: Kind, rate: float, seed: int) -> None:
        self._batch, self._law, self._rng = question.batch, Law(kind, rate), np.random.default_rng(seed)

    def play(self, _: Any, tasks: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
        """Yield batches of counts for ever."""
        for task in tasks:
            alarms = self._law.draw(self._rng, (self._batch,)) * (self._rng.random(self._batch) < self._law.chance)
            armed = exposure_n(alarms)
            yield task, [Count(int(each), int(n)) for each, n in zip(alarms, armed, strict=True)]
