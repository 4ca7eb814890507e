"""For all tests: skip those whose tools are missing, name the tools, and end with a table of them.

Any other skip is a failure; ANALOGRIG_CI=1 allows none.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, TypeVar

import pytest

from tests import tools
from tests.wheels import environment, sdist, users_environment, wheel

if TYPE_CHECKING:
    from playwright.sync_api import Browser

FOREIGN = ("MAKE", "MFLAGS", "PYTHONPATH", "PYTEST_ADDOPTS", "PYTEST_PLUGINS")
"""Beginnings of the variables of the make around this session, or of its user's other work: children see none."""
for name in [name for name in os.environ if name.startswith(FOREIGN)]:
    del os.environ[name]

collect_ignore = ["user_repository"]  # test_packaging.py runs it where it belongs
if not tools.silverbox_file().is_file():
    collect_ignore.append("harness/test_silverbox.py")  # it needs data that is not part of the repository
if "ANALOGRIG_WHEELS" not in os.environ:
    collect_ignore.append("test_manylinux.py")

__all__ = ["environment", "sdist", "users_environment", "wheel"]  # the fixtures of tests/wheels.py


Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


NOTHING_MAY_SKIP = os.environ.get("ANALOGRIG_CI") == "1"
LACKING = pytest.StashKey[tuple[str, ...]]()
SLOWEST = (
    *(
        "test_readme_commands",
        "test_shipped_properties",
        "test_accuracy",
        "test_drawn_plays",
        "test_claimed",
        "test_qemu",
    ),
    *("test_pytest_plugin", "test_planted_defects", "test_bit_exact", "test_evidence", "test_compiler", "test_cost"),
    *("test_foreign_repositories", "test_guest", "test_fault_runs", "test_end_to_end", "test_mutation", "test_spice"),
    *(
        "test_real_rig",
        "test_reference_device",
        "test_trust_plugin",
        "test_tried_advice",
        "test_coverage",
        "test_dating",
    ),
    *("test_calibration", "test_conformance", "test_packaging", "test_docs", "test_kills", "test_detection"),
)
"""Modules to start with, in order: one that is left for the end has a processor to itself while others are idle."""


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "tools(*names): programs or files of tests/tools.py that the test needs")
    config.addinivalue_line("markers", "heavy: takes more than 5 s of processor time; make test-heavy runs it")
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            # Under nohup or in the background. Children inherit an ignored signal, but not a handler: with one, a test
            # can interrupt its child, and this process still ignores the signal.
            signal.signal(number, lambda *_: None)


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what each test needs, by its fixtures too; skip those whose tools are missing; the slowest come first.

    A wheel takes 8 s, so that its tests are heavy.
    """
    for item in items:
        for fixture in getattr(item, "fixturenames", ()):
            if fixture == "wheel":
                item.add_marker(pytest.mark.heavy)
            if fixture in tools.FIXTURES:
                item.add_marker(pytest.mark.tools(*tools.FIXTURES[fixture]))
        needed = [name for marker in item.iter_markers("tools") for name in marker.args]
        try:
            lacking = tools.missing(needed)
        except KeyError as error:
            raise pytest.UsageError(f"{item.nodeid} needs {error}: tests/tools.py has no such tool") from error
        if lacking:
            item.stash[LACKING] = lacking
            item.add_marker(pytest.mark.skip(reason=tools.reason(lacking)))
    rank = {name: number for number, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(SLOWEST)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.skipped and LACKING in item.stash:
        lacking = item.stash[LACKING]
        report.lacking = list(lacking)  # type: ignore[attr-defined]  # xdist passes it on
    return _without_skips(report)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return _without_skips((yield))


def _without_skips(report: Report) -> Report:
    if report.outcome != "skipped" or hasattr(report, "wasxfail"):
        return report
    if hasattr(report, "lacking") and not NOTHING_MAY_SKIP:
        return report
    text = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
    allowed = "ANALOGRIG_CI=1: nothing may skip" if NOTHING_MAY_SKIP else "only a missing tool may skip a test"
    report.outcome = "failed"
    report.longrepr = f"{text} ({allowed})"
    return report


@pytest.hookimpl(wrapper=True, tryfirst=True)  # after the summaries of pytest
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Generator[None, None, None]:
    """End with one table: how many tests wait for which tool."""
    yield
    reports = (report for category in terminalreporter.stats.values() for report in category)
    waiting = [report.lacking for report in reports if hasattr(report, "lacking")]
    if waiting:
        terminalreporter.section("missing tools")
        for line in tools.table(waiting):
            terminalreporter.line(line)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """For ``tests.browser.Watched``."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # Without a sandbox, since tests may run as root; the pages under test are our own.
        browser = playwright.chromium.launch(executable_path=tools.found("chromium"), args=["--no-sandbox"])
        yield browser
        browser.close()
