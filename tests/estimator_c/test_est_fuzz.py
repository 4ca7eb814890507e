"""Core and isolation under libFuzzer and sanitizers of addresses and undefined behaviour: a minute in CI."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ESTIMATOR = Path(__file__).parents[2] / "estimator_c"
SECONDS = 60 if os.environ.get("ANALOGRIG_CI") else 5
SANITIZED = ["-g", "-O1", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=undefined"]


@pytest.mark.timeout(SECONDS + 120)
def test_any_configuration_and_any_samples_leave_the_invariants_standing(tmp_path: Path) -> None:
    if shutil.which("clang") is None:
        pytest.skip("no clang here: apt-get install clang libclang-rt-14-dev")
    program = tmp_path / "fuzz_est"
    parts = [ESTIMATOR / "core", ESTIMATOR / "isolation"]
    sources = [ESTIMATOR / "fuzz" / "fuzz_est.c", *(path for part in parts for path in sorted(part.glob("*.c")))]
    command = ["clang", "-std=c99", *SANITIZED, "-ffp-contract=off", "-DEST_NC_MAX=2U"]
    command += [f"-I{part}" for part in parts]
    subprocess.run([*command, *map(str, sources), "-o", str(program)], check=True)
    options = [f"-max_total_time={SECONDS}", "-max_len=512", "-seed=1", "-print_final_stats=1", "-rss_limit_mb=1024"]
    done = subprocess.run([str(program), *options], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    executed = re.search(r"number_of_executed_units: (\d+)", done.stderr)
    assert executed is not None
    assert int(executed[1]) > 1000 * SECONDS
