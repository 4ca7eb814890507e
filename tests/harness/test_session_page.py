"""The page of a session: all runs below a folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from analogrig.cli import main
from analogrig.errors import ConfigurationError
from analogrig.output import NOT_ENDED, OutputFolder
from analogrig_session import session_page
from analogrig_session.session_page import find_session, render
from tests.harness.commands import output_of
from tests.harness.reported import Page

CHANGE = {"latency": 3, "bound": 2, "result": "detected"}

VERDICT: dict[str, Any] = {
    "format": "analogrig-verdict",
    "version": 1,
    "scenario": "thesis",
    "rig": "emulator",
    "dut": {"name": "mine"},
    "seed": 7,
    "samples": 1800,
    "outcome": "passed",
    "changes": [CHANGE, {**CHANGE, "latency": 9, "bound": 4}],
    "false_alarms": [],
    "recorded_by": {"started": "2026-01-01T12:00:00+00:00", "commit": None, "devices": [{"sha256": "0123456789ab"}]},
}


@pytest.fixture
def add(tmp_path: Path) -> Callable[..., Path]:
    def added(name: str, *, page: bool = True, **changes: Any) -> Path:
        folder = tmp_path / name
        folder.mkdir(parents=True)
        (folder / "verdict.json").write_text(json.dumps({**VERDICT, **changes}))
        if page:
            (folder / "report.html").write_text("the page")
        return folder

    return added


def found(folder: Path) -> session_page.RunList:
    return find_session(folder, folder / "session.html")


def test_row_of_a_run_is_that_of_its_verdict(add: Callable[..., Path], tmp_path: Path) -> None:
    add("a run/<1>", false_alarms=[3, 4])
    page = Page(render(found(tmp_path)))
    figures = ["7", "1,800", "2", "0", "2", "2.00"]
    assert [
        "2026-01-01 12:00:00",
        "✓ passed",
        "a run/<1>",
        "thesis",
        "emulator",
        "mine",
        "01234567",
        "",
        *figures,
    ] in page.rows
    assert 'href="a%20run/%3C1%3E/report.html"' in page.source
    assert "<1>" not in page.source


def test_runs_are_in_the_order_of_their_start_and_plotted_if_several(add: Callable[..., Path], tmp_path: Path) -> None:
    late = {**VERDICT["recorded_by"], "started": "2026-01-02T12:00:00+00:00", "devices": [{"sha256": "fedcba98"}]}
    missed = [{"latency": None, "bound": 4, "result": "missed"}]
    add("a", recorded_by=late, outcome="failed", changes=missed)
    add("b", page=False)
    add("c", scenario="slow")
    runs = found(tmp_path).runs
    assert [(run.folder, run.ratio, run.missed, run.build) for run in runs] == [
        ("b", 2.0, 0, "01234567"),
        ("c", 2.0, 0, "01234567"),
        ("a", None, 1, "fedcba98"),
    ]
    source = render(found(tmp_path))
    assert source.count("<svg") == 1  # slow was played once
    assert "thesis on emulator, device mine" in source
    assert '<section class="outcome failed"' in source
    assert "b/report.html" not in source
    assert source == render(found(tmp_path))


def test_verdict_of_another_command_is_no_run(add: Callable[..., Path], tmp_path: Path) -> None:
    add("run")
    other = add("thesis")
    (other / "verdict.json").write_text('{"format": "analogrig-verdict", "version": 1, "outcome": "passed"}')
    assert [run.folder for run in found(tmp_path).runs] == ["run"]


def test_run_that_has_not_ended_is_inconclusive_and_earlier_results_are_left_out(
    add: Callable[..., Path], tmp_path: Path
) -> None:
    add("run")
    add("run.previous")
    with OutputFolder(tmp_path / "killed", "analogrig run", "2026-01-01T12:00:00+00:00"):
        session = found(tmp_path)
    assert [run.folder for run in session.runs] == ["run"]
    assert session.unread == ()
    assert session.unended == (f"{tmp_path}/killed/verdict.json: inconclusive: {NOT_ENDED}",)
    assert '<section class="outcome inconclusive"' in render(session)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"\xff",
        b"[" * 100_000,
        b'{"format": "analogrig-verdict", "version": 2}',
        json.dumps({**VERDICT, "outcome": "<script>"}).encode(),
        json.dumps({**VERDICT, "changes": None}).encode(),
        json.dumps({**VERDICT, "changes": [{**CHANGE, "latency": "NaN", "bound": 1e309}]}).encode(),
        json.dumps({**VERDICT, "seed": "x"}).encode(),
        json.dumps({**VERDICT, "recorded_by": [1]}).encode(),
        json.dumps({**VERDICT, "dut": []}).encode(),
    ],
    ids=lambda content: content[:20],
)
def test_file_that_is_no_verdict_is_one_line_beside_the_others(
    add: Callable[..., Path], tmp_path: Path, content: bytes
) -> None:
    add("good")
    (add("bad") / "verdict.json").write_bytes(content)
    lines = output_of("report", str(tmp_path)).splitlines()
    assert len(lines) == 3
    assert lines[0] == "passed       good: 0 of 2 missed, 2.00 bounds, 0 false alarms"
    assert lines[1].startswith(f"not read: {tmp_path}/bad/verdict.json: not a verdict")
    assert lines[2] == f"page: {tmp_path}/session.html"
    assert "bad/verdict.json" in (tmp_path / "session.html").read_text()


def test_line_of_a_file_that_is_no_verdict_names_a_cure_and_no_python(add: Callable[..., Path], tmp_path: Path) -> None:
    (add("bad") / "verdict.json").write_bytes(b"[")
    line, _ = output_of("report", str(tmp_path), status=2).splitlines()
    place = f"{tmp_path}/bad/verdict.json"
    assert line == f"not read: {place}: not a verdict of analogrig: run the command again, or remove it"


def test_folder_with_runs_that_have_not_ended_alone_is_inconclusive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with OutputFolder(tmp_path / "killed", "analogrig run", "2026-01-01T12:00:00+00:00"):
        assert main(["report", str(tmp_path)]) == 3
    assert capsys.readouterr().out.startswith(f"no result: {tmp_path}/killed/verdict.json: inconclusive: {NOT_ENDED}")


def test_folder_without_a_run_or_with_too_many_is_refused(
    add: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigurationError, match="no such folder"):
        found(tmp_path / "absent")
    with pytest.raises(ConfigurationError, match="holds no run"):
        found(tmp_path)
    add("a")
    add("b")
    monkeypatch.setattr(session_page, "MOST_RUNS", 1)
    with pytest.raises(ConfigurationError, match="more than 1 runs"):
        found(tmp_path)


def test_page_may_stand_elsewhere_and_links_to_the_runs(add: Callable[..., Path], tmp_path: Path) -> None:
    add("runs/a")
    page = tmp_path / "site" / "index.html"
    shown = json.loads(output_of("report", str(tmp_path / "runs"), "--out", str(page), "--json"))
    assert [run["folder"] for run in shown["runs"]] == ["a"]
    assert 'href="../runs/a/report.html"' in page.read_text()
    assert main(["report", str(tmp_path / "runs"), "--out", str(tmp_path)]) == 2
