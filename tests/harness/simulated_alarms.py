"""Simulated devices that raise false alarms exactly at a given rate, independently, in bursts or periodically.

``SimulatedPlays`` stands in for the workers of a certificate. All devices raise their alarms on one time axis that is
cut into plays, so that bursts may span a seam, unless their kind starts anew with each play.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.campaigns.certificate import MOST_LONGER, Question, certify
from analogrig.campaigns.plays import Count

GAP_N = 60
"""Samples between two alarms of a burst: the hold-off of the shipped device."""

REGIME_N = 5_000
"""Samples of a regime in which alarms are frequent."""

Instants = NDArray[np.float64]
Sizes = Callable[[np.random.Generator, int], NDArray[np.int64]]
Kind = Callable[[np.random.Generator, float, int, int], Instants]
"""Instants of the alarms from random generator, rate per sample, samples of a play, and number of plays."""


def in_bursts(sizes: Sizes, mean: float, gap_n: float = GAP_N, spread_n: float = 0.0) -> Kind:
    """Bursts at independent instants; ``mean``: mean of their ``sizes``.

    Alarms of a burst are ``gap_n`` samples apart and an exponential time of mean ``spread_n``.
    """

    def draw(rng: np.random.Generator, rate: float, play_n: int, plays: int) -> Instants:
        before_n = 200 * (gap_n + spread_n)  # bursts that began before the first play
        length = before_n + play_n * plays
        starts = rng.uniform(-before_n, play_n * plays, rng.poisson(rate / mean * length))
        counts = sizes(rng, len(starts))
        gaps = gap_n + (rng.exponential(spread_n, (len(starts), counts.max(initial=1))) if spread_n else 0.0)
        later = np.cumsum(np.broadcast_to(gaps, (len(starts), counts.max(initial=1))), axis=1) - gap_n
        return (starts[:, None] + later)[np.arange(later.shape[1]) < counts[:, None]]

    return draw


def _of(size: int) -> Sizes:
    return lambda _, count: np.full(count, size)


def _geometric(mean: float) -> Sizes:
    return lambda rng, count: rng.geometric(1.0 / mean, count)


def _branching(mean: float) -> Sizes:
    """Sizes of bursts in which each alarm is followed by a Poisson number of others (Borel's distribution)."""

    def draw(rng: np.random.Generator, count: int) -> NDArray[np.int64]:
        last = total = np.ones(count, np.int64)
        while last.any():
            last = rng.poisson((1.0 - 1.0 / mean) * last)
            total = total + last
        return total

    return draw


def _periodic(rng: np.random.Generator, rate: float, play_n: int, plays: int) -> Instants:
    return np.arange(rng.uniform(0.0, 1.0 / rate), play_n * plays, 1.0 / rate)


def _periodic_from_start(_: np.random.Generator, rate: float, play_n: int, plays: int) -> Instants:
    """The same period in every play, counted from its start."""
    instants = np.arange(1.0 / rate, play_n, 1.0 / rate)
    return (np.arange(plays)[:, None] * play_n + instants).ravel()


def _at_seams(rng: np.random.Generator, rate: float, play_n: int, plays: int) -> Instants:
    """Bursts of five that span the end of a play, at random ones; several may meet."""
    ends = play_n * rng.integers(0, plays + 1, rng.poisson(rate / 5.0 * play_n * plays))
    return (ends[:, None] + GAP_N * (np.arange(5) - rng.integers(1, 5, len(ends))[:, None])).ravel()


def _in_regimes(rng: np.random.Generator, rate: float, play_n: int, plays: int) -> Instants:
    """A tenth of the alarms on their own, the others in rare regimes of five alarms on average."""
    length = play_n * plays
    alone = rng.uniform(0.0, length, rng.poisson(0.1 * rate * length))
    starts = rng.uniform(-REGIME_N, length, rng.poisson(0.9 * rate / 5.0 * (length + REGIME_N)))
    numbers = rng.poisson(5.0, len(starts))
    return np.concatenate((alone, np.repeat(starts, numbers) + rng.uniform(0.0, REGIME_N, numbers.sum())))


COVERED: Mapping[str, Kind] = {
    "independent": in_bursts(_of(1), 1.0),
    "bursts of two": in_bursts(_of(2), 2.0),
    "bursts of five": in_bursts(_of(5), 5.0),
    "geometric bursts of five on average": in_bursts(_geometric(5.0), 5.0),
    "an alarm after each alarm with probability 0.8, 500 samples later": in_bursts(_geometric(5.0), 5.0, 0.0, 500.0),
    "bursts of five across the seams of plays": _at_seams,
    "rare regimes of five alarms on average, a tenth of the alarms outside": _in_regimes,
    "periodic": _periodic,
    "periodic from the start of each play": _periodic_from_start,
}
"""Kinds of alarms that the assumption of a certificate covers."""

BEYOND: Mapping[str, Kind] = {
    "bursts of twenty, not covered": in_bursts(_of(20), 20.0),
    "0.8 alarms after each alarm on average, Poisson, not covered": in_bursts(_branching(5.0), 5.0),
}
"""Kinds of alarms that it does not cover."""


class SimulatedPlays:
    """Counts of the plays of one simulated device, in place of workers that play."""

    def __init__(self, question: Question, kind: Kind, rate: float, seed: int) -> None:
        self._question = question
        self._kind = kind
        self._rate = rate
        self._rng = np.random.default_rng(seed)

    def play(self, work: Any, tasks: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
        """Yield as many counts as the certificate may need; ``work`` is its ``count_run``."""
        (case,) = work.args
        armed_n = case.scenario.samples - self._question.datasheet.warm_up_n
        plays = math.ceil(MOST_LONGER * self._question.design_n / armed_n) + 1
        instants = self._kind(self._rng, self._rate, armed_n, plays)
        alarms = np.histogram(instants, bins=np.arange(plays + 1) * armed_n)[0]
        return zip(tasks, (Count(int(each), armed_n) for each in alarms), strict=False)


def certificates(question: Question, kind: Kind, rate: float, devices: int) -> Counter[str]:
    """Outcomes of the certificates of so many simulated devices; seeds from 0 on."""
    return Counter(certify(question, SimulatedPlays(question, kind, rate, seed)).outcome for seed in range(devices))
