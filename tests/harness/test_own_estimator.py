"""The tutorial on an estimator of one's own, pasted into an empty folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from analogrig.cli import main

PAGE = Path(__file__).parents[2] / "harness/docs/tutorials/your-estimator.md"


def pasted() -> str:
    """The shell blocks of the page, in order."""
    return "".join(re.findall(r"^```sh\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL))


@pytest.mark.tools("sed")
def test_own_estimator_is_judged_as_the_page_states(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    script = f"set -e\n{pasted()}"
    done = subprocess.run(
        ["sh", "-c", script], cwd=tmp_path, env=os.environ | {"PATH": path}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "my_device").is_file()
    device = f"inproc:{tmp_path / 'my_device.so'}"
    assert main(["run", "--dut", device, "--out", str(tmp_path / "mine")]) == 1
    assert "missed 4 of 4 changes" in capsys.readouterr().out
    assert main(["run", "--dut", device, "--scenario", "healthy", "--out", str(tmp_path / "healthy")]) == 0
