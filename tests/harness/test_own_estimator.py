"""The tutorial on an estimator of one's own, pasted into an empty folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from analogrig.cli import main

PAGE = (Path(__file__).parents[2] / "harness/docs/tutorials/your-estimator.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def test_own_estimator_is_judged_as_the_page_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    script = "".join(blocks("sh")).replace("make test", "true")  # test_new.py runs these tests
    done = subprocess.run(
        ["sh", "-c", f"set -e\n{script}\nmake estimator.so CFLAGS='-O2 -Wall -Wextra -Werror'"],
        cwd=tmp_path, env={**os.environ, "PATH": path, "MAKEFLAGS": "", "PYTHON": sys.executable},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    monkeypatch.chdir(tmp_path / "my_estimator")
    (command,) = re.findall(r"^\$ analogrig (run .*)$", PAGE, re.MULTILINE)
    assert main(command.split()) == 1
    (summary,) = blocks("text")
    assert summary in capsys.readouterr().out
