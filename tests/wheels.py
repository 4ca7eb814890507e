"""Fixtures of the built distributions: an sdist of this checkout, the wheel built from it, environments that hold it.

tests/conftest.py imports the fixtures, so every test may ask for them. A session makes each once, also where
pytest-xdist spreads it over several processes.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]

NOT_SOURCES = (".*", "__pycache__", "*.egg-info", "*.so", "_catalogue.py", "bin", "build", "dist", "uPlot*", "venv*")
"""Files of a working checkout that are no sources: the build under test must make its products itself."""

INHERITED = (
    "PYTHONPATH",
    "PYTHONHOME",
    "PYTHONDONTWRITEBYTECODE",
    "VIRTUAL_ENV",
    "CFLAGS",
    "LDFLAGS",
    "CC",
    "ANALOGRIG",
    "PYTEST_",
    "MAKE",
    "MFLAGS",
)
"""Beginnings of the variables that would let a build or an installed program depend on this checkout or session."""


def run(*command: str | Path, cwd: Path | None = None, status: int = 0, **variables: str) -> str:
    """Run a command that must end with ``status``; return its output and error output."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(INHERITED)}
    environment = kept | variables
    done = subprocess.run(
        command, cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    assert done.returncode == status, f"{command} ended with status {done.returncode}:\n{done.stdout}"
    return done.stdout


def environment_with(folder: Path, *requirements: str | Path, python: str = sys.executable) -> Path:
    """Make an environment that holds the requirements and their dependencies alone; return its folder of programs.

    uv takes a tenth of pip's processor time; pip takes over where its own settings say where packages are. Python
    compiles the modules that a test imports, a tenth of all.
    """
    run(python, "-m", "venv", "--without-pip", folder)
    uv = (sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", str(folder / "bin" / "python"))
    if subprocess.run((*uv, *requirements), cwd=folder, capture_output=True, check=False).returncode != 0:
        pip = (sys.executable, "-m", "pip", "--python", str(folder), "install", "--quiet", "--no-compile")
        run(*pip, *requirements, cwd=folder)
    return folder / "bin"


def pack(folder: Path) -> None:
    """Build an sdist of this checkout into ``folder``."""
    sources = shutil.copytree(CHECKOUT, folder / "sources", ignore=shutil.ignore_patterns(*NOT_SOURCES))
    _build("--sdist", folder, sources)
    shutil.rmtree(sources)


def _build(kind: str, folder: Path, sources: Path) -> None:
    words = ("-m", "build", "--no-isolation", kind, "--outdir", str(folder), str(sources))
    run(sys.executable, *words, cwd=folder, CFLAGS="-O0")  # quickly; make test-wheels tries wheels as they are shipped


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that the first test of the session makes, whichever process of pytest-xdist runs it."""
    session = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        session = session.parent
    folder = session / name
    with (session / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "complete").exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            (folder / "complete").touch()
    return folder


@pytest.fixture(scope="session")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An sdist of this checkout."""
    (path,) = made_once(tmp_path_factory, "sdist", pack).glob("*.tar.gz")
    return path


@pytest.fixture(scope="session")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel for this machine, built from the sdist. tests/conftest.py marks its tests as heavy."""

    def make(folder: Path) -> None:
        shutil.unpack_archive(sdist, folder / "sources", filter="data")
        _build("--wheel", folder, next((folder / "sources").iterdir()))
        shutil.rmtree(folder / "sources")

    (path,) = made_once(tmp_path_factory, "wheel", make).glob("*.whl")
    return path


@pytest.fixture(scope="session")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of a new environment that holds the wheel and its dependencies alone."""
    return made_once(tmp_path_factory, "empty", lambda folder: environment_with(folder, wheel)) / "bin"


@pytest.fixture(scope="session")
def users_environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with the dependencies of the plugin for pytest."""
    return made_once(tmp_path_factory, "users", lambda folder: environment_with(folder, f"{wheel}[pytest]")) / "bin"
