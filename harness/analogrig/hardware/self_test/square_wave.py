"""Square wave as a card samples it: levels, edges, timing, and the noise of force and displacement.

An edge between two samples shows only that it lies between them. Each edge gives an interval for the unknown delay, and
the truth lies in all of them. Edges fall on many parts of a sample period, so the intersection is narrow
(set-membership estimation: Milanese and Vicino, Automatica 27, 1991, 997).

An instrument that averages over a part of each sample period shows some edges between the levels; the value there is
linear in the instant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import SelfTestError
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2

Floats = NDArray[np.float64]

SETTLED_PART = 0.01
"""Largest deviation from a level, in parts of the swing, of a sample at that level; at least the noise."""

_NOISES = 6.0
_MOST_BETWEEN = 3
"""Most samples of one edge between the levels."""
_AVERAGES_FROM = 8
"""Fewest samples between the levels of an instrument that averages; fewer are chance, such as jitter at the edge."""

_UNSETTLED_N = 3
"""Samples on either side of an edge that are left out of the noise of a level."""
_MOVING_PART = 0.25
"""Part of a half period, from its edge, in which the displacement moves by more than a code per sample."""
_PARTS = 104
"""Parts of a period that are averaged: about two samples each."""
_NEAR_N = 0.2
"""Largest distance of neighbours in equivalent time, in samples."""


class Uncertain(NamedTuple):
    """Value with its standard error."""

    value: float
    error: float


@dataclass(frozen=True, eq=False)
class Levels:
    """Two levels of a square wave, in codes (medians), and the level of each sample."""

    low: float
    high: float
    state: NDArray[np.int8]
    """(n,): 0 at the lower level, 1 at the upper one, -1 between."""

    @classmethod
    def of(cls, codes: NDArray[np.uint16]) -> Levels:
        """Find the levels.

        :raises SelfTestError: the codes are constant.
        """
        values = codes.astype(np.float64)
        upper = values > 0.5 * (values.min() + values.max())
        if not upper.any():
            raise SelfTestError("the force does not change")
        low, high = float(np.median(values[~upper])), float(np.median(values[upper]))
        off = np.abs(values - np.where(upper, high, low))
        noise = max(1.4826 * float(np.median(off)), 0.5)
        settled = off <= max(SETTLED_PART * (high - low), _NOISES * noise)
        return cls(low, high, np.where(settled, upper, -1).astype(np.int8))


@dataclass(frozen=True, eq=False)
class SeenEdges:
    """Edges of a square wave between samples, rising and falling alternately; all arrays (edges,)."""

    before: NDArray[np.int64]
    """Last sample at the old level."""
    after: NDArray[np.int64]
    """First sample at the new level."""
    rising: NDArray[np.bool_]

    @classmethod
    def of(cls, state: NDArray[np.int8], half_period_n: float) -> SeenEdges:
        """Find the edges.

        :param half_period_n: approximate number of samples between two edges.
        :raises SelfTestError: it is no unbroken square wave.
        """
        settled = np.flatnonzero(state >= 0)
        turns = np.flatnonzero(np.diff(state[settled]))
        before, after = settled[turns], settled[turns + 1]
        marks = np.concatenate(([0], 0.5 * (before + after), [len(state)]))
        lengths = np.diff(marks) / half_period_n
        lengths[[0, -1]] = np.where(lengths[[0, -1]] < 1.5, 1.0, lengths[[0, -1]])
        if (broken := np.flatnonzero(np.rint(lengths) != 1)).size:
            raise SelfTestError(f"the square wave of the force is broken after sample {int(marks[broken[0]])}")
        if (longest := int((after - before).max())) > _MOST_BETWEEN + 1:
            raise SelfTestError(f"the force takes {longest} samples from level to level: it is no square wave")
        return cls(before, after, state[after] == 1)

    @property
    def turn(self) -> Floats:
        """(edges,): number of the period of each edge, 0 in the middle of the record."""
        first = 0 if self.rising[0] else 1
        return np.asarray((np.arange(len(self.rising)) + first) // 2 - len(self.rising) // 4, dtype=np.float64)

    def times(self) -> EdgeTimes:
        """Least-squares timing of the middles of the edges; accurate to a part of a sample."""
        design = np.stack([self.turn, self.rising, ~self.rising], axis=1).astype(np.float64)
        middles = 0.5 * (self.before + self.after)
        period, rising, falling = np.linalg.lstsq(design, middles, rcond=None)[0]
        return EdgeTimes(float(period), float(rising), float(falling))

    def samples_between(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Samples between the levels, and the index of each one's edge."""
        counts = self.after - self.before - 1
        edge = np.repeat(np.arange(len(counts)), counts)
        place = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
        return self.before[edge] + 1 + place, edge

    def averaging_n(self) -> float:
        """Time over which the instrument averages, in samples: the share of edges between levels; 0 if it does not."""
        seen = len(self.samples_between()[0])
        return seen / len(self.rising) / (1.0 - 2.0 * SETTLED_PART) if seen >= _AVERAGES_FROM else 0.0


@dataclass(frozen=True)
class EdgeTimes:
    """Period of a square wave, and instants of one rising and one falling edge mid-record; in samples."""

    period_n: float
    rising_n: float
    falling_n: float

    def instants(self, edges: SeenEdges) -> Floats:
        """(edges,): instant of each edge, in samples."""
        return np.asarray(edges.turn * self.period_n + np.where(edges.rising, self.rising_n, self.falling_n))


def delay(codes: NDArray[np.uint16], levels: Levels, edges: SeenEdges, times: EdgeTimes, drift_n: float) -> Uncertain:
    """Delay of the edges of these codes after ``times``, in samples.

    :param drift_n: largest error of ``times`` at the ends of the record.
    """
    samples, edge = edges.samples_between()
    instants, averaging_n = times.instants(edges), edges.averaging_n()
    if averaging_n:
        upper = (codes[samples] - levels.low) / (levels.high - levels.low)
        new = np.where(edges.rising[edge], upper, 1.0 - upper)
        late = samples - averaging_n * (new - 0.5) - instants[edge]
        return Uncertain(float(late.mean()), float(np.hypot(late.std() / np.sqrt(len(late)), drift_n)))
    least, most = float((edges.before - instants).max()), float((edges.after - instants).min())
    return Uncertain(0.5 * (least + most), float((abs(most - least) + 2.0 * drift_n) / np.sqrt(12.0)))


def level_noise(codes: NDArray[np.uint16], levels: Levels, edges: SeenEdges) -> Uncertain:
    """Noise of a square wave about its levels, rms in LSB, quantisation included.

    A level at rest may show less than its quantisation variance of 1/12 LSB^2, which is taken as the least.
    """
    at_rest = levels.state >= 0
    for sample in (edges.before, edges.after):
        for away in range(-_UNSETTLED_N, _UNSETTLED_N + 1):
            at_rest[np.clip(sample + away, 0, len(codes) - 1)] = False
    groups = [codes[at_rest & (levels.state == level)].astype(np.float64) for level in (0, 1)]
    count = sum(len(group) for group in groups)
    variance = sum(float(np.square(group - group.mean()).sum()) for group in groups) / (count - 2)
    rms = math.sqrt(max(variance, QUANTISATION_VARIANCE_LSB2))
    return Uncertain(rms, rms / math.sqrt(2.0 * count))


def remove_quantisation(rms_lsb: float) -> float:
    """Analogue part of a noise, LSB rms."""
    return math.sqrt(max(rms_lsb**2 - QUANTISATION_VARIANCE_LSB2, 0.0))


@dataclass(frozen=True, eq=False)
class Residual:
    """Residual of the displacement's fit in equivalent time: all periods laid over each other."""

    times: EdgeTimes
    since: Floats
    """(m,): time since the last rising edge, samples."""
    steady: Floats
    """(m,): residual less its mean over that period, LSB."""

    @classmethod
    def of(cls, residual: Floats, samples: NDArray[np.int64], times: EdgeTimes) -> Residual:
        """Fold the residual (m,), in LSB, of ``samples`` (m,)."""
        turn, since = np.divmod(samples - times.rising_n, times.period_n)
        turn = (turn - turn.min()).astype(np.intp)
        mean = np.bincount(turn, residual) / np.maximum(np.bincount(turn), 1)
        return cls(times, since, residual - mean[turn])

    def noise(self, half_period_n: float) -> Uncertain:
        """Noise of the displacement while it moves, rms in LSB, quantisation included.

        Samples at nearly the same equivalent time differ by noise only, whatever the error of the model. Each is
        compared with the line through its neighbours (Gasser, Sroka and Jennen-Steinmetz, Biometrika 73, 1986, 625).
        """
        falling = (self.times.falling_n - self.times.rising_n) % self.times.period_n
        after = np.where(self.since < falling, self.since, self.since - falling)
        moving = (after > 1.0) & (after < _MOVING_PART * half_period_n)
        order = np.argsort(self.since[moving])
        t, y = self.since[moving][order], self.steady[moving][order]
        left, right = np.diff(t)[:-1], np.diff(t)[1:]
        near = (left + right > 0.0) & (left + right < _NEAR_N)
        part = right[near] / (left + right)[near]
        off = part * y[:-2][near] + (1.0 - part) * y[2:][near] - y[1:-1][near]
        variance = float(np.mean(np.square(off) / (1.0 + part**2 + (1.0 - part) ** 2)))
        return Uncertain(math.sqrt(variance), math.sqrt(35.0 / 36.0 * variance / len(off)))

    def unexplained(self, noise_rms: float) -> Uncertain:
        """Part of the residual that repeats in every period, rms in LSB.

        It is the variance of the means over parts of the period, less the contribution of noise.
        """
        parts = np.minimum(self.since * (_PARTS / self.times.period_n), _PARTS - 1).astype(np.intp)
        count = np.bincount(parts, minlength=_PARTS)
        filled = count > 0
        mean = np.bincount(parts, self.steady, minlength=_PARTS)[filled] / count[filled]
        by_noise = noise_rms**2 / count[filled]
        square = max(float(np.mean(np.square(mean) - by_noise)), 0.0)
        error_of_square = math.sqrt(2.0 * float(np.mean(np.square(by_noise))) / int(filled.sum()))
        return Uncertain(math.sqrt(square), error_of_square / (2.0 * math.sqrt(max(square, error_of_square))))
