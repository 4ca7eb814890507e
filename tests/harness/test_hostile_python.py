"""Python devices that act on their process: neither the status of the command nor its output is theirs."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from analogrig import Bench, Scenario, judge, open_rig
from analogrig.config import locate
from analogrig.devices.python import PythonDescription
from analogrig.run import Run
from tests.harness.commands import called
from tests.harness.hostile_python import ACTS, AT
from tests.harness.processes import LONG_S, descendants, ends

HANG_S = 1.0
HANGS = ("sleep", "deadlock", "stop")
SAMPLES = 600

ENDS = {
    "exit": "step: the process of the device ended with status 0",
    "exit-with-failure": "step: the process of the device ended with status 1",
    "sys-exit": f"step of sample {AT} raised SystemExit: 0",
    "sleep": f"sample {AT}: step has not returned for {HANG_S:g} s",
    "deadlock": f"sample {AT}: step has not returned for {HANG_S:g} s",
    "terminate": f"sample {AT}: step: the process of the device ended with status -15 (SIGTERM)",
    "interrupt": "raised KeyboardInterrupt",
    "hang-up": f"sample {AT}: step: the process of the device ended with status -1 (SIGHUP)",
    "kill-group": "ended with status -9 (SIGKILL)",
    "kill-parent": "ended with status -9 (SIGKILL)",
    "stop": f"sample {AT}: step has not returned for {HANG_S:g} s",
    "fork-and-exit": "step: the process of the device ended with status 0",  # its copy counts on, for a while
    "close-all": "the device closed a descriptor that it did not open",
    "segfault": f"sample {AT}: step: the process of the device ended with status -11 (SIGSEGV)",
    "alarm": f"sample {AT}: step: the process of the device ended with status -14 (SIGALRM)",
}
"""Faults of runs that cannot go on."""

DO_NO_HARM = tuple(act for act in ACTS if act not in ENDS)

SHORT = dataclasses.replace(Scenario.load("healthy"), samples=SAMPLES)


def played(act: str) -> Run:
    description = PythonDescription(
        name="it",
        factory="tests.harness.hostile_python:make",
        settings={"act": act},
        timeout_s=HANG_S if act in HANGS else LONG_S,
    )
    before = set(descendants(os.getpid()))
    threads = threading.active_count()
    with open_rig("emulator") as rig, description.connect() as device:
        run = Bench(rig, device).play(SHORT, 1)
        started = set(descendants(os.getpid())) - before
    assert all(ends(pid) for pid in started), "a process of the device is left"
    assert threading.active_count() == threads
    return run


@pytest.mark.parametrize("act", ENDS)
def test_act_that_ends_a_device_is_a_fault_of_the_run(act: str, capfd: pytest.CaptureFixture[str]) -> None:
    run = played(act)
    (fault,) = run.conditions.faults
    assert fault.startswith("device it: ") and ENDS[act] in fault, fault
    assert judge(run).outcome == "inconclusive"
    assert run.samples <= AT
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("act", DO_NO_HARM)
def test_other_acts_do_no_harm(act: str, capfd: pytest.CaptureFixture[str]) -> None:
    run = played(act)
    assert run.conditions.faults == () and run.samples == SAMPLES
    assert capfd.readouterr() == ("", "")


def command(act: str, out: Path, *options: str, query: str = "") -> list[str]:
    """Play two thousand samples of the scenario ``healthy``."""
    scenario = out.with_name("short.toml")
    scenario.write_text(locate("scenarios", "healthy").read_text().replace("samples = 20000", "samples = 2000"))
    dut = f"python:tests.harness.hostile_python:make?act={act}{query}"
    return ["run", "--scenario", str(scenario), "--dut", dut, "--out", str(out), *options]


def test_time_limit_ends_a_step_that_sleeps(tmp_path: Path) -> None:
    captured = called(*(command("sleep", tmp_path / "out", "--time-limit", "2", "--json")))
    assert captured.status == 3, captured.out + captured.err
    assert f"time limit of 2 s reached after {AT} of" in captured.err
    json.loads(captured.out)


@pytest.mark.parametrize("query", ["", "&in_process=true"], ids=["child", "in process"])
def test_print_does_not_spoil_json(query: str, tmp_path: Path) -> None:
    words = command("print", tmp_path / "out", "--json", query=query)
    done = subprocess.run([sys.executable, "-m", "analogrig.cli", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    assert json.loads(line)["outcome"] == "passed"
    assert ("from C" in done.stderr) == bool(query)


def test_ctrl_c_ends_a_command_whose_device_hangs(tmp_path: Path) -> None:
    (tmp_path / "hangs.py").write_text(
        "import os, threading\n\n\nclass It:\n    def step(self, u, y, valid):\n"
        f"        open({str(tmp_path / 'fifo')!r}, 'w').close()\n        threading.Event().wait()\n"
    )
    os.mkfifo(tmp_path / "fifo")
    words = [sys.executable, "-m", "analogrig.cli", "run", "--dut", "python:hangs:It", "--out", "out"]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        (tmp_path / "fifo").read_text()  # until the step opens it
        started = descendants(process.pid)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in errors
    assert all(ends(pid) for pid in started)


@pytest.mark.parametrize(
    "words",
    [
        ("--help",),
        ("run", "--help"),
        ("--version",),
        ("list", "devices"),
        ("list", "scenarios", "--json"),
        ("include",),
        ("completion", "bash"),
        ("netlist",),
        ("run", "--dut", "inproc", "--out", "out"),
        ("run", "--dut", "inproc", "--out", "out", "--json"),
    ],
    ids=" ".join,
)
def test_results_that_cannot_be_written_are_no_success(words: tuple[str, ...], tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = subprocess.run(
            [sys.executable, "-m", "analogrig.cli", *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            check=False,
        )
    assert (done.returncode, done.stderr) == (3, "analogrig: standard output: No space left on device\n")
