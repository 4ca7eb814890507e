"""Detection delay of the shipped device for the thesis's changes, over 100 seeds, beside the information bound.

python -m tests.bench.bench_detection [FIRST_SEED END_SEED]
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

from tests.harness.plants import PROGRAM
from tests.thesis.detection import detect

from .figure import Figure

DEFAULT_SEEDS = (0, 100)

CHANGES = ("K-27%", "B+14%", "B-39% K+11%", "M-74%")

CASES = [(scenario, rig) for rig in ("emulator", "emulator-0-10v") for scenario in ("thesis", "thesis-free-running")]


def figures(first_seed: int = DEFAULT_SEEDS[0], end_seed: int = DEFAULT_SEEDS[1]) -> Iterator[Figure]:
    """Missed changes, false alarms and estimates of the device; bounds are two standard errors either side."""
    for scenario, rig in CASES:
        detection = detect(scenario, rig, range(first_seed, end_seed))
        name = f"{scenario} on {rig}"
        yield Figure(f"{name}: missed", detection.missed, "changes", f"of {detection.latencies_n.size} changes")
        runs = f"in {detection.runs} runs of 1800 samples"
        yield Figure(f"{name}: false alarms", detection.false_alarms, "alarms", runs)
        for what, ratio, error in zip(CHANGES, detection.ratios(), detection.ratio_errors(), strict=True):
            bounds = (float(ratio - 2 * error), float(ratio + 2 * error))
            yield Figure(f"{name}: mean latency, {what}", float(ratio), "mean bounds", bounds=bounds)
        for parameter, error in zip(
            PROGRAM.estimates, np.sqrt(np.nanmean(detection.errors**2, axis=(0, 1))), strict=True
        ):
            yield Figure(f"{name}: rms error of {parameter} at the end of a stretch", 100.0 * float(error), "%")


def main() -> None:
    """Print the figures for other seeds; bench.json keeps those of DEFAULT_SEEDS."""
    for figure in figures(*map(int, sys.argv[1:3])):
        print(figure, flush=True)


if __name__ == "__main__":
    main()
