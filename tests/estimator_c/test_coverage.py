"""Every line and branch of core, isolation and fit is reached by a test through its public header."""

from __future__ import annotations

import pytest

from estimator_c.evidence.coverage import measured


@pytest.mark.heavy
@pytest.mark.tools("gcc", "gcov")
def test_every_line_and_branch_of_core_isolation_and_fit_is_tested() -> None:
    coverage = measured()
    assert coverage.lines > 700
    assert coverage.branches > 450
    assert coverage.missed_lines == []
    assert coverage.missed_branches == []
