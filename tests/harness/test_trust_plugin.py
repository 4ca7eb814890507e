"""The rule of test_trust.py in pytest: --hil-allow on the command line or conftest.py allow a thing, no file does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.harness.test_pytest_plugin import run, user
from tests.harness.test_trust import (
    _OPEN,
    DEVICES,
    RIGS,
    Bait,
    a_library,
    a_url,
    an_instrument,
    device_file,
    instrument,
    library,
    pytestmark,
    rig_file,
    scenario_of,
    scenario_of_file,
    scenario_on,
)

__all__ = ["instrument", "library", "pytestmark", "user"]
"""Fixtures, and what applies to every test."""

PLAYS = "def test_it(hil_play):\n    hil_play('healthy')\n"


@pytest.fixture
def folder(user: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Working directory, like the fixture of test_trust.py."""
    monkeypatch.setenv("TRUST_WITNESS", str(user.path / "witness"))
    (user.path / "theirs").mkdir()
    with _OPEN:
        yield user.path


def by_ini(bait: Bait, user: pytest.Pytester) -> list[str]:
    """The ini file is where the user is, and its paths are relative to it."""
    name = bait.name.replace("inproc:", "inproc:./theirs/").replace("qemu-m4:", "qemu-m4:theirs/")
    user.makepyfile(PLAYS)
    user.makeini(f"[pytest]\nhil_dut = {name}\n")
    return []


def by_ini_and_file(bait: Bait, user: pytest.Pytester) -> list[str]:
    user.makepyfile(PLAYS)
    user.makeini(f"[pytest]\nhil_dut = {device_file(bait)}\n")
    return []


def by_addopts(bait: Bait, user: pytest.Pytester) -> list[str]:
    name = bait.name.replace("inproc:", "inproc:./theirs/").replace("qemu-m4:", "qemu-m4:theirs/")
    user.makepyfile(PLAYS)
    user.makeini(f"[pytest]\naddopts = --hil-dut {name}\n")
    return []


def by_file_of_addopts(bait: Bait, user: pytest.Pytester) -> list[str]:
    name = bait.name.replace("inproc:", "inproc:./theirs/").replace("qemu-m4:", "qemu-m4:theirs/")
    user.makepyfile(PLAYS)
    (user.path / "words").write_text(f"--hil-dut={name}\n")
    user.makeini("[pytest]\naddopts = @words\n")
    return []


def by_addopts_that_hide(bait: Bait, user: pytest.Pytester) -> list[str]:
    name = bait.name.replace("inproc:", "inproc:./theirs/").replace("qemu-m4:", "qemu-m4:theirs/")
    user.makepyfile(PLAYS)
    user.makeini(f"[pytest]\naddopts = --hil-dut={name} -o addopts=\n")
    return []


def by_device_file(bait: Bait, user: pytest.Pytester) -> list[str]:
    user.makepyfile(PLAYS)
    return ["--hil-dut", device_file(bait)]


def by_scenario(bait: Bait, user: pytest.Pytester) -> list[str]:  # noqa: ARG001
    return ["--hil-scenario-dir", str(Path(scenario_of(bait, Path())).parent)]


def by_scenario_and_file(bait: Bait, user: pytest.Pytester) -> list[str]:  # noqa: ARG001
    return ["--hil-scenario-dir", str(Path(scenario_of_file(bait, Path())).parent)]


def by_rig_file(bait: Bait, user: pytest.Pytester) -> list[str]:
    user.makepyfile(PLAYS)
    return ["--hil-dut", "inproc", "--hil-rig", rig_file(bait)]


def by_ini_of_rig(bait: Bait, user: pytest.Pytester) -> list[str]:
    user.makepyfile(PLAYS)
    user.makeini(f"[pytest]\nhil_rig = {rig_file(bait)}\n")
    return ["--hil-dut", "inproc"]


def by_scenario_on_rig(bait: Bait, user: pytest.Pytester) -> list[str]:  # noqa: ARG001
    return ["--hil-dut", "inproc", "--hil-scenario-dir", str(Path(scenario_on(bait)).parent)]


def check(user: pytest.Pytester, bait: Bait, arguments: list[str]) -> None:
    """Refused in one line, and opened if it is allowed."""
    refused = run(user, *arguments)
    said = [line for line in refused.stdout.lines if "which no file may order: pass --hil-allow" in line]
    assert said and all(bait.allow in line for line in said)
    assert refused.ret == pytest.ExitCode.TESTS_FAILED
    assert not bait.witness.happened()
    run(user, *arguments, "--hil-allow", bait.allow)
    assert bait.witness.happened()


DEVICE_ROUTES = (
    by_ini,
    by_ini_and_file,
    by_addopts,
    by_file_of_addopts,
    by_addopts_that_hide,
    by_device_file,
    by_scenario,
    by_scenario_and_file,
)
RIG_ROUTES = (by_rig_file, by_ini_of_rig, by_scenario_on_rig)


@pytest.mark.parametrize(
    ("kind", "route"),
    [
        *((kind, by_scenario) for kind in DEVICES),
        *((a_url, route) for route in DEVICE_ROUTES if route is not by_scenario),
        (a_library, by_ini),
    ],
)
def test_what_a_file_names_as_device_is_opened_in_pytest_only_if_it_is_allowed(
    kind: Callable[..., Bait],
    route: Callable[[Bait, pytest.Pytester], list[str]],
    user: pytest.Pytester,
    folder: Path,
    library: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bait = kind(folder, monkeypatch, library)
    check(user, bait, route(bait, user))


@pytest.mark.parametrize(
    ("kind", "route"),
    [
        *((kind, by_scenario_on_rig) for kind in RIGS),
        *((an_instrument, route) for route in RIG_ROUTES if route is not by_scenario_on_rig),
    ],
)
def test_what_a_file_names_as_rig_is_opened_in_pytest_only_if_it_is_allowed(
    kind: Callable[..., Bait],
    route: Callable[[Bait, pytest.Pytester], list[str]],
    user: pytest.Pytester,
    folder: Path,
    request: pytest.FixtureRequest,
) -> None:
    bait = kind(folder, lambda: request.getfixturevalue("instrument"))
    check(user, bait, [*route(bait, user), *(word.replace("--allow", "--hil-allow") for word in bait.besides)])


@pytest.fixture
def bait(
    user: pytest.Pytester,  # noqa: ARG001
    folder: Path,
    library: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Bait:
    return a_library(folder, monkeypatch, library)


def test_conftest_allows_what_the_ini_file_names(user: pytest.Pytester, bait: Bait) -> None:
    arguments = by_ini(bait, user)
    user.makeconftest(f"def pytest_configure(config):\n    config.option.hil_allow = ['{bait.allow}']\n")
    run(user, *arguments)
    assert bait.witness.happened()


@pytest.mark.parametrize("addopts", ["--hil-allow {}", "--hil-allow={} -o addopts=", "@words"])
def test_ini_file_allows_nothing(addopts: str, user: pytest.Pytester, bait: Bait) -> None:
    user.makepyfile(PLAYS)
    (user.path / "words").write_text(f"--hil-allow={bait.allow}\n")
    user.makeini(f"[pytest]\naddopts = {addopts.format(bait.allow)}\n")
    result = run(user, "--hil-dut", device_file(bait))
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*addopts: --hil-allow is for the command line or conftest.py*"])
    assert not bait.witness.happened()


@pytest.mark.parametrize("through", ["--hil-dut", "ANALOGRIG_DUT", "parameter"])
def test_name_on_the_command_line_in_the_environment_or_in_the_code_is_enough(
    through: str,
    user: pytest.Pytester,
    bait: Bait,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = "inproc:theirs/evil.so"
    user.makepyfile(PLAYS)
    if through == "ANALOGRIG_DUT":
        monkeypatch.setenv(through, name)
    if through == "parameter":
        mark = f"@pytest.mark.parametrize('hil_dut', ['{name}'], indirect=True)\n"
        user.makepyfile(f"import pytest\n{mark}{PLAYS.replace('hil_play)', 'hil_dut, hil_play)')}")
    run(user, *(("--hil-dut", name) if through == "--hil-dut" else ()))
    assert bait.witness.happened()
