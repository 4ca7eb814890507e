"""Measure samples per second over SocketCAN. Runs in the guest; writes /run/results/throughput.json."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

from analogrig.devices.can import CanDevice
from tests.bench.bench_link import WAYS, samples_per_s

from .suite.interfaces import CONTROLLERS, VIRTUAL, device

SAMPLES = 600


def rates() -> Iterator[tuple[str, float]]:
    """Measure from process to process, through the kernel alone and through two emulated controllers."""
    for way, fields in WAYS:
        bus = CanDevice(name="CAN", interface="socketcan", channel=VIRTUAL, device="host", **fields)
        yield f"CAN vcan in the guest (emulated), {way}", samples_per_s(bus, SAMPLES)
    here, there, *_ = CONTROLLERS
    for way, fields in WAYS:
        if "fd" not in fields:
            with device(there):
                bus = CanDevice(name="CAN", interface="socketcan", channel=here, **fields)
                yield f"CAN kvaser_pci in the guest (emulated), {way}", samples_per_s(bus, SAMPLES)


def main(out: Path) -> None:
    out.write_text(json.dumps(dict(rates())))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
