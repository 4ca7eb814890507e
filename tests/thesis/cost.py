"""What a sample costs with each of the thesis's schemes: instructions of the C on x86-64, counted by callgrind.

    .venv/bin/python -m tests.thesis.cost       # some four minutes; writes harness/analogrig_thesis/cost.json

Counted are the instructions of a whole process that runs the samples of Fig. 5.7 once, and of one that runs them a
hundred times over: the difference is the estimator and some ten instructions of copying a sample. The figures depend on
the compiler, not on the load of the machine.
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

from analogrig.devices.estimator import Estimator
from analogrig_thesis.circuit import NOISY, SEED, TRACKING, circuit_schemes, codes

RESULT = Path("harness/analogrig_thesis/cost.json")
REPEATS = 100


def executed(key: str, repeats: int) -> int:
    """Instructions of a whole process.

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
    """What is counted."""
    u, y, _, m_per_code = codes(NOISY, TRACKING, SEED)
    (scheme,) = (each for each in circuit_schemes(m_per_code) if each.key == key)
    Estimator(scheme.config).run(np.tile(u, repeats), np.tile(y, repeats))


def main() -> None:
    compiler = subprocess.run(["gcc", "--version"], check=True, capture_output=True, text=True).stdout.splitlines()[0]
    once = executed("rls", 1)
    samples = (REPEATS - 1) * TRACKING.samples
    counted = {each.key: round((executed(each.key, REPEATS) - once) / samples) for each in circuit_schemes(1e-4)}
    RESULT.write_text(json.dumps({"compiler": compiler, "instructions": counted}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        run(sys.argv[1], int(sys.argv[2]))
    else:
        main()
