"""Provenance of results: what says it, where, and what does not depend on it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import platform
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from analogrig import identity as identity_module
from analogrig.campaigns.tally import Results
from analogrig.cli import main
from analogrig.config import fixtures
from analogrig.devices.library import LIBRARY
from analogrig.errors import RecordingError
from analogrig.identity import DeviceFile, Identity
from analogrig.judging.verdict import judge
from analogrig.reporting import render
from analogrig.run import Run

ROOT = Path(__file__).parents[2]

SOMEBODY = Identity(
    analogrig="9.9",
    commit="0123456789ab+dirty",
    command="analogrig run --dut '<script>'",
    started="2001-02-03T04:05:06+00:00",
    host="elsewhere",
    python="3.99",
    devices=(DeviceFile("mine", "/nowhere/mine.so", "ab" * 32),),
)


def git(folder: Path, *words: str) -> str:
    command = ["git", "-c", "user.name=n", "-c", "user.email=e@x", "-c", "commit.gpgsign=false", *words]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    table: dict[str, Any] = json.loads(capsys.readouterr().out)
    return table


def test_run_says_what_made_it_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = Path(shutil.copy(LIBRARY, tmp_path / "mine one.so"))
    begun = datetime.now(UTC).replace(microsecond=0)
    words = ["run", "--dut", f"inproc:{mine}", "--out", str(tmp_path / "out"), "--json"]
    assert main(words) == 0
    told = printed(capsys)["identity"]
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert (told["analogrig"], told["host"]) == (version, platform.node())
    assert told["python"] == ".".join(map(str, sys.version_info[:3]))
    assert told["command"] == f"analogrig run --dut 'inproc:{mine}' --out {tmp_path / 'out'} --json"
    assert begun <= datetime.fromisoformat(told["started"]) <= datetime.now(UTC)
    assert datetime.fromisoformat(told["started"]).utcoffset() == timedelta(0)
    (device,) = told["devices"]
    assert device == {
        "device": f"inproc:{mine}",
        "path": str(mine),
        "sha256": hashlib.sha256(mine.read_bytes()).hexdigest(),
    }
    recorded = Run.load(tmp_path / "out" / "run.npz").conditions.identity
    assert recorded is not None and recorded.as_table() == told
    assert json.loads((tmp_path / "out" / "verdict.json").read_text())["identity"] == told
    page = (tmp_path / "out" / "report.html").read_text()
    assert all(text in page for text in (device["sha256"], told["started"], told["commit"] or "unknown"))


def test_judge_says_who_judged_and_who_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--dut", "inproc", "--out", str(tmp_path / "run"), "--json"]) == 0
    played = printed(capsys)["identity"]
    assert main(["judge", str(tmp_path / "run" / "run.npz"), "--out", str(tmp_path / "judge"), "--json"]) == 0
    told = printed(capsys)
    assert told["recorded_by"] == played
    assert told["identity"]["command"].startswith("analogrig judge ")
    again = Run.load(tmp_path / "judge" / "run.npz").conditions.identity
    assert again is not None and again.as_table() == played


def test_neither_hash_nor_verdict_depends_on_identity(recorded_thesis: Path) -> None:
    run = Run.load(recorded_thesis)
    other = run.with_identity(SOMEBODY)
    assert other.theta_hash() == run.theta_hash()
    assert judge(other) == judge(run)


def test_identity_survives_the_file_and_is_escaped_on_the_page(recorded_thesis: Path, tmp_path: Path) -> None:
    run = Run.load(recorded_thesis).with_identity(SOMEBODY)
    run.save(tmp_path / "run.npz")
    assert Run.load(tmp_path / "run.npz").conditions.identity == SOMEBODY
    page = render(run, judge(run))
    assert SOMEBODY.command not in page
    assert "analogrig run --dut &#39;&lt;script&gt;&#39;" in page
    assert "9.9, commit 0123456789ab+dirty, Python 3.99" in page


def test_older_recordings_load_without(tmp_path: Path) -> None:
    shipped = fixtures() / "recordings" / "fig-5.7.npz"
    run = Run.load(shipped)
    assert run.conditions.identity is None
    run.save(tmp_path / "again.npz")
    assert b'"identity": null' not in (tmp_path / "again.npz").read_bytes()
    assert main(["judge", str(shipped), "--out", str(tmp_path / "out")]) in (0, 1)
    assert json.loads((tmp_path / "out" / "verdict.json").read_text())["recorded_by"] is None


@pytest.mark.parametrize("wrong", ["mine", {"analogrig": "1"}, {**SOMEBODY.as_table(), "user": "me"}])
def test_identity_that_is_none_is_one_line(recorded_thesis: Path, tmp_path: Path, wrong: object) -> None:
    class Wrong:
        def as_table(self) -> object:
            return wrong

    run = Run.load(recorded_thesis)
    conditions = dataclasses.replace(run.conditions, identity=Wrong())  # type: ignore[arg-type]
    dataclasses.replace(run, conditions=conditions).save(tmp_path / "run.npz")
    with pytest.raises(RecordingError, match=r"run\.npz: the header of the recording: identity: [^\n]+$"):
        Run.load(tmp_path / "run.npz")


# ---------------------------------------------------------------------------------------------------------- the commit


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A repository that holds the package as ours does, with one commit."""
    package = tmp_path / "harness" / "analogrig"
    package.mkdir(parents=True)
    (package / "file").write_text("committed")
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        git(tmp_path, *words)
    monkeypatch.setattr(identity_module, "_PACKAGE", package)
    monkeypatch.setattr(identity_module, "STAMP", package / "_commit.txt")
    identity_module.commit.cache_clear()
    yield tmp_path
    identity_module.commit.cache_clear()


def test_commit_is_that_of_the_checkout(checkout: Path) -> None:
    assert identity_module.commit() == git(checkout, "rev-parse", "HEAD")[:12]


def test_changed_checkout_is_dirty_and_new_files_do_not_count(checkout: Path) -> None:
    (checkout / "new").write_text("of the user")
    head = git(checkout, "rev-parse", "HEAD")[:12]
    assert identity_module.commit_of(checkout) == head
    (checkout / "harness" / "analogrig" / "file").write_text("changed")
    assert identity_module.commit_of(checkout) == f"{head}+dirty"


def test_repository_of_a_hook_is_not_ours(
    checkout: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a hook git sets GIT_DIR to the repository of the user."""
    other = tmp_path_factory.mktemp("other")
    git(other, "init", "-q")
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    assert len(identity_module.commit_of(checkout)) == 12


def test_installed_package_says_the_commit_of_its_wheel(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its environment may lie within a repository of the user, whose commit says nothing."""
    package = checkout / ".venv" / "lib" / "site-packages" / "analogrig"
    package.mkdir(parents=True)
    monkeypatch.setattr(identity_module, "_PACKAGE", package)
    monkeypatch.setattr(identity_module, "STAMP", package / "_commit.txt")
    assert identity_module.commit() == ""
    identity_module.commit.cache_clear()
    (package / "_commit.txt").write_text("0123456789ab\n")
    assert identity_module.commit() == "0123456789ab"


# -------------------------------------------------------------------------------------------------------- more results


def test_campaign_is_the_same_whoever_played_it_and_says_who(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "spec.toml").write_text("trials = 4\nchunk = 2\nsamples = 700\n")
    monkeypatch.chdir(tmp_path)
    words = ["campaign", "spec.toml", "--workers", "1", "--json", "--out"]

    def interrupted(*_: object) -> Iterator[object]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("analogrig.campaigns.workers.ThisProcess.play", interrupted)
        assert main([*words, "one.sqlite"]) == 130
    for name in ("one.sqlite", "two.sqlite"):
        assert main([*words, name]) in (0, 3)
        told = json.loads(capsys.readouterr().out)
        sessions = Results.load(Path(name)).played_by
        assert told["played_by"] == [each.as_table() for each in sessions]
        assert len(sessions) == {"one.sqlite": 2, "two.sqlite": 1}[name]
        assert sessions[-1].command.endswith(name)
        assert sessions[-1].devices == (DeviceFile.of("inproc", LIBRARY),)
        page = Path(name).with_suffix(".html").read_text()
        assert page.count(sessions[-1].command) == len(sessions)
    assert Path("one.json").read_bytes() == Path("two.json").read_bytes()


def test_other_commands_say_it_with_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["netlist", "--json", "--out", str(tmp_path / "deck.cir")]) == 0
    assert printed(capsys)["identity"]["command"].startswith("analogrig netlist --json")


def junit_suite(pytester: pytest.Pytester) -> ET.Element:
    return ET.parse(pytester.path / "out.xml").getroot()[0]  # noqa: S314 - written by pytest a moment ago


PLAYED = """
def test_played(hil_play):
    assert hil_play("thesis").passes()

def test_other():
    pass

def test_failed(hil_play):
    hil_play("thesis")
    assert False
"""


@pytest.mark.parametrize("options", [[], ["-n", "1"]])
def test_junit_says_it_of_each_play_and_of_the_suite_and_a_recording_has_it(
    pytester: pytest.Pytester, options: list[str]
) -> None:
    pytester.makepyfile(PLAYED)
    pytester.runpytest_subprocess("--hil-dut", "inproc", "--junitxml", "out.xml", *options).assert_outcomes(
        passed=2, failed=1
    )
    suite = junit_suite(pytester)
    of_suite = {each.get("name"): each.get("value") for each in suite.findall("properties/property")}
    cases = {case.get("name"): case for case in suite.findall("testcase")}
    of_case = {each.get("name"): each.get("value") for each in cases["test_played"].findall("properties/property")}
    assert cases["test_other"].find("properties") is None
    assert of_case["device_sha256"] == hashlib.sha256(LIBRARY.read_bytes()).hexdigest()
    for told in (of_suite, of_case):
        assert told["analogrig"] == identity_module.version()
        assert "--hil-dut inproc --junitxml out.xml" in str(told["command"])
        assert datetime.fromisoformat(str(told["started"])).utcoffset() == timedelta(0)
    assert "device_sha256" not in of_suite
    (recording,) = (pytester.path / "build" / "runs").rglob("run.npz")  # of the one that failed
    made_by = Run.load(recording).conditions.identity
    assert made_by is not None and made_by.command.startswith("pytest ")


def test_junit_of_a_session_that_plays_nothing_stays_as_it_is(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("def test_other(): pass")
    pytester.runpytest_inprocess("-p", "no:xdist", "--junitxml", "out.xml").assert_outcomes(passed=1)
    assert junit_suite(pytester).find("properties") is None
