"""Verdicts: judge a run against its scenario, with the information bound and exposure."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.judging.bursts import bound_rate
    from analogrig.judging.courses import Model, PlantChange, first_at_level
    from analogrig.judging.estimates import trajectory
    from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2, information_of, weights
    from analogrig.judging.linear import LinearPlant
    from analogrig.judging.machine_model import Machine
    from analogrig.judging.statistics import mean_interval, upper_rate
    from analogrig.judging.verdict import diagnosis_text, unexplained_alarms
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig.judging.bursts": "bound_rate",
            "analogrig.judging.courses": "Model PlantChange first_at_level",
            "analogrig.judging.estimates": "trajectory",
            "analogrig.judging.information": "QUANTISATION_VARIANCE_LSB2 information_of weights",
            "analogrig.judging.linear": "LinearPlant",
            "analogrig.judging.machine_model": "Machine",
            "analogrig.judging.statistics": "mean_interval upper_rate",
            "analogrig.judging.verdict": "diagnosis_text unexplained_alarms",
        },
    )

__all__ = [
    "QUANTISATION_VARIANCE_LSB2",
    "LinearPlant",
    "Machine",
    "Model",
    "PlantChange",
    "bound_rate",
    "diagnosis_text",
    "first_at_level",
    "information_of",
    "mean_interval",
    "trajectory",
    "unexplained_alarms",
    "upper_rate",
    "weights",
]
