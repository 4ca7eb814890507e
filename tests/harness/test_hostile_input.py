"""Files that are wrong on purpose, each by the defect that it once showed; ``make hostile`` looks for more."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.campaigns.conduct import conduct
from analogrig.campaigns.plan import Plan
from analogrig.campaigns.spec import CampaignSpec
from analogrig.campaigns.store import Store
from analogrig.campaigns.workers import Processes
from analogrig.catalogue import Change
from analogrig.cli import main
from analogrig.errors import ConfigurationError
from analogrig.recordings.files import CapturedFrames
from analogrig.reporting.campaign_page import as_json
from analogrig.scenario import Scenario
from analogrig.wording import MOST_MESSAGE, counter_text, number_of, one_line
from tests.harness.commands import error_of, output_of

SCENARIO = """
samples = 600
seed = 7
[excitation]
low_v = 0.1
high_v = 9.9
frequency_hz = 400.0
"""

RIG = """
kind = "emulator"
[card.range_v]
force = [-1.0, 11.0]
displacement = [-1.0, 9.0]
velocity = [-10.0, 10.0]
net_force = [-12.5, 12.5]
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 600 samples."""
    folder = tmp_path_factory.mktemp("sound")
    (folder / "short.toml").write_text(SCENARIO)
    assert main(["run", "--scenario", str(folder / "short.toml"), "--dut", "inproc", "--out", str(folder)]) == 0
    return folder / "run.npz"


Rewrite = Callable[[dict[str, Any], dict[str, Any]], object]
"""Change to the conditions in the header and to the arrays."""


def rewritten(recording: Path, path: Path, change: Rewrite) -> Path:
    with np.load(recording) as file:
        members = {name: file[name] for name in file.files}
    header = json.loads(str(members.pop("header")))
    change(header["conditions"], members)
    np.savez(path, allow_pickle=False, header=np.array(json.dumps(header)), **members)
    return path


def refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that a command ends in; its status is 2 or 3."""
    capsys.readouterr()
    assert main(argv) in (2, 3)
    said = capsys.readouterr().err
    assert said.startswith("analogrig: ")
    assert said.endswith("\n")
    assert said.count("\n") == 1
    assert "a fault of analogrig itself" not in said
    assert said[:-1].isprintable()
    assert len(said) < 2 * MOST_MESSAGE
    return said


def judged(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    return refused(["judge", str(path), "--json", "--out", str(path.parent / "judged")], capsys)


# ---------------------------------------------------------------------------------------------------------- recordings


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("dut", "identity"), 1e-30, "dut: identity: must be a table"),
        (("dut", "estimator", "ceiling"), "x", "dut: estimator: ceiling"),
        (("dut", "estimator", "noise_variance"), [], "dut: estimator: noise_variance"),
        (("dut", "estimator", "warm_up_n"), 1e300, "dut: estimator: warm_up_n"),
        (("dut", "estimator", "hold_off_n"), -1, "hold_off_n = -1 is no setting"),
        (("dut", "most_lost_n"), None, "dut: most_lost_n"),
        (("dut", "report_interval_n"), 0, "report_interval_n must be 1"),
        (("dut", "assumed_n"), "x", "dut: assumed_n"),
        (("dut", "timeout_s"), float("inf"), "not a recording of analogrig"),
        (("dut", "name"), 7, "dut: name: must be a text"),
        (("scenario", "expect"), 3, "scenario: expect: must be a table"),
        (("scenario", "excitation"), "x", "scenario: excitation: must be a table"),
        (("scenario", "name"), {}, "scenario: name: must be a text"),
        (("line", "bitrate"), 0, "line: bitrate"),
        (("samples_asked",), 2**62, "number of samples"),
        (("seed",), -1, "seed"),
        (("channels", "force", "lsb_v"), 1e-300, "units"),
        (("channels", "displacement", "codes"), 2**62, "units"),
        (("sample_period_s",), 1e-300, "sample times"),
        (("real_time",), -1.0, "sample times"),
    ],
    ids=str,
)
def test_header_value_that_a_verdict_cannot_use_is_refused(
    recording: Path,
    tmp_path: Path,
    place: tuple[str, ...],
    value: object,
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def change(conditions: dict[str, Any], _: object) -> None:
        for key in place[:-1]:
            conditions = conditions.setdefault(key, {})
        conditions[place[-1]] = value

    assert said in judged(rewritten(recording, tmp_path / "run.npz", change), capsys)


@pytest.mark.parametrize("key", ["na", "nb", "offset", "trigger", "ceiling"])
def test_setting_that_a_verdict_needs_is_not_assumed(
    recording: Path, tmp_path: Path, key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rewritten(recording, tmp_path / "run.npz", lambda conditions, _: conditions["dut"]["estimator"].pop(key))
    assert f"dut: estimator: missing key '{key}'" in judged(path, capsys)


def test_alarms_out_of_order_are_refused(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def change(_: object, arrays: dict[str, Any]) -> None:
        arrays |= {"alarm_index": np.array([200, 100])}
        arrays |= {"alarm_kind": np.zeros(2, np.uint8), "alarm_statistic": np.zeros(2, np.float32)}

    assert "its alarms do not fit together" in judged(rewritten(recording, tmp_path / "run.npz", change), capsys)


def cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def extended(samples: int) -> Rewrite:
    def change(conditions: dict[str, Any], arrays: dict[str, Any]) -> None:
        conditions["samples_asked"] = samples
        for name, array in arrays.items():
            if len(array) == 600:
                arrays[name] = np.resize(array, (samples, *array.shape[1:]))

    return change


@pytest.mark.parametrize("extent", [np.inf, -np.inf, np.nan])
def test_diagnosis_of_a_non_finite_extent_is_judged_and_reported(
    recording: Path, tmp_path: Path, extent: float, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(conditions: dict[str, Any], arrays: dict[str, Any]) -> None:
        first = conditions["segments"][0]
        conditions["segments"].append({**first, "start": 200, "plant": {**first["plant"], "M": 60.0}})
        arrays |= {"alarm_index": np.array([210]), "alarm_kind": np.full(1, 3, np.uint8)}
        arrays |= {"alarm_statistic": np.full(1, 12.0, np.float32), "diagnosis_index": np.array([220])}
        arrays |= {"diagnosis_change": np.full(1, Change.MASS, np.uint8), "diagnosis_onset": np.array([200])}
        arrays |= {"diagnosis_extent": np.full(1, extent, np.float32)}

    path = rewritten(recording, tmp_path / "run.npz", change)
    assert main(["judge", str(path), "--json", "--out", str(tmp_path / "judged")]) in (0, 1)
    diagnosis = json.loads(capsys.readouterr().out)["changes"][0]["diagnosis"]
    assert diagnosis["named"] == "M"
    assert diagnosis["extent"] is None


@pytest.mark.filterwarnings("error")
def test_estimates_beyond_any_plant_are_reported_without_warnings(recording: Path, tmp_path: Path) -> None:
    """A gain of nearly nothing is a stiffness that single precision does not hold."""

    def change(_: object, arrays: dict[str, Any]) -> None:
        arrays["theta"][:, 2:] = 1e-42

    path = rewritten(recording, tmp_path / "run.npz", change)
    assert "describes no plant of the program" in output_of(
        "judge", str(path), "--out", str(tmp_path / "judged"), status=1
    )


def test_a_record_a_sample_takes_no_time(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """1,800 records took 41 s of CPU; now so many are refused, and those that are allowed take one second."""

    def change(conditions: dict[str, Any], arrays: dict[str, Any]) -> None:
        extended(1800)(conditions, arrays)
        conditions["records"] = list(range(1800))

    start_s = cpu_s()
    assert "its records do not fit together" in judged(rewritten(recording, tmp_path / "run.npz", change), capsys)
    assert cpu_s() - start_s < 5.0


def test_recording_of_as_many_changes_as_are_allowed_is_judged_in_time(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each is named by the device, and not known exactly: the costliest verdict."""

    def change(conditions: dict[str, Any], arrays: dict[str, Any]) -> None:
        extended(2000)(conditions, arrays)
        first = conditions["segments"][0]
        for start in range(8, 2000, 8):
            plant = {**first["plant"], "M": 100.0 + start % 7}
            changed = {"start": start, "plant": plant, "ramp_n": 0, "start_low": start - 1, "start_high": start + 1}
            conditions["segments"].append(changed)
        at = np.arange(9, 2000, 8)
        arrays |= {"alarm_index": at, "alarm_kind": np.zeros(len(at), np.uint8)}
        arrays |= {"alarm_statistic": np.zeros(len(at), np.float32), "diagnosis_index": at + 1}
        arrays |= {"diagnosis_change": np.full(len(at), 2, np.uint8), "diagnosis_onset": at}
        arrays |= {"diagnosis_extent": np.ones(len(at), np.float32)}

    start_s = cpu_s()
    judged(rewritten(recording, tmp_path / "run.npz", change), capsys)
    assert cpu_s() - start_s < 10.0  # 3 s on an idle machine


def test_control_characters_of_a_recording_do_not_reach_the_terminal(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(conditions: dict[str, Any], _: object) -> None:
        conditions["faults"] = ["\x1b]0;owned\x07\x9b2J\u202e" + "x" * 10_000_000]
        conditions["scenario"]["name"] = "\x1b[2Jname"

    path = rewritten(recording, tmp_path / "run.npz", change)
    assert "\\x1b]0;owned\\x07\\x9b2J\\u202e" in judged(path, capsys)
    shown = output_of("judge", str(path), "--out", str(tmp_path / "judged"), status=3)
    assert "\\x1b[2Jname" in shown
    assert shown.replace("\n", "").isprintable()


# --------------------------------------------------------------------------------------------------------------- TOML


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[plant]\nmass_kg = 1e30\n", "M must be less than 1e+15, not 1e+30"),
        ("[plant]\nmass_kg = 1e-30\n", "M must be more than 1e-15, not 1e-30"),
        ("[[changes]]\nsample = 9\nstiffness_n_per_m = 1e29\n", "changes[0]: K must be less than 1e+15"),
        ("a." * 20_000 + "a = 1\n", "a key has more than 32 parts"),
        ("[" + "a." * 20_000 + "a]\n", "a key has more than 32 parts"),
        ("a = " + "[" * 20_000 + "]" * 20_000 + "\n", "nested too deep"),
        ("a = " + "9" * 900_000 + "\n", "Exceeds the limit (4300 digits)"),
        ("\x1b[31m" + "x" * 900_000 + " = 1\n", "not valid TOML"),
        (f'"{"x" * 900_000}\\u001b" = 1\n', "unknown key 'xxx"),
        ('"\\u001b[2J" = 1\n', r"unknown key '\x1b[2J'"),
    ],
    ids=lambda value: value[:30],
)
def test_scenario_that_is_absurd_is_one_line_in_little_time_and_memory(
    tmp_path: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "absurd.toml"
    path.write_text(SCENARIO.replace("[excitation]", f"{text}[excitation]") if "[" not in text[:1] else SCENARIO + text)
    start_s = cpu_s()
    assert said in refused(["run", "--scenario", str(path), "--dut", "inproc", "--out", str(tmp_path)], capsys)
    assert cpu_s() - start_s < 5.0


def test_deep_words_in_strings_and_comments_are_no_nesting(tmp_path: Path) -> None:
    path = tmp_path / "long.toml"
    long = "a.[{" * 100
    path.write_text(f'description = \'{long}\' # {long}\nname = """\n{long} \\""" """\n{SCENARIO}')
    assert Scenario.load(str(path)).description == long


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ("skew_s = 1e9", "card: faults: skew_s: must be an array, not 1000000000.0"),
        ('skew_s = [0.0, "x"]', "card: faults: skew_s[1]: must be a number"),
        ("stuck_high = 1.5", "card: faults: stuck_high: must be a whole number"),
        ("acquisition = nan", "card: faults: acquisition: must be a number"),
        ("skew_s = [0.0, 0.0, 0.0, 1e9]", "card: skew_s with the aperture delay exceeds 0.9 sample periods"),
    ],
)
def test_fault_of_a_card_that_cannot_be_is_named(
    tmp_path: Path, faults: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(f"{RIG}[card.faults]\n{faults}\n")
    message = refused(["emulate", "--rig", str(path), "--out", str(tmp_path / "signals.csv")], capsys)
    assert f"{path}: {said}" in message


# ---------------------------------------------------------------------------------------------------------------- logs


def test_library_that_reads_a_log_prints_nothing_of_its_own(tmp_path: Path) -> None:
    """In a process of its own: what asammdf and cantools log goes to standard error by itself."""
    (tmp_path / "short.toml").write_text(SCENARIO)
    device = ["--dut", "inproc?link=can&bitrate=1000000", "--can-log", "mf4"]
    scenario = ["--scenario", str(tmp_path / "short.toml")]
    assert main(["run", *scenario, *device, "--out", str(tmp_path)]) == 0
    log = tmp_path / "can.mf4"
    log.write_bytes(log.read_bytes()[:300] + bytes(100_000))
    ran = command("judge", str(log), *scenario, "--out", str(tmp_path / "judged"))
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert f"{log}: holds no run of a device" in ran.stderr


def test_dictionary_with_every_message_twice_prints_no_warnings(tmp_path: Path) -> None:
    dbc = (Path(__file__).parents[2] / "estimator_c" / "catalogue" / "analogrig.dbc").read_text()
    (tmp_path / "own.dbc").write_text(dbc + dbc)
    (tmp_path / "short.toml").write_text(SCENARIO)
    (tmp_path / "can.log").write_text("(1.0) can0 7FF#00\n")
    scenario = ["--scenario", str(tmp_path / "short.toml"), "--dbc", str(tmp_path / "own.dbc")]
    ran = command("judge", str(tmp_path / "can.log"), *scenario, "--out", str(tmp_path / "judged"))
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1


def command(*argv: str, files: int | None = None) -> subprocess.CompletedProcess[str]:
    """``analogrig`` in a process, which may open so many files."""

    def limited() -> None:
        if files is not None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (files, files))

    return subprocess.run(
        [sys.executable, "-m", "analogrig.cli", *argv],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=limited,
    )


# ------------------------------------------------------------------------------------------------------------ campaigns

CAMPAIGN = "trials = 4\nchunk = 2\nsamples = 300\n"


def planned(tmp_path: Path) -> Plan:
    (tmp_path / "spec.toml").write_text(CAMPAIGN)
    return Plan.of(CampaignSpec.load(str(tmp_path / "spec.toml")))


def test_too_few_open_files_for_workers_is_one_line(tmp_path: Path) -> None:
    planned(tmp_path)
    ran = command(
        "campaign", str(tmp_path / "spec.toml"), "--workers", "2", "--out", str(tmp_path / "o.sqlite"), files=16
    )
    assert ran.returncode == 2
    assert ran.stderr.startswith("analogrig: only 16 files may be open at once, and workers need ")
    assert ran.stderr.count("\n") == 1


def until(happened: Callable[[], bool], *processes: subprocess.Popen[bytes]) -> None:
    """Wait as long as it takes for five minutes; fails if one of the processes ends before."""
    deadline_s = time.monotonic() + 300.0
    while not happened():
        assert time.monotonic() < deadline_s
        assert all(process.poll() is None for process in processes)
        time.sleep(0.05)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """The address of a Dask scheduler that has a worker, and its process."""
    told, said = tmp_path / "scheduler.json", tmp_path / "worker.log"
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(told)]
    with (
        said.open("wb") as log,
        subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_scheduler", *options], stderr=subprocess.DEVNULL
        ) as scheduler,
    ):
        until(lambda: told.exists() and told.read_text().strip().endswith("}"), scheduler)
        address = json.loads(told.read_text())["address"]
        words = ["-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        with subprocess.Popen([sys.executable, *words], stderr=log, cwd=tmp_path) as worker:
            try:
                until(lambda: b"Registered to" in said.read_bytes(), scheduler, worker)
                yield address, scheduler
            finally:
                worker.kill()
                scheduler.kill()


@pytest.mark.heavy
def test_scheduler_that_dies_is_one_line_and_the_campaign_goes_on_from_there(
    tmp_path: Path, cluster: tuple[str, subprocess.Popen[bytes]]
) -> None:
    address, scheduler = cluster
    spec, out = tmp_path / "spec.toml", tmp_path / "out.sqlite"
    spec.write_text("trials = 8000\nsamples = 300\n")
    argv = [sys.executable, "-m", "analogrig.cli", "campaign", str(spec), "--out", str(out)]
    with subprocess.Popen([*argv, "--cluster", address], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as campaign:
        log = out.with_name("out.sqlite-wal")
        until(lambda: log.exists() and log.stat().st_size > 20_000, campaign, scheduler)
        scheduler.kill()
        _, stderr = campaign.communicate(timeout=300)
    assert campaign.returncode == 3, stderr
    said = (
        f"analogrig: INCONCLUSIVE: --cluster {address}: the connection to the scheduler is lost; what is done is kept"
    )
    assert stderr.decode().startswith(said)
    assert stderr.count(b"\n") == 1
    plan = Plan.of(CampaignSpec.load(str(spec)))
    with Store.read(out) as store:
        kept = sum(part.trials for part, _ in store.parts())
    assert 0 < kept < 8000
    resumed, whole = (conduct(plan, Processes(2), path) for path in (out, tmp_path / "whole.sqlite"))
    assert as_json(resumed) == as_json(whole)


# --------------------------------------------------------------------------------------------------------------- words


@pytest.mark.parametrize("name", ["inproc:", "inproc:?link=can", "host:", "qemu-m4:"])
def test_device_with_nothing_after_the_colon_is_refused(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"device '{name}': nothing follows the colon" in refused(["run", "--dut", name], capsys)


def test_counts_have_their_nouns_in_number() -> None:
    assert number_of(1, "false alarm") == "1 false alarm"
    assert number_of(0, "false alarm") == "0 false alarms"
    assert number_of(1234, "sample", form=",") == "1,234 samples"
    assert number_of(1, "sample was", "samples were") == "1 sample was"
    assert counter_text(1, "error_frames") == "1 error frame"
    assert counter_text(2, "frames_foreign") == "2 frames foreign"
    assert counter_text(1, "messages_of_other_runs") == "1 message of other runs"
    assert counter_text(1, "refreshes") == "1 refresh"


def test_message_of_any_length_is_one_printable_line() -> None:
    said = str(ConfigurationError("first\n\x1b[2J" + "\U000e0001" * 10_000_000 + "\x07 last"))
    assert said.startswith("first \\x1b[2J")
    assert said.endswith("\\x07 last")
    assert len(said) <= MOST_MESSAGE
    assert said.isprintable()
    assert one_line(said) == said


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "--scenario", "pipe.toml"],
        ["run", "--rig", "pipe.toml"],
        ["run", "--dut", "inproc:./pipe.so"],
        ["judge", "pipe.log", "--scenario", "thesis"],
        ["judge", "frames.log", "--scenario", "thesis", "--dbc", "pipe.dbc"],
        ["campaign", "pipe.toml"],
    ],
    ids=" ".join,
)
def test_pipe_in_the_place_of_a_file_is_refused_and_not_waited_for(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for suffix in ("toml", "so", "log", "dbc"):
        os.mkfifo(f"pipe.{suffix}")
    (tmp_path / "frames.log").write_text("(0.0) can0 010#0000000000000000\n")
    (line,) = error_of(*arguments).splitlines()
    assert "pipe." in line


def test_line_without_end_of_a_log_is_read_in_parts(tmp_path: Path) -> None:
    path = tmp_path / "long.log"
    path.write_text("x" * 100_000)
    frames = CapturedFrames(path)
    assert list(frames) == []
    assert frames.damaged


def test_results_are_read_from_files_of_bounded_size_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`compare /dev/zero` grew until the system ended it; a FIFO was waited for without end."""
    os.mkfifo(tmp_path / "fifo")
    for name in ("/dev/zero", str(tmp_path / "fifo")):
        assert main(["compare", name, name]) == 2
        assert "not a" in capsys.readouterr().err


def test_file_takes_the_place_of_a_file_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--out /dev/null` replaced the device of the whole machine, for root."""
    os.mkfifo(tmp_path / "fifo.csv")
    for words in (["netlist", "--out", str(tmp_path)], ["emulate", "--out", str(tmp_path / "fifo.csv")]):
        assert main(words) == 2
        assert capsys.readouterr().err.endswith("cannot be written: it is a folder, or no regular file\n")
    assert (tmp_path / "fifo.csv").is_fifo()


def test_working_directory_that_is_gone_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = Path.cwd()
    (tmp_path / "gone").mkdir()
    os.chdir(tmp_path / "gone")
    try:
        (tmp_path / "gone").rmdir()
        assert main(["judge", "run.npz"]) == 2
    finally:
        os.chdir(before)
    assert capsys.readouterr().err == "analogrig: the working directory is gone: change to one that exists\n"


def test_rigs_file_of_another_program_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rigs.toml").write_text("[drill]\nx = 1\n")
    assert "drill" not in output_of("list", "rigs", "--json")


def test_zero_with_a_minus_is_zero(tmp_path: Path) -> None:
    """NumPy refuses it as the width of a range."""
    shipped = Path(__file__).parents[2] / "fixtures/rigs/emulator.toml"
    (tmp_path / "rig.toml").write_text(shipped.read_text().replace("offset_v = 0.003", "offset_v = -0.0"))
    assert main(["run", "--rig", str(tmp_path / "rig.toml"), "--dut", "inproc", "--out", str(tmp_path / "out")]) in (
        0,
        1,
    )


def test_container_of_a_blf_log_that_expands_without_bound_is_refused(tmp_path: Path) -> None:
    """A file of 3 MB took 3 GB."""
    from can.io import blf

    with blf.BLFWriter(str(tmp_path / "log.blf")) as _:
        pass
    header = (tmp_path / "log.blf").read_bytes()[: blf.FILE_HEADER_SIZE]
    packed = zlib.compress(bytes(100_000_000))
    container = blf.LOG_CONTAINER_STRUCT.pack(blf.ZLIB_DEFLATE, 100_000_000) + packed
    size = blf.OBJ_HEADER_BASE_STRUCT.size + len(container)
    base = blf.OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", blf.OBJ_HEADER_BASE_STRUCT.size, 1, size, blf.LOG_CONTAINER)
    (tmp_path / "log.blf").write_bytes(header + base + container)
    frames = CapturedFrames(tmp_path / "log.blf")
    assert list(frames) == []
    assert frames.end.endswith("a container expands to 32000000 bytes or more")
