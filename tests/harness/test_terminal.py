"""Progress, colour and messages on a terminal."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from analogrig.cli import terminal
from analogrig.cli.terminal import ProgressLine, progress_line


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_progress_is_shown_once_a_second_from_the_second_second_on(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    line = ProgressLine(clock)
    for done in range(1, 31):
        clock.now_s = 0.1 * done
        line.show(f"{done} of 30", is_last=done == 30)
    assert capsys.readouterr().err.split("\r") == ["", "10 of 30", "20 of 30", "30 of 30\n"]


def test_last_progress_ends_the_line_and_leaves_nothing_of_a_longer_one(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    line = ProgressLine(clock)
    clock.now_s = 1.0
    line.show("9 of 10, at present", is_last=False)
    line.show("10 of 10", is_last=True)
    assert capsys.readouterr().err == "\r9 of 10, at present\r10 of 10           \n"


def test_what_is_done_at_once_shows_no_progress(capsys: pytest.CaptureFixture[str]) -> None:
    ProgressLine(Clock()).show("10 of 10", is_last=True)
    assert capsys.readouterr().err == ""


def test_progress_is_for_those_who_watch(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert progress_line() is None
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr("analogrig.cli.terminal._PROGRESS_S", 0.0)
    show = progress_line("recordings")
    assert show is not None
    show(3, 12)
    assert capsys.readouterr().err == "\r3 of 12 recordings (25%)"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminals(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Terminal, Terminal]]:
    """Standard output and standard error as terminals, in an environment that says nothing of colours."""
    out, err = Terminal(), Terminal()
    monkeypatch.setattr(terminal, "sys", SimpleNamespace(stdout=out, stderr=err))
    for name in ("NO_COLOR", "FORCE_COLOR", "CLICOLOR_FORCE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    yield out, err
    ProgressLine.unfinished = None


@pytest.mark.parametrize(
    ("word", "colour"), [("PASSED", 32), ("CERTIFIED", 32), ("FAILED", 31), ("REFUTED", 31), ("INCONCLUSIVE", 33)]
)
def test_verdict_is_coloured_on_a_terminal(word: str, colour: int, terminals: tuple[Terminal, Terminal]) -> None:
    terminal.show(f"thesis: {word}")
    assert terminals[0].getvalue() == f"thesis: \x1b[{colour}m{word}\x1b[0m\n"


def test_words_that_are_no_verdict_stay_plain(terminals: tuple[Terminal, Terminal]) -> None:
    terminal.show("passed UNFAILED failed")
    assert terminals[0].getvalue() == "passed UNFAILED failed\n"


def test_reason_on_standard_error_is_coloured(terminals: tuple[Terminal, Terminal]) -> None:
    terminal.complain("INCONCLUSIVE: the device reset", 3)
    assert terminals[1].getvalue() == "analogrig: \x1b[33mINCONCLUSIVE\x1b[0m: the device reset\n"


@pytest.mark.parametrize(
    ("environment", "on_terminal", "on_pipe"),
    [
        ({}, True, False),
        ({"NO_COLOR": "1"}, False, False),
        ({"NO_COLOR": ""}, True, False),
        ({"TERM": "dumb"}, False, False),
        ({"NO_COLOR": "1", "FORCE_COLOR": "1"}, False, False),
        ({"TERM": "dumb", "FORCE_COLOR": "1"}, True, True),
        ({"FORCE_COLOR": "0"}, True, False),
        ({"CLICOLOR_FORCE": "1"}, True, True),
    ],
)
def test_environment_decides_about_colour(
    environment: dict[str, str],
    *,
    on_terminal: bool,
    on_pipe: bool,
    terminals: tuple[Terminal, Terminal],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    terminal.show("FAILED")
    pipe = io.StringIO()
    monkeypatch.setattr(terminal, "sys", SimpleNamespace(stdout=pipe, stderr=terminals[1]))
    terminal.show("FAILED")
    assert ["\x1b" in stream.getvalue() for stream in (terminals[0], pipe)] == [on_terminal, on_pipe]


def test_json_is_never_coloured(terminals: tuple[Terminal, Terminal], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    terminal.show_json({"outcome": "FAILED"})
    assert terminals[0].getvalue() == '{"outcome": "FAILED"}\n'


def test_json_has_null_for_numbers_that_are_not_finite(capsys: pytest.CaptureFixture[str]) -> None:
    terminal.show_json({"a": float("nan"), "b": [1.0, (float("inf"),)], "c": {"d": -float("inf")}})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [1.0, [None]], "c": {"d": None}}


@pytest.fixture
def progress(terminals: tuple[Terminal, Terminal]) -> tuple[ProgressLine, Clock]:
    """A line that stands at 9 of 10, and its clock."""
    assert terminals[1].getvalue() == ""
    clock = Clock()
    line = ProgressLine(clock)
    clock.now_s = 2.0
    line.show("9 of 10", is_last=False)
    return line, clock


@pytest.mark.usefixtures("progress")
def test_message_never_continues_a_progress_line(terminals: tuple[Terminal, Terminal]) -> None:
    terminal.show("done")
    terminal.complain("the device reset", 3)
    assert terminals[0].getvalue() == "done\n"
    assert terminals[1].getvalue() == "\r9 of 10\nanalogrig: the device reset\n"


def test_progress_goes_on_below_a_message(
    terminals: tuple[Terminal, Terminal], progress: tuple[ProgressLine, Clock]
) -> None:
    line, clock = progress
    terminal.complain("one sample was lost", 0)
    clock.now_s = 4.0
    line.show("10 of 10", is_last=False)
    line.show("10 of 10", is_last=True)
    assert terminals[1].getvalue() == "\r9 of 10\nanalogrig: one sample was lost\n\r10 of 10\r10 of 10\n"


def test_second_progress_begins_on_a_line_of_its_own(
    terminals: tuple[Terminal, Terminal], progress: tuple[ProgressLine, Clock]
) -> None:
    second = ProgressLine(progress[1])
    progress[1].now_s = 4.0
    second.show("second", is_last=False)
    second.end()
    assert terminals[1].getvalue() == "\r9 of 10\n\rsecond\n"


def test_work_without_a_count_shows_its_seconds(
    terminals: tuple[Terminal, Terminal], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "_PROGRESS_S", 0.01)
    with terminal.show_work("self-test"):
        while "self-test: 0 s" not in terminals[1].getvalue():
            time.sleep(0.001)
    assert terminals[1].getvalue().startswith("\rself-test: 0 s")
    assert terminals[1].getvalue().endswith("\n") and terminals[1].getvalue().count("\n") == 1


def test_work_is_silent_where_nobody_watches(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "_PROGRESS_S", 0.0)
    threads = threading.active_count()
    with terminal.show_work("self-test"):
        assert threading.active_count() == threads
    assert capsys.readouterr() == ("", "")


@pytest.mark.usefixtures("terminals")
def test_progress_needs_a_terminal_that_can_overwrite(monkeypatch: pytest.MonkeyPatch) -> None:
    assert terminal.open_progress_line() is not None
    monkeypatch.setenv("TERM", "dumb")
    assert terminal.open_progress_line() is None


def test_interrupted_run_on_a_terminal_ends_its_progress_first(tmp_path: Path) -> None:
    """A pseudo-terminal, a run at a fraction of real time, Ctrl-C once progress is shown."""
    ours, theirs = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "analogrig.cli",
        "run",
        "--real-time",
        "100",
        "--dut",
        "host",
        "--out",
        f"{tmp_path}",
    ]
    environment = {**os.environ, "TERM": "xterm", "NO_COLOR": "1"}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=theirs, env=environment) as process:
        os.close(theirs)
        shown = b""
        while b"samples" not in shown:
            shown += os.read(ours, 4096)
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(OSError):  # the last writer has closed the terminal
            while more := os.read(ours, 4096):
                shown += more
    os.close(ours)
    lines = shown.decode().replace("\r\n", "\n").splitlines()
    assert process.returncode == 130
    assert [line for line in lines if "analogrig:" in line and not line.startswith("analogrig:")] == []
    assert any(line.startswith("analogrig: INCONCLUSIVE") for line in lines)
