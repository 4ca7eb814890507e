"""A session that uses nothing of the plugin runs as if analogrig were not installed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

THEIRS = "def test_theirs():\n    pass\n"
OURS = "def test_ours(hil_rig, hil_dut, hil_runs_dir, hil_profile):\n    pass\n"


@pytest.fixture
def repository(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """Somebody's repository, in an environment without settings of ours."""
    for variable in [name for name in os.environ if name.startswith("ANALOGRIG_")]:
        monkeypatch.delenv(variable)
    return pytester


PLUGINS = ("analogrig.testing.plugin", "_hypothesis_pytestplugin", "xdist.plugin")
"""All that a session in this process loads: it must not depend on what else is installed."""


def run(repository: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    chosen = [word for name in (*PLUGINS, "no:cacheprovider") for word in ("-p", name)]
    return repository.runpytest_inprocess("--disable-plugin-autoload", *chosen, *arguments)


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("ANALOGRIG_RIG", "no-such"),
        ("ANALOGRIG_RIG", "/"),
        ("ANALOGRIG_DUT", "no-such"),
        ("ANALOGRIG_DUT", "can:"),
        ("ANALOGRIG_RUNS_DIR", "/dev/null/runs"),
        ("ANALOGRIG_HIL_PROFILE", "tea"),
    ],
)
def test_nonsense_in_the_environment_fails_nothing_but_tests_of_ours(
    repository: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    monkeypatch.setenv(variable, value)
    repository.makepyfile(test_theirs=THEIRS)
    run(repository, "-W", "error").assert_outcomes(passed=1)
    repository.makepyfile(test_ours=OURS)
    result = run(repository)
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines([f"{variable}: *"])
    assert "Traceback" not in result.stdout.str()


def test_scenario_folder_in_the_environment_collects_nothing(
    repository: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    repository.mkdir("suite").joinpath("config.toml").write_text("[theirs]\n")
    repository.makepyfile(test_theirs=THEIRS)
    for folder in ("suite", "nowhere"):
        monkeypatch.setenv("ANALOGRIG_SCENARIO_DIR", folder)
        run(repository).assert_outcomes(passed=1)


def test_file_called_build_in_the_working_directory_does_no_harm(repository: pytest.Pytester) -> None:
    repository.path.joinpath("build").write_text("#!/bin/sh\n")
    repository.makepyfile(test_theirs=THEIRS)
    run(repository).assert_outcomes(passed=1)


def test_scenario_folder_of_the_ini_file_that_is_not_there_fails_as_one_test(repository: pytest.Pytester) -> None:
    repository.makeini("[pytest]\nhil_scenario_dir = nowhere")
    repository.makepyfile(test_theirs=THEIRS)
    result = run(repository)
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*tox.ini: hil_scenario_dir: nowhere is no folder"])
    run(repository, "test_theirs.py").assert_outcomes(passed=1)


def test_environment_of_the_process_is_left_as_it_is(repository: pytest.Pytester) -> None:
    repository.makeconftest(
        """
        import os

        BEFORE = dict(os.environ)

        def pytest_unconfigure():
            os.environ.pop("PYTEST_CURRENT_TEST", None)
            assert dict(os.environ) == BEFORE
        """
    )
    repository.makepyfile(
        """
        import os

        def test_theirs():
            assert not [name for name in os.environ if name.startswith("ANALOGRIG_")]
        """
    )
    run(repository, "--hil-profile", "nightly").assert_outcomes(passed=1)


def test_nothing_is_written(repository: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setenv("TMPDIR", str(repository.mkdir("temporary")))
    monkeypatch.setenv("ANALOGRIG_DUT", "serial:/dev/null")
    theirs = repository.mkdir("theirs")
    (theirs / "test_theirs.py").write_text("def test_theirs():\n    assert False\n")
    before = sorted(repository.path.rglob("*"))
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-n", "2"]
    done = subprocess.run(command, cwd=theirs, capture_output=True, text=True, check=False)
    assert done.returncode == pytest.ExitCode.TESTS_FAILED, done.stdout
    assert sorted(repository.path.rglob("*")) == before


def test_tests_of_hypothesis_without_our_fixtures_are_left_alone(repository: pytest.Pytester) -> None:
    repository.makepyfile(
        """
        from hypothesis import given, settings, strategies

        INNER = []

        @settings(max_examples=1, database=None)
        @given(strategies.just(1))
        def test_theirs(one):
            assert test_theirs.hypothesis.inner_test is INNER[0]

        INNER.append(test_theirs.hypothesis.inner_test)
        """
    )
    run(repository).assert_outcomes(passed=1)


@pytest.mark.parametrize(
    ("setting", "examples"), [("", 15), ("ini", 300), ("environment", 5000), ("command line", 300)]
)
def test_profile_of_the_session_decides_how_much_a_property_tries(
    repository: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, setting: str, examples: int
) -> None:
    if setting == "ini":
        repository.makeini("[pytest]\nhil_profile = nightly")
    if setting in ("environment", "command line"):
        monkeypatch.setenv("ANALOGRIG_HIL_PROFILE", "soak")
    repository.makepyfile(
        f"""
        from analogrig.testing.strategies import profile

        CHOSEN = profile()

        def test_it():
            assert CHOSEN.max_examples == {examples}
        """
    )
    run(repository, *(["--hil-profile=nightly"] if setting == "command line" else [])).assert_outcomes(passed=1)


def test_wrong_profile_of_the_environment_spoils_only_the_file_that_asks(
    repository: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ANALOGRIG_HIL_PROFILE", "tea")
    repository.makepyfile(
        test_theirs=THEIRS, test_ours="from analogrig.testing.strategies import profile\n\nCHOSEN = profile()\n"
    )
    result = run(repository, "--continue-on-collection-errors")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["ANALOGRIG_HIL_PROFILE: must be one of ci, nightly, soak, not 'tea'"])


def test_device_named_in_the_environment_leaves_the_scheduler_alone(
    repository: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ANALOGRIG_DUT", "serial:/dev/null")
    repository.makeconftest(
        """
        def pytest_xdist_make_scheduler(config, log):
            from xdist.scheduler import LoadScheduling

            print("<theirs>")
            return LoadScheduling(config, log)
        """
    )
    repository.makepyfile(test_theirs=THEIRS, test_ours="def test_ours(hil_dut):\n    pass\n")
    result = run(repository, "-s", "-n", "2")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*<theirs>*", "device serial:/dev/null: one worker owns it: leave out -n, or *"])


def test_start_loads_only_the_modules_of_the_plugin() -> None:
    collect = "pytest.main(['--collect-only', '-q', '-p', 'no:cacheprovider', *sys.argv[1:], '/dev/null'])"
    listing = f"import sys, pytest; {collect}; print(*sorted(sys.modules))"

    def loaded(*arguments: str) -> set[str]:
        done = subprocess.run(
            [sys.executable, "-c", listing, *arguments], capture_output=True, text=True, check=True, cwd="/"
        )
        return set(done.stdout.splitlines()[-1].split())

    without = loaded("-p", "no:analogrig")
    names = loaded() - without
    assert "analogrig.testing.plugin" in names
    assert "analogrig.testing.plugin" not in without
    assert {name for name in names if not name.startswith("analogrig.testing.plugin")} <= {
        "analogrig",
        "analogrig.rigs",
        "analogrig.testing",
        "analogrig.lazy",
    }


def test_every_name_of_the_plugin_carries_its_prefix() -> None:
    from analogrig.testing import plugin
    from analogrig.testing.plugin.hil_options import OPTIONS

    fixtures = {
        name for name, value in vars(plugin).items() if type(value).__name__ == "FixtureFunctionDefinition"
    } or {name for name, value in vars(plugin).items() if hasattr(value, "_pytestfixturefunction")}
    assert fixtures == {
        "hil_bench",
        "hil_dut",
        "hil_play",
        "hil_profile",
        "hil_rig",
        "hil_runs_dir",
        "hil_scenario_dir",
    }
    assert all(option.flag.startswith("--hil-") and option.name.startswith("hil_") for option in OPTIONS)


def test_help_names_every_option_with_its_source(repository: pytest.Pytester) -> None:
    result = run(repository, "--help")
    text = " ".join(" ".join(result.outlines).split())
    for told in ("--hil-rig=RIG", "--hil-dut=DUT", "ANALOGRIG_RIG, ini hil_rig; default: emulator", "ci (15)"):
        assert told in text
    assert Path.cwd() == repository.path
