"""Commands as users call them, on the real executable behind a real pseudo terminal."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.config import locate
from analogrig.devices.processes import HOST_PROGRAM
from analogrig.run import Run
from tests.harness.commands import called
from tests.harness.firmware import needs_firmware
from tests.harness.processes import LONG_S, descendants
from tests.harness.runs import made_run

from .plants import front

ENVIRONMENT = {key: value for key, value in os.environ.items() if not key.startswith("ANALOGRIG_")}


def analogrig(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "analogrig.cli", *map(str, arguments)]
    environment = {**ENVIRONMENT, "PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=LONG_S, check=False
    )


def run_json(*arguments: str | Path, cwd: Path, status: int = 0) -> dict[str, Any]:
    ended, out, errors = called(*arguments, "--json", cwd=cwd)
    assert ended == status, errors
    table = json.loads(out)
    assert isinstance(table, dict)
    return table


def refusal(*arguments: str | Path, cwd: Path, status: int = 2) -> str:
    """Error message of a refused command: one line, no traceback."""
    ended, out, errors = called(*arguments, cwd=cwd)
    assert (ended, out) == (status, ""), out + errors
    (line,) = errors.splitlines()
    assert line.startswith("analogrig: ")
    return line


@pytest.fixture(scope="module")
def thesis(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder and the JSON of `analogrig run --seed 3`."""
    folder = tmp_path_factory.mktemp("thesis")
    done = analogrig("run", "--seed", "3", "--out", folder / "run", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


def test_run_finds_every_change_of_the_thesis(thesis: tuple[Path, dict[str, Any]]) -> None:
    _, out = thesis
    assert (out["outcome"], out["valid"], out["seed"], out["samples"]) == ("passed", True, 3, 1800)
    assert [change["sample"] for change in out["changes"]] == [1200, 1400, 1500, 1600]
    assert [change["what"] for change in out["changes"]] == ["K", "B", "B, K", "M"]
    assert out["changes"][2]["from"] == {"B": 3453.0, "K": 18000.0}
    assert out["changes"][2]["to"] == {"B": 2123.0, "K": 20000.0}
    assert all(change["latency"] >= 1 and change["bound"] >= 1 for change in out["changes"])
    assert out["false_alarms"] == []
    assert out["counters"]["updated"] == 1800
    assert out["counters"]["alarms"] == 4


def test_stiffness_and_damping_of_the_thesis_are_named_and_their_extent_told(
    thesis: tuple[Path, dict[str, Any]],
) -> None:
    """The other two changes come within 100 samples of an alarm: nothing is said of them."""
    _, out = thesis
    said = [change["diagnosis"] for change in out["changes"]]
    assert [each and (each["named"], each["right"]) for each in said] == [("K", True), ("B", True), None, None]
    assert all(abs(each["extent_error"]) < 0.02 and each["delay_n"] < 60 for each in said if each)


def test_estimates_are_the_plants_within_two_percent(thesis: tuple[Path, dict[str, Any]]) -> None:
    for segment in thesis[1]["estimates"]:
        assert segment["estimate"] == pytest.approx(segment["truth"], rel=0.02)


def test_run_leaves_a_report_and_a_recording(thesis: tuple[Path, dict[str, Any]]) -> None:
    _, out = thesis
    assert Path(out["report"]).read_text(encoding="utf-8").startswith("<!doctype html>")
    assert Run.load(Path(out["run"])).theta_hash() == out["theta_hash"]


def test_same_seed_gives_the_same_estimates_bit_for_bit(thesis: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    _, out = thesis
    assert run_json("run", "--seed", "3", cwd=tmp_path)["theta_hash"] == out["theta_hash"]
    assert run_json("run", "--seed", "4", "--dut", "inproc", cwd=tmp_path)["theta_hash"] != out["theta_hash"]


@pytest.mark.parametrize("dut", ["inproc", pytest.param("qemu-m4", marks=needs_firmware)])
def test_every_device_gives_the_same_estimates_bit_for_bit(
    thesis: tuple[Path, dict[str, Any]], tmp_path: Path, dut: str
) -> None:
    """test_qemu.py plays the other boards."""
    out = run_json("run", "--seed", "3", "--dut", dut, cwd=tmp_path)
    assert out["theta_hash"] == thesis[1]["theta_hash"]
    assert out["dut"]["kind"] == dut


def test_replay_gives_the_same_estimates_bit_for_bit(thesis: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    _, out = thesis
    again = run_json("replay", out["run"], cwd=tmp_path)
    for key in ("theta_hash", "changes", "false_alarms", "outcome", "estimates"):
        assert again[key] == out[key], key


def test_table_names_outcome_latencies_and_report(tmp_path: Path) -> None:
    done = analogrig("run", "--seed", "3", cwd=tmp_path)
    assert done.returncode == 0
    assert "PASSED" in done.stdout
    assert "K 24500 -> 18000 N/m" in done.stdout
    assert re.search(r"^ +1200  K +yes +0\.7\d\d", done.stdout, re.MULTILINE)
    assert "build/run/report.html" in done.stdout
    assert done.stderr == ""


def test_emulate_writes_volts_and_codes(tmp_path: Path) -> None:
    out = run_json("emulate", "--seed", "3", "--out", "signals.csv", cwd=tmp_path)
    lines = (tmp_path / "signals.csv").read_text().splitlines()
    assert lines[0].split(",")[:3] == ["sample", "force_v", "displacement_v"]
    assert len(lines) == 1801 == out["samples"] + 1
    assert lines[0].split(",")[-2:] == ["machine_s", "plant_s"]
    assert [float(each) for each in lines[1001].split(",")[-2:]] == [0.05, 10.0]  # 20,000 samples/s, 200 times faster
    run_json("emulate", "--seed", "3", "--out", "signals.npz", cwd=tmp_path)
    with np.load(tmp_path / "signals.npz") as file:
        volts = np.array([line.split(",")[1:5] for line in lines[1:]], float)
        assert file["volts"] == pytest.approx(volts, abs=1e-6)
        assert file["codes"].shape == (1800, 4)


def test_own_files_work_like_shipped_ones(thesis: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    for kind, name in (("scenarios", "thesis"), ("rigs", "emulator"), ("devices", "host")):
        (tmp_path / f"my-{kind}.toml").write_text(locate(kind, name).read_text())  # type: ignore[arg-type]
    own = ("--scenario", "my-scenarios.toml", "--rig", "my-rigs.toml", "--dut", "my-devices.toml")
    assert run_json("run", *own, "--seed", "3", cwd=tmp_path)["theta_hash"] == thesis[1]["theta_hash"]


@pytest.mark.parametrize("dut", ["host", "shock"])
def test_shock_absorber_is_followed_with_either_prefilter(tmp_path: Path, dut: str) -> None:
    assert run_json("run", "--scenario", "shock", "--dut", dut, cwd=tmp_path)["outcome"] == "passed"


def test_failed_verdict_has_status_1(tmp_path: Path) -> None:
    """A ceiling that nothing reaches misses every change."""
    text = locate("devices", "prediction-error").read_text().replace("ceiling = 12.0", "ceiling = 1.0e6")
    (tmp_path / "deaf.toml").write_text(text)
    out = run_json("run", "--dut", "deaf.toml", cwd=tmp_path, status=1)
    assert out["outcome"] == "failed"
    assert [change["latency"] for change in out["changes"]] == [None] * 4


def test_recording_is_a_rig_with_its_own_scenario_and_seed(thesis: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    _, out = thesis
    rig = f"recording:{out['run']}"
    assert run_json("run", "--rig", rig, cwd=tmp_path)["theta_hash"] == out["theta_hash"]
    assert "was recorded with seed 3, not 4" in refusal("run", "--rig", rig, "--seed", "4", cwd=tmp_path)
    assert "can play no other" in refusal("run", "--rig", rig, "--scenario", "healthy", cwd=tmp_path)
    assert "would overwrite" in refusal("replay", out["run"], "--out", Path(out["run"]).parent, cwd=tmp_path)


def test_generator_may_have_any_period(tmp_path: Path) -> None:
    text = (
        locate("scenarios", "thesis-free-running").read_text().replace("frequency_hz = 200.0", "frequency_hz = 180.0")
    )
    (tmp_path / "180.toml").write_text(text)
    assert run_json("run", "--scenario", "180.toml", "--dut", "any-edges", cwd=tmp_path)["outcome"] == "passed"
    assert run_json("run", "--scenario", "180.toml", cwd=tmp_path)["outcome"] == "passed"


# ---- what goes wrong


def test_faults_of_the_line_are_asked_for_by_name(tmp_path: Path) -> None:
    out = run_json("run", "--dut", "inproc", "--wire-faults", "reset@to:100", cwd=tmp_path, status=3)
    assert "it was reset after the handshake" in out["reasons"][0]


@pytest.mark.parametrize(
    ("kind", "old", "new", "words"),
    [
        ("rigs", '"tl07x"', '"lm358"', "mine.toml: "),
        ("rigs", "noise_lsb = 1.0", "noise_lsb = -1.0", "mine.toml: "),
        ("rigs", "noise_lsb = 1.0", "noise_lsb = 1e308", "mine.toml"),
        ("rigs", "0.003", "-1.0", "mine.toml"),
        ("rigs", "[-10.0, 10.0]", "[1e308, -1e308]", "mine.toml"),
        ("scenarios", "random_phase", "randam_phase", "mine.toml: unknown key 'randam_phase'"),
        ("scenarios", "M = 30.0", "M = 20.0", "M = 20 cannot be set .*at least 29.4: pot M"),
        ("scenarios", "frequency_hz = 200.0", "frequency_hz = 1e-12", "mine.toml"),
        pytest.param("scenarios", "samples = 1800", f"samples = {10**400}", "mine.toml", id="samples"),
        ("devices", "forgetting", "forgeting", "mine.toml: estimator: unknown key 'forgeting'"),
        ("devices", "forgetting = 0.995\n", "forgetting = 0.2\n", "forgetting.* 0.2"),
        ("devices", "arl0 = 1.0e5", "ceiling = 1.0e12", "mine.toml"),
        ("devices", 'kind = "host"', f'kind = "serial"\nurl = "loop://"\nbaud = 1{20 * "0"}', "mine.toml"),
    ],
)
def test_wrong_file_is_named_in_one_line(
    kind: Any,
    old: str,
    new: str,
    words: str,
    tmp_path: Path,
) -> None:
    option, name = {"devices": ("dut", "host"), "rigs": ("rig", "emulator"), "scenarios": ("scenario", "thesis")}[kind]
    text = locate(kind, name).read_text()
    assert old in text
    (tmp_path / "mine.toml").write_text(text.replace(old, new))
    assert re.search(words, refusal("run", f"--{option}", "mine.toml", cwd=tmp_path))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "COMMAND"),
        ("fly", "fly"),
        ("run --sede 3", "--sede"),
        ("run --seed -1", "--seed"),
        ("run --seed x", "--seed"),
        ("run --real-time 0", "--real-time"),
        ("run --baud 0", "baud must be 1"),
        ("run --wire-faults flop@2", "'flop@2' is not KIND@to:FRAME"),
        ("run --out file/run", "--out file/run: Not a directory"),
        pytest.param(f"run --scenario {300 * 'x'}", "File name too long", id="name"),
        ("run --dut serial:/dev/ttyNOWHERE", "/dev/ttyNOWHERE"),
        *(
            (f"run --dut serial:{url}", url)
            for url in ("loop://?foo=1", "socket://127.0.0.1:abc", "nonsense://x", "alt://?class=x")
        ),
    ],
)
def test_wrong_argument_is_one_line(arguments: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert words in refusal(*arguments.split(), cwd=tmp_path)


def test_truncated_recording_is_named(thesis: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    whole = Path(thesis[1]["run"]).read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    assert "cut.npz: truncated" in refusal("replay", "cut.npz", cwd=tmp_path)


def test_dead_device_is_named_within_seconds(tmp_path: Path) -> None:
    """A line on which nobody answers."""
    ours, theirs = pty.openpty()
    try:
        line = refusal("run", "--dut", f"serial:{os.ttyname(theirs)}?timeout_s=0.5", cwd=tmp_path)
    finally:
        os.close(ours)
        os.close(theirs)
    assert "Hello" in line


@contextmanager
def device(*arguments: str) -> Iterator[str]:
    """The executable started by hand, as one would on a bench; yields the path that it prints."""
    with subprocess.Popen(
        [HOST_PROGRAM, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.kill()


def test_device_started_by_hand_is_reached_by_its_path(thesis: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    with device() as path:
        out = run_json("run", "--seed", "3", "--dut", f"serial:{path}", cwd=tmp_path)
    assert out["theta_hash"] == thesis[1]["theta_hash"]


def test_device_with_another_catalogue_is_refused_by_name(tmp_path: Path) -> None:
    with device("--catalogue-hash", "deadbeef") as path:
        assert "catalogue" in (line := refusal("run", "--dut", f"serial:{path}", cwd=tmp_path))
    assert "deadbeef" in line.lower()


@contextmanager
def long_run(folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """`analogrig run` in the middle of two million samples, and the pid of its device."""
    text = locate("scenarios", "healthy").read_text().replace("samples = 20000", "samples = 2000000")
    (folder / "long.toml").write_text(text)
    command = [sys.executable, "-m", "analogrig.cli", "run", "--scenario", "long.toml"]
    environment = {**ENVIRONMENT, "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        deadline_s = time.monotonic() + LONG_S
        while True:
            assert time.monotonic() < deadline_s
            pids = descendants(process.pid)[1:]  # behind the tether
            # A quarter of a second of the device's own time: it is well into the samples.
            if pids and int(Path(f"/proc/{pids[0]}/stat").read_text().split()[13]) >= 2:
                break
            time.sleep(0.01)
        yield process, pids[0]
        process.kill()


def test_device_that_dies_in_the_run_makes_it_inconclusive(tmp_path: Path) -> None:
    with long_run(tmp_path) as (process, device_pid):
        os.kill(device_pid, signal.SIGKILL)
        _, errors = process.communicate(timeout=LONG_S)
    assert process.returncode == 3
    (line,) = errors.splitlines()
    assert line.startswith("analogrig: INCONCLUSIVE: ")
    assert "-9" in line
    run = Run.load(tmp_path / "build" / "run" / "run.npz")
    assert 0 < run.samples < 2_000_000
    assert run.conditions.faults


def test_interrupted_run_keeps_what_it_has(tmp_path: Path) -> None:
    with long_run(tmp_path) as (process, _):
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=LONG_S)
    assert process.returncode == 130, errors
    assert "INCONCLUSIVE" in out
    assert "Traceback" not in errors
    assert 0 < Run.load(tmp_path / "build" / "run" / "run.npz").samples < 2_000_000


def test_killed_harness_leaves_no_device_behind(tmp_path: Path) -> None:
    with long_run(tmp_path) as (process, device_pid):
        process.kill()
        process.wait()
        deadline_s = time.monotonic() + LONG_S
        while Path(f"/proc/{device_pid}").exists() and time.monotonic() < deadline_s:
            time.sleep(0.01)
        assert not Path(f"/proc/{device_pid}").exists()


def test_closed_pipe_does_not_turn_a_failed_verdict_into_success(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "analogrig.cli", "run", "--dut", "mean-between-faults"]
    environment = {**ENVIRONMENT, "PYTHONPATH": str(Path(__file__).parents[2])}
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, stdout=writer, stderr=subprocess.PIPE, timeout=LONG_S, check=False
    )
    os.close(writer)
    assert done.returncode == 1
    assert b"Traceback" not in done.stderr


def test_run_whose_output_nobody_hears_is_kept_and_judged(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "analogrig.cli", "run", "--dut", "inproc", "--out", "kept"]
    environment = {**ENVIRONMENT, "PYTHONPATH": str(Path(__file__).parents[2])}
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, stdout=writer, stderr=writer, timeout=LONG_S, check=False
    )
    os.close(writer)
    assert done.returncode == 0
    run = Run.load(tmp_path / "kept" / "run.npz")
    assert run.samples == run.conditions.samples_asked
    assert (tmp_path / "kept" / "report.html").is_file()


def test_recording_without_a_sample_is_named(tmp_path: Path) -> None:
    made_run(np.zeros(0), [(0, front(115.0, 3021.0, 24500.0))], samples_asked=10).save(tmp_path / "none.npz")
    assert "holds no samples" in refusal("replay", "none.npz", cwd=tmp_path)


def test_device_at_a_url_is_not_opened_on_the_word_of_a_file(tmp_path: Path) -> None:
    with device() as path:
        out = run_json("run", "--dut", f"serial:{path}", cwd=tmp_path)
    assert f"which no file may order: pass --allow {path}" in refusal("replay", out["run"], cwd=tmp_path)
    assert run_json("replay", out["run"], "--dut", "host", cwd=tmp_path)["theta_hash"] == out["theta_hash"]


def test_real_time_and_baud_are_options(thesis: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """Slow enough for any machine that tests run on: 1800 samples in 1.8 s."""
    out = run_json("run", "--seed", "3", "--real-time", "20", cwd=tmp_path)
    assert (out["theta_hash"], out["real_time"]) == (thesis[1]["theta_hash"], 20.0)
    assert out["dut"]["exchange"] == "stream"
    timed = run_json("run", "--seed", "3", "--baud", "115200", cwd=tmp_path)
    assert timed["line_s"] == pytest.approx(1800 * 144 * 10 / 115_200, rel=0.001)
    line = refusal("run", "--seed", "3", "--baud", "115200", "--real-time", cwd=tmp_path)
    assert "real time does not fit its line" in line
