"""For all tests: one that needs what a machine lacks skips and says so; in CI, where all is installed, none may."""

from __future__ import annotations

import os
from collections.abc import Generator
from typing import TypeVar

import pytest

collect_ignore = ["user_repository"]  # test_packaging.py runs it where it belongs

Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return _without_skips((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return _without_skips((yield))


def _without_skips(report: Report) -> Report:
    expected_to_fail = hasattr(report, "wasxfail")
    if os.environ.get("ANALOGRIG_CI") and report.outcome == "skipped" and not expected_to_fail:
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"{reason} (ANALOGRIG_CI is set: nothing may skip)"
    return report
