"""A sample of the soak that ``make hostile`` is: what one in fifty cases shows is found with a probability of 97 %."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.heavy

ROOT = Path(__file__).parents[3]


def test_mutated_files_end_in_one_line_in_time_and_in_little_memory() -> None:
    """In a process of its own, which forks and so must have no threads."""
    counts = {"--recordings": "65", "--files": "50", "--logs": "30", "--keys": "30"}
    command = [sys.executable, "-m", "tests.soak.mutated", *(word for pair in counts.items() for word in pair)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=False)
    assert ran.returncode == 0, ran.stdout[-5000:] + ran.stderr[-2000:]
    assert "\nall " in ran.stdout
