"""`analogrig serve -- COMMAND`: the rig is served while a command runs."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from analogrig.cli import main
from tests.harness.processes import ends

SERVE = [sys.executable, "-m", "analogrig.cli", "serve", "--port", "0", "--"]

ASK = """
import os, sys
sys.stdout.write("asked\\n"); sys.stdout.flush()
sys.exit(%d)
"""


def address(line: str) -> tuple[str, int]:
    host, port = re.findall(r" at (\S+):(\d+)$", line)[0]
    return host, int(port)


@pytest.mark.parametrize("status", [0, 7])
def test_status_is_that_of_the_command(status: int) -> None:
    done = subprocess.run([*SERVE, sys.executable, "-c", ASK % status], stdout=subprocess.PIPE, text=True, check=False)
    assert done.returncode == status
    assert done.stdout.splitlines()[1:] == ["asked"]


def test_rig_is_served_before_the_command_starts_and_no_longer_than_it_runs(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "go")
    command = [*SERVE, sys.executable, "-c", f"open({str(tmp_path / 'go')!r}).read()"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        where = address(process.stdout.readline().strip())
        with socket.create_connection(where, timeout=60.0) as client, client.makefile("rb") as heard:
            client.sendall(b"*IDN?\r\n")
            assert heard.readline().strip()
        (tmp_path / "go").write_text("")
        assert process.wait() == 0
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(where, timeout=60.0)


def test_termination_ends_the_command_too(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pid")
    ask = f"import os, signal; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); signal.pause()"
    with subprocess.Popen([*SERVE, sys.executable, "-c", ask], stdout=subprocess.DEVNULL) as process:
        pid = int((tmp_path / "pid").read_text())
        process.send_signal(signal.SIGTERM)
        assert process.wait() == 130
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_command_ends_with_a_server_that_is_killed(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pid")
    ask = f"import os, signal; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); signal.pause()"
    with subprocess.Popen([*SERVE, sys.executable, "-c", ask], stdout=subprocess.DEVNULL) as process:
        pid = int((tmp_path / "pid").read_text())
        process.kill()
        process.wait()
    assert ends(pid)


def test_command_that_cannot_be_started_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--port", "0", "--", "/nowhere/at-all"]) == 2
    assert capsys.readouterr().err == "analogrig: /nowhere/at-all: cannot be started: No such file or directory\n"
