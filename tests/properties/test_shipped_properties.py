"""The device of this project has the shipped properties: in this process, as a program of this computer, as firmware.

What takes more samples than a line carries (rates of false alarms and of diagnoses) is shown in this process, and
carried over: the program and the firmware are the same to the bit.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from analogrig.bench import Bench
from analogrig.devices.registry import open_dut
from analogrig.judging.statistics import Decision, SequentialTest
from analogrig.rigs.description import open_rig
from analogrig.scenario import Scenario
from analogrig.testing.properties.test_detection import SINGLY
from tests.harness.firmware import needs_firmware

pytestmark = pytest.mark.heavy

LONG = (
    "rarer_than or of_all_kinds or stay_rare or rightly_named or faults_of_the_line or converses or computes_what"
    " or as_described or beyond_65536"
)
"""Properties for which a line is too slow; its faults and messages are tried apart, with short time-outs."""

FIRMWARE = "found_once or come_to_the_truth or (warm_up and not option) or answers_with_numbers"
"""Properties of short plays: QEMU takes 1500 samples a second."""

DIFFERING, MISS = 7e-4, 1e-3
"""So large a part of the samples does not differ, with confidence 99.9 %: 10,000 samples without a difference."""


def run(folder: Path, dut: str, *arguments: str) -> str:
    command: list[str | Path] = [
        *(sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--rootdir", folder, "-p", "no:cacheprovider"),
        *("-p", "no:xdist", "--pyargs", "analogrig.testing.properties", "--hil-dut", dut, *arguments),
    ]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("ANALOGRIG_", "PYTEST_"))}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_device_in_this_process_has_every_property(tmp_path: Path) -> None:
    last = run(tmp_path, "inproc").splitlines()[-1]
    assert "passed" in last
    assert "skipped" not in last


def test_device_whose_file_states_a_rate_of_false_alarms_takes_the_settings_of_the_cases(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('kind = "inproc"\n[estimator]\narl0 = 2e5\n')
    chosen = "(states_misfits and drift) or prediction or no_trigger or extended"
    assert "3 passed" in run(tmp_path, "mine.toml", "-k", chosen)


def test_device_program_has_every_property_that_a_line_has_time_for(tmp_path: Path) -> None:
    assert "22 passed" in run(tmp_path, "host?exchange=block", "-k", f"not ({LONG})")


def test_device_program_converses_and_faults_of_its_line_do_no_harm(tmp_path: Path) -> None:
    told = run(tmp_path, "host?exchange=block&timeout_s=1", "-k", "faults_of_the_line or converses")
    assert "9 passed" in told


@pytest.mark.parametrize("core", [pytest.param("m4", marks=needs_firmware)])
def test_firmware_has_those_of_short_plays(core: str, tmp_path: Path) -> None:
    assert "4 passed" in run(tmp_path, f"qemu-{core}?exchange=stream&timeout_s=60", "-k", FIRMWARE)


@pytest.mark.parametrize(
    "dut", ["host?exchange=block", pytest.param("qemu-m4?exchange=stream&timeout_s=60", marks=needs_firmware)]
)
def test_device_elsewhere_is_the_one_in_this_process_to_the_bit(dut: str) -> None:
    """Estimates, alarms and diagnoses, of plays with changes, with missing samples, and with none of either."""
    test = SequentialTest(good=1e-6, bad=DIFFERING, miss=MISS, false_alarm=MISS)
    plays = itertools.cycle(
        [
            ("emulator", Scenario.load("thesis")),
            ("emulator-0-10v", Scenario.load("thesis")),
            ("emulator", SINGLY),
            ("emulator", dataclasses.replace(Scenario.load("healthy"), samples=1500)),
        ]
    )
    with open_dut(dut) as elsewhere, open_dut("inproc", exchange="block") as here:
        for seed, (rig_name, scenario) in enumerate(plays):
            with open_rig(rig_name) as rig:
                runs = [Bench(rig, device).play(scenario, seed) for device in (elsewhere, here)]
            assert [run.conditions.faults for run in runs] == [(), ()]
            ours, theirs = (run.theta.view(np.uint32) for run in runs)
            differing = int((ours != theirs).any(axis=1).sum())
            assert test.add(len(ours), differing) is not Decision.ABOVE, f"{differing} samples of seed {seed} differ"
            for name in (
                "statistic",
                "alarm_index",
                *(f"diagnosis_{what}" for what in ("index", "change", "onset", "extent")),
            ):
                one, other = (getattr(run, name) for run in runs)
                assert one.tobytes() == other.tobytes(), f"{name} of seed {seed} differs"
            if test.decision is Decision.BELOW:
                break
    assert test.events == 0
