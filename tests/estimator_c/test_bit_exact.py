"""The estimates are the same bits wherever and however the core is compiled (estimator_c/evidence/bit_exact.py)."""

from __future__ import annotations

import re

import pytest

from estimator_c.evidence import bit_exact

pytestmark = pytest.mark.tools(*bit_exact.PACKAGES)


@pytest.fixture(scope="module")
def expected() -> str:
    return bit_exact.outcome(bit_exact.BUILDS[0])


@pytest.mark.parametrize("build", bit_exact.QUICK, ids=lambda build: build.name)
def test_every_build_gives_the_same_bits(build: bit_exact.Build, expected: str) -> None:
    assert bit_exact.outcome(build) == expected


def test_the_run_is_long_enough_and_holds_what_may_happen(expected: str) -> None:
    counts = {name: int(value) for name, value in re.findall(r"(\w+) (\d+) ", expected)}
    assert counts["steps"] >= 100_000
    assert counts["nan"] == counts["violations"] == 0
    assert min(counts[name] for name in ("alarms", "slips", "refused", "missing", "refreshes")) > 0
    assert counts["diagnoses"] >= 24


def test_a_fused_multiplication_would_be_noticed(expected: str) -> None:
    aarch64 = next(build for build in bit_exact.QUICK if build.name.startswith("aarch64"))
    assert bit_exact.outcome(aarch64, contraction="-ffp-contract=fast") != expected
