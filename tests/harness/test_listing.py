"""``analogrig list``: every name that a command takes, with a line on it."""

from __future__ import annotations

import json
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest

from analogrig.cli import main
from analogrig.cli.listing import KINDS
from analogrig.entry_points import EntryPoint
from analogrig.rigs.description import KINDS as RIG_KINDS
from analogrig.rigs.description import describe
from analogrig.rigs.rig import RigDescription

FIXTURES = Path(__file__).parents[2] / "fixtures"
FILES = sorted(FIXTURES.glob("*/*.toml"))


def listed(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, list[dict[str, Any]]]:
    assert main(["list", *arguments, "--json"]) == 0
    found: dict[str, list[dict[str, Any]]] = json.loads(capsys.readouterr().out)
    return found


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ANALOGRIG_RIGS", raising=False)


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_every_shipped_file_describes_itself_in_one_line(path: Path) -> None:
    description = tomllib.loads(path.read_text(encoding="utf-8"))["description"]
    assert description.isprintable() and 10 <= len(description) <= 90


@pytest.mark.parametrize("kind", KINDS)
def test_every_shipped_file_is_listed_with_its_description(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    files = [path for path in FILES if path.parent.name == kind]
    rows = {row["name"]: row["description"] for row in listed(capsys, kind)[kind]}
    assert files
    for path in files:
        assert rows[path.stem] == tomllib.loads(path.read_text(encoding="utf-8"))["description"]


def test_kinds_of_devices_are_listed_as_they_are_spelt(capsys: pytest.CaptureFixture[str]) -> None:
    rows = listed(capsys, "devices")["devices"]
    names = {row["name"] for row in rows}
    assert names >= {
        "inproc[:LIBRARY]",
        "qemu-m4[:ELF]",
        "serial:URL[?exchange=...&baud=...]",
        "can:INTERFACE[/CHANNEL][?KEY=VALUE&...]",
    }
    assert all(row["description"] for row in rows)


def test_kinds_of_rigs_that_need_keys_are_not_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert "real" in RIG_KINDS.added
    names = [row["name"] for row in listed(capsys, "rigs")["rigs"]]
    assert "real" not in names
    for name in names:
        describe(name)


@pytest.mark.parametrize("kind", KINDS)
def test_descriptions_have_no_marks_of_docstrings(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert not [row for row in listed(capsys, kind)[kind] if "``" in row["description"] or ":`" in row["description"]]


def test_kind_of_a_rig_that_needs_no_key_is_listed_without_marks(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Flat(RigDescription):
        """A rig of ``zeros``, as :class:`Rig` is one."""

        kind: Literal["flat"] = "flat"
        name: str

    module = SimpleNamespace(Flat=Flat)
    monkeypatch.setitem(sys.modules, "flat_rigs", module)
    monkeypatch.setitem(RIG_KINDS._added, "flat", EntryPoint("flat", "analogrig.rigs", "flat_rigs:Flat", "flat"))
    rows = {row["name"]: row["description"] for row in listed(capsys, "rigs")["rigs"]}
    assert rows["flat"] == "A rig of `zeros`, as `Rig` is one."


def test_rigs_of_a_rigs_file_come_first_and_replace_shipped_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = (
        '[rig.bench]\nkind = "emulator"\ndescription = "by\\u001b the \\n window"\n[rig.emulator]\nkind = "emulator"\n'
    )
    (tmp_path / "rigs.toml").write_text(own)
    rows = listed(capsys, "rigs")["rigs"]
    assert rows[0] == {"name": "bench", "description": "by the window", "file": "rigs.toml"}
    assert [row["file"] for row in rows if row["name"] == "emulator"] == ["rigs.toml"]


def test_broken_rigs_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rigs.toml").write_text("[rig\n")
    assert main(["list", "rigs"]) == 2
    assert capsys.readouterr().err.startswith("analogrig: rigs.toml: not valid TOML")


def test_all_kinds_are_listed_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.endswith(":") and not line.startswith(" ")] == [f"{kind}:" for kind in KINDS]
    assert "  healthy              front suspension, 20,000 samples without any change" in lines


def test_unknown_kind_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["list", "cars"])
    assert ended.value.code == 2
    assert "cars" in capsys.readouterr().err
