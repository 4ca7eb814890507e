"""Rows of the adapter for an ECU with a DBC of its own."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Generator
from pathlib import Path

from analogrig.devices.device import Device
from analogrig.devices.registry import open_dut
from tests.harness.scripted_ecu import PARAMETERS, ScriptedEcu, write

COUNTERS = 256
BLOCK_N = 256


def answer_from_table(ecu: ScriptedEcu, ends: threading.Event) -> None:
    """Answer every sample with seven frames encoded in advance, so that the rate is that of the adapter."""
    answers = [
        [
            *(ecu.frame("EST_Par", Index=i, Ctr=counter, **{f"V{i}": 1.5}) for i in range(PARAMETERS)),
            ecu.frame("EST_Status", Ctr=counter, Fault=0, Armed=1, Stat=1.0),
        ]
        for counter in range(COUNTERS)
    ]
    ready = ecu.frame("EST_State", Ready=1)
    while not ends.is_set():
        frame = ecu.bus.recv(0.05)
        if frame is None:
            continue
        if frame.arbitration_id == 0x102:
            ecu.bus.send(ready)
        elif frame.arbitration_id == 0x101:
            for answer in answers[frame.data[1]]:
                ecu.bus.send(answer)


def ecus() -> Generator[tuple[str, Device, int], None, None]:
    """ECU on a virtual bus: two frames to it and seven back for each sample."""
    with tempfile.TemporaryDirectory() as folder:
        file, ends = write(Path(folder), folder), threading.Event()
        ecu = ScriptedEcu(folder)
        thread = threading.Thread(target=answer_from_table, args=(ecu, ends), daemon=True)
        thread.start()
        try:
            with open_dut(str(file)) as device:
                yield "ECU by its DBC, virtual bus, 7 frames of answers", device, BLOCK_N
        finally:
            ends.set()
            thread.join()
            ecu.bus.shutdown()
