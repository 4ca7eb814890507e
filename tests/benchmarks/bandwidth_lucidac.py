"""Deviation of the manufacturer's examples on a calibrated LUCIDAC, by the bandwidth of its op-amps.

python -m tests.benchmarks.bandwidth_lucidac
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from analogrig.scenario import DEFAULT_SEED
from analogrig_emulator.lucidac.machine import Lucidac
from analogrig_emulator.lucidac.wiring import LucidacParts
from tests.served.lucidac_deviations import deviation, play, read_configuration, run_examples
from tests.served.lucidac_examples import EXAMPLES
from tests.served.serving import serving

BANDWIDTHS_MHZ = (20, 50, 100, 400)


def machine(bandwidth_mhz: float) -> Lucidac:
    parts = LucidacParts()
    computing = replace(parts.computing, gbw_hz=1e6 * bandwidth_mhz)
    return Lucidac(replace(parts, computing=computing, components=replace(parts.components, seed=DEFAULT_SEED)))


def main() -> None:
    print(f"{'% of a machine unit':20}" + "".join(f"{mhz:5} MHz" for mhz in BANDWIDTHS_MHZ))
    with tempfile.TemporaryDirectory() as folder, serving("--as", "lucidac") as served:
        run_examples(served.port, Path(folder))
        for name, example in EXAMPLES.items():
            patch, found = read_configuration(Path(folder), name), []
            for bandwidth_mhz in BANDWIDTHS_MHZ:
                each = machine(bandwidth_mhz)
                each.configure(patch)
                each.calibrate(gain=True, offset=True)
                found.append(100.0 * deviation(example, patch, play(each, example)))
            print(f"{name:20}" + "".join(f"{value:9.2f}" for value in found), flush=True)


if __name__ == "__main__":
    main()
