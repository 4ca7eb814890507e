"""The C under libFuzzer and sanitizers of addresses and undefined behaviour: a minute each in CI, briefly elsewhere."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from estimator_c.fuzz.fuzz import LONGEST_INPUT, build, fuzz

SECONDS = 60 if os.environ.get("ANALOGRIG_CI") else 3


@pytest.mark.timeout(SECONDS + 120)
@pytest.mark.parametrize("target", LONGEST_INPUT)
def test_no_input_breaks_what_is_promised(tmp_path: Path, target: str) -> None:
    if shutil.which("clang") is None:
        pytest.skip("no clang here: apt-get install clang libclang-rt-14-dev")
    tried, log = fuzz(build(target, tmp_path), SECONDS, "-seed=1")
    assert tried > 1000 * SECONDS, log[-4000:]
