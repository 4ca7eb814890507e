"""How much of a signal is noise, and how much of it is neither noise nor what was fitted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from analogrig.hardware.self_test.timing import EdgeTimes, Levels, SeenEdges
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2

_UNSETTLED_N = 3
"""So many samples on either side of an edge do not count for the noise of a level."""

_MOVING_PART = 0.25
"""Of a half period, after an edge: there the displacement moves by more than a code a sample."""

_PARTS = 104
"""Of a period, for means over them: about two samples each."""

_NEAR_N = 0.2
"""Neighbours of equivalent time are no further apart than so many samples."""


def of_levels(codes: NDArray[np.uint16], levels: Levels, edges: SeenEdges) -> tuple[float, float]:
    """The noise (rms) of a square wave about its levels in LSB, quantisation included, and its standard error.

    A level that does not move may show less of its quantisation than 1/12 LSB^2: so much is taken to be there.
    """
    at_rest = levels.state >= 0
    for sample in (edges.before, edges.after):
        for away in range(_UNSETTLED_N + 1):
            at_rest[np.clip(sample + away, 0, len(codes) - 1)] = False
            at_rest[np.clip(sample - away, 0, len(codes) - 1)] = False
    groups = [codes[at_rest & (levels.state == level)].astype(np.float64) for level in (0, 1)]
    count = sum(len(group) for group in groups)
    variance = sum(float(np.square(group - group.mean()).sum()) for group in groups) / (count - 2)
    rms = math.sqrt(max(variance, QUANTISATION_VARIANCE_LSB2))
    return rms, rms / math.sqrt(2.0 * count)


def of_answer(
    residual: NDArray[np.float64], samples: NDArray[np.int64], line: EdgeTimes, half_period_n: float
) -> tuple[float, float]:
    """The noise (rms) of the displacement while it moves, quantisation included, and its standard error.

    Samples at nearly the same time after an edge, of whatever period, differ by noise only, though no model be right:
    each is set against the line through its neighbours in that equivalent time (Gasser, Sroka and Jennen-Steinmetz,
    Biometrika 73, 1986, 625). What drifts from period to period is taken out before.

    :param residual: (m,) of the fit at ``samples`` (m,); in LSB.
    """
    since, steady = _in_equivalent_time(residual, samples, line)
    falling = (line.falling_n - line.rising_n) % line.period_n
    after = np.where(since < falling, since, since - falling)
    moving = (after > 1.0) & (after < _MOVING_PART * half_period_n)
    order = np.argsort(since[moving])
    t, y = since[moving][order], steady[moving][order]
    left, right = np.diff(t)[:-1], np.diff(t)[1:]
    near = (left + right > 0.0) & (left + right < _NEAR_N)
    part = right[near] / (left + right)[near]
    off = part * y[:-2][near] + (1.0 - part) * y[2:][near] - y[1:-1][near]
    variance = float(np.mean(np.square(off) / (1.0 + part**2 + (1.0 - part) ** 2)))
    return math.sqrt(variance), math.sqrt(35.0 / 36.0 * variance / len(off))


def unexplained(
    residual: NDArray[np.float64], samples: NDArray[np.int64], line: EdgeTimes, noise_rms: float
) -> tuple[float, float]:
    """What the fit leaves alike in every period (rms), and its standard error; arguments as ``of_answer``.

    It is the scatter of the means over parts of the period, less what noise gives it.
    """
    since, steady = _in_equivalent_time(residual, samples, line)
    parts = np.minimum(since * (_PARTS / line.period_n), _PARTS - 1).astype(np.intp)
    count = np.bincount(parts, minlength=_PARTS)
    filled = count > 0
    mean = np.bincount(parts, steady, minlength=_PARTS)[filled] / count[filled]
    by_noise = noise_rms**2 / count[filled]
    square = max(float(np.mean(np.square(mean) - by_noise)), 0.0)
    error_of_square = math.sqrt(2.0 * float(np.mean(np.square(by_noise))) / int(filled.sum()))
    return math.sqrt(square), error_of_square / (2.0 * math.sqrt(max(square, error_of_square)))


def _in_equivalent_time(
    residual: NDArray[np.float64], samples: NDArray[np.int64], line: EdgeTimes
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Time since the last rising edge, and the residual less its mean over that period."""
    turn, since = np.divmod(samples - line.rising_n, line.period_n)
    turn = (turn - turn.min()).astype(np.intp)
    mean = np.bincount(turn, residual) / np.maximum(np.bincount(turn), 1)
    return since, residual - mean[turn]


def analogue(rms_lsb: float) -> float:
    """What is left of it without quantisation."""
    return math.sqrt(max(rms_lsb**2 - QUANTISATION_VARIANCE_LSB2, 0.0))
