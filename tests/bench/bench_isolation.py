"""Isolation of changes of M, B and K, and of faults of the channels: errors, delay beside the bound, and extent.

Full range, 12 bits and 1 LSB; the work per sample of the device; 100 trials a change and 200 a fault, random phase and
onset, fixed seed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.estimator_c.est_driver import Estimator, compile_driver
from tests.estimator_c.isolation import FAULTS, SIZES, Change, diagnose_fault, measure
from tests.estimator_c.performance import FULL, FULL_FREE, OWN_CLOCK, SHARED_CLOCK, Settings
from tests.estimator_c.plants import FRONT, Excitation

from .figure import Figure

CHANGES: tuple[Change, ...] = (
    *({name: factor} for name in "MBK" for factor in (0.8, 1.2)),
    *({one: factor, two: factor} for one, two in ("BK", "MB", "MK") for factor in (0.8, 1.2)),
    {"B": 0.8, "K": 1.2},
)


SEED = 31


def figures(trials: int = 100, faults: int = 200) -> Iterator[Figure]:
    """One row a change and a clock, and one a fault and a clock."""
    clocks = {"one clock": (SHARED_CLOCK, FULL), "edges anywhere, 20 ppm": (OWN_CLOCK, FULL_FREE)}
    with tempfile.TemporaryDirectory() as folder:
        estimator = Estimator(compile_driver(Path(folder)))
        for clock, (settings, excitation) in clocks.items():
            for change in CHANGES:
                found = measure(estimator, settings, FRONT, change, excitation, trials, SEED)
                named = ", ".join(f"{name}{100 * (factor - 1):+.0f}%" for name, factor in change.items())
                remark = (
                    f"{found.mean_n:.1f} samples; bound {found.bound_n:.1f} with single rivals; "
                    f"within twice in {100 * found.within_twice:.0f} % of the trials; "
                    f"{100 * found.reported:.1f} % reported, {100 * found.right:.1f} % of those right"
                )
                ratio = found.mean_n / found.bound_n
                if len(change) == 1:
                    ratio = found.mean_n / found.bound_of_all_n
                    remark += (
                        f"; bound {found.bound_of_pairs_n:.1f} with two at once as a rival, {found.bound_of_all_n:.1f}"
                        f" with faults of the channels too, limit 2"
                        f"; extent within {100 * found.error:.1f} %, later {100 * found.error_refined:.2f} %"
                    )
                yield Figure(f"{clock}: isolation, {named}", ratio, "bounds", remark)
            for fault in FAULTS:
                yield _of_fault(estimator, clock, settings, excitation, fault, faults)


def _of_fault(
    estimator: Estimator, clock: str, settings: Settings, excitation: Excitation, fault: str, trials: int
) -> Figure:
    """Number of trials in which a fault is named a parameter."""
    found, onset = diagnose_fault(estimator, settings, FRONT, fault, excitation, trials, SEED)
    names, counts = np.unique(found.change, return_counts=True)
    counted = dict(zip(names.tolist(), counts.tolist(), strict=True))
    wrong = sum(counted.pop(name, 0) for name in "MBK")
    right, undecided = counted.pop(fault, 0), counted.pop("undecided", 0)
    others = ", ".join(f"{name} {n}" for name, n in sorted(counted.items(), key=lambda each: -each[1]))
    delay_n = (found.at - onset)[found.change == fault]
    remark = f"limit 10 of {trials}; right {right}, undecided {undecided}{f', {others}' if others else ''}"
    if right:
        remark += f"; {delay_n.mean():.1f} samples"
    if fault in SIZES:
        remark += f"; size {SIZES[fault][0]:g} to {SIZES[fault][1]:g}"
    return Figure(f"{clock}: {fault}", float(wrong), "named a parameter", remark)
