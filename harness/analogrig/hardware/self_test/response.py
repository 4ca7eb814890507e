"""Second-order response of the displacement to a square wave, fitted together with the timing of the edges.

    x(t) = offset + gain (low + (high - low) sum of +-s(t - t_edge)),    mass s'' + damping s' + s = 1

Mass and damping are per unit of the spring, in samples. Least squares fits offset, gain, mass, damping, the instants of
a rising and a falling edge and the period jointly: components that deviate by several per cent change mass and damping
but no instant. Offset and gain are linear (Golub and Pereyra, SIAM Journal on Numerical Analysis 10, 1973, 413).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import SelfTestError
from analogrig.hardware.self_test.square_wave import EdgeTimes, Floats, SeenEdges, Uncertain

_EDGES_FELT = 2
"""Latest edges whose response is computed; earlier ones have settled to 1e-5 for half periods of 100 samples."""

_LATEST_N, _SCAN_N = 40.0, 2.0
"""Largest delay of the displacement's edges that is searched, and step of the search, in samples."""
_SCANNED_N = 2000
"""Samples used in the search."""

_MASS, _DAMPING, _PERIOD, _RISING, _FALLING = range(5)


@dataclass(frozen=True)
class SecondOrder:
    """System mass s'' + damping s' + s = 1, with time in samples."""

    mass_n2: float
    damping_n: float

    def step(self, t: Floats, averaging_n: float = 0.0) -> Floats:
        """Response s at times ``t`` to a step at 0, averaged over ``averaging_n`` about ``t``."""
        after = np.maximum(t, 0.0)
        slow, fast = self._poles
        if averaging_n:
            begin = np.maximum(t - 0.5 * averaging_n, 0.0)
            after = np.maximum(t + 0.5 * averaging_n, 0.0)
            slow_part, fast_part = (np.exp(pole * after) - np.exp(pole * begin) for pole in (slow, fast))
            moved = fast / slow * slow_part - slow / fast * fast_part
            return np.asarray((after - begin - (moved / (fast - slow)).real) / averaging_n)
        parts = fast * np.exp(slow * after) - slow * np.exp(fast * after)
        return np.asarray(1.0 - (parts / (fast - slow)).real)

    @property
    def _poles(self) -> tuple[complex, complex]:
        """Roots of mass p^2 + damping p + 1, kept distinct."""
        middle = -0.5 * self.damping_n / self.mass_n2
        root = complex(middle * middle - 1.0 / self.mass_n2) ** 0.5
        if abs(root) < -1e-5 * middle:
            root = complex(1e-5 * middle)
        return middle + root, middle - root


@dataclass(frozen=True, eq=False)
class FittedResponse:
    """Fitted response; standard errors follow from the residual."""

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
    residual: Floats
    """(m,): residual of the samples used, in the unit of the displacement."""


@dataclass(frozen=True, eq=False)
class ObservedResponse:
    """Displacement, any unit, and the square wave that drives it."""

    displacement: Floats  # (n,)
    used: NDArray[np.bool_]  # (n,): not clipped
    edges: SeenEdges
    levels: tuple[float, float]
    """Low and high level of the force, any unit."""
    averaging_n: float
    """Time over which the instrument averages, in samples."""

    def fit(self, nominal: SecondOrder) -> FittedResponse:
        """Fit the response.

        :param nominal: approximate mass and damping.
        :raises SelfTestError: the fit does not converge.
        """
        from scipy.optimize import least_squares

        samples = np.flatnonzero(self.used)
        start = self._start(nominal)
        scale = np.array([0.1, 0.1, 1e-3, 0.1, 0.1])
        fit = least_squares(lambda q: self._residual(q, samples), start, method="lm", x_scale=scale, diff_step=1e-7)
        if not fit.success or not np.isfinite(fit.x).all():
            raise SelfTestError("the displacement does not respond to the force as a mass, a damper and a spring do")
        return self._response(fit.x, samples)

    def _start(self, nominal: SecondOrder) -> Floats:
        """Nominal machine and the timing of the force's edges, delayed by the whole samples that fit best."""
        times = self.edges.times()
        first = np.array(
            [np.log(nominal.mass_n2), np.log(nominal.damping_n), times.period_n, times.rising_n, times.falling_n]
        )
        few = np.flatnonzero(self.used)[:_SCANNED_N]
        later = np.array([0.0, 0.0, 0.0, 1.0, 1.0])
        shifts = np.arange(-_LATEST_N, _LATEST_N + 1.0, _SCAN_N)
        sums = [np.square(self._residual(first + shift * later, few)).sum() for shift in shifts]
        return np.asarray(first + shifts[int(np.argmin(sums))] * later)

    def _design(self, q: Floats, samples: NDArray[np.int64]) -> Floats:
        """(samples, 2): factors of offset and gain."""
        second_order = SecondOrder(float(np.exp(q[_MASS])), float(np.exp(q[_DAMPING])))
        instants = EdgeTimes(q[_PERIOD], q[_RISING], q[_FALLING]).instants(self.edges)
        sign = np.where(self.edges.rising, 1.0, -1.0)
        last = np.searchsorted(instants, samples + 0.5 * self.averaging_n) - 1
        before = last - _EDGES_FELT
        part = np.where(before >= 0, np.where(self.edges.rising[np.maximum(before, 0)], 1.0, 0.0), 0.5 - 0.5 * sign[0])
        for back in range(_EDGES_FELT):
            edge = np.maximum(last - back, 0)
            response = sign[edge] * second_order.step(samples - instants[edge], self.averaging_n)
            part = part + np.where(last - back >= 0, response, 0.0)
        low, high = self.levels
        return np.stack([np.ones(len(samples)), low + (high - low) * part], axis=1)

    def _residual(self, q: Floats, samples: NDArray[np.int64]) -> Floats:
        design, y = self._design(q, samples), self.displacement[samples]
        return np.asarray(design @ np.linalg.lstsq(design, y, rcond=None)[0] - y)

    def _response(self, q: Floats, samples: NDArray[np.int64]) -> FittedResponse:
        """Response at the minimum ``q``, with standard errors."""
        design, y = self._design(q, samples), self.displacement[samples]
        linear = np.linalg.lstsq(design, y, rcond=None)[0]
        steps = np.diag([1e-5, 1e-5, 1e-6, 1e-4, 1e-4])
        moved = [
            (self._design(q + step, samples) - self._design(q - step, samples)) @ linear / (2.0 * step.max())
            for step in steps
        ]
        jacobian = np.concatenate((design, np.stack(moved, axis=1)), axis=1)
        rms = float(np.sqrt(np.square(design @ linear - y).sum() / (len(y) - jacobian.shape[1])))
        errors = (rms * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))).tolist()
        mass, damping = float(np.exp(q[_MASS])), float(np.exp(q[_DAMPING]))
        return FittedResponse(
            offset=Uncertain(float(linear[0]), errors[0]),
            gain=Uncertain(float(linear[1]), errors[1]),
            mass_n2=Uncertain(mass, errors[2] * mass),
            damping_n=Uncertain(damping, errors[3] * damping),
            times=EdgeTimes(*map(float, q[_PERIOD:])),
            period_error_n=errors[4],
            instant_error_n=max(errors[5:]),
            residual=y - design @ linear,
        )
