"""Deviation of the manufacturer's examples from the ideal solution: of its client's data, by specimen, by op-amps.

python -m tests.bench.bandwidth_lucidac
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from analogrig.scenario import DEFAULT_SEED
from analogrig_emulator.lucidac.lucidac_circuit import LucidacParts
from analogrig_emulator.lucidac.machine import Lucidac
from analogrig_lucidac.served_machine import specimen
from tests.served.lucidac_deviations import calibrated_deviation, deviation, play, read_configuration, run_examples
from tests.served.lucidac_examples import EXAMPLES
from tests.served.serving import serving

BANDWIDTHS_MHZ = (50, 100, 400, 1000)
SEEDS = range(1, 13)


def machine(bandwidth_mhz: float) -> Lucidac:
    parts = LucidacParts()
    computing = replace(parts.computing, gbw_hz=1e6 * bandwidth_mhz)
    return Lucidac(replace(parts, computing=computing, components=replace(parts.components, seed=DEFAULT_SEED)))


def main() -> None:
    with tempfile.TemporaryDirectory() as name, serving("--as", "lucidac") as served:
        folder = Path(name)
        run_examples(served.port, folder)
        show_client(folder)
        show_specimens(folder)
        show_bandwidths(folder)


def show_client(folder: Path) -> None:
    """Show the deviations in machine units: of the same machine before calibration, and of the client's data."""
    print(f"{'machine units':20}{'before':>9}{'after calibration':>19}")
    largest = 0.0
    for name, example in EXAMPLES.items():
        patch, uncalibrated = read_configuration(folder, name), specimen(DEFAULT_SEED)
        uncalibrated.configure(patch)
        before = deviation(example, patch, play(uncalibrated, example))
        after = deviation(example, patch, np.load(folder / f"{name}.npz")["data"].T)
        largest = max(largest, after)
        print(f"{name:20}{before:9.4f}{after:19.4f}", flush=True)
    print(f"{len(EXAMPLES)} examples of the manufacturer's client: at most {largest:.4f} of a machine unit off")


def show_specimens(folder: Path) -> None:
    """Show the deviations of calibrated machines of other seeds, in machine units."""
    print(f"{f'seeds {SEEDS[0]} to {SEEDS[-1]}':20}{'median':>9}{'largest':>10}")
    for name, example in EXAMPLES.items():
        patch = read_configuration(folder, name)
        found = [calibrated_deviation(specimen(seed), example, patch) for seed in SEEDS]
        print(f"{name:20}{np.median(found):9.4f}{max(found):10.4f}", flush=True)


def show_bandwidths(folder: Path) -> None:
    """Show the deviations in % of a machine unit, by the bandwidth of the op-amps."""
    print(f"{'% of a machine unit':20}" + "".join(f"{mhz:5} MHz" for mhz in BANDWIDTHS_MHZ))
    for name, example in EXAMPLES.items():
        patch = read_configuration(folder, name)
        found = [calibrated_deviation(machine(mhz), example, patch) for mhz in BANDWIDTHS_MHZ]
        print(f"{name:20}" + "".join(f"{100.0 * value:9.2f}" for value in found), flush=True)


if __name__ == "__main__":
    main()
