"""Isolation bound of one change: samples until the output rejects every change of one other parameter."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.courses import Model, PlantChange, first_at_level

ISOLATION_INFORMATION = math.log(20.0)
"""Information at which a rival hypothesis is rejected with 95 % confidence."""

ISOLATION_HORIZON_N = 300
"""Samples after a change in which it must be isolated; later counts as never."""

_GRID = np.linspace(-math.log(4.0), math.log(4.0), 193)
"""Logarithms of the factors on the rival parameter."""

_COARSE = _GRID[::48]
"""Those that are played first; the middle one changes nothing."""

_REACH = 16
"""Steps of the grid to either side of a factor that a refinement covers."""

_NODES = _REACH * (_GRID[1] - _GRID[0]) * np.cos(np.pi * (np.arange(5) + 0.5) / 5.0)
"""Factors that a refinement plays, about its own: Chebyshev's."""

_LEAST_NODES = 3
"""Courses without which none is interpolated."""

_MOST_REFINEMENTS = 12


def bound(model: Model, change: PlantChange, weight: NDArray[np.float64]) -> int | None:
    """Samples after a change until every rival is rejected; None: not before the next change or within the horizon.

    :param weight: information per squared LSB of each sample after the change.
    """
    if not change.changed or not len(change.course_lsb):
        return None
    rivals = _Rivals(model, change, weight)
    latest_n = 0
    for name in change.before:
        if change.changed != (name,):
            rejected_n = rivals.rejected_after(name)
            if rejected_n is None:
                return None
            latest_n = max(latest_n, rejected_n)
    return latest_n or None


class _Rivals:
    """Changes of one other parameter by any factor from 1/4 to 4 that the plant can have."""

    def __init__(self, model: Model, change: PlantChange, weight: NDArray[np.float64]) -> None:
        self._model, self._change = model, change
        self._truth = change.course_lsb[:ISOLATION_HORIZON_N]
        self._weight = weight[: len(self._truth)]
        self._unchanged = model.course(change.moment, change.before, change.before, 0).advance(len(self._truth))

    def rejected_after(self, name: str) -> int | None:
        """Samples until every factor on a parameter is rejected; None: some never is.

        Few factors are played, and courses between them are interpolated. About the factor that is rejected last more
        are played, until it lies in a range refined so.
        """
        factors, courses = self._played(name, _COARSE)
        if len(factors) < _LEAST_NODES:
            return 0
        grid = _GRID[(factors[0] <= _GRID) & (factors[-1] >= _GRID)]
        information = self._information(_lagrange(factors, grid) @ courses)
        least = np.full(len(self._truth), np.inf)
        is_fine = np.isin(grid, factors[[0, -1]])  # no better rival is expected inside if an end is the best
        rejected_n = None
        for _ in range(_MOST_REFINEMENTS):
            rejected_n = first_at_level(np.minimum(least, information.min(axis=0)), ISOLATION_INFORMATION)
            last = int(information[:, (rejected_n or 0) - 1].argmin())
            if is_fine[last]:
                break
            near = slice(max(last - _REACH, 0), min(last + _REACH + 1, len(grid)))
            factors, courses = self._played(name, grid[last] + _NODES)
            if len(factors) >= _LEAST_NODES:
                information[near] = self._information(_lagrange(factors, grid[near]) @ courses)
                least = np.minimum(least, _interpolate_minimum(information[near]))
            inner = slice(near.start + (near.start > 0), near.stop - (near.stop < len(grid)))
            is_fine[inner] = True
        return rejected_n

    def _played(self, name: str, factors: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Logarithms of the factors that the plant can have, and the courses with them, (f, n)."""
        found = []
        for factor in factors.tolist():
            values = {**self._change.before, name: self._change.before[name] * math.exp(factor)}
            if not factor:
                found.append((factor, self._unchanged))
            elif (course := self._model.rival(self._change.moment, values)) is not None:
                found.append((factor, course.advance(len(self._truth))))
        return np.array([factor for factor, _ in found]), np.array([course for _, course in found])

    def _information(self, courses: NDArray[np.float64]) -> NDArray[np.float64]:
        """I(n) between the truth and each of (f, n) courses: (f, n)."""
        return np.cumsum((courses - self._truth) ** 2 * self._weight, axis=1)


def _lagrange(nodes: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """(a, n) weights of the polynomial through n nodes."""
    others = ~np.eye(len(nodes), dtype=np.bool_)
    apart = np.where(others, nodes[:, None] - nodes, 1.0).prod(axis=1)
    return np.asarray(np.where(others, at[:, None, None] - nodes, 1.0).prod(axis=2) / apart)


def _interpolate_minimum(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Minimum over evenly spaced f of (f, n), interpolated by a parabola unless it is the first or last: (n,)."""
    least = information.argmin(axis=0)
    at = np.clip(least, 1, len(information) - 2)
    low, mid, high = (information[at + i, np.arange(information.shape[1])] for i in (-1, 0, 1))
    curvature = low + high - 2.0 * mid
    is_inner = (at == least) & (curvature > 0.0)
    dip = np.divide((high - low) ** 2, 8.0 * curvature, out=np.zeros_like(mid), where=is_inner)
    return np.asarray(np.maximum(np.minimum(information.min(axis=0), mid - dip), 0.0))
