"""Window-limited generalised likelihood ratio test that knows the plant and every plant it may change to.

The yardstick of ``bench_detectors``: it estimates nothing but an offset. Each hypothesis, a change to one of the plants
after one of the last samples, has the innovations of its own stationary Kalman filter; the statistic is the largest
sum of log-likelihood ratios (Willsky and Jones, IEEE Transactions on Automatic Control 21, 1976; Lai, IEEE
Transactions on Information Theory 44, 1998).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2
from analogrig.plant import discretise

from .detectors import CHANGES, HOLD_OFF_N, PLANT, SIGNS, WARM_UP_N, changed_plant

_SETTLING_N = 50
"""Samples from rest that the offset is not estimated from."""


class KnownPlantsGlr:
    """Device of the kind ``python``. After an alarm and a hold-off it continues with the likeliest plant."""

    def __init__(
        self,
        level: float,
        *,
        n_per_code: float,
        m_per_code: float,
        force_zero: float,
        displacement_zero: float,
        force_noise_codes: float,
        displacement_noise_codes: float,
        period_s: float,
        window_n: int = 100,
    ) -> None:
        """Start at rest.

        level: of the statistic that raises an alarm. window_n: number of instants among the hypotheses.
        """
        plants = [PLANT, *(changed_plant(what, sign) for what in CHANGES for sign in SIGNS)]
        sampled = discretise(PLANT.program, np.array([each.values for each in plants]), period_s)
        self._transitions = sampled[:, :, :2]
        self._responses = sampled[:, :, 2] * (n_per_code / m_per_code)
        variances = [each**2 + QUANTISATION_VARIANCE_LSB2 for each in (force_noise_codes, displacement_noise_codes)]
        filters = [_stationary(a, b, *variances) for a, b in zip(self._transitions, self._responses, strict=True)]
        self._gains = np.array([gain for gain, _ in filters])
        self._variances = np.array([variance for _, variance in filters])
        self._logs = np.log(self._variances)
        self.datasheet: Mapping[str, object] = {"statistic": True, "warm_up_n": WARM_UP_N, "hold_off_n": HOLD_OFF_N}
        self._level = level
        self._force_zero, self._displacement_zero = force_zero, displacement_zero
        self._samples, self._hold_off_n = 0, 0
        self._offset = 0.0
        self._states = np.zeros((len(plants), window_n, 2))
        """Predicted state of each hypothesis: plants by instants."""
        self._begin(0, np.zeros(2))

    def _begin(self, plant: int, state: NDArray[np.float64]) -> None:
        """Continue with a plant from its predicted state, without hypotheses."""
        self._plant, self._state = plant, state
        self._ratios = np.full(self._states.shape[:2], -np.inf)

    def step(self, u: int, y: int, valid: bool) -> dict[str, object]:  # noqa: FBT001
        """Take one sample.

        :raises ValueError: it is missing.
        """
        if not valid:
            raise ValueError("a missing sample")
        self._force = u - self._force_zero
        displacement = y - self._displacement_zero - self._offset
        statistic = 0.0
        if self._samples < WARM_UP_N:
            self._learn_offset(displacement)
        elif self._hold_off_n:
            self._identify(displacement)
        else:
            statistic = self._weigh(displacement)
        self._samples += 1
        alarm = statistic >= self._level
        if alarm:
            self._hold_off_n = HOLD_OFF_N
            self._bank = np.tile(self._state, (len(self._states), 1, 1))
            self._misfits = np.zeros(len(self._states))
        return {"alarm": alarm, "statistic": statistic}

    def _learn_offset(self, displacement: float) -> None:
        """Average the error of a simulation from rest."""
        counted = self._samples - _SETTLING_N
        if counted >= 0:
            self._offset += (displacement - self._state[0]) / (counted + 1)
        self._state = self._transitions[0] @ self._state + self._responses[0] * self._force

    def _weigh(self, displacement: float) -> float:
        """Add the sample to all log-likelihood ratios; return the largest, or 0."""
        error = displacement - self._state[0]
        own = error**2 / self._variances[self._plant] + self._logs[self._plant]
        errors = displacement - self._states[:, :, 0]
        self._ratios += 0.5 * (own - errors**2 / self._variances[:, None] - self._logs[:, None])
        statistic = max(0.0, float(self._ratios.max()))
        self._states = self._predict(self._states + self._gains[:, None, :] * errors[:, :, None])
        oldest = self._samples % self._states.shape[1]
        self._states[:, oldest] = self._predict((self._state + self._gains[self._plant] * error)[None, None, :])[:, 0]
        self._ratios[:, oldest] = 0.0
        self._state = self._states[self._plant, oldest]
        return statistic

    def _identify(self, displacement: float) -> None:
        """Run the filters of all plants; at the end of the hold-off continue with that of the likeliest plant."""
        errors = displacement - self._bank[:, :, 0]
        self._misfits += errors[:, 0] ** 2 / self._variances + self._logs
        self._bank = self._predict(self._bank + self._gains[:, None, :] * errors[:, :, None])
        self._hold_off_n -= 1
        if not self._hold_off_n:
            likeliest = int(np.argmin(self._misfits))
            self._begin(likeliest, self._bank[likeliest, 0])

    def _predict(self, filtered: NDArray[np.float64]) -> NDArray[np.float64]:
        """States (plants, n, 2) at the next sample from those at this one."""
        return np.asarray(filtered @ self._transitions.transpose(0, 2, 1) + (self._responses * self._force)[:, None, :])


def _stationary(
    transition: NDArray[np.float64], response: NDArray[np.float64], force_variance: float, displacement_variance: float
) -> tuple[NDArray[np.float64], float]:
    """Gain of the measurement update and variance of the innovation, with white noise on force and displacement."""
    output = np.array([[1.0, 0.0]])
    noise = np.outer(response, response) * force_variance
    predicted = solve_discrete_are(transition.T, output.T, noise, np.array([[displacement_variance]]))
    variance = float(predicted[0, 0]) + displacement_variance
    return predicted[:, 0] / variance, variance
