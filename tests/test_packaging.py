"""What a user gets: a complete sdist, and a wheel that works in an empty environment, far from this checkout."""

from __future__ import annotations

import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.wheels import CHECKOUT, run

HELP_PER_START_LIMIT = 5.0
"""`analogrig --help` against `python -c pass`: 0.1 s where the interpreter itself needs 20 ms."""

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_wheel_serves_every_python_3_on_one_platform(wheel: Path) -> None:
    assert re.search(r"-py3-none-linux_\w+\.whl$", wheel.name)


def test_wheel_holds_every_product_and_no_source_of_c(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    assert held >= {
        "analogrig_emulator/_engine.so",
        "analogrig_emulator/py.typed",
        "analogrig/_catalogue.py",
        "analogrig/_device.so",
        "analogrig/bin/analogrig-device",
        "analogrig/bin/analogrig-tether",
        "analogrig/fixtures/scenarios/thesis.toml",
        "analogrig/py.typed",
        "analogrig/reporting/uPlot.iife.min.js",
        "analogrig/reporting/uPlot.min.css",
    }
    assert not [name for name in held if name.endswith((".c", ".h")) or name.startswith("tests/")]


def test_every_scenario_rig_and_device_is_shipped(distributions: Path, wheel: Path) -> None:
    fixtures = {str(path.relative_to(CHECKOUT)) for path in CHECKOUT.glob("fixtures/*/*.toml")}
    assert fixtures
    with tarfile.open(next(distributions.glob("*.tar.gz"))) as sdist:
        assert {name.partition("/")[2] for name in sdist.getnames()} >= fixtures
    assert set(zipfile.ZipFile(wheel).namelist()) >= {f"analogrig/{fixture}" for fixture in fixtures}


def test_command_works_from_the_wheel(environment: Path) -> None:
    assert run(environment / "analogrig", "--help").startswith("usage: analogrig")
    assert re.fullmatch(r"analogrig \d+\.\d+\.\d+\n", run(environment / "analogrig", "--version"))


def test_installed_device_can_be_executed(environment: Path) -> None:
    device = next(environment.parent.glob("lib/python*/site-packages/analogrig/bin/analogrig-device"))
    assert "analogrig-device" in run(device, "--help")


def test_main_job_works_from_the_wheel(environment: Path, tmp_path: Path) -> None:
    run(environment / "analogrig", "run", "--out", tmp_path)
    assert (tmp_path / "run.npz").stat().st_size > 0
    assert "<html" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.fixture
def users_repository(distributions: Path, tmp_path: Path) -> Path:
    """tests/user_repository in a folder of its own, with the sources of the device as the sdist has them."""
    repository = shutil.copytree(CHECKOUT / "tests" / "user_repository", tmp_path / "repository")
    run(sys.executable, "-m", "tarfile", "-e", next(distributions.glob("*.tar.gz")), tmp_path / "sdist")
    (sources,) = (tmp_path / "sdist").iterdir()
    shutil.copytree(sources / "estimator_c", repository / "vendor" / "estimator_c")
    generate = sources / "estimator_c" / "catalogue" / "generate.py"
    (repository / "vendor" / "generated").mkdir()
    run(sys.executable, generate, repository / "vendor" / "generated", tmp_path / "tables.py", cwd=sources)
    return repository


def test_users_repository_passes_without_its_bug(users_environment: Path, users_repository: Path) -> None:
    run("make", "BUG=0", cwd=users_repository)
    assert "2 passed" in run(users_environment / "python", "-m", "pytest", "-q", cwd=users_repository)


def test_users_repository_finds_its_bug_and_leaves_what_repeats_it(
    users_environment: Path, users_repository: Path
) -> None:
    run("make", cwd=users_repository)
    found = run(users_environment / "python", "-m", "pytest", "-q", cwd=users_repository, status=1)
    assert "1 failed, 1 passed" in found
    assert "B at 1400 was missed" in found
    repeat = re.search(r"^repeat it with: analogrig (.*)$", found, re.MULTILINE)
    assert repeat is not None
    again = run(users_environment / "analogrig", *shlex.split(repeat[1]), cwd=users_repository, status=1)
    assert "missed" in again
    suite = run(
        users_environment / "python",
        "-m",
        "pytest",
        "-q",
        "failed",
        "--hil-scenario-dir",
        "failed",
        cwd=users_repository,
        status=1,
    )
    assert "1 failed" in suite


def test_help_loads_nothing_heavy(environment: Path) -> None:
    listing = run(environment / "python", "-X", "importtime", "-m", "analogrig.cli", "run", "--help")
    loaded = set(re.findall(r"\| +(\w+)", listing))
    assert "argparse" in loaded
    assert not loaded & {"numpy", "scipy", "serial", "cobs", "anycrc"}


def test_help_starts_at_once(environment: Path) -> None:
    bare, with_help = [], []
    for _ in range(9):  # by turns, so that a busy machine slows both alike
        bare.append(_processor_s(environment / "python", "-c", "pass"))
        with_help.append(_processor_s(environment / "analogrig", "--help"))
    assert min(with_help) < HELP_PER_START_LIMIT * min(bare)


def _processor_s(*command: str | Path) -> float:
    """What a command takes of the processor: on a busy machine it takes longer, but no more."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run(*command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_build_without_a_compiler_names_the_package_to_install(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "setup.py", "--quiet", "build_products", "-b", tmp_path / "lib", "-t", tmp_path / "temp"],
        cwd=CHECKOUT,
        env={**os.environ, "CC": "no-such-compiler"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert done.stderr.splitlines() == [
        "analogrig: there is no C compiler 'no-such-compiler': apt-get install gcc libc6-dev"
    ]
