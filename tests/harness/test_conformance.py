"""The shipped conformance suite: every kind of ours keeps it, and it finds each of many faults."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import tempfile
import tty
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from analogrig.testing.conformance.test_contract import *  # noqa: F403 - the tests, run here on each device
from tests.harness.faulty_devices import FAULTS, SHARED_MEMORY
from tests.harness.library_builds import OWN, build
from tests.harness.scripted_ecu import ScriptedEcu, write
from tests.harness.test_third_party import install

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PAGE = ROOT / "harness/docs/howto/test-a-python-estimator.md"
PROGRAM = ROOT / "harness/examples/program"

FOLDER = Path(tempfile.gettempdir()) / f"analogrig-conformance-{os.getpid()}"
"""Folder of the devices that the tests build."""

DEVICES = {
    "inproc": "inproc",
    "host": "host",
    "python": "python:my_estimator:Rls",
    "library": f"library:{FOLDER / 'own.so'}",
    "exec": str(FOLDER / "my_program.toml"),
    "lines": str(FOLDER / "lines.toml"),
    "can-dbc": str(FOLDER / "ecu.toml"),
}
"""Devices of each kind that this machine can run without tools."""

ONE_PROCESS = frozenset({"lines", "can-dbc"})
NOT_FOR = {
    "test_description_is_plain_and_opens_the_same_device": ONE_PROCESS,
    "test_answers_are_the_same_in_a_new_process": ONE_PROCESS,
    "test_two_side_by_side_do_not_disturb_each_other": ONE_PROCESS,
    "test_closed_device_leaves_nothing_behind": ONE_PROCESS,
    "test_answers_without_messages_are_those_over_the_line": ONE_PROCESS | {"host", "exec"},
}
"""Kinds that a test skips, by its name: in CI nothing may be skipped."""

FAULTY_TESTS = """\
import pytest
from analogrig.testing.conformance.test_contract import *

def pytest_generate_tests(metafunc):
    metafunc.parametrize("hil_dut", {names}, indirect=True, ids=lambda name: name)
"""
CONFTEST = """\
def pytest_collection_modifyitems(items):
    items[:] = [item for item in items if item.name in {wanted}]
"""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if metafunc.function.__module__ == "analogrig.testing.conformance.test_contract":
        left_out = NOT_FOR.get(metafunc.function.__name__, frozenset())
        devices = {kind: name for kind, name in DEVICES.items() if kind not in left_out}
        metafunc.parametrize("hil_dut", list(devices.values()), ids=list(devices), indirect=True)


@pytest.fixture(autouse=True, scope="module")
def _devices(pytestconfig: pytest.Config) -> Iterator[None]:
    """Build the devices, and start the firmware on a terminal and the ECU on a bus."""
    FOLDER.mkdir()
    build(FOLDER / "own.so", OWN)
    (source,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (FOLDER / "my_estimator.py").write_text(source)
    shutil.copytree(PROGRAM, FOLDER, dirs_exist_ok=True)
    subprocess.run(["make", "--silent", f"ESTIMATOR={ROOT / 'estimator_c'}"], cwd=FOLDER, check=True)
    with pytest.MonkeyPatch.context() as patch, firmware() as port, ScriptedEcu(FOLDER.name):
        patch.syspath_prepend(FOLDER)
        patch.setattr(pytestconfig.option, "hil_allow", [str(FOLDER / "my_program"), port])
        program = (FOLDER / "my_program.toml").read_text()
        lines = program.replace('kind = "exec"\narguments = ["./my_program"]', f'kind = "lines"\nurl = "{port}"')
        (FOLDER / "lines.toml").write_text(lines)
        write(FOLDER, FOLDER.name)
        yield
    shutil.rmtree(FOLDER)


@contextlib.contextmanager
def firmware() -> Iterator[str]:
    """Terminal behind which the program runs as a firmware would."""
    theirs, ours = os.openpty()
    tty.setraw(ours)
    with subprocess.Popen([FOLDER / "my_program"], stdin=theirs, stdout=theirs) as process:
        os.close(theirs)
        yield os.ttyname(ours)
        process.kill()
        os.close(ours)


@pytest.fixture
def _site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Folder with an installed package of faulty devices; what they leave in shared memory is removed."""
    folder = tmp_path / "site"
    install(folder, "faulty", devices={"faulty": "faulty_devices:FaultyDescription"})
    (folder / "faulty_devices.py").write_text((HERE / "faulty_devices.py").read_text())
    monkeypatch.setenv("PYTHONPATH", str(folder))
    yield
    for left in Path("/dev/shm").glob(f"{SHARED_MEMORY}*"):  # noqa: S108
        left.unlink()


def finding(fault: str) -> str:
    """Name of the test that must find a fault."""
    test, _, rest = FAULTS[fault].found_by.partition("[")
    return f"{test}[faulty:{fault}{'-' if rest else ']'}{rest}"


@pytest.mark.heavy
@pytest.mark.usefixtures("_site")
def test_suite_finds_every_fault(pytester: pytest.Pytester) -> None:
    wanted = [finding(name) for name, cls in FAULTS.items() if cls.found_by]
    pytester.makepyfile(FAULTY_TESTS.format(names=[f"faulty:{name}" for name in FAULTS]))
    pytester.makeconftest(CONFTEST.format(wanted=wanted))
    pytester.runpytest_subprocess("-q", "--hil-time-limit", "1", "--junitxml", "out.xml")
    cases = ET.parse(pytester.path / "out.xml").getroot().iter("testcase")  # noqa: S314 - written a moment ago
    found = {case.attrib["name"] for case in cases if any(each.tag in ("failure", "error") for each in case)}
    assert len(wanted) >= 24
    assert found == set(wanted)


@pytest.mark.usefixtures("_site")
def test_suite_runs_as_shipped_on_a_device_of_another_package(pytester: pytest.Pytester) -> None:
    done = pytester.runpytest_subprocess("--pyargs", "analogrig.testing.conformance", "--hil-dut", "faulty", "-rs")
    assert done.ret == 0
    done.assert_outcomes(passed=24, skipped=1)
    done.stdout.fnmatch_lines("*has not the capability blocks")
