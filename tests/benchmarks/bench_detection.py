"""How soon the shipped device sees the thesis's changes, over 100 seeds, against the information bound.

python -m tests.benchmarks.bench_detection [FIRST_SEED END_SEED]
"""

from __future__ import annotations

import sys

import numpy as np

from harness.plant import PARAMETERS
from tests.thesis.detection import detect

DEFAULT_SEEDS = (0, 100)

CASES = [(scenario, rig) for rig in ("emulator", "emulator-0-10v") for scenario in ("thesis", "thesis-free-running")]


def main() -> None:
    """Print one line a figure: name, value, unit."""
    seeds = range(*(map(int, sys.argv[1:3]) if len(sys.argv) > 2 else DEFAULT_SEEDS))
    for scenario, rig in CASES:
        detection = detect(scenario, rig, seeds)
        name = f"{scenario} on {rig}"
        print(f"{name}: missed\t{detection.missed}\tof {detection.latencies_n.size} changes")
        print(f"{name}: false alarms\t{detection.false_alarms}\tin {detection.runs} runs of 1800 samples")
        pairs = zip(
            ("K-27%", "B+14%", "B-39% K+11%", "M-74%"), detection.ratios(), detection.ratio_errors(), strict=True
        )
        for what, ratio, error in pairs:
            print(f"{name}: mean latency over mean bound, {what}\t{ratio:.2f}\t+- {error:.2f} (standard error)")
        for parameter, error in zip(PARAMETERS, np.sqrt(np.nanmean(detection.errors**2, axis=(0, 1))), strict=True):
            print(f"{name}: rms error of {parameter} at the end of a stretch\t{100.0 * error:.2f}\t%")


if __name__ == "__main__":
    main()
