"""Campaigns: many trials of a device over plants, changes and noise. Plan, workers, results file and page."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.campaigns.differences import Comparison, compare
    from analogrig.campaigns.trials import Trial
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {"analogrig.campaigns.differences": "Comparison compare", "analogrig.campaigns.trials": "Trial"},
    )

__all__ = ["Comparison", "Trial", "compare"]
