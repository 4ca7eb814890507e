"""Estimators for devices of the kind ``python``: our own core, and one that reports every quantity."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.devices.library import Estimator
from analogrig.estimator_config import EstimatorConfig

SHEET = {"theta_n": 6, "innovation": True, "statistic": True, "warm_up_n": 150}


class Core:
    """Our core, one sample at a time."""

    datasheet = SHEET

    def __init__(self, arl0: float = 1.0e5) -> None:
        self._estimator = Estimator(EstimatorConfig(arl0=arl0))

    def reset(self) -> None:
        self._estimator.restart()

    def step(self, u: int, y: int, valid: bool) -> dict[str, Any]:  # noqa: FBT001
        out = self._estimator.run([u], [y], [valid])
        return {
            "alarm": len(out.alarms) > 0,
            "theta": out.theta[0],
            "innovation": out.innovation[0],
            "statistic": out.statistic[0],
        }


class CoreInBlocks(Core):
    """The same, a block at a time, as an object with attributes."""

    def step_block(self, u: NDArray[np.uint16], y: NDArray[np.uint16], valid: NDArray[np.bool_]) -> SimpleNamespace:
        out = self._estimator.run(u, y, valid)
        alarm = np.isin(np.arange(len(u)), out.alarms)
        return SimpleNamespace(alarm=alarm, theta=out.theta, innovation=out.innovation, statistic=out.statistic)


class Counting:
    """Reports everything; each quantity is the number of the sample. Alarms and diagnoses every ``period`` samples."""

    def __init__(self, period: int = 10, sheet: dict[str, Any] | None = None) -> None:
        everything = {"theta_n": 2, "innovation": True, "statistic": True, "armed": True, "diagnoses": True}
        everything["misfits"] = True
        self.datasheet = everything if sheet is None else sheet
        self._period, self._n = period, 0

    def step(self, u: int, y: int, valid: bool) -> dict[str, Any]:  # noqa: ARG002, FBT001
        n, self._n = self._n, self._n + 1
        alarm = n % self._period == 0
        return {
            "alarm": alarm,
            "theta": [n, -n] if valid else None,
            "innovation": float(n),
            "statistic": n,
            "armed": n >= self._period,
            "diagnosis": {"change": "mass", "onset": n, "extent": 0.5} if alarm else None,
            "misfit": {"cause": "hum", "frequency": 0.25} if alarm else None,
        }


class Answering:
    """Gives one answer to every sample."""

    def __init__(self, answer: object, sheet: object = None, *, block: bool = False) -> None:
        if sheet is not None:
            self.datasheet = sheet
        if block:
            self.step_block = lambda u, y, valid: answer  # noqa: ARG005
        else:
            self.step = lambda u, y, valid: answer  # noqa: ARG005
