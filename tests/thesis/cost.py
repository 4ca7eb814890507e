"""Instructions a sample of each of the thesis's schemes: the C on x86-64, counted by callgrind.

    .venv/bin/python -m tests.thesis.cost       # some four minutes; writes harness/analogrig_thesis/cost.json

One process runs the samples of Fig. 5.7 once, another a hundred times: the difference is the estimator and some ten
instructions for copying a sample. The figures depend on the compiler, not on the load of the machine.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from analogrig.devices.library import Estimator
from analogrig_thesis.chapter5 import NOISY, SEED, TRACKING, circuit_schemes, play_alone

RESULT = Path("harness/analogrig_thesis/cost.json")
REPEATS = 100


def executed(key: str, repeats: int) -> int:
    """Count the instructions of a whole process.

    :raises subprocess.CalledProcessError: valgrind failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "callgrind"
        tool = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}"]
        command = [*tool, sys.executable, "-m", "tests.thesis.cost", key, str(repeats)]
        subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONHASHSEED": "0"})
        (total,) = re.findall(r"^summary: (\d+)", out.read_text(), flags=re.MULTILINE)
    return int(total)


def run(key: str, repeats: int) -> None:
    """Run one scheme over the repeated samples of Fig. 5.7: the counted process."""
    samples = play_alone(NOISY, TRACKING, SEED)
    config = circuit_schemes(samples.m_per_unit)[key]
    Estimator(config).run(np.tile(samples.u, repeats), np.tile(samples.y, repeats))


def main() -> None:
    compiler = subprocess.run(["gcc", "--version"], check=True, capture_output=True, text=True).stdout.splitlines()[0]
    once = executed("rls", 1)
    samples = (REPEATS - 1) * TRACKING.samples
    counted = {key: round((executed(key, REPEATS) - once) / samples) for key in circuit_schemes(1e-4)}
    RESULT.write_text(json.dumps({"compiler": compiler, "instructions": counted}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        run(sys.argv[1], int(sys.argv[2]))
    else:
        main()
