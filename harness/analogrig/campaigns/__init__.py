"""Campaigns: many trials of a device over plants, changes and noise. Plan, workers, results file and page."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.campaigns.comparison import Comparison, compare
    from analogrig.campaigns.rows import Row, changes, row
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig.campaigns.comparison": "Comparison compare",
            "analogrig.campaigns.rows": "Row changes row",
        },
    )

__all__ = ["Comparison", "Row", "changes", "compare", "row"]
