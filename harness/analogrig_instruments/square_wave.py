"""Square wave as a card samples it, and the second-order response to it: levels, edges, timing, noise.

An edge between two samples shows only that it lies between them. Each edge gives an interval for the unknown delay, and
the truth lies in all of them. Edges fall on many parts of a sample period, so the intersection is narrow
(set-membership estimation: Milanese and Vicino, Automatica 27, 1991, 997).

An instrument that averages over a part of each sample period shows some edges between the levels; the value there is
linear in the instant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import SelfTestError
from analogrig.judging import QUANTISATION_VARIANCE_LSB2

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
"""Part of a half period, from its edge, in which the output moves by more than a code per sample."""
_PARTS = 104
"""Parts of a period that are averaged: about two samples each."""
_NEAR_N = 0.2
"""Largest distance of neighbours in equivalent time, in samples."""

_EDGES_FELT = 2
"""Latest edges whose response is computed; earlier ones have settled to 1e-5 for half periods of 100 samples."""
_LATEST_N, _SCAN_N = 40.0, 2.0
"""Largest delay of the output's edges that is searched, and step of the search, in samples."""
_SCANNED_N = 2000
"""Samples used in the search."""


class Uncertain(NamedTuple):
    """Value with its standard error."""

    value: float
    error: float


@dataclass(frozen=True, eq=False)
class SquareWave:
    """Sampled square wave: its levels, and its edges between samples, rising and falling alternately."""

    codes: NDArray[np.uint16]
    low: float
    high: float
    """Levels in codes (medians)."""
    state: NDArray[np.int8]
    """(n,): 0 at the lower level, 1 at the upper one, -1 between."""
    before: NDArray[np.int64]
    """(edges,): last sample at the old level."""
    after: NDArray[np.int64]
    """(edges,): first sample at the new level."""
    rising: NDArray[np.bool_]  # (edges,)

    @classmethod
    def of(cls, codes: NDArray[np.uint16], half_period_n: float) -> Self:
        """Find levels and edges.

        :param half_period_n: approximate number of samples between two edges.
        :raises SelfTestError: it is no unbroken square wave.
        """
        values = codes.astype(np.float64)
        upper = values > 0.5 * (values.min() + values.max())
        if not upper.any():
            raise SelfTestError("the input does not change")
        low, high = float(np.median(values[~upper])), float(np.median(values[upper]))
        off = np.abs(values - np.where(upper, high, low))
        noise = max(1.4826 * float(np.median(off)), 0.5)
        state = np.where(off <= max(SETTLED_PART * (high - low), _NOISES * noise), upper, -1).astype(np.int8)
        settled = np.flatnonzero(state >= 0)
        turns = np.flatnonzero(np.diff(state[settled]))
        before, after = settled[turns], settled[turns + 1]
        marks = np.concatenate(([0], 0.5 * (before + after), [len(state)]))
        lengths = np.diff(marks) / half_period_n
        lengths[[0, -1]] = np.where(lengths[[0, -1]] < 1.5, 1.0, lengths[[0, -1]])
        if (broken := np.flatnonzero(np.rint(lengths) != 1)).size:
            raise SelfTestError(f"the square wave of the input is broken after sample {int(marks[broken[0]])}")
        if (longest := int((after - before).max())) > _MOST_BETWEEN + 1:
            raise SelfTestError(f"the input takes {longest} samples from level to level: it is no square wave")
        return cls(codes, low, high, state, before, after, state[after] == 1)

    @property
    def turn(self) -> Floats:
        """(edges,): number of the period of each edge, 0 in the middle of the record."""
        first = 0 if self.rising[0] else 1
        return np.asarray((np.arange(len(self.rising)) + first) // 2 - len(self.rising) // 4, dtype=np.float64)

    def times(self) -> EdgeTimes:
        """Least-squares timing of the middles of the edges; accurate to a part of a sample."""
        design = np.stack([self.turn, self.rising, ~self.rising], axis=1).astype(np.float64)
        middles = 0.5 * (self.before + self.after)
        return EdgeTimes(*np.linalg.lstsq(design, middles, rcond=None)[0].tolist())

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

    def delay(self, times: EdgeTimes, drift_n: float) -> Uncertain:
        """Delay of the edges after ``times``, in samples.

        :param drift_n: largest error of ``times`` at the ends of the record.
        """
        samples, edge = self.samples_between()
        instants, averaging_n = times.instants(self), self.averaging_n()
        if averaging_n:
            upper = (self.codes[samples] - self.low) / (self.high - self.low)
            new = np.where(self.rising[edge], upper, 1.0 - upper)
            late = samples - averaging_n * (new - 0.5) - instants[edge]
            return Uncertain(float(late.mean()), float(np.hypot(late.std() / np.sqrt(len(late)), drift_n)))
        least, most = float((self.before - instants).max()), float((self.after - instants).min())
        return Uncertain(0.5 * (least + most), float((abs(most - least) + 2.0 * drift_n) / np.sqrt(12.0)))

    def noise(self) -> Uncertain:
        """Noise about the levels, rms in LSB, quantisation included.

        A level at rest may show less than its quantisation variance of 1/12 LSB^2, which is taken as the least.
        """
        near = np.arange(-_UNSETTLED_N, _UNSETTLED_N + 1)
        at_rest = self.state >= 0
        at_rest[np.clip(np.add.outer(np.append(self.before, self.after), near), 0, len(self.codes) - 1)] = False
        groups = [self.codes[at_rest & (self.state == level)].astype(np.float64) for level in (0, 1)]
        count = sum(len(group) for group in groups)
        variance = sum(float(np.square(group - group.mean()).sum()) for group in groups) / (count - 2)
        rms = math.sqrt(max(variance, QUANTISATION_VARIANCE_LSB2))
        return Uncertain(rms, rms / math.sqrt(2.0 * count))


class EdgeTimes(NamedTuple):
    """Period of a square wave, and instants of one rising and one falling edge mid-record; in samples."""

    period_n: float
    rising_n: float
    falling_n: float

    def instants(self, wave: SquareWave) -> Floats:
        """(edges,): instant of each edge, in samples."""
        return np.asarray(wave.turn * self.period_n + np.where(wave.rising, self.rising_n, self.falling_n))


# ---- the response


def step_response(t: Floats, mass_n2: float, damping_n: float, averaging_n: float = 0.0) -> Floats:
    """Response s of mass s'' + damping s' + s = 1 at times ``t`` after a step, averaged over ``averaging_n`` about it.

    All times are in samples.
    """
    middle = -0.5 * damping_n / mass_n2
    root = complex(middle * middle - 1.0 / mass_n2) ** 0.5
    if abs(root) < -1e-5 * middle:
        root = complex(1e-5 * middle)  # keeps the poles distinct
    slow, fast = middle + root, middle - root
    if averaging_n:
        begin, end = (np.maximum(t + side * averaging_n, 0.0) for side in (-0.5, 0.5))
        slow_part, fast_part = (np.exp(pole * end) - np.exp(pole * begin) for pole in (slow, fast))
        moved = fast / slow * slow_part - slow / fast * fast_part
        return np.asarray((end - begin - (moved / (fast - slow)).real) / averaging_n)
    after = np.maximum(t, 0.0)
    parts = fast * np.exp(slow * after) - slow * np.exp(fast * after)
    return np.asarray(1.0 - (parts / (fast - slow)).real)


@dataclass(frozen=True, eq=False)
class Response:
    """Second-order response of the displacement to a square wave, fitted together with the timing of the edges.

        x(t) = offset + gain (low + (high - low) sum of +-s(t - t_edge)),    mass s'' + damping s' + s = 1

    Mass and damping are per unit of the spring, in samples. Components that deviate by several per cent change mass and
    damping but no instant. Standard errors follow from the residual.
    """

    offset: Uncertain
    """Displacement without force."""
    gain: Uncertain
    """Displacement per force at rest."""
    mass_n2: Uncertain
    damping_n: Uncertain
    times: EdgeTimes
    """Timing of the edges as the displacement shows it."""
    period_error_n: float
    instant_error_n: float
    """Larger standard error of the rising and the falling instant."""
    samples: NDArray[np.int64]
    """(m,): samples used."""
    residual: Floats
    """(m,): their residual, in the unit of the displacement."""

    @classmethod
    def fit(
        cls,
        displacement: Floats,
        used: NDArray[np.bool_],
        wave: SquareWave,
        levels: tuple[float, float],
        nominal: tuple[float, float],
    ) -> Self:
        """Fit the response by least squares.

        :param displacement: (n,) in any unit.
        :param used: (n,): samples that are not clipped.
        :param levels: low and high level of the force, in any unit.
        :param nominal: approximate mass and damping.
        :raises SelfTestError: the fit does not converge.
        """
        from scipy.optimize import least_squares

        averaging_n = wave.averaging_n()
        samples = np.flatnonzero(used)
        few = samples[:_SCANNED_N]
        # Nominal machine and the timing of the force's edges, delayed by the whole samples that fit best.
        shape, later = np.array([*np.log(nominal), *wave.times()]), np.array([0.0, 0.0, 0.0, 1.0, 1.0])
        starts = []
        for shift in np.arange(-_LATEST_N, _LATEST_N + 1.0, _SCAN_N):
            design = _design(shape + shift * later, few, wave, levels, averaging_n)
            linear = np.linalg.lstsq(design, displacement[few], rcond=None)[0]
            squares = float(np.square(design @ linear - displacement[few]).sum())
            starts.append((squares, [*linear, *(shape + shift * later)]))

        def residual(q: Floats) -> Floats:
            return np.asarray(_design(q[2:], samples, wave, levels, averaging_n) @ q[:2] - displacement[samples])

        scale = np.array([0.1, 0.1, 0.1, 0.1, 1e-3, 0.1, 0.1])
        found = least_squares(residual, min(starts)[1], method="lm", x_scale=scale, diff_step=1e-7)
        determined = np.linalg.matrix_rank(found.jac) == len(scale) if np.isfinite(found.jac).all() else False
        if not found.success or not np.isfinite(found.x).all() or not determined:
            raise SelfTestError("the output does not respond to the input as a plant of second order does")
        variance = float(np.square(found.fun).sum()) / (len(samples) - len(scale))
        inverse = np.linalg.pinv(found.jac)
        errors = np.sqrt(variance * np.square(inverse).sum(axis=1)).tolist()
        offset, gain, log_mass, log_damping, *times = found.x.tolist()
        mass, damping = math.exp(log_mass), math.exp(log_damping)
        return cls(
            offset=Uncertain(offset, errors[0]),
            gain=Uncertain(gain, errors[1]),
            mass_n2=Uncertain(mass, errors[2] * mass),
            damping_n=Uncertain(damping, errors[3] * damping),
            times=EdgeTimes(*times),
            period_error_n=errors[4],
            instant_error_n=max(errors[5:]),
            samples=samples,
            residual=-found.fun,
        )

    def noise(self, half_period_n: float) -> Uncertain:
        """Noise of the displacement while it moves, rms in its unit, quantisation included.

        Samples at nearly the same time after an edge differ by noise only, whatever the error of the model. Each is
        compared with the line through its neighbours (Gasser, Sroka and Jennen-Steinmetz, Biometrika 73, 1986, 625).
        """
        since, steady = self._fold()
        falling = (self.times.falling_n - self.times.rising_n) % self.times.period_n
        after = np.where(since < falling, since, since - falling)
        moving = (after > 1.0) & (after < _MOVING_PART * half_period_n)
        order = np.argsort(since[moving])
        t, y = since[moving][order], steady[moving][order]
        left, right = np.diff(t)[:-1], np.diff(t)[1:]
        near = (left + right > 0.0) & (left + right < _NEAR_N)
        part = right[near] / (left + right)[near]
        off = part * y[:-2][near] + (1.0 - part) * y[2:][near] - y[1:-1][near]
        variance = float(np.mean(np.square(off) / (1.0 + part**2 + (1.0 - part) ** 2)))
        return Uncertain(math.sqrt(variance), math.sqrt(35.0 / 36.0 * variance / len(off)))

    def unexplained(self, noise_rms: float) -> Uncertain:
        """Part of the residual that repeats in every period, rms in its unit.

        It is the variance of the means over parts of the period, less the contribution of noise.
        """
        since, steady = self._fold()
        parts = np.minimum(since * (_PARTS / self.times.period_n), _PARTS - 1).astype(np.intp)
        count = np.bincount(parts, minlength=_PARTS)
        filled = count > 0
        mean = np.bincount(parts, steady, minlength=_PARTS)[filled] / count[filled]
        by_noise = noise_rms**2 / count[filled]
        square = max(float(np.mean(np.square(mean) - by_noise)), 0.0)
        error_of_square = math.sqrt(2.0 * float(np.mean(np.square(by_noise))) / int(filled.sum()))
        return Uncertain(math.sqrt(square), error_of_square / (2.0 * math.sqrt(max(square, error_of_square))))

    def _fold(self) -> tuple[Floats, Floats]:
        """Time (m,) since the last rising edge, in samples, and residual (m,) less its mean over that period."""
        turn, since = np.divmod(self.samples - self.times.rising_n, self.times.period_n)
        turn = (turn - turn.min()).astype(np.intp)
        mean = np.bincount(turn, self.residual) / np.maximum(np.bincount(turn), 1)
        return since, self.residual - mean[turn]


def _design(
    q: Floats, samples: NDArray[np.int64], wave: SquareWave, levels: tuple[float, float], averaging_n: float
) -> Floats:
    """(samples, 2): factors of offset and gain, for logarithms of mass and damping, and edge times ``q`` (5,)."""
    mass_n2, damping_n = np.exp(q[:2]).tolist()
    instants = EdgeTimes(*q[2:].tolist()).instants(wave)
    sign = np.where(wave.rising, 1.0, -1.0)
    last = np.searchsorted(instants, samples + 0.5 * averaging_n) - 1
    before = last - _EDGES_FELT
    part = np.where(before >= 0, np.where(wave.rising[np.maximum(before, 0)], 1.0, 0.0), 0.5 - 0.5 * sign[0])
    for back in range(_EDGES_FELT):
        edge = np.maximum(last - back, 0)
        response = sign[edge] * step_response(samples - instants[edge], mass_n2, damping_n, averaging_n)
        part = part + np.where(last - back >= 0, response, 0.0)
    low, high = levels
    return np.stack([np.ones(len(samples)), low + (high - low) * part], axis=1)
