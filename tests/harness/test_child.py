"""The device as a process of this computer: it answers, it ends with us whatever happens, and its death is told."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from analogrig.catalogue import CATALOGUE_HASH, Hello, Identify
from analogrig.devices import child as child_module
from analogrig.devices.child import TETHER, Child, ChildWire
from analogrig.devices.processes import host_wire
from analogrig.errors import LinkClosed, LinkError
from analogrig.links.link import FramedLink, Link
from tests.harness.processes import LONG_S, children, ends


def hello(link: Link) -> Hello:
    link.send([Identify(0)])
    answer = link.receive(LONG_S)
    assert isinstance(answer, Hello)
    return answer


def device_pid(wire: ChildWire) -> int:
    (pid,) = children(wire.child.tether_pid)
    return pid


@pytest.fixture
def wire() -> Iterator[ChildWire]:
    out = host_wire()
    yield out
    out.close()


def test_process_answers_and_is_gone_after_close(wire: ChildWire) -> None:
    link = FramedLink(wire)
    assert hello(link).catalogue_hash == CATALOGUE_HASH
    pid = device_pid(wire)
    link.close()
    assert ends(pid, 0.0)
    assert ends(wire.child.tether_pid, 0.0)
    link.close()


def test_ctrl_c_at_the_terminal_does_not_reach_the_process(wire: ChildWire) -> None:
    """It goes to all processes of a group."""
    assert os.getpgid(device_pid(wire)) != os.getpgid(0)
    assert os.getpgid(wire.child.tether_pid) != os.getpgid(0)


def test_process_that_hangs_is_gone_after_close(wire: ChildWire) -> None:
    pid = device_pid(wire)
    os.kill(pid, signal.SIGSTOP)
    wire.close()
    assert ends(pid, 0.0)


def test_process_is_gone_after_close_though_its_tether_hangs(wire: ChildWire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_module, "END_TIMEOUT_S", 0.05)
    pid = device_pid(wire)
    os.kill(wire.child.tether_pid, signal.SIGSTOP)
    os.kill(pid, signal.SIGSTOP)
    wire.close()
    assert ends(pid)


def test_process_does_not_outlive_its_tether(wire: ChildWire) -> None:
    pid = device_pid(wire)
    os.kill(wire.child.tether_pid, signal.SIGKILL)
    assert ends(pid)


def test_killed_process_is_told_with_its_status(wire: ChildWire) -> None:
    os.kill(device_pid(wire), signal.SIGKILL)
    with pytest.raises(LinkClosed, match=r"^the device process ended with status -9 \(SIGKILL\)$"):
        wire.read(LONG_S)
    with pytest.raises(LinkClosed, match=r"^the device process ended with status -9 \(SIGKILL\)$"):
        wire.write(b"anybody?")


def test_process_that_pretends_another_catalogue_says_so() -> None:
    link = FramedLink(host_wire(["--catalogue-hash", "0xdeadbeef"]))
    assert hello(link).catalogue_hash == 0xDEADBEEF
    link.close()


def test_absent_program_is_named_with_the_cure(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=f"{tmp_path}/absent is absent: run `make setup`"):
        host_wire(program=tmp_path / "absent")


def test_absent_tether_is_named_with_the_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_module, "TETHER", tmp_path / "absent")
    with pytest.raises(LinkError, match=f"cannot start {tmp_path}/absent: No such file or directory; run `make setup`"):
        host_wire()


def program(folder: Path, script: str) -> Path:
    path = folder / "program"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(stat.S_IRWXU)
    return path


def test_program_that_ends_at_once_is_told_with_its_status_and_its_last_words(tmp_path: Path) -> None:
    with pytest.raises(LinkClosed, match="^the device process ended with status 5: no such luck$"):
        host_wire(program=program(tmp_path, "echo so it goes >&2; echo no such luck >&2; exit 5"))


def test_program_that_cannot_be_executed_is_named(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("no program")
    with pytest.raises(
        LinkClosed, match=f"ended with status 127: analogrig-tether: {tmp_path}/text: Permission denied"
    ):
        host_wire(program=tmp_path / "text")


def test_program_that_says_nothing_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_module, "START_TIMEOUT_S", 0.05)
    with pytest.raises(LinkError, match="printed nothing within"):
        host_wire(program=program(tmp_path, "read end"))


def test_program_that_says_half_a_line_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_module, "START_TIMEOUT_S", 0.2)
    with pytest.raises(LinkError, match="printed nothing within"):
        host_wire(program=program(tmp_path, "printf half; read end"))


def test_of_a_program_that_never_stops_talking_the_last_words_are_kept() -> None:
    """More than any pipe holds: it must neither block nor be remembered."""
    child = Child(["sh", "-c", "seq 1 200000 >&2; exit 3"], "the babbler")
    assert ends(child.tether_pid)
    assert child.exit_report() == "the babbler ended with status 3: 200000"
    assert child.exit_report() == "the babbler ended with status 3: 200000"
    child.end()


@pytest.mark.parametrize("stopped", [False, True])
def test_process_does_not_outlive_a_killed_parent(*, stopped: bool) -> None:
    parent = (
        "import os, signal; from analogrig.devices.processes import host_wire;"
        " from tests.harness.processes import children; wire = host_wire();"
        " (pid,) = children(wire.child.tether_pid); print(pid, flush=True);"
        f" {stopped} and os.kill(pid, signal.SIGSTOP); os.kill(os.getpid(), signal.SIGKILL)"
    )
    out = subprocess.run([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True, check=False)
    assert out.returncode == -signal.SIGKILL
    assert ends(int(out.stdout))


# ---- the tether by itself


def test_tether_ends_as_its_command_does() -> None:
    def status(script: str) -> int:
        command = [str(TETHER), "sh", "-c", script]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL) as tether:
            return tether.wait(LONG_S)

    assert [status(script) for script in ("exit 0", "exit 7", "kill -KILL $$", "kill -SEGV $$")] == [0, 7, -9, -11]


def test_tether_without_a_command_explains_itself() -> None:
    done = subprocess.run([TETHER], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "usage: analogrig-tether [--stdio IN OUT] COMMAND [ARGUMENT...]\n")
