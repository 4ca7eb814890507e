"""The wheel in other people's repositories: theirs run as without it, beside their plugins, and ours run there too."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from tests.wheels import environment_with, made_once, run

pytestmark = [
    pytest.mark.timeout(3600),
    pytest.mark.heavy,
]  # environments are made from the package index, maybe on a loaded machine

VERSIONS = ("3.11", "3.13")
"""First and last that are supported."""
THIS = f"{sys.version_info.major}.{sys.version_info.minor}"
PLUGINS = ("pytest-embedded", "pytest-asyncio", "pytest-mock", "pytest-xdist", "pytest-timeout", "hypothesis")

CONFTEST = """
import pytest

def pytest_addoption(parser):
    parser.addoption("--rig", default="their rig")
    parser.addoption("--dut", default="their dut")

@pytest.fixture
def rig(pytestconfig):
    return pytestconfig.getoption("--rig")

@pytest.fixture
def dut(pytestconfig):
    return pytestconfig.getoption("--dut")

@pytest.fixture
def bench(rig, dut):
    return [rig, dut]

@pytest.fixture
def play():
    return "their play"
"""
FILES = {
    "conftest.py": CONFTEST,
    "harness/jig.py": "NAME = 'their jig'\n",
    "emulator/cpu.py": "NAME = 'their cpu'\n",
    "fixtures/data.py": "NAME = 'their data'\n",
    "tests/harness/test_jig.py": "from harness import jig\n\ndef test_jig():\n    assert jig.NAME == 'their jig'\n",
    "tests/emulator/test_cpu.py": "from emulator import cpu\n\ndef test_cpu():\n    assert cpu.NAME == 'their cpu'\n",
    "tests/test_theirs.py": """
import os
import pytest
from fixtures import data

def test_fixtures(rig, dut, bench, play):
    assert (bench, play) == (["their rig", "my board"], "their play")
    assert data.NAME == "their data"

def test_environment():
    assert not [name for name in os.environ if name.startswith(("ANALOGRIG", "HIL"))]

def test_that_fails():
    assert False

@pytest.mark.skip
def test_that_skips():
    pass
""",
}
OUTCOMES = {
    "test_cpu": "passed",
    "test_environment": "passed",
    "test_fixtures": "passed",
    "test_jig": "passed",
    "test_that_fails": "failure",
    "test_that_skips": "skipped",
}
OURS = """
def test_ours(hil_play, rig, dut):
    assert (rig, dut) == ("their rig", "my board")
    assert hil_play("healthy", seed=3).stays_quiet()
"""


@dataclass(frozen=True)
class Way:
    """One way of calling pytest."""

    program: tuple[str, ...] = ("pytest",)
    ini: str = "[pytest]\n"
    pythonpath: str = ""


WAYS = {
    "pytest": Way(),
    "python -m pytest": Way(("python", "-m", "pytest")),
    "PYTHONPATH=. pytest": Way(pythonpath="."),
    "ini pythonpath": Way(ini="[pytest]\npythonpath = .\n"),
}


@functools.cache
def interpreter(version: str) -> str | None:
    """A Python of this version that can make an environment, of the PATH or of pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    installed = sorted(pyenv.glob(f"versions/{version}.*/bin/python{version}"))
    for python in filter(None, [shutil.which(f"python{version}"), *map(str, installed)]):
        if subprocess.run([python, "-c", "import venv"], capture_output=True, check=False).returncode == 0:
            return python
    return None


@pytest.fixture(scope="session")
def without(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of an environment with pytest, without analogrig."""
    return made_once(tmp_path_factory, "without", lambda folder: environment_with(folder, "pytest")) / "bin"


@pytest.fixture
def with_ours(request: pytest.FixtureRequest, wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of an environment with analogrig[pytest], of the Python version of the parameter."""
    if request.param == THIS:
        users: Path = request.getfixturevalue("users_environment")
        return users
    python = interpreter(request.param)
    assert python is not None
    made = made_once(
        tmp_path_factory,
        f"with_{request.param}",
        lambda folder: environment_with(folder, f"{wheel}[pytest]", python=python),
    )
    return made / "bin"


def repository(folder: Path, way: Way, *, packages: bool) -> Path:
    """Write somebody's repository; with ``packages`` every folder of Python files has an ``__init__.py``."""
    for name, text in FILES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    if packages:
        for path in {(folder / name).parent for name in FILES} - {folder}:
            (path / "__init__.py").touch()
        (folder / "tests" / "__init__.py").touch()
    (folder / "pytest.ini").write_text(way.ini)
    return folder


def outcomes(programs: Path, way: Way, folder: Path, *options: str, status: int = 1) -> dict[str, str]:
    """Outcome of every test by its name, of a pytest that ends with ``status``."""
    variables = {"PYTHONPATH": way.pythonpath} if way.pythonpath else {}
    program, *arguments = way.program
    command: list[str | Path] = [
        programs / program,
        *arguments,
        "-p",
        "no:cacheprovider",
        "--junitxml",
        "junit.xml",
        *options,
    ]
    output = run(*command, cwd=folder, status=status, **variables)
    told = {}
    for case in ET.parse(folder / "junit.xml").getroot().iter("testcase"):  # noqa: S314 - written a moment ago
        tags = [each.tag for each in case if each.tag in ("failure", "error", "skipped")]
        told[case.attrib["name"]] = tags[0] if tags else "passed"
    assert told, output
    return told


@pytest.mark.parametrize(
    ("with_ours", "way", "packages"),
    [
        *((THIS, way, number % 2 == 0) for number, way in enumerate(WAYS)),
        (THIS, "ini pythonpath", True),
        *((version, "python -m pytest", True) for version in VERSIONS if version != THIS and interpreter(version)),
    ],
    indirect=["with_ours"],
)
def test_repository_with_folders_of_our_old_names_is_tested_as_without_us(
    without: Path, with_ours: Path, way: str, tmp_path: Path, *, packages: bool
) -> None:
    folder = repository(tmp_path, WAYS[way], packages=packages)
    alone = outcomes(without, WAYS[way], folder, "--dut", "my board")
    assert alone == OUTCOMES
    assert outcomes(with_ours, WAYS[way], folder, "--dut", "my board") == alone
    (folder / "tests" / "test_ours.py").write_text(OURS)
    both = outcomes(with_ours, WAYS[way], folder, "--dut", "my board", "--hil-dut", "inproc")
    assert both == {**alone, "test_ours": "passed"}


@pytest.mark.parametrize("with_ours", [THIS], indirect=True)
def test_command_works_in_a_repository_with_folders_of_our_old_names(with_ours: Path, tmp_path: Path) -> None:
    folder = repository(tmp_path, Way(), packages=True)
    output = run(with_ours / "analogrig", "run", "--dut", "inproc", "--out", "out", cwd=folder, PYTHONPATH=".")
    assert (folder / "out" / "run.npz").is_file(), output


@pytest.mark.parametrize("with_ours", [THIS], indirect=True)
def test_shipped_property_runs_from_any_folder(with_ours: Path, tmp_path: Path) -> None:
    folder = repository(tmp_path, Way(), packages=True)
    options = ("--pyargs", "analogrig.testing.properties", "--hil-dut", "inproc", "-k", "samples_that_are_missing")
    told = outcomes(with_ours, Way(), folder, *options, status=0)
    assert set(told.values()) == {"passed"}


SMOKE = """
import asyncio, os, time
import pytest
from hypothesis import given, strategies

def test_embedded(dut):
    dut.write("ready 42\\n")
    assert dut.expect(r"ready (\\d+)", timeout=60).group(1) == b"42"

@pytest.mark.asyncio
async def test_asyncio():
    assert await asyncio.sleep(0, result="done") == "done"

def test_mock(mocker):
    mocker.patch("os.getcwd", return_value="patched")
    assert os.getcwd() == "patched"

def test_xdist(worker_id):
    assert worker_id in ("gw0", "gw1")

@pytest.mark.timeout(1, method="signal")
def test_timeout():
    with pytest.raises(pytest.fail.Exception, match="Timeout"):
        time.sleep(3600)

@given(strategies.integers())
def test_hypothesis(number):
    assert number + 1 > number

def test_ours(dut, hil_play, hil_dut, mocker):
    dut.write("on the bench\\n")
    dut.expect_exact("on the bench", timeout=60)
    assert hil_dut.recover()
    assert hil_play("healthy", seed=3).stays_quiet()
"""


def test_other_plugins_work_beside_ours(wheel: Path, tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> None:
    made = made_once(tmp_path_factory, "plugins", lambda folder: environment_with(folder, f"{wheel}[pytest]", *PLUGINS))
    (tmp_path / "test_smoke.py").write_text(SMOKE)
    told = outcomes(made / "bin", Way(), tmp_path, "-n", "2", "--hil-dut", "inproc", status=0)
    names = {"embedded", "asyncio", "mock", "xdist", "timeout", "hypothesis", "ours"}
    assert told == {f"test_{name}": "passed" for name in names}
