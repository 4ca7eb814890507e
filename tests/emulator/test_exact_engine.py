"""The engine without its fast parts passes the emulator's main tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
ENGINE = TESTS.parents[1] / "emulator" / "analogrig_emulator" / "engine"
SUITES = ("engine", "engine_steps", "engine_watch", "engine_limiter", "look_ahead", "streams")
OF_FAST_PARTS = "bits_do_not_depend or steps_slow_states_alone or makes_numbers_otherwise"
"""Tests of these suites about the fast parts themselves."""

RUN = """
import sys
from pathlib import Path
import pytest
from analogrig_emulator.engine import binding

exact = binding.load_from(Path(sys.argv[1]))
assert not any(hasattr(exact, name) for name in binding.FAST)
binding.load = lambda: exact
sys.exit(pytest.main(sys.argv[2:]))
"""


@pytest.mark.heavy
def test_the_engine_passes_its_tests_without_its_fast_parts(tmp_path: Path) -> None:
    engine, sources = tmp_path / "_engine.so", sorted(map(str, ENGINE.glob("*.c")))
    flags = (
        "-std=c99",
        "-O2",
        "-ffp-contract=off",
        "-fPIC",
        "-shared",
        "-DENGINE_FAST=0",
        "-Wall",
        "-Wextra",
        "-Werror",
    )
    subprocess.run(["cc", *flags, "-o", str(engine), *sources, "-lm"], check=True)
    suites = [str(TESTS / f"test_{suite}.py") for suite in SUITES]
    options = ["-q", "-n", "0", "-p", "no:cacheprovider", "-m", "not heavy", "-k", f"not ({OF_FAST_PARTS})"]
    command = [sys.executable, "-c", RUN, str(engine), *options, *suites]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=TESTS.parents[1])
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
