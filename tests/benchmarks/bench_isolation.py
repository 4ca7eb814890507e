"""Isolation of changes of M, B and K: error rate, delay beside the isolation bound, and extent.

Full range, 12 bits and 1 LSB; 400 trials a cell, random phase and onset, fixed seed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.estimator_c.est_driver import Estimator, compile_driver
from tests.estimator_c.isolation import Change, measure
from tests.estimator_c.performance import FULL, FULL_FREE, OWN_CLOCK, SHARED_CLOCK
from tests.estimator_c.plants import FRONT

from .figure import Figure

CHANGES: tuple[Change, ...] = (
    *({name: factor} for name in "MBK" for factor in (0.8, 1.2)),
    *({one: factor, two: factor} for one, two in ("BK", "MB", "MK") for factor in (0.8, 1.2)),
    {"B": 0.8, "K": 1.2},
)


def figures(trials: int = 400) -> Iterator[Figure]:
    """One row a change and a clock."""
    clocks = {"one clock": (SHARED_CLOCK, FULL), "edges anywhere, 20 ppm": (OWN_CLOCK, FULL_FREE)}
    with tempfile.TemporaryDirectory() as folder:
        estimator = Estimator(compile_driver(Path(folder)))
        for clock, (settings, excitation) in clocks.items():
            for change in CHANGES:
                found = measure(estimator, settings, FRONT, change, excitation, trials, seed=31)
                named = ", ".join(f"{name}{100 * (factor - 1):+.0f}%" for name, factor in change.items())
                remark = (
                    f"limit 2: {found.mean_n:.1f} against {found.bound_n:.1f} samples, "
                    f"{found.bound_of_pairs_n:.1f} with two at once as a rival; "
                    f"within twice in {100 * found.within_twice:.0f} % of the trials; "
                    f"{100 * found.reported:.1f} % reported, {100 * found.right:.1f} % of those right"
                )
                if len(change) == 1:
                    remark += f"; extent within {100 * found.error:.1f} %, later {100 * found.error_refined:.2f} %"
                yield Figure(f"{clock}: isolation, {named}", found.mean_n / found.bound_n, "bounds", remark)
                if len(change) == 1:
                    ratio = found.mean_n / found.bound_of_pairs_n
                    yield Figure(f"{clock}: isolation against all rivals, {named}", ratio, "bounds", "limit 2")
