"""Sample rate through a device that returns every element of the estimate for every sample; and real time.

python -m tests.bench link
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from analogrig.bench import Bench
from analogrig.devices.can import CanDevice
from analogrig.devices.device import DeviceDescription
from analogrig.devices.library import InprocDevice
from analogrig.devices.pace import Pace
from analogrig.devices.processes import FIRMWARE, HostDevice, QemuM4
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario
from tests.harness.fed import fed
from tests.soak.can_guest.__main__ import throughput_in_guest

from .figure import Figure

SAMPLES = 20_000
SAMPLES_SLOW = 3000
REPEATS = 5
"""Number of repetitions, of which the best is reported: the machine is shared."""
REAL_TIME_S = 60.0

QEMU = (QemuM4(name="QEMU M4F, lock-step by sample", exchange="sample"),)

BUSES: Mapping[str, DeviceDescription] = {
    "CAN in process": InprocDevice(name="", link="can"),
    "CAN virtual": CanDevice(name="", interface="virtual"),
    "CAN udp_multicast": CanDevice(name="", interface="udp_multicast", channel="239.74.163.2", device="inproc"),
}
WAYS: tuple[tuple[str, Mapping[str, Any]], ...] = (
    ("lock-step by sample", {"exchange": "sample"}),
    ("stream of samples", {"exchange": "stream"}),
    ("FD, stream of blocks", {"exchange": "stream", "fd": True}),
)

CASES: tuple[DeviceDescription, ...] = (
    HostDevice(name="pty, lock-step by sample", exchange="sample"),
    HostDevice(name="pty, lock-step by block", exchange="block"),
    HostDevice(name="pty, stream of blocks", exchange="stream"),
    *(QEMU if (FIRMWARE / f"analogrig-{QemuM4.core}.elf").exists() else ()),
    InprocDevice(name="in process, by sample", exchange="sample"),
    InprocDevice(name="in process, by block", exchange="block"),
    *(
        dataclasses.replace(description, name=f"{bus}, {way}", **fields)
        for bus, description in BUSES.items()
        for way, fields in WAYS
    ),
)
SLOW = ("QEMU", "CAN")
"""Names of devices that play fewer samples."""


def samples_per_s(description: DeviceDescription, samples: int) -> float:
    """Rate of one run with ARX(2, 3), offset and the default trigger."""
    index = np.arange(samples)
    force = np.where((index // 50) % 2, 3900, 150).astype(np.uint16)
    displacement = (2000 + 3 * (index % 100)).astype(np.uint16)
    with description.connect() as dut:
        dut.start()
        start_s = time.perf_counter()
        fed(dut, 0, force, displacement, np.zeros(samples, bool))
        return samples / (time.perf_counter() - start_s)


def overruns(duration_s: float) -> Pace:
    """Figures of a run of the emulator and the host device in real time."""
    paces = []

    class Watched(Bench):
        def pace(self, period_s: float) -> Pace:
            paces.append(super().pace(period_s))
            return paces[-1]

    scenario = dataclasses.replace(Scenario.load("healthy"), samples=round(duration_s * 20_000))
    with open_rig("emulator") as rig, HostDevice(name="host", exchange="stream").connect() as dut:
        Watched(rig, dut, real_time=1.0).play(scenario, seed=1)
    return paces[0]


def figures() -> Iterator[Figure]:
    """One figure for each exchange mode; the bounds are the slowest and the fastest run."""
    for description in CASES:
        samples = SAMPLES_SLOW if any(word in description.name for word in SLOW) else SAMPLES
        rates = [samples_per_s(description, samples) for _ in range(REPEATS)]
        yield Figure(f"link, {description.name}", max(rates), "samples/s", bounds=(min(rates), max(rates)))
    for name, rate in throughput_in_guest().items():
        yield Figure(f"link, {name}", rate, "samples/s")
    pace = overruns(REAL_TIME_S)
    name = f"link, pty, {REAL_TIME_S:g} s of real time at 20 kHz, overruns of {pace.messages} messages"
    yield Figure(name, pace.overruns, "messages")
