"""Completion of the command line in bash: the shell's own function is run on words as a user types them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from analogrig.cli import main
from analogrig.cli.listing import SHELLS

pytestmark = pytest.mark.tools("bash")

COMMAND = Path(sys.executable).with_name("analogrig")

COMPLETE = """
complete() { :; }  # not interactive: nothing is registered
compopt() { return 1; }
source /dev/stdin <<< "$SCRIPT"
COMP_LINE="$*" COMP_POINT=${#COMP_LINE} COMP_TYPE=9 COMP_WORDBREAKS=$' \\t\\n"\\'><=;|&(:'
_python_argcomplete "$COMMAND"
printf '%s\\n' "${COMPREPLY[@]}"
"""


def completed(line: str, capsys: pytest.CaptureFixture[str], **environment: str) -> list[str]:
    """Completions by bash after ``line``, whose last word is being typed."""
    assert main(["completion", "bash"]) == 0
    done = subprocess.run(
        ["bash", "-c", COMPLETE, "bash", line],
        env={**os.environ, "SCRIPT": capsys.readouterr().out, "COMMAND": str(COMMAND), **environment},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return [word.strip() for word in done.stdout.split("\n") if word.strip()]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("analogrig ca", {"calibrate", "campaign"}),
        ("analogrig run --re", {"--real-time", "--report-interval"}),
        ("analogrig run --scenario the", {"thesis", "thesis-free-running"}),
        ("analogrig run --rig emulator-s", {"emulator-skewed", "emulator-slow"}),
        ("analogrig replay run.npz --dut qemu-", {"qemu-m3", "qemu-m4", "qemu-m7", "qemu-f405"}),
        ("analogrig certify --dut me", {"mean-between-faults"}),
        ("analogrig campaign p", {"pot-plane"}),
        ("analogrig compare-rigs emulator emulator-i", {"emulator-ideal"}),
        ("analogrig emulate --program b", {"bump-stop"}),
        ("analogrig completion z", {"zsh"}),
    ],
)
def test_word_is_completed(line: str, offered: set[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert set(completed(line, capsys)) == offered


def test_files_are_completed_beside_names(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "thermal.toml").touch()
    assert set(completed("analogrig run --scenario the", capsys)) == {"thesis", "thesis-free-running", "thermal.toml"}
    assert completed("analogrig judge ther", capsys) == ["thermal.toml"]


def test_rigs_of_the_users_rigs_file_are_completed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "lab.toml").write_text('[rig.Bench-2]\nkind = "emulator"\n[rig.cellar]\nkind = "emulator"\n')
    assert completed("analogrig doctor --rig B", capsys, ANALOGRIG_RIGS="lab.toml") == ["Bench-2"]


def test_broken_rigs_file_completes_nothing_and_prints_nothing(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (folder / "rigs.toml").write_text("no = toml = at all")
    done = subprocess.run(
        [COMMAND, "completion", "bash"], stdout=subprocess.PIPE, text=True, check=True, stdin=subprocess.DEVNULL
    )
    environment = {**os.environ, "SCRIPT": done.stdout, "COMMAND": str(COMMAND)}
    subprocess.run(["bash", "-c", COMPLETE, "bash", "analogrig run --rig e"], env=environment, check=True)
    printed = capfd.readouterr()
    assert (printed.out.strip(), printed.err) == ("", "")


@pytest.mark.parametrize("shell", SHELLS)
def test_every_shell_gets_a_script_that_completes_analogrig(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    assert "analogrig" in capsys.readouterr().out


def test_script_is_valid_bash(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    subprocess.run(["bash", "-n"], input=capsys.readouterr().out, text=True, check=True)
