"""An estimator of one's own, as harness/README.md says it is brought: copied and pasted into an empty folder."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from analogrig.cli import main

CHECKOUT = Path(__file__).parents[2]
README = CHECKOUT / "harness" / "README.md"


def pasted(section: str) -> list[str]:
    """The shell commands of the section, block by block."""
    text = README.read_text(encoding="utf-8").partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    commands = re.findall(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [each.replace("CLONE", str(CHECKOUT)).replace(".venv/bin/python", sys.executable) for each in commands]


def test_own_estimator_is_judged_as_the_readme_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sources, state, estimator, build, *_ = pasted("Your own estimator")
    script = f"set -e\n{sources}\n{state}\n{estimator}\n{build}"
    subprocess.run(["sh", "-c", script], cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "my_device").is_file()
    device = f"inproc:{tmp_path / 'my_device.so'}"
    assert main(["run", "--dut", device, "--out", str(tmp_path / "mine")]) == 1
    assert "missed 4 of 4 changes" in capsys.readouterr().out
    assert main(["run", "--dut", device, "--scenario", "healthy", "--out", str(tmp_path / "healthy")]) == 0
