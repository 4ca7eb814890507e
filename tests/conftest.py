"""For all tests: one that needs what a machine lacks skips and says so; in CI, where all is installed, none may."""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, TypeVar

import pytest

from tests.wheels import distributions, environment, users_environment, wheel

if TYPE_CHECKING:
    from playwright.sync_api import Browser

collect_ignore = ["user_repository"]  # test_packaging.py runs it where it belongs

__all__ = ["distributions", "environment", "users_environment", "wheel"]  # the fixtures of tests/wheels.py

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


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """For ``tests.browser.Watched``."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("needs a browser: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # Without a sandbox, since tests may run as root; the pages under test are our own.
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()
