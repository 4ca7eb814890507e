"""The C under libFuzzer and sanitizers of addresses and undefined behaviour.

In CI ten seconds for the core, three for each kind of line; briefly elsewhere. `make fuzz` takes its time.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from estimator_c.fuzz.fuzz import LONGEST_INPUT, build, fuzz

IN_CI = bool(os.environ.get("ANALOGRIG_CI"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all targets, which share most of the C."""
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.tools("clang")
@pytest.mark.parametrize("target", LONGEST_INPUT)
def test_no_input_breaks_what_is_promised(folder: Path, target: str) -> None:
    seconds = 10 if IN_CI and target == "fuzz_est" else 3
    tried, log = fuzz(build(target, folder), seconds, "-seed=1")
    assert tried > 1000 * seconds, log[-4000:]
