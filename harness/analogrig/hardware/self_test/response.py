"""The displacement's answer to a square wave: a second-order response, fitted together with the instants of the edges.

    x(t) = offset + gain (low + (high - low) sum of +-s(t - t_edge)),    mass s'' + damping s' + s = 1

for a mass and a damping by the unit of the spring, in samples. Offset, gain, mass, damping, the instants of a rising
and a falling edge and the period are fitted at once, by least squares: a machine whose components are several per cent
off has another mass and damping, and no other instants. Offset and gain are linear (Golub and Pereyra, SIAM Journal on
Numerical Analysis 10, 1973, 413).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import SelfTestError
from analogrig.hardware.self_test.timing import EdgeTimes, SeenEdges

_EDGES_FELT = 2
"""So many edges back is the response settled: the rest is below 1e-5 for a half period of 100 samples."""

_LATEST_N, _SCAN_N = 40.0, 2.0
"""Within so many samples of the force's edges are those of the displacement looked for, in such steps."""
_SCANNED_N = 2000
"""... among so many samples."""

_MASS, _DAMPING, _PERIOD, _RISING, _FALLING = range(5)


@dataclass(frozen=True)
class SecondOrder:
    """mass s'' + damping s' + s = 1, by the sample."""

    mass_n2: float
    damping_n: float

    def step(self, t: NDArray[np.float64], averaged: float = 0.0) -> NDArray[np.float64]:
        """The answer s at times t to a step at 0; averaged over so much time about t."""
        after = np.maximum(t, 0.0)
        slow, fast = self._poles
        if averaged:
            begin = np.maximum(t - 0.5 * averaged, 0.0)
            after = np.maximum(t + 0.5 * averaged, 0.0)
            moved = fast / slow * _exponentials(slow, begin, after) - slow / fast * _exponentials(fast, begin, after)
            return np.asarray((after - begin - (moved / (fast - slow)).real) / averaged)
        parts = fast * np.exp(slow * after) - slow * np.exp(fast * after)
        return np.asarray(1.0 - (parts / (fast - slow)).real)

    @property
    def _poles(self) -> tuple[complex, complex]:
        """Roots of mass p^2 + damping p + 1, never quite equal."""
        middle = -0.5 * self.damping_n / self.mass_n2
        root = complex(middle * middle - 1.0 / self.mass_n2) ** 0.5
        if abs(root) < -1e-5 * middle:
            root = complex(1e-5 * middle)
        return middle + root, middle - root


def _exponentials(pole: complex, begin: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.complex128]:
    return np.asarray(np.exp(pole * end) - np.exp(pole * begin))


@dataclass(frozen=True, eq=False)
class Response:
    """What was fitted; the errors are standard errors by the residuals."""

    offset: float
    """What there is without force, in the unit of the displacement."""
    gain: float
    """Displacement per force at rest."""
    second_order: SecondOrder
    line: EdgeTimes
    """The edges' instants by the displacement."""
    offset_error: float
    gain_error: float
    mass_error_n2: float
    damping_error_n: float
    period_error_n: float
    instant_error_n: float
    """Of the rising or the falling instant, whichever is larger."""
    residual: NDArray[np.float64]
    """(m,): of the samples used, in the unit of the displacement."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What is to be explained."""

    displacement: NDArray[np.float64]
    """(n,): any unit."""
    used: NDArray[np.bool_]
    """(n,): clipped samples are not."""
    edges: SeenEdges
    levels: tuple[float, float]
    """Of the force, any unit: low, high."""
    averaged_n: float
    """Over so much of a sample period the instrument averages."""

    def fitted(self, nominal: SecondOrder) -> Response:
        """
        :param nominal: about what the machine is.
        :raises SelfTestError: nothing fits.
        """
        from scipy.optimize import least_squares

        samples = np.flatnonzero(self.used)
        start = self._start(nominal)
        scale = np.array([0.1, 0.1, 1e-3, 0.1, 0.1])
        fit = least_squares(lambda q: self._residual(q, samples), start, method="lm", x_scale=scale, diff_step=1e-7)
        if not fit.success or not np.isfinite(fit.x).all():
            raise SelfTestError("the displacement does not answer the force as a mass, a damper and a spring do")
        return self._response(fit.x, samples)

    def _start(self, nominal: SecondOrder) -> NDArray[np.float64]:
        """The nominal machine, and the edges' instants by the force, later by whole samples as fits best."""
        line = self.edges.line()
        first = np.array(
            [np.log(nominal.mass_n2), np.log(nominal.damping_n), line.period_n, line.rising_n, line.falling_n]
        )
        few = np.flatnonzero(self.used)[:_SCANNED_N]
        later = np.array([0.0, 0.0, 0.0, 1.0, 1.0])
        shifts = np.arange(-_LATEST_N, _LATEST_N + 1.0, _SCAN_N)
        sums = [np.square(self._residual(first + shift * later, few)).sum() for shift in shifts]
        return np.asarray(first + shifts[int(np.argmin(sums))] * later)

    def _design(self, q: NDArray[np.float64], samples: NDArray[np.int64]) -> NDArray[np.float64]:
        """(samples, 2): what the offset and the gain are multiplied with."""
        second_order = SecondOrder(float(np.exp(q[_MASS])), float(np.exp(q[_DAMPING])))
        instants = EdgeTimes(q[_PERIOD], q[_RISING], q[_FALLING]).instants(self.edges)
        sign = np.where(self.edges.rising, 1.0, -1.0)
        last = np.searchsorted(instants, samples + 0.5 * self.averaged_n) - 1
        before = last - _EDGES_FELT
        part = np.where(before >= 0, np.where(self.edges.rising[np.maximum(before, 0)], 1.0, 0.0), 0.5 - 0.5 * sign[0])
        for back in range(_EDGES_FELT):
            edge = np.maximum(last - back, 0)
            felt = last - back >= 0
            part = part + np.where(felt, sign[edge] * second_order.step(samples - instants[edge], self.averaged_n), 0.0)
        low, high = self.levels
        return np.stack([np.ones(len(samples)), low + (high - low) * part], axis=1)

    def _residual(self, q: NDArray[np.float64], samples: NDArray[np.int64]) -> NDArray[np.float64]:
        design, y = self._design(q, samples), self.displacement[samples]
        return np.asarray(design @ np.linalg.lstsq(design, y, rcond=None)[0] - y)

    def _response(self, q: NDArray[np.float64], samples: NDArray[np.int64]) -> Response:
        design, y = self._design(q, samples), self.displacement[samples]
        linear = np.linalg.lstsq(design, y, rcond=None)[0]
        steps = np.diag([1e-5, 1e-5, 1e-6, 1e-4, 1e-4])
        moved = [
            (self._design(q + step, samples) - self._design(q - step, samples)) @ linear / (2.0 * step.max())
            for step in steps
        ]
        jacobian = np.concatenate((design, np.stack(moved, axis=1)), axis=1)
        rms = float(np.sqrt(np.square(design @ linear - y).sum() / (len(y) - jacobian.shape[1])))
        errors = rms * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
        mass, damping = float(np.exp(q[_MASS])), float(np.exp(q[_DAMPING]))
        return Response(
            offset=float(linear[0]),
            gain=float(linear[1]),
            second_order=SecondOrder(mass, damping),
            line=EdgeTimes(*map(float, q[_PERIOD:])),
            offset_error=float(errors[0]),
            gain_error=float(errors[1]),
            mass_error_n2=float(errors[2]) * mass,
            damping_error_n=float(errors[3]) * damping,
            period_error_n=float(errors[4]),
            instant_error_n=float(errors[5:].max()),
            residual=y - design @ linear,
        )
