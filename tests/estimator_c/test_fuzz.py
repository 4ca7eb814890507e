"""The C under libFuzzer and sanitizers of addresses and undefined behaviour.

Some seconds of each target. `make fuzz` takes its time.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from estimator_c.fuzz.fuzz import LONGEST_INPUT, build, fuzz

RUNS = {"fuzz_est": 40_000, "fuzz_serial": 4_000, "fuzz_can": 4_000, "fuzz_slcan": 4_000}
"""Inputs by target."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all targets, which share most of the C."""
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.heavy
@pytest.mark.tools("clang")
@pytest.mark.parametrize("target", RUNS)
def test_no_input_breaks_what_is_promised(folder: Path, target: str) -> None:
    tried, log = fuzz(build(target, folder), f"-runs={RUNS[target]}", "-seed=1")
    assert tried >= RUNS[target], log[-4000:]


def test_every_target_is_run() -> None:
    assert RUNS.keys() == LONGEST_INPUT.keys()
