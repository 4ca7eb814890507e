"""Estimators that the thesis compares, and ours: settings of the same C."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from analogrig.estimator_config import EstimatorConfig

HOLD_N = 4
"""Section 4.4.3: "After four samples, calculate the mean as normal". The C counts four innovations: it restarts its
equations with the sample after an alarm, so two samples pass before the first innovation."""

WARM_UP_N = 50
"""Section 5.5: "the fault detection algorithm was switched off for the first 50 samples"."""

UNITS_PER_M = 1e7
"""Units of y for which the printed ceilings make sense: 0.1 um."""

ERROR_CEILING = 1500.0
"""Section 4.4.2, in units of 0.1 um."""

FORGETTING = 0.97

P0 = 10.0
"""Section 4.4.1: "a diagonal P matrix with the value 10 along the main diagonal"."""

PLAIN = EstimatorConfig(
    nb=2,
    nk=1,
    offset=False,
    forgetting=1.0,
    p0=P0,
    noise_variance=1.0,
    c=(),
    refresh_n=0,
    stuck_n=0,
    idle_n=0,
    isolation=False,
    edge_instants="locked",
    trigger="none",
    warm_up_n=0,
)
"""Plain recursive least squares (Equ 3.19, 3.20): no whitening, no forgetting, no trigger."""

OURS = "cusum"
"""Key of the shipped default: whitened equations, cumulative sum of the normalised innovation."""

NAMES: Mapping[str, str] = {
    "rls": "recursive least squares",
    "forgetting": f"forgetting factor {FORGETTING:g}",
    "random-walk": "random walk, R = I",
    "prediction-error": "prediction error",
    "mean-between-faults": "mean between faults",
    OURS: "our default trigger",
}
"""Names of all schemes by key, in the order of the tables."""


def schemes(plain: EstimatorConfig, prediction_error: float, mean: float, warm_up_n: int) -> dict[str, EstimatorConfig]:
    """Settings of the thesis's five schemes by key: ``plain`` and its variants.

    :param prediction_error: ceiling of that trigger, in codes.
    :param mean: ceiling of the mean between faults, in codes.
    :param warm_up_n: samples at the start without a trigger.
    """
    held: dict[str, Any] = {"hold_off_n": HOLD_N, "warm_up_n": warm_up_n}
    variants: dict[str, dict[str, Any]] = {
        "rls": {},
        "forgetting": {"forgetting": FORGETTING},
        "random-walk": {"random_walk": 1.0},
        "prediction-error": {"trigger": "prediction-error", "ceiling": prediction_error, "reset": "all", **held},
        "mean-between-faults": {"trigger": "mean-between-faults", "ceiling": mean, **held},
    }
    return {key: dataclasses.replace(plain, **fields) for key, fields in variants.items()}
