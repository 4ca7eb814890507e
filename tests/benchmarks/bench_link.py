"""How fast samples go through a device, with all elements of the estimate returned for every one; and real time.

python -m tests.benchmarks link
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator

import numpy as np

from harness.bench import Bench
from harness.devices import FIRMWARE, DeviceDescription, HostDevice, InprocDevice, QemuDevice, QemuM4
from harness.dut import connect
from harness.pace import Pace
from harness.rig import open_rig
from harness.scenario import Scenario

from .figure import Figure

SAMPLES = 20_000
SAMPLES_QEMU = 3000
REPEATS = 5
"""The best of so many is reported: the machine is shared."""
REAL_TIME_S = 60.0

QEMU = QemuM4(name="QEMU M4F, lock-step by sample", exchange="sample")

CASES: tuple[DeviceDescription, ...] = (
    HostDevice(name="pty, lock-step by sample", exchange="sample"),
    HostDevice(name="pty, lock-step by block", exchange="block"),
    HostDevice(name="pty, stream of blocks", exchange="stream"),
    *([QEMU] if (FIRMWARE / f"analogrig-{QEMU.core}.elf").exists() else []),
    InprocDevice(name="in process, by sample", exchange="sample"),
    InprocDevice(name="in process, by block", exchange="block"),
)


def samples_per_s(description: DeviceDescription) -> float:
    """Of one run with ARX(2, 3), offset and the default trigger."""
    samples = SAMPLES_QEMU if isinstance(description, QemuDevice) else SAMPLES
    index = np.arange(samples)
    force = np.where((index // 50) % 2, 3900, 150).astype(np.uint16)
    displacement = (2000 + 3 * (index % 100)).astype(np.uint16)
    with connect(description) as dut:
        dut.start()
        start_s = time.perf_counter()
        dut.feed(0, force, displacement, np.zeros(samples, bool))
        return samples / (time.perf_counter() - start_s)


def overruns(duration_s: float) -> Pace:
    """Of a run of the emulator and the host device in real time."""
    paces = []

    class Watched(Bench):
        def pace(self, period_s: float) -> Pace:
            paces.append(super().pace(period_s))
            return paces[-1]

    scenario = dataclasses.replace(Scenario.load("healthy"), samples=round(duration_s * 20_000))
    with open_rig("emulator") as rig, connect(HostDevice(name="host", exchange="stream")) as dut:
        Watched(rig, dut, real_time=1.0).play(scenario, seed=1)
    return paces[0]


def figures() -> Iterator[Figure]:
    """One for each way of exchange; the bounds are the slowest and the fastest run."""
    for description in CASES:
        rates = [samples_per_s(description) for _ in range(REPEATS)]
        yield Figure(f"link, {description.name}", max(rates), "samples/s", bounds=(min(rates), max(rates)))
    pace = overruns(REAL_TIME_S)
    name = f"link, pty, {REAL_TIME_S:g} s of real time at 20 kHz, overruns of {pace.messages} messages"
    yield Figure(name, pace.overruns, "messages")
