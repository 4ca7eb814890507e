"""Skipped samples are missing ones to foreign code, and no report of them leaves a device."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analogrig.answers import Samples
from analogrig.devices.device import DeviceDescription
from analogrig.devices.estimator_library import EstimatorLibrary
from analogrig.devices.foreign_memory import SLOT_SAMPLES
from analogrig.devices.python import PythonDescription
from tests.harness.library_builds import FAULTY, build

COUNTING = "tests.harness.python_estimators:Counting"

CASES = {
    # blocks from, to (exclusive); period of the alarms of the Python object; samples with an alarm
    "nothing skipped": ([(0, 30), (30, 60)], 10, [0, 10, 20, 30, 40, 50]),
    "alarms in the skipped samples": ([(0, 15), (35, 60)], 10, [0, 10, 40, 50]),
    "alarm at the last skipped sample": ([(0, 20), (31, 60)], 10, [0, 10, 40, 50]),
    "alarm at the first sample behind": ([(0, 15), (30, 45)], 10, [0, 10, 30, 40]),
    "alarm at the last sample before": ([(0, 21), (29, 45)], 10, [0, 10, 20, 30, 40]),
    "first samples": ([(25, 45)], 10, [30, 40]),
    "one sample": ([(0, 10), (11, 30)], 10, [0, 20]),
    "two gaps": ([(0, 5), (15, 25), (35, 45)], 10, [0, 20, 40]),
    "nothing but alarms": ([(0, 2), (5, 8)], 1, [0, 1, 5, 6, 7]),
    "gap beyond a slot": ([(0, 5), (SLOT_SAMPLES + 8, SLOT_SAMPLES + 20)], 10, [0, 16_400]),
    "block beyond a slot behind a gap": ([(0, 5), (15, 2 * SLOT_SAMPLES)], 10_000, [0, 10_000, 20_000, 30_000]),
    "gap and block beyond a slot": ([(0, 5), (20_000, 40_000)], 10_000, [0, 20_000, 30_000]),
}


def reported(description: DeviceDescription, blocks: list[tuple[int, int]]) -> dict[str, list[int]]:
    """Samples of the reports of each kind."""

    def samples(first: int, end: int) -> Samples:
        codes = np.full(end - first, 2048, np.uint16)
        return Samples(first, codes, codes, np.ones(end - first, np.bool_))

    with description.connect() as device:
        device.start()
        answers = list(device.play([samples(*block) for block in blocks]))
        device.stop()
    assert [len(part.flags) for part in answers] == [end - first for first, end in blocks]
    kinds = ("alarms", "diagnoses", "misfits")
    return {kind: [each.index for part in answers for each in getattr(part, kind)] for kind in kinds}


@pytest.mark.parametrize("in_process", [False, True], ids=["child", "in process"])
@pytest.mark.parametrize("case", CASES)
def test_reports_of_skipped_samples_are_left_out(case: str, *, in_process: bool) -> None:
    blocks, period, expected = CASES[case]
    description = PythonDescription(name="it", factory=COUNTING, settings={"period": period}, in_process=in_process)
    assert reported(description, blocks) == {"alarms": expected, "diagnoses": expected, "misfits": expected}


def test_alarms_of_a_library_in_skipped_samples_are_left_out(tmp_path: Path) -> None:
    """The library raises its alarm at every hundredth sample, from 99 on."""
    library = build(tmp_path / "faulty.so", FAULTY)
    description = EstimatorLibrary(name="it", library=str(library))
    assert reported(description, [(0, 150), (350, 450), (500, 600)])["alarms"] == [99, 399, 599]
