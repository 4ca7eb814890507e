"""The rule of test_trust.py in pytest: --hil-allow on the command line or conftest.py allow a thing, no file does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import analogrig.testing.properties.claimed
import analogrig.testing.properties.conversed
import analogrig.testing.properties.experiments  # noqa: F401 - a session in this process forgets what it imports itself
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
    lose_patience,
    pytestmark,
    scenario_of,
    scenario_of_file,
    scenario_on,
    written,
)

__all__ = ["instrument", "library", "pytestmark", "user"]
"""Fixtures, and what applies to every test."""

PLAYS = "def test_it(hil_play):\n    hil_play('short.toml')\n"


@pytest.fixture
def folder(user: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Working directory, like the fixture of test_trust.py."""
    monkeypatch.setenv("TRUST_WITNESS", str(user.path / "witness"))
    (user.path / "theirs").mkdir()
    with _OPEN:
        yield user.path


ROUTES: dict[str, tuple[str, tuple[str, ...]]] = {
    "ini": ("hil_dut = {name}", ()),
    "ini and file": ("hil_dut = {file}", ()),
    "addopts": ("addopts = --hil-dut {name}", ()),
    "file of addopts": ("addopts = @words", ()),
    "addopts that hide": ("addopts = --hil-dut={name} -o addopts=", ()),
    "device file": ("", ("--hil-dut", "{file}")),
    "rig file": ("", ("--hil-dut", "inproc", "--hil-rig", "{file}")),
    "ini of rig": ("hil_rig = {file}", ("--hil-dut", "inproc")),
}
"""Line of the ini file, and arguments, by which a device or a rig is named."""

SCENARIO_ROUTES: dict[str, Callable[[Bait], str]] = {
    "scenario": lambda bait: scenario_of(bait, Path()),
    "scenario and file": lambda bait: scenario_of_file(bait, Path()),
    "scenario on rig": scenario_on,
}


def arguments_of(route: str, bait: Bait, user: pytest.Pytester) -> list[str]:
    """Write the files of a route; return the arguments of pytest."""
    if route in SCENARIO_ROUTES:
        device = ("--hil-dut", "inproc") if route == "scenario on rig" else ()
        return [*device, "--hil-scenario-dir", str(Path(SCENARIO_ROUTES[route](bait)).parent)]
    name = bait.name.replace("inproc:", "inproc:./theirs/")
    file = written("named.toml", bait.toml)
    ini, words = ROUTES[route]
    user.makepyfile(PLAYS)
    (user.path / "words").write_text(f"--hil-dut={name}\n")
    user.makeini("[pytest]\n" + ini.format(name=name, file=file))
    return [word.format(file=file) for word in words]


def check(user: pytest.Pytester, bait: Bait, arguments: list[str]) -> None:
    """Refused in one line, and opened if it is allowed."""
    refused = run(user, *arguments)
    said = [line for line in refused.stdout.lines if "which no file may order: pass --hil-allow" in line]
    assert said and all(bait.allow in line for line in said)
    assert refused.ret == pytest.ExitCode.TESTS_FAILED
    assert not bait.witness.happened()
    run(user, *arguments, "--hil-allow", bait.allow)
    assert bait.witness.happened()


OF_RIGS = ("rig file", "ini of rig")


@pytest.mark.parametrize(
    ("kind", "route"),
    [
        *((kind, "scenario") for kind in DEVICES),
        *((a_url, route) for route in (*ROUTES, "scenario and file") if route not in OF_RIGS),
        (a_library, "ini"),
    ],
)
def test_what_a_file_names_as_device_is_opened_in_pytest_only_if_it_is_allowed(
    kind: Callable[..., Bait],
    route: str,
    user: pytest.Pytester,
    folder: Path,
    library: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lose_patience(monkeypatch)
    bait = kind(folder, monkeypatch, library)
    check(user, bait, arguments_of(route, bait, user))


@pytest.mark.parametrize(
    ("kind", "route"),
    [*((kind, "scenario on rig") for kind in RIGS), *((an_instrument, route) for route in OF_RIGS)],
)
def test_what_a_file_names_as_rig_is_opened_in_pytest_only_if_it_is_allowed(
    kind: Callable[..., Bait], route: str, user: pytest.Pytester, folder: Path, request: pytest.FixtureRequest
) -> None:
    bait = kind(folder, lambda: request.getfixturevalue("instrument"))
    besides = [word.replace("--allow", "--hil-allow") for word in bait.besides]
    check(user, bait, [*arguments_of(route, bait, user), *besides])


def test_device_of_a_scenario_that_a_test_passes_on_is_opened_only_if_it_is_allowed(
    user: pytest.Pytester, folder: Path, library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bait = a_library(folder, monkeypatch, library)
    scenario = scenario_of(bait, Path())
    user.makepyfile(f"""
        import pytest
        from analogrig import Scenario

        @pytest.mark.parametrize("hil_dut", [Scenario.load({scenario!r}).dut], indirect=True)
        def test_it(hil_play):
            hil_play("short.toml")
    """)
    check(user, bait, [])


@pytest.fixture
def bait(
    user: pytest.Pytester,  # noqa: ARG001
    folder: Path,
    library: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Bait:
    return a_library(folder, monkeypatch, library)


def test_conftest_allows_what_the_ini_file_names(user: pytest.Pytester, bait: Bait) -> None:
    arguments = arguments_of("ini", bait, user)
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
