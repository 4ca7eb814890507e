"""Self-test of the manufacturer's package (`pybrid report`) against a LUCIDAC, its data kept instead of drawn.

The report subtracts its references and draws what is left; it has no criterion. The file holds the values of each plot,
an array for each channel, by the name of the test and the number of its plot.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np


class KeptReport:
    """Reporter that keeps the data of plots."""

    def __init__(self) -> None:
        self.plots: list[list[Any]] = []

    def box_plot(self, _: list[str], distributions: list[Any], title: str = "") -> None:
        del title
        self.plots.append([np.asarray(values) for values in distributions])

    def line_plot(self, _: list[str], __: list[Any], title: str = "") -> None:
        del title

    def drawString(self, *_: Any) -> None:
        """Draw nothing."""

    def nextPage(self) -> None:
        """Turn no page."""


async def reported(port: int) -> dict[str, list[list[Any]]]:
    """Plots by test."""
    from pybrid.lucidac.controller import Controller
    from pybrid.util import reporter

    controller, found = Controller(), {}
    await controller.add_device("127.0.0.1", port)
    async with controller:
        for name in ("sin", "lane", "mul", "itor"):
            kept = KeptReport()
            await getattr(reporter, f"{name}_test")(controller, kept)
            found[name] = kept.plots
    return found


def keep(port: int, folder: Path) -> None:
    """Write report.npz to a folder."""
    plots = asyncio.run(reported(port))
    named: dict[str, Any] = {
        f"{test}-{i}": np.stack(plot) for test, each in plots.items() for i, plot in enumerate(each)
    }
    np.savez(folder / "report.npz", **named)
