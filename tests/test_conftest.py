"""Nothing may skip in CI: tests/conftest.py turns a skip into a failure there, and only there."""

from __future__ import annotations

from pathlib import Path

import pytest

SKIPS = """
    import pytest

    def test_that_skips():
        pytest.skip("no oscilloscope: apt-get install oscilloscope")

    @pytest.mark.skipif(True, reason="no soldering iron")
    def test_that_is_marked():
        pass

    @pytest.mark.xfail(reason="a known fault")
    def test_that_is_expected_to_fail():
        raise ValueError
"""


@pytest.fixture
def suite(pytester: pytest.Pytester) -> pytest.Pytester:
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text())
    pytester.makepyfile(test_skips=SKIPS)
    pytester.makepyfile(test_module="import pytest\npytest.importorskip('no_such_module_anywhere')")
    return pytester


def test_skips_are_skips_outside_ci(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ANALOGRIG_CI", raising=False)
    suite.runpytest_subprocess().assert_outcomes(skipped=3, xfailed=1)


def test_skips_fail_in_ci_and_keep_their_reason(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ANALOGRIG_CI", "1")
    result = suite.runpytest_subprocess("--continue-on-collection-errors")
    result.assert_outcomes(failed=1, errors=2, xfailed=1)  # of the module, and of the marker
    result.stdout.fnmatch_lines_random(["*no oscilloscope: apt-get install oscilloscope (ANALOGRIG_CI is set*"])
    assert result.ret == pytest.ExitCode.TESTS_FAILED
