"""Packages for users: a complete sdist, and a wheel that works in an empty environment, far from this checkout."""

from __future__ import annotations

import filecmp
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

from analogrig import device_program
from tests.wheels import CHECKOUT, run

HELP_PER_START_LIMIT = 6.0
"""`analogrig --help` against `python -c pass`: 0.1 s where the interpreter itself needs 20 ms."""


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_wheel_serves_every_python_3_on_one_platform(wheel: Path) -> None:
    assert re.search(r"-py3-none-linux_\w+\.whl$", wheel.name)


def test_wheel_holds_every_product(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    assert held >= {
        "analogrig_emulator/_engine.so",
        *(f"analogrig_emulator/{folder}/__init__.py" for folder in ("card", "circuit", "engine", "machine")),
        "analogrig_emulator/py.typed",
        "analogrig/_catalogue.py",
        "analogrig/_commit.txt",
        "analogrig/_device.so",
        "analogrig/_device_fixed.so",
        "analogrig/_device_wide.so",
        "analogrig/bin/analogrig-device",
        "analogrig/bin/analogrig-device-wide",
        "analogrig/bin/analogrig-library",
        "analogrig/bin/analogrig-tether",
        "analogrig/fixtures/scenarios/thesis.toml",
        "analogrig/include/analogrig_estimator.h",
        "analogrig/py.typed",
        "analogrig/reporting/uPlot.iife.min.js",
        "analogrig/reporting/uPlot.min.css",
    }
    assert not [name for name in held if name.startswith("tests/")]


def shipped() -> set[str]:
    """Sources of estimator and device, and every scenario, rig and device, by their paths in this checkout."""
    parts = ("core", "isolation", "fit", "device", "ports", "catalogue")
    sources = [path for part in parts for path in (CHECKOUT / "estimator_c" / part).rglob("*")]
    fixtures = list(CHECKOUT.glob("fixtures/*/*.toml"))
    assert fixtures
    assert len([path for path in sources if path.suffix == ".c"]) > 10
    files = [path for path in (*sources, *fixtures) if path.is_file() and path.suffix != ".pyc"]
    return {str(path.relative_to(CHECKOUT)) for path in files}


def test_sdist_holds_sources_and_fixtures(sdist: Path) -> None:
    with tarfile.open(sdist) as files:
        assert {name.partition("/")[2] for name in files.getnames()} >= shipped()


def test_wheel_holds_sources_and_fixtures(wheel: Path) -> None:
    assert set(zipfile.ZipFile(wheel).namelist()) >= {f"analogrig/{name}" for name in shipped()}


def test_licence_is_in_the_metadata(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as files:
        (metadata,) = (name for name in files.namelist() if name.endswith(".dist-info/METADATA"))
        assert "\nLicense-Expression: MIT\n" in files.read(metadata).decode()
        licence = files.read(metadata.replace("METADATA", "licenses/LICENSE"))
    assert licence == (CHECKOUT / "LICENSE").read_bytes()


FOLDERS = "from analogrig.config import estimator_c, generated_c; print(estimator_c(), generated_c())"


@pytest.mark.parametrize("where", ["installed", "checkout"])
def test_device_compiles_from_the_sources_and_is_the_shipped_one(where: str, environment: Path, tmp_path: Path) -> None:
    """The program that a user compiles speaks the catalogue that the harness speaks."""
    python = environment / "python" if where == "installed" else Path(sys.executable)
    estimator, generated = map(Path, run(python, "-c", FOLDERS).split())
    assert estimator.is_relative_to(environment.parent if where == "installed" else CHECKOUT)
    folders = [*(estimator / part for part in ("core", "isolation", "fit", "device", "ports/loop")), generated]
    sources = [path for folder in (*folders, estimator / "ports" / "host") for path in sorted(folder.glob("*.c"))]
    flags = ("-std=c99", "-D_XOPEN_SOURCE=700", "-DEST_NC_MAX=2U", *(f"-I{folder}" for folder in folders))
    run("cc", *flags, *sources, "-o", tmp_path / "own")
    assert run(tmp_path / "own", "--version") == run(environment / "analogrig-device", "--version")


def test_codec_that_is_generated_from_the_shipped_catalogue_is_the_shipped_one(
    users_environment: Path, tmp_path: Path
) -> None:
    estimator, generated = map(Path, run(users_environment / "python", "-c", FOLDERS).split())
    generate = estimator / "catalogue" / "generate.py"
    (tmp_path / "c").mkdir()
    run(users_environment / "python", generate, tmp_path / "c", tmp_path / "tables.py")
    names = {path.name for path in generated.iterdir()}
    assert names == {path.name for path in (tmp_path / "c").iterdir()}
    assert filecmp.cmpfiles(generated, tmp_path / "c", sorted(names), shallow=False)[0] == sorted(names)


def test_command_works_from_the_wheel(environment: Path) -> None:
    assert run(environment / "analogrig", "--help").startswith("usage: analogrig")
    assert re.fullmatch(r"analogrig \d+\.\d+\.\d+\n", run(environment / "analogrig", "--version"))


def test_installed_device_is_a_command(environment: Path) -> None:
    device = next(environment.parent.glob("lib/python*/site-packages/analogrig/bin/analogrig-device"))
    assert run(environment / "analogrig-device", "--help") == run(device, "--help")
    refused = run(environment / "analogrig-device", "--no-such-option", status=2)
    assert refused == run(device, "--no-such-option", status=2)


def test_command_of_a_device_that_is_gone_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(device_program, "PROGRAM", tmp_path / "gone")
    with pytest.raises(SystemExit) as stopped:
        device_program.main()
    assert stopped.value.code == 2


def test_device_that_runs_is_the_command_itself(environment: Path) -> None:
    """It replaces the interpreter, so a signal to the command reaches the device."""
    with subprocess.Popen([environment / "analogrig-device"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as device:
        assert device.stdout is not None
        assert device.stdout.readline().startswith(b"/dev/")
        program = Path(f"/proc/{device.pid}/exe").readlink()
        assert device.stdin is not None
        device.stdin.close()
        assert device.wait() == 0
    assert program.name == "analogrig-device"


def test_main_job_works_from_the_wheel(environment: Path, tmp_path: Path) -> None:
    run(environment / "analogrig", "run", "--out", tmp_path)
    assert (tmp_path / "run.npz").stat().st_size > 0
    assert "<html" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.fixture
def users_repository(users_environment: Path, tmp_path: Path) -> Path:
    """tests/user_repository in a folder of its own, with the sources of the device that the wheel brings."""
    repository = shutil.copytree(CHECKOUT / "tests" / "user_repository", tmp_path / "repository")
    estimator, generated = map(Path, run(users_environment / "python", "-c", FOLDERS).split())
    shutil.copytree(estimator, repository / "vendor" / "estimator_c")
    shutil.copytree(generated, repository / "vendor" / "generated")
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
    repeat = re.search(r"^play it again with: analogrig (.*)$", found, re.MULTILINE)
    assert repeat is not None
    again = run(users_environment / "analogrig", *shlex.split(repeat[1]), cwd=users_repository, status=1)
    assert "missed" in again
    words = ("-m", "pytest", "-q", "failed", "--hil-scenario-dir", "failed")
    assert "1 failed" in run(users_environment / "python", *words, cwd=users_repository, status=1)


def test_help_loads_nothing_heavy(environment: Path) -> None:
    listing = run(environment / "python", "-X", "importtime", "-m", "analogrig.cli", "run", "--help")
    loaded = set(re.findall(r"\| +(\w+)", listing))
    assert "argparse" in loaded
    assert not loaded & {"numpy", "scipy", "serial", "cobs", "anycrc", "argcomplete"}


def test_help_starts_at_once(environment: Path) -> None:
    bare, with_help = [], []
    for _ in range(9):  # by turns, so that a busy machine slows both alike
        bare.append(_processor_s(environment / "python", "-c", "pass"))
        with_help.append(_processor_s(environment / "analogrig", "--help"))
    assert min(with_help) < HELP_PER_START_LIMIT * min(bare)


def _processor_s(*command: str | Path) -> float:
    """Processor time of a command [s], which a busy machine does not increase."""
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
