"""Samples a second in lock-step, an estimate of every parameter returned for every sample."""

from __future__ import annotations

import statistics
import time

import numpy as np

from harness.dut import DeviceDescription, connect

SAMPLES = 10_000
REPEATS = 5


def rate_per_s(description: DeviceDescription) -> float:
    """The median of several runs."""
    rng = np.random.default_rng(1)
    force, displacement = rng.integers(0, 4096, (2, SAMPLES), dtype=np.uint16)
    missing = np.zeros(SAMPLES, dtype=bool)
    rates = []
    with connect(description) as dut:
        for _ in range(REPEATS):
            dut.start()
            start_s = time.perf_counter()
            dut.feed(0, force, displacement, missing)
            rates.append(SAMPLES / (time.perf_counter() - start_s))
            dut.stop()
    return statistics.median(rates)


def main() -> None:
    """Print one line a figure: name, value, unit."""
    print(f"lock-step over a pty, sample by sample\t{rate_per_s(DeviceDescription('host', 'host')):.0f}\tsamples/s")
    in_blocks = DeviceDescription("host", "host", exchange="block")
    print(f"lock-step over a pty, blocks of 14\t{rate_per_s(in_blocks):.0f}\tsamples/s")
    print(f"in process, blocks of 14\t{rate_per_s(DeviceDescription('i', 'inproc', exchange='block')):.0f}\tsamples/s")


if __name__ == "__main__":
    main()
