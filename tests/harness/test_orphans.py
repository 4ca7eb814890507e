"""Whenever the harness is killed, nothing that it has started is left."""

# ruff: noqa: S311 - the moments are drawn from a seed; they are no secret

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.harness.firmware import needs_firmware
from tests.harness.processes import LONG_S, gone, marked

KILLS = 3


@contextmanager
def harness(dut: str, folder: Path) -> Iterator[str]:
    """`analogrig run` of a long scenario, killed at the end; yields the mark of all that it starts."""
    mark = str(uuid.uuid4())
    command = [sys.executable, "-m", "analogrig.cli", "run", "--scenario", "healthy", "--dut", dut]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "ANALOGRIG_TEST_MARK": mark}
    with subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL) as process:
        yield mark
        process.kill()


@pytest.mark.parametrize("dut", ["host", pytest.param("qemu-m4", marks=needs_firmware)])
def test_harness_killed_at_any_time_leaves_no_process_behind(dut: str, tmp_path: Path) -> None:
    draw = random.Random(f"orphans of {dut}")
    start_s = time.monotonic()
    with harness(dut, tmp_path) as mark:
        while len(marked(mark)) < len(("harness", "tether", "device")):
            assert time.monotonic() < start_s + LONG_S
        until_all_are_there_s = time.monotonic() - start_s
    assert gone(mark)
    for _ in range(KILLS):
        after_s = draw.uniform(0.5, 1.5) * until_all_are_there_s
        with harness(dut, tmp_path) as mark:
            time.sleep(after_s)
        assert gone(mark), f"killed after {after_s} s"
