"""The estimates are the same bits wherever and however the core is compiled (estimator_c/evidence/bit_exact.py)."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from estimator_c.evidence import bit_exact

pytestmark = [pytest.mark.tools(*bit_exact.PACKAGES), pytest.mark.heavy]


@pytest.fixture(scope="module")
def expected() -> str:
    return bit_exact.outcome(bit_exact.BUILDS[0])


@pytest.mark.parametrize("build", bit_exact.QUICK, ids=lambda build: build.name)
def test_every_build_gives_the_same_bits(build: bit_exact.Build, expected: str) -> None:
    assert bit_exact.outcome(build) == expected


def test_the_run_is_long_enough_and_holds_what_may_happen(expected: str) -> None:
    counts = {name: int(value) for name, value in re.findall(r"(\w+) (\d+) ", expected)}
    assert counts["steps"] >= 250_000
    assert counts["nan"] == counts["violations"] == 0
    assert min(counts[name] for name in ("alarms", "slips", "refused", "missing", "refreshes")) > 0
    assert counts["diagnoses"] >= 24
    assert counts["hypotheses"] >= 50_000


def test_a_fused_multiplication_would_be_noticed(expected: str) -> None:
    aarch64 = next(build for build in bit_exact.QUICK if build.name.startswith("aarch64"))
    assert bit_exact.outcome(aarch64, contraction="-ffp-contract=fast") != expected


@pytest.mark.parametrize(
    ("header", "constant", "value"),
    [
        ("est_correlation.h", "EST_SMOOTH", "0.0F"),  # no second hypothesis
        ("est_correlation.h", "EST_PARTIAL_MAX", "0.97F"),
        ("est_scale.h", "EST_DISPERSION_MAX", "11.0F"),
        ("est_scale.h", "EST_INFLATION_DECAY", "0.9999F"),
        ("est_scale.h", "EST_VALIDATION_MAX_N", "121U"),
        ("est_scale.h", "EST_BUDGET_N", "150U"),
    ],
)
def test_an_altered_constant_of_the_scale_or_the_second_reading_changes_the_bits(
    expected: str, tmp_path: Path, header: str, constant: str, value: str
) -> None:
    core = shutil.copytree(bit_exact.CORE, tmp_path / "core")
    text, altered_n = re.subn(rf"(?m)^(#define {constant}) .*", rf"\1 {value}", (core / header).read_text())
    assert altered_n == 1
    (core / header).write_text(text)
    assert bit_exact.outcome(bit_exact.BUILDS[0], core=core) != expected
