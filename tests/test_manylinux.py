"""The wheels of `make wheels` run where their tags say. `make test-wheels` runs this module, `make test` does not.

ANALOGRIG_WHEELS is the folder of the wheels, ANALOGRIG_PYTHONS the interpreters to install them for.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.wheels import environment_with, run

WHEELS = Path(os.environ["ANALOGRIG_WHEELS"]).absolute()
PYTHONS = os.environ["ANALOGRIG_PYTHONS"].split()
PROGRAM = "analogrig/bin/analogrig-device"
AARCH64 = ("qemu-aarch64", "-L", "/usr/aarch64-linux-gnu")


def wheel_for(machine: str) -> Path:
    (path,) = WHEELS.glob(f"*-py3-none-manylinux_2_17_{machine}.whl")
    return path


def theta_hash(python: Path, dut: str, folder: Path) -> str:
    """The estimates of a run, as a hash, with the package that ``python`` has."""
    out = run(python, "-m", "analogrig.cli", "run", "--json", "--seed", "3", "--dut", dut, "--out", folder, cwd=folder)
    return str(json.loads(out)["theta_hash"])


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Library of this checkout, built by the system's compiler."""
    return theta_hash(Path(sys.executable), "inproc", tmp_path_factory.mktemp("checkout"))


@pytest.fixture(scope="module", params=PYTHONS)
def python(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment of another Python that holds the wheel."""
    return environment_with(tmp_path_factory.mktemp("fresh"), wheel_for("x86_64"), python=request.param) / "python"


@pytest.mark.parametrize("dut", ["host", "inproc"])
def test_wheel_gives_the_same_bits_with_every_python(dut: str, python: Path, expected: str, tmp_path: Path) -> None:
    assert theta_hash(python, dut, tmp_path) == expected


@contextmanager
def device_of(machine: str, folder: Path, *emulator: str) -> Iterator[str]:
    """The program of a wheel at work; yields the path of its pseudo-terminal."""
    with zipfile.ZipFile(wheel_for(machine)) as files:
        program = Path(files.extract(PROGRAM, folder))
    program.chmod(0o755)
    with subprocess.Popen([*emulator, program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.kill()


@pytest.mark.tools("qemu-aarch64", "aarch64-linux-gnu-gcc")  # the compiler's package brings the C library
def test_program_for_aarch64_gives_the_same_bits(expected: str, tmp_path: Path) -> None:
    with device_of("aarch64", tmp_path, *AARCH64) as path:
        assert theta_hash(Path(sys.executable), f"serial:{path}", tmp_path) == expected


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_tag_of_the_wheel_is_what_auditwheel_finds(machine: str) -> None:
    auditwheel = shutil.which("auditwheel", path=os.environ["ANALOGRIG_ZIG"])
    assert auditwheel is not None
    shown = run(auditwheel, "show", wheel_for(machine))
    assert f'platform tag: "manylinux_2_17_{machine}"' in " ".join(shown.split())
