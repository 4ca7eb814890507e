"""Estimators and change detectors of packages from PyPI, as devices of the kind ``python``.

padasip (MIT), river (BSD), filterpy (MIT). Only ``level`` is calibrated; what is not set here is the package's default.
``_FORGETTING``, ``delta`` of Page-Hinkley and ``clock`` of ADWIN were chosen for short delays, on other seeds. After an
alarm the covariance of the estimate and the detector start anew.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from padasip.filters import FilterRLS
from river.drift import ADWIN, KSWIN, PageHinkley

from .detectors import HOLD_OFF_N, WARM_UP_N

_PARAMETERS = 5
"""Elements of theta: y(k) from y(k-1), y(k-2), u(k-1), u(k-2) and a constant."""

_PRIOR_VARIANCE = 1e3

_FORGETTING = 0.998


class _Estimator(Protocol):
    def error(self, regressor: NDArray[np.float64], y: float) -> float:
        """Size of the prediction error, before the estimate is updated."""

    def restart(self) -> None:
        """Reset the covariance."""


class _PadasipRls:
    def __init__(self) -> None:
        self._filter = FilterRLS(_PARAMETERS, mu=_FORGETTING, eps=1.0 / _PRIOR_VARIANCE, w="zeros")

    def error(self, regressor: NDArray[np.float64], y: float) -> float:
        error = y - float(self._filter.predict(regressor))
        self._filter.adapt(y, regressor)
        return abs(error)

    def restart(self) -> None:
        self._filter.R = _PRIOR_VARIANCE * np.eye(_PARAMETERS)


class _FilterpyKalman:
    """Parameters as a constant state with a fading memory; the size of the error is its Mahalanobis distance."""

    def __init__(self) -> None:
        self._filter = KalmanFilter(dim_x=_PARAMETERS, dim_z=1)
        self._filter.Q = np.zeros((_PARAMETERS, _PARAMETERS))
        self._filter.R = np.array([[5.0]])
        self._filter.alpha = _FORGETTING**-0.5
        self.restart()

    def error(self, regressor: NDArray[np.float64], y: float) -> float:
        self._filter.H = regressor[None, :]
        self._filter.predict()
        self._filter.update(y)
        return float(self._filter.mahalanobis)

    def restart(self) -> None:
        self._filter.P = _PRIOR_VARIANCE * np.eye(_PARAMETERS)


class _Gate:
    """Alarm of a single error; the statistic is the error."""

    def __init__(self, level: float) -> None:
        self._level = level
        self.drift_detected = False
        self.statistic = 0.0

    def update(self, error: float) -> None:
        self.statistic = error
        self.drift_detected = error >= self._level


class _Device:
    """Device of the kind ``python``: the errors of an estimator go to a detector."""

    def __init__(
        self, estimator: _Estimator, make_detector: Callable[[], Any], statistic: Callable[[Any], float] | None = None
    ) -> None:
        self._estimator = estimator
        self._make_detector = make_detector
        self._statistic = statistic
        self._detector = make_detector()
        self._past: deque[tuple[int, int]] = deque(maxlen=2)
        self._unarmed_n = WARM_UP_N
        self.datasheet: Mapping[str, object] = {
            "statistic": statistic is not None,
            "warm_up_n": WARM_UP_N,
            "hold_off_n": HOLD_OFF_N,
        }

    def step(self, u: int, y: int, valid: bool) -> Mapping[str, object] | bool:  # noqa: FBT001
        """Take one sample.

        :raises ValueError: it is missing.
        """
        if not valid:
            raise ValueError("a missing sample")
        alarm = self._takes(y)
        self._past.append((u, y))
        if self._statistic is None:
            return alarm
        return {"alarm": alarm, "statistic": 0.0 if self._unarmed_n else self._statistic(self._detector)}

    def _takes(self, y: int) -> bool:
        """True if the sample raises an alarm."""
        if len(self._past) == 2:
            (u2, y2), (u1, y1) = self._past
            error = self._estimator.error(np.array([y1, y2, u1, u2, 1.0]), y)
            if not self._unarmed_n:
                self._detector.update(error)
        if self._unarmed_n:
            self._unarmed_n -= 1
            return False
        if not self._detector.drift_detected:
            return False
        self._estimator.restart()
        self._detector = self._make_detector()
        self._unarmed_n = HOLD_OFF_N
        return True


def rls_page_hinkley(level: float) -> _Device:
    """Join padasip's RLS and river's Page-Hinkley test for a rising mean of the error."""
    return _Device(_PadasipRls(), lambda: PageHinkley(threshold=level, delta=1.0, mode="up"))


def rls_adwin(level: float) -> _Device:
    """Join padasip's RLS and river's ADWIN with delta = exp(-level), checked at each sample."""
    return _Device(_PadasipRls(), lambda: ADWIN(delta=math.exp(-level), clock=1))


def rls_kswin(level: float) -> _Device:
    """Join padasip's RLS and river's KSWIN with alpha = exp(-level)."""
    return _Device(
        _PadasipRls(),
        lambda: KSWIN(alpha=math.exp(-level), seed=0),
        lambda detector: -math.log(max(detector.p_value, 1e-300)) if detector.n >= detector.window_size else 0.0,
    )


def kalman_gate(level: float) -> _Device:
    """Join filterpy's Kalman filter and a limit on its Mahalanobis distance."""
    return _Device(_FilterpyKalman(), lambda: _Gate(level), lambda detector: float(detector.statistic))
