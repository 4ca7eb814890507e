"""Guest: it runs the tests of suite/, and leaves no process behind, however it ends."""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests import tools
from tests.harness.processes import descendants, ends
from tests.soak.can_guest import guest
from tests.soak.can_guest.__main__ import REPORT, ROOT, TIME_LIMIT_S, run_suite

needs_guest = pytest.mark.tools(*guest.NEEDED)

BOOT_S = 600.0
"""Limit for one command in the guest, which takes three seconds on an idle machine."""


@pytest.mark.heavy
@needs_guest
@pytest.mark.timeout(TIME_LIMIT_S + BOOT_S)  # the guest ends the tests before pytest does
def test_suite_passes_on_socketcan(tmp_path: Path) -> None:
    with (tmp_path / "console").open("w+b") as console:
        status = run_suite(tmp_path, console=console)
    assert status == 0, (tmp_path / "console").read_text(errors="replace")
    (suite,) = ET.parse(tmp_path / REPORT).getroot()  # noqa: S314
    assert int(suite.attrib["tests"]) > 0
    assert suite.attrib["skipped"] == "0"


@pytest.mark.heavy
@needs_guest
def test_command_sees_the_files_of_the_host_cannot_change_them_and_its_status_and_results_come_out(
    tmp_path: Path,
) -> None:
    (tmp_path / "given").write_text("for it to read")
    results = tmp_path / "results, of a name that QEMU could misread"
    results.mkdir()
    command = "cat given > /run/results/taken; echo spoilt > given; exit 7"
    with (tmp_path / "console").open("wb") as console:
        status = guest.run(
            ["sh", "-c", command], results, folder=tmp_path, environment={}, time_limit_s=BOOT_S, console=console
        )
    assert status == 7
    assert (results / "taken").read_text() == "for it to read"
    assert (tmp_path / "given").read_text() == "for it to read"


@pytest.mark.heavy
@needs_guest
def test_guest_that_does_not_end_in_time_is_ended(tmp_path: Path) -> None:
    before = set(descendants(os.getpid()))
    with (tmp_path / "console").open("wb") as console, pytest.raises(guest.GuestError, match="did not end within 1 s"):
        guest.run(["sleep", "1000"], tmp_path, folder=tmp_path, environment={}, time_limit_s=1.0, console=console)
    assert set(descendants(os.getpid())) <= before


@pytest.mark.heavy
@needs_guest
def test_guest_ends_with_whoever_started_it(tmp_path: Path) -> None:
    """Also after SIGKILL."""
    command = ["sh", "-c", "echo up; sleep 1000"]
    words = f"guest.run({command}, Path('.'), folder=Path('/'), environment={{}}, time_limit_s={BOOT_S})"
    program = f"from pathlib import Path; from tests.soak.can_guest import guest; {words}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, stdout=subprocess.PIPE
    ) as caller:
        assert caller.stdout is not None
        assert caller.stdout.readline().strip() == b"up"
        started = descendants(caller.pid)
        caller.kill()
    assert len(started) == len(("tether", "QEMU"))
    assert all(ends(pid) for pid in started)


@needs_guest
def test_guest_whose_kernel_is_none_is_told_in_the_words_of_qemu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = tmp_path / "vmlinux"
    nothing.write_bytes(b"")
    monkeypatch.setattr(guest, "VMLINUX", nothing)
    with pytest.raises(guest.GuestError, match=r"QEMU ended with status 1: qemu: could not load kernel"):
        guest.run(["true"], tmp_path, folder=tmp_path, environment={}, time_limit_s=BOOT_S)


def test_what_is_lacking_is_named_with_the_cure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(tools.BUILT, "guest kernel", tools.Built((tmp_path / "vmlinux",), "build/can_guest/linux"))
    assert guest.lacking() == (
        "needs qemu-system-x86_64, ip, guest kernel: apt-get install --no-install-recommends "
        "qemu-system-x86 iproute2 && make build/can_guest/linux"
    )


def test_suite_is_not_collected_outside_the_guest() -> None:
    """Outside the guest it would take down the interfaces of this machine."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "pytest_timeout"]
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    suite = ROOT / "tests/soak/can_guest/suite"
    done = subprocess.run(command, cwd=suite, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == pytest.ExitCode.NO_TESTS_COLLECTED, done.stdout
