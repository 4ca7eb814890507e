"""The device of this project has the shipped properties: all in this process, those of short plays elsewhere too."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.firmware import needs_firmware

pytestmark = pytest.mark.timeout(300)

FEW = "found_once or raises_no_alarm or come_to_the_truth or warm_up"
"""Those of short plays."""


def run(folder: Path, dut: str, *arguments: str) -> str:
    command: list[str | Path] = [
        *(sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--rootdir", folder, "-p", "no:cacheprovider"),
        *("-p", "no:xdist", "--pyargs", "harness.properties", "--dut", dut, *arguments),
    ]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("ANALOGRIG_", "PYTEST_"))}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_device_in_this_process_has_every_property(tmp_path: Path) -> None:
    last = run(tmp_path, "inproc").splitlines()[-1]
    assert "passed" in last
    assert "skipped" not in last


def test_device_program_has_those_of_short_plays(tmp_path: Path) -> None:
    assert "4 passed" in run(tmp_path, "host?exchange=block", "-k", FEW)


@pytest.mark.parametrize("core", [pytest.param("m4", marks=needs_firmware)])
def test_firmware_has_those_of_short_plays(core: str, tmp_path: Path) -> None:
    assert "3 passed" in run(
        tmp_path, f"qemu-{core}?exchange=stream", "-k", "found_once or come_to_the_truth or warm_up"
    )
