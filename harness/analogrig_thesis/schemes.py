"""The estimators that the thesis compares, and ours: settings of the same C."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from analogrig.devices.estimator_config import EstimatorConfig

HOLD_N = 4
"""Section 4.4.3: "After four samples, calculate the mean as normal". Of the C they are four innovations: it begins its
equations anew with the sample after an alarm, so that two samples go by before the first of them."""

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
"""Recursive least squares and nothing else (Equ 3.19, 3.20): no whitening, no forgetting, no trigger."""


@dataclass(frozen=True)
class Scheme:
    """One way to follow a plant that changes."""

    key: str
    name: str
    config: EstimatorConfig


def schemes(plain: EstimatorConfig, prediction_error: float, mean: float, warm_up_n: int) -> tuple[Scheme, ...]:
    """The thesis's five: ``plain``, and what each adds to it.

    :param prediction_error: ceiling of that trigger, in codes.
    :param mean: ceiling of the mean between faults, in codes.
    :param warm_up_n: samples at the start in which the triggers are off.
    """
    held = {"hold_off_n": HOLD_N, "warm_up_n": warm_up_n}
    variants: dict[tuple[str, str], dict[str, Any]] = {
        ("rls", "recursive least squares"): {},
        ("forgetting", f"forgetting factor {FORGETTING:g}"): {"forgetting": FORGETTING},
        ("random-walk", "random walk, R = I"): {"random_walk": 1.0},
        ("prediction-error", "prediction error"): {
            "trigger": "prediction-error",
            "ceiling": prediction_error,
            "reset": "all",
            **held,
        },
        ("mean-between-faults", "mean between faults"): {"trigger": "mean-between-faults", "ceiling": mean, **held},
    }
    return tuple(Scheme(*names, dataclasses.replace(plain, **fields)) for names, fields in variants.items())


OURS = Scheme("cusum", "our default trigger", EstimatorConfig())
"""What the device `host` has: whitened equations, cumulative sum of the normalised innovation."""
