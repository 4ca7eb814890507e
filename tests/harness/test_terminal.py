"""What a command shows while it works."""

from __future__ import annotations

import sys

import pytest

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
