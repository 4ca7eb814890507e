"""Whenever the harness is killed, nothing that it has started is left."""

# ruff: noqa: S311 - the moments are drawn from a seed; they are no secret

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

from tests.harness.firmware import needs_firmware

KILLS = 15
GONE_WITHIN_S = 5.0
"""The tether waits a second for a device that does not end when it is asked."""
LATEST_S = 1.5
"""By then the samples have long begun."""


def marked(mark: str) -> list[int]:
    """The processes that have it in their environment, as what they start has too."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (process / "environ").read_bytes():
                found.append(int(process.name))
        except OSError:  # it has just ended, or is none of ours
            continue
    return found


@pytest.mark.parametrize("dut", ["host", pytest.param("qemu-m4", marks=needs_firmware)])
def test_harness_killed_at_any_time_leaves_no_process_behind(dut: str, tmp_path: Path) -> None:
    draw = random.Random(f"orphans of {dut}")
    command = [sys.executable, "-m", "harness.cli", "run", "--scenario", "healthy", "--dut", dut]
    seen_most = 0
    for _ in range(KILLS):
        mark = str(uuid.uuid4())
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "ANALOGRIG_TEST_MARK": mark}
        after_s = draw.uniform(0.0, LATEST_S)
        with subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL) as harness:
            time.sleep(after_s)
            seen_most = max(seen_most, len(marked(mark)))
            harness.kill()
        deadline_s = time.monotonic() + GONE_WITHIN_S
        while marked(mark) and time.monotonic() < deadline_s:
            time.sleep(0.01)
        assert marked(mark) == [], f"killed after {after_s} s"
    assert seen_most == 3, "the harness, the tether and the device were never seen together"
