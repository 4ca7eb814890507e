"""How fast samples go through a device, with all elements of the estimate returned for every one.

python -m tests.benchmarks link
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from harness.devices import DeviceDescription, HostDevice, InprocDevice
from harness.dut import connect

from .figure import Figure

SAMPLES = 20_000
REPEATS = 5
"""The best of so many is reported: the machine is shared."""

CASES: tuple[DeviceDescription, ...] = (
    HostDevice(name="pty, lock-step by sample", exchange="sample"),
    HostDevice(name="pty, lock-step by block", exchange="block"),
    InprocDevice(name="in process, by sample", exchange="sample"),
    InprocDevice(name="in process, by block", exchange="block"),
)


def samples_per_s(description: DeviceDescription) -> float:
    """Of one run with ARX(2, 3), offset and the default trigger."""
    index = np.arange(SAMPLES)
    force = np.where((index // 50) % 2, 3900, 150).astype(np.uint16)
    displacement = (2000 + 3 * (index % 100)).astype(np.uint16)
    with connect(description) as dut:
        dut.start()
        start_s = time.perf_counter()
        dut.feed(0, force, displacement, np.zeros(SAMPLES, bool))
        return SAMPLES / (time.perf_counter() - start_s)


def figures() -> Iterator[Figure]:
    """One for each way of exchange; the bounds are the slowest and the fastest run."""
    for description in CASES:
        rates = [samples_per_s(description) for _ in range(REPEATS)]
        yield Figure(f"link, {description.name}", max(rates), "samples/s", bounds=(min(rates), max(rates)))
