"""Tests wait for tools by name, and skip for nothing else: the hooks of tests/conftest.py, each in its own session."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from estimator_c.evidence import bit_exact, cost
from tests import bare, tools
from tests.wheels import CHECKOUT

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

WAITING = """
    import pytest

    @pytest.fixture
    def ngspice():
        raise AssertionError("the fixture of a skipped test is not set up")

    @pytest.mark.tools("cppcheck")
    def test_of_a_fixture(ngspice):
        pass

    @pytest.mark.parametrize("number", range(3))
    @pytest.mark.tools("qemu-arm", "cppcheck")
    def test_of_two_programs(number):
        pass

    def test_of_nothing():
        pass
"""


@pytest.fixture
def suite(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text())
    monkeypatch.setenv("PYTHONPATH", str(CHECKOUT))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # what else is installed takes time, and may talk
    monkeypatch.delenv("ANALOGRIG_CI", raising=False)
    return pytester


@pytest.fixture
def skipping(suite: pytest.Pytester) -> pytest.Pytester:
    suite.makepyfile(test_skips=SKIPS)
    suite.makepyfile(test_module="import pytest\npytest.importorskip('no_such_module_anywhere')")
    return suite


@pytest.fixture
def waiting(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """A session on a machine that has no program at all."""
    monkeypatch.setenv("PATH", str(suite.mkdir("no_programs")))
    suite.makepyfile(WAITING)
    return suite


@pytest.mark.parametrize(
    ("setting", "says"), [("0", "only a missing tool may skip a test"), ("1", "ANALOGRIG_CI=1: nothing may skip")]
)
def test_other_skips_fail_and_keep_their_reason(
    setting: str, says: str, skipping: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ANALOGRIG_CI", setting)
    result = skipping.runpytest_subprocess("--continue-on-collection-errors")
    result.assert_outcomes(failed=1, errors=2, xfailed=1)  # of the module, and of the marker
    result.stdout.fnmatch_lines_random([f"*no oscilloscope: apt-get install oscilloscope ({says})"])
    assert result.ret == pytest.ExitCode.TESTS_FAILED


@pytest.mark.parametrize("options", [(), ("-p", "xdist.plugin", "-n", "2")], ids=["alone", "xdist"])
def test_missing_tools_are_named_by_test_and_in_a_table(options: tuple[str, ...], waiting: pytest.Pytester) -> None:
    result = waiting.runpytest_subprocess("-rs", *options)
    result.assert_outcomes(passed=1, skipped=4)
    result.stdout.fnmatch_lines(
        [
            "*= missing tools =*",
            " tests  tool      provided by",
            "     4  cppcheck  cppcheck",
            "     3  qemu-arm  qemu-user",
            "     1  ngspice   ngspice",
            "",
            "4 tests wait for a tool. All tools: make tools",
            "These alone: apt-get install --no-install-recommends cppcheck ngspice qemu-user",
        ],
        consecutive=True,
    )
    result.stdout.fnmatch_lines_random(
        [
            "SKIPPED*needs qemu-arm, cppcheck: apt-get install --no-install-recommends qemu-user cppcheck",
            "SKIPPED*needs cppcheck, ngspice: apt-get install --no-install-recommends cppcheck ngspice",
        ]
    )


def test_missing_tool_fails_a_test_where_nothing_may_skip(
    waiting: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ANALOGRIG_CI", "1")
    result = waiting.runpytest_subprocess()
    result.assert_outcomes(passed=1, errors=4)
    result.stdout.fnmatch_lines(["*= missing tools =*"])


def test_marker_selects_the_tests_that_need_a_tool_by_a_fixture_too(waiting: pytest.Pytester) -> None:
    waiting.runpytest_subprocess("-m", "tools").assert_outcomes(skipped=4, deselected=1)


def test_children_see_nothing_of_the_make_and_the_pytest_around(
    suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite.makepyfile("""
        import os, subprocess, sys

        def test_child():
            print("<", *sorted({*os.environ} & {"MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES", "PYTHONPATH",
                "PYTEST_ADDOPTS", "PYTEST_PLUGINS"}), ">")
    """)
    for name in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES"):
        monkeypatch.setenv(name, "w")
    monkeypatch.setenv("PYTEST_ADDOPTS", "-v")
    result = suite.runpytest_subprocess("-s")
    result.stdout.fnmatch_lines(["*test_child < >*"])


def test_tool_that_is_not_in_the_list_is_refused(suite: pytest.Pytester) -> None:
    suite.makepyfile("import pytest\n@pytest.mark.tools('sextant')\ndef test_it(): pass")
    result = suite.runpytest_subprocess()
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*test_it needs 'sextant': tests/tools.py has no such tool"])


def test_children_of_a_session_under_nohup_can_be_interrupted(suite: pytest.Pytester) -> None:
    """A shell that starts pytest with ``nohup ... &`` leaves SIGINT and SIGHUP ignored; children inherit that."""
    suite.makepyfile("""
        import signal, subprocess, sys

        def test_child():
            program = "import signal, time; print(flush=True); time.sleep(600)"
            for number in (signal.SIGHUP, signal.SIGINT):
                with subprocess.Popen([sys.executable, "-c", program], stdout=-1, stderr=-1) as child:
                    child.stdout.readline()
                    child.send_signal(number)
                assert child.returncode == -number
    """)
    ignore = "[signal.signal(each, signal.SIG_IGN) for each in (signal.SIGHUP, signal.SIGINT)]"
    ignoring = f"import os, signal, sys; {ignore}; os.execv(sys.argv[1], sys.argv[1:])"
    command = [sys.executable, "-c", ignoring, sys.executable, "-m", "pytest", "-q"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("tool", [*tools.PACKAGES, *tools.BUILT])
def test_every_tool_of_the_list_is_waited_for(tool: str) -> None:
    fixtures = [fixture for fixture, names in tools.FIXTURES.items() if tool in names]
    modules = [
        *(CHECKOUT / "tests" / "soak" / "can_guest").glob("*.py"),
        *(CHECKOUT / "tests").rglob("test_*.py"),
        *(CHECKOUT / "estimator_c" / "evidence").glob("*.py"),
    ]
    texts = [path.read_text(encoding="utf-8") for path in modules if path != Path(__file__)]
    assert any(f'"{tool}"' in text for text in texts) or fixtures


def test_continuous_integration_calls_the_commands_of_the_readme_as_they_stand() -> None:
    lines = (CHECKOUT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert bare.commands() == ["make run", "make test"]
    assert [line for line in lines if line.startswith("make")][1:3] == bare.commands()  # the first: make tools
    assert not [line for line in lines if "=" in line or line.startswith(("export", "unset"))]


@pytest.mark.parametrize("packages", [bit_exact.PACKAGES, cost.PACKAGES], ids=["bit_exact", "cost"])
def test_programs_of_the_evidence_have_the_same_packages_in_the_list(packages: dict[str, str]) -> None:
    assert {name: tools.PACKAGES[name].removesuffix(" libclang-rt-dev") for name in packages} == packages


def test_built_file_is_missing_by_its_compiler_or_by_its_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    firmware = tools.Built((tmp_path / "absent.elf",), "firmware", "arm-none-eabi-gcc")
    monkeypatch.setitem(tools.BUILT, "firmware", firmware)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert tools.missing(["firmware", "arm-none-eabi-gcc"]) == ("arm-none-eabi-gcc",)
    (tmp_path / "arm-none-eabi-gcc").touch(mode=0o755)
    assert tools.missing(["firmware", "arm-none-eabi-gcc"]) == ("firmware",)
    assert tools.reason(["firmware"]) == "needs firmware: make firmware"
