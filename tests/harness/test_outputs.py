"""An output folder holds one run; signals end every command alike; no older result is taken for the new one."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from analogrig import output as output_module
from analogrig.bench import Bench
from analogrig.cli import main
from analogrig.errors import ConfigurationError, LinkClosed, RecordingError, RigClosed
from analogrig.judging.verdict import judge
from analogrig.output import NOT_ENDED, OutputFolder, previous_of
from analogrig.run import Run
from analogrig.signals import ENDING
from tests.harness.commands import error_of, output_of
from tests.harness.processes import descendants, ends, with_default_signals

LONG_S = 300.0
"""For what takes seconds unless something is broken, on a machine that has much else to do."""

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def passed_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that `analogrig run` has left, PASSED."""
    folder = tmp_path_factory.mktemp("passed") / "out"
    assert main(["run", "--dut", "inproc", "--seed", "3", "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def out(passed_run: Path, tmp_path: Path) -> Path:
    """A copy of it, with a file of the user."""
    folder = Path(shutil.copytree(passed_run, tmp_path / "out"))
    (folder / "notes.txt").write_text("mine")
    return folder


def verdict(folder: Path) -> dict[str, Any]:
    table: dict[str, Any] = json.loads((folder / "verdict.json").read_text())
    return table


def page_outcome(folder: Path) -> str:
    (outcome,) = re.findall(r'class="outcome (\w+)"', (folder / "report.html").read_text())
    return str(outcome)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def check_inconclusive(folder: Path, reason: str) -> None:
    """The folder holds no result but this reason, and what was there before is beside it."""
    assert set(contents(folder)) == {"notes.txt", "report.html", "verdict.json"}
    assert verdict(folder)["outcome"] == page_outcome(folder) == "inconclusive"
    assert reason in verdict(folder)["reasons"][0]
    before = folder.with_name("out.previous")
    assert verdict(before)["outcome"] == page_outcome(before) == "passed"
    assert Run.load(before / "run.npz").conditions.seed == 3


# ------------------------------------------------------------------------------------------------------ how a run ends


def test_device_that_does_not_answer_leaves_no_older_verdict(out: Path) -> None:
    """A CI job would publish the PASSED report of an earlier run."""
    assert main(["run", "--dut", "inproc", "--wire-faults", "drop@1.0", "--out", str(out)]) == 2
    check_inconclusive(out, "Hello")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["run", "--dut", "none.toml"], "none.toml: no such file"),
        (["run", "--rig", "none.toml"], "none.toml: no such file"),
        (["run", "--scenario", "none.toml"], "none.toml: no such file"),
        (["run", "--dut", "inproc", "--can-log", "blf"], "device inproc is not on a CAN bus"),
        (["replay", "none.npz"], "none.npz"),
        (["judge", "none.npz"], "none.npz"),
        (["judge", "none.log"], "name one with --scenario"),
    ],
)
def test_wrong_option_leaves_no_older_verdict(out: Path, words: list[str], reason: str) -> None:
    assert main([*words, "--out", str(out)]) == 2
    check_inconclusive(out, reason)


def interrupted_import() -> ImportError:
    """The error of a module in C that was interrupted while it was imported, as pybind11 raises it."""
    error = ImportError("initialization failed")
    error.__cause__ = KeyboardInterrupt("SIGTERM")
    return error


@pytest.mark.parametrize(
    ("raised", "status", "reason"),
    [
        (RigClosed("the instrument is gone"), 2, "the instrument is gone"),
        (ZeroDivisionError("by zero"), 3, "a fault of analogrig itself: ZeroDivisionError: by zero"),
        (KeyboardInterrupt("SIGTERM"), 130, "interrupted by SIGTERM"),
        (interrupted_import(), 130, "interrupted by SIGTERM"),
        (KeyboardInterrupt(), 130, "interrupted by SIGINT"),
    ],
)
def test_run_that_cannot_begin_leaves_its_reason(
    out: Path, raised: BaseException, status: int, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def play(*_: object) -> Run:
        raise raised

    monkeypatch.setattr(Bench, "play", play)
    assert main(["run", "--dut", "inproc", "--out", str(out)]) == status
    check_inconclusive(out, reason)


@pytest.mark.parametrize("fault", [LinkClosed("the line was cut"), RigClosed("the instrument is gone")])
def test_run_that_fails_later_keeps_what_it_has(out: Path, fault: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def play(*_: object) -> Iterator[object]:
        raise fault

    monkeypatch.setattr("analogrig.devices.catalogue_device.CatalogueDevice.play", play)
    assert main(["run", "--dut", "inproc", "--out", str(out)]) == 3
    assert verdict(out)["outcome"] == page_outcome(out) == "inconclusive"
    assert Run.load(out / "run.npz").conditions.faults == (str(fault),)


@pytest.mark.parametrize("name", ["run.npz", "report.html", "verdict.json", "can.log"])
def test_folder_in_the_place_of_a_result_is_refused_before_the_run(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "out" / name).mkdir(parents=True)
    monkeypatch.setattr(Bench, "play", None)
    assert f"{name} is no file: remove it, or choose another folder" in error_of(
        "run", "--dut", "inproc", "--out", str(tmp_path / "out")
    )
    assert (tmp_path / "out" / name).is_dir()


def test_verdict_file_is_what_json_prints(out: Path) -> None:
    printed = json.loads(output_of("run", "--dut", "inproc", "--seed", "4", "--out", str(out), "--json"))
    assert verdict(out) == {"format": "analogrig-verdict", "version": 1, **printed}
    assert printed["outcome"] == page_outcome(out) == judge(Run.load(out / "run.npz")).outcome == "passed"
    assert (out / "notes.txt").read_text() == "mine"


def test_full_disk_leaves_no_result_and_no_part_of_one(out: Path) -> None:
    """A limit on the size of files, 32 blocks, stands for the disk: the mark fits, a recording does not."""
    command = f"ulimit -f 32; exec {sys.executable} -m analogrig.cli run --dut inproc --out {out}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=LONG_S, check=False)
    assert done.returncode == 3
    assert done.stderr == f"analogrig: INCONCLUSIVE: {out / 'run.npz'}: cannot be written: File too large\n"
    check_inconclusive(out, "run.npz: cannot be written: File too large")
    assert not (out / ".analogrig-parts").exists()


def test_disk_that_is_full_at_the_start_leaves_no_older_verdict(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(*_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", write)
        assert main(["run", "--dut", "inproc", "--out", str(out)]) == 2
    assert set(contents(out)) == {"notes.txt"}


# ------------------------------------------------------------------------------------------------------------- signals


@contextmanager
def long_run(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A run of two million samples into ``folder``, whose first ones have gone to the device."""
    scenario = folder.with_name("long.toml")
    text = (ROOT / "fixtures/scenarios/healthy.toml").read_text()
    scenario.write_text(re.sub(r"samples = \d+", "samples = 2000000", text))
    command = with_default_signals(
        sys.executable, "-m", "analogrig.cli", "run", "--scenario", scenario, "--out", folder
    )
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline_s = time.monotonic() + LONG_S
        while True:
            assert process.poll() is None and time.monotonic() < deadline_s
            pids = descendants(process.pid)[1:]  # behind the tether
            if pids and int(Path(f"/proc/{pids[0]}/stat").read_text().split()[13]) >= 4:
                break
            time.sleep(0.01)
        yield process
        process.kill()


def test_folder_says_that_the_run_has_not_ended_until_a_signal_keeps_what_was_recorded(out: Path) -> None:
    """The signal comes twice, as from ``timeout``, which is one request."""
    with long_run(out) as process:
        check_inconclusive(out, NOT_ENDED)
        assert verdict(out)["identity"]["command"].startswith("analogrig run --scenario ")
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGTERM)
        said, errors = process.communicate(timeout=LONG_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert "INCONCLUSIVE" in said and "interrupted by SIGTERM" in said
    assert verdict(out)["outcome"] == page_outcome(out) == "inconclusive"
    run = Run.load(out / "run.npz")
    assert 0 < run.samples < 2_000_000
    assert verdict(out)["samples"] == run.samples


PROGRAM = """
import time
from analogrig import signals
signals.AGAIN_S = {again_s}
try:
    with signals.raise_signals(), signals.hold_signals():
        print("ready", flush=True)
        while {forever} or not signals._handlers[-1]._held:
            time.sleep(0.01)
        print("done", flush=True)
except KeyboardInterrupt as error:
    print(f"interrupted by {{error}}", flush=True)
"""


@contextmanager
def program(*, again_s: float, forever: bool = False, ignored: str = "") -> Iterator[subprocess.Popen[str]]:
    """A program that holds back the first signal until it has come, or for ever."""
    command = with_default_signals(sys.executable, "-c", PROGRAM.format(again_s=again_s, forever=forever))
    if ignored:
        command = ["env", f"--ignore-signal={ignored}", *command[2:]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
        process.kill()


@pytest.mark.parametrize("number", ENDING)
def test_signal_waits_for_what_is_being_written(number: signal.Signals) -> None:
    with program(again_s=LONG_S) as process:
        process.send_signal(number)
        said, _ = process.communicate(timeout=LONG_S)
    assert said == f"done\ninterrupted by {number.name}\n"


COMPILED = """
import os, signal, sys
from analogrig import signals
try:
    with signals.raise_signals():
        exec("os.kill(os.getpid(), signal.SIGINT)")
except KeyboardInterrupt:
    sys.exit(130)
"""


def test_status_is_that_of_the_command_wherever_the_signal_comes() -> None:
    """In code compiled from text, as while a dataclass is defined, Python took it for a reason to end by SIGINT."""
    command = with_default_signals(sys.executable, "-c", COMPILED)
    assert subprocess.run(command, timeout=LONG_S, check=False).returncode == 130


@pytest.mark.parametrize("number", ENDING)
def test_second_signal_ends_at_once(number: signal.Signals) -> None:
    with program(again_s=0.0, forever=True) as process:
        while process.poll() is None:
            process.send_signal(number)
            time.sleep(0.01)
        assert process.returncode == -number


def test_signal_that_the_parent_ignores_stays_ignored() -> None:
    with program(again_s=LONG_S, ignored="HUP") as process:
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=LONG_S)
    assert said == "done\ninterrupted by SIGTERM\n"


def test_command_leaves_the_handlers_of_its_host_alone(tmp_path: Path) -> None:
    before = {number: signal.getsignal(number) for number in ENDING}
    assert main(["netlist", "--out", str(tmp_path / "deck.cir")]) == 0
    assert {number: signal.getsignal(number) for number in ENDING} == before


def test_campaign_ends_its_workers_and_goes_on_later(tmp_path: Path) -> None:
    """The signal goes to the whole group, as from ``timeout`` or a terminal that is closed."""
    (tmp_path / "spec.toml").write_text("trials = 2000\nsamples = 400\n")
    results = tmp_path / "out.sqlite"
    words = ["campaign", str(tmp_path / "spec.toml"), "--out", str(results), "--workers", "2"]
    command = with_default_signals(sys.executable, "-m", "analogrig.cli", *words)
    log = results.with_name("out.sqlite-wal")
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, process_group=0) as process:
        deadline_s = time.monotonic() + LONG_S
        while not log.exists() or log.stat().st_size < 10_000:
            assert process.poll() is None and time.monotonic() < deadline_s
            time.sleep(0.01)
        started = descendants(process.pid)
        os.killpg(process.pid, signal.SIGHUP)
        _, errors = process.communicate(timeout=LONG_S)
    assert process.returncode == 130
    kept = f"what is done is kept in {results}, and the same command goes on from there"
    assert errors == f"analogrig: interrupted: {kept}\n"
    assert all(ends(pid) for pid in started)
    assert results.exists() and not results.with_suffix(".html").exists()


# ------------------------------------------------------------------------------------------- what stands in the folder


def test_one_generation_is_kept_and_a_failure_does_not_push_it_out(out: Path) -> None:
    for _ in range(3):
        assert main(["run", "--dut", "none.toml", "--out", str(out)]) == 2
    check_inconclusive(out, "none.toml")
    assert main(["run", "--dut", "inproc", "--seed", "4", "--out", str(out)]) == 0
    assert main(["run", "--dut", "inproc", "--seed", "5", "--out", str(out)]) == 0
    assert [Run.load(each / "run.npz").conditions.seed for each in (out, previous_of(out))] == [5, 4]
    assert set(contents(previous_of(out))) == {"run.npz", "report.html", "verdict.json"}


def test_log_of_an_earlier_run_goes_with_it(out: Path) -> None:
    (out / "can.blf").write_text("of an earlier run")
    assert main(["run", "--dut", "inproc", "--out", str(out)]) == 0
    assert not (out / "can.blf").exists()
    assert (previous_of(out) / "can.blf").read_text() == "of an earlier run"
    assert main(["run", "--dut", "inproc", "--out", str(out)]) == 0
    assert not (previous_of(out) / "can.blf").exists()


def test_earlier_results_stay_within_where_nothing_may_stand_beside(out: Path) -> None:
    """A volume of its own has no place beside it."""
    previous_of(out).write_text("in the way")
    assert main(["run", "--dut", "none.toml", "--out", str(out)]) == 2
    assert verdict(out)["outcome"] == "inconclusive"
    assert verdict(out / ".previous")["outcome"] == "passed"
    assert previous_of(out).read_text() == "in the way"


@pytest.mark.parametrize("beside", ["", ".previous"])
def test_recording_that_is_played_is_refused_before_anything_moves(
    out: Path, beside: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = out.with_name(f"out{beside}")
    if beside:
        shutil.copytree(out, folder)
    (out.with_name("its.toml")).write_text(f"rig = 'recording:{folder / 'run.npz'}'\n")
    (folder / "beside.toml").write_text("rig = 'recording:run.npz'\n")  # relative to the file
    before = contents(out), contents(folder)
    recording = str(folder / "run.npz")
    for words in (
        ["replay", recording, "--dut", "inproc"],
        ["judge", recording],
        ["run", "--rig", f"recording:{recording}"],
        ["run", "--scenario", str(out.with_name("its.toml"))],
        ["run", "--scenario", str(folder / "beside.toml")],
    ):
        assert main([*words, "--out", str(out)]) == 2
        assert "would overwrite the recording that is played; choose another folder" in capsys.readouterr().err
        assert (contents(out), contents(folder)) == before


def test_two_commands_do_not_write_to_one_folder(out: Path) -> None:
    with OutputFolder(out, "analogrig run", "now"):
        with pytest.raises(ConfigurationError, match="another command is writing to it: wait for its end, or choose"):
            OutputFolder(out, "analogrig run", "now").__enter__()
        assert verdict(out)["reasons"] == [NOT_ENDED]
    assert verdict(out)["reasons"] == ["the command ended without a result"]


class Killed(BaseException):
    """Nothing of the command runs after it."""


class Killer:
    """Kills before the so manieth change of a file's place."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left = -1
        for name in ("rename", "replace", "unlink"):
            monkeypatch.setattr(Path, name, self._counted(getattr(Path, name)))

    def _counted(self, change: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any, **named: Any) -> Any:
            if self.left == 0:
                raise Killed
            self.left -= 1
            return change(*arguments, **named)

        return counted


def result(folder: Path) -> tuple[Callable[[Path], None], dict[str, str]]:
    """Writer of the files of a run that has passed, and its verdict."""
    recording, page = (folder / "run.npz").read_bytes(), (folder / "report.html").read_text()

    def write(parts: Path) -> None:
        (parts / "run.npz").write_bytes(recording)
        (parts / "report.html").write_text(page)

    return write, {"outcome": "passed", "seed": "new"}


def test_kill_at_any_step_leaves_no_older_and_no_half_result(
    passed_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every step of beginning and ending. ``verdict.json`` says passed only while all that it speaks of is there."""
    write, table = result(passed_run)
    killer = Killer(monkeypatch)
    steps = 0
    for step in range(100):
        killer.left = -1
        out = Path(shutil.copytree(passed_run, tmp_path / str(step)))
        old = contents(out)
        folder = OutputFolder(out, "analogrig run", "now")
        killer.left = step
        try:
            folder.__enter__()
            folder.conclude(write, table)
            break
        except Killed:
            steps += 1
            folder._release()  # as the kernel does, but for the parts
        if (out / "verdict.json").exists() and verdict(out)["outcome"] == "passed":
            assert contents(out) == old, f"killed at step {step}"
        if (out / "run.npz").exists():
            Run.load(out / "run.npz")
    assert steps >= 2 * len(("run.npz", "report.html", "verdict.json"))
    killer.left = -1
    assert verdict(out)["seed"] == "new"


def test_result_that_cannot_be_put_in_place_is_none(out: Path, passed_run: Path) -> None:
    write, table = result(passed_run)
    with OutputFolder(out, "analogrig run", "now") as folder:
        (out / "run.npz").mkdir()
        with pytest.raises(RecordingError, match="Is a directory"):
            folder.conclude(write, table)
    assert verdict(out)["outcome"] == page_outcome(out) == "inconclusive"


# --------------------------------------------------------------------------------------------------------- other files


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("signals.csv", ["emulate", "--rig", "none.toml"]),
        ("deck.cir", ["netlist", "--rig", "none.toml"]),
        ("twin.toml", ["calibrate", "--rig", "none.toml"]),
    ],
)
def test_older_file_is_not_taken_for_the_new_one(tmp_path: Path, name: str, words: list[str]) -> None:
    (tmp_path / name).write_text("older")
    assert main([*words, "--out", str(tmp_path / name)]) == 2
    assert contents(tmp_path) == {f"{name}.previous": b"older"}


def test_older_picture_is_not_taken_for_the_new_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(*_: object) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr("analogrig_circuits.effects_page.measure", measure)
    (tmp_path / "effects.svg").write_text("older")
    assert main(["effects", "--out", str(tmp_path / "effects.svg")]) == 130
    assert contents(tmp_path) == {"effects.svg.previous": b"older"}


def test_file_that_is_read_is_not_moved(tmp_path: Path) -> None:
    (tmp_path / "twin.toml").write_text("older")
    words = ["calibrate", "--rig", f"{tmp_path / 'twin.toml'}:mine", "--out", str(tmp_path / "twin.toml")]
    assert "would overwrite a file that is read; choose another" in error_of(*words)
    assert contents(tmp_path) == {"twin.toml": b"older"}


def test_file_of_a_kind_that_is_not_written_stays(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["emulate", "--out", str(tmp_path / "notes.txt")]) == 2
    assert contents(tmp_path) == {"notes.txt": b"mine"}


def test_thesis_that_is_interrupted_leaves_no_older_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reproduce() -> object:
        raise KeyboardInterrupt("SIGHUP")

    monkeypatch.setattr("analogrig_thesis.reproduce", reproduce)
    (tmp_path / "out" / "recordings").mkdir(parents=True)
    for name in ("thesis.html", "claims.json", "recordings/fig-5.4.npz", "recordings/mine.npz"):
        (tmp_path / "out" / name).write_text("older")
    assert main(["thesis", "--out", str(tmp_path / "out")]) == 130
    out, before = tmp_path / "out", tmp_path / "out.previous"
    assert set(contents(out)) == {"thesis.html", "verdict.json"}
    assert verdict(out)["reasons"] == ["interrupted by SIGHUP"]
    assert "INCONCLUSIVE" in (out / "thesis.html").read_text()
    assert set(contents(out / "recordings")) == {"mine.npz"}
    assert contents(before) == {"thesis.html": b"older", "claims.json": b"older"}
    assert contents(before / "recordings") == {"fig-5.4.npz": b"older"}


def test_page_of_an_older_campaign_is_not_taken_for_that_of_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "spec.toml").write_text("trials = 1\nsamples = 700\n")
    words = ["campaign", str(tmp_path / "spec.toml"), "--out", str(tmp_path / "out.sqlite"), "--workers", "1"]
    assert main(words) in (0, 1, 3)
    (tmp_path / "out.sqlite").unlink()

    def conduct(*_: object) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr("analogrig.campaigns.conduct.conduct", conduct)
    assert main(words) == 130
    assert not (tmp_path / "out.html").exists()
    assert (tmp_path / "out.html.previous").exists()


def test_names_of_logs_are_those_that_are_written() -> None:
    from analogrig.recordings import WRITTEN

    assert set(output_module.RUN_FILES) == {"run.npz", *(f"can.{suffix}" for suffix in WRITTEN)}


SERVER = """
import asyncio, signal
from analogrig.signals import raise_signals, signal_future

class Finalized:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)

async def serve():
    Finalized()
    await signal_future()

try:
    with raise_signals():
        asyncio.run(serve())
except KeyboardInterrupt as error:
    print(f"interrupted by {error}")
"""


def test_signal_that_a_finalizer_has_swallowed_ends_a_server() -> None:
    """Python prints what a finalizer raises, and goes on: `serve` then waited for ever."""
    command = with_default_signals(sys.executable, "-c", SERVER)
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=False)
    assert "Exception ignored" in done.stderr
    assert done.stdout == "interrupted by SIGTERM\n"
