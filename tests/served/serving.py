"""`analogrig serve` in another process, and clients of it."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.harness.processes import LONG_S

ROOT = Path(__file__).parents[2]

RIG = """\
[rig.bench]
kind = "real"
instrument = "redpitaya://{address}"
timeout_s = 60.0
generator.gain = 10.0
inputs.force = {{ input = 1, range = "HV" }}
inputs.displacement = {{ input = 2, range = "HV" }}
pots.kind = "instrument"
self_test = {self_test}
"""
"""Rigs file with a rig on the served instrument, correctly wired."""


@dataclass(frozen=True)
class Served:
    """Running server."""

    process: subprocess.Popen[str]
    said: dict[str, Any]
    """First line of its output."""

    @property
    def port(self) -> int:
        return int(self.said["port"])

    @property
    def address(self) -> str:
        return str(self.said["address"])

    def rigs_file(self, folder: Path, *, self_test: bool = False) -> Path:
        """Rigs file with the rig ``bench``: this instrument, correctly wired."""
        path = folder / "rigs.toml"
        path.write_text(RIG.format(address=self.address, self_test=str(self_test).lower()))
        return path

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=LONG_S)

    def client(self) -> Client:
        return Client(self.connect())

    @property
    def most_resident_kb(self) -> int:
        """Largest resident memory so far."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0])

    @property
    def processor_s(self) -> float:
        """Processor time of the server, which does not depend on the load of the machine."""
        times = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")


class Client:
    """Client that sends and receives lines."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self._heard = connection.makefile("rb")

    def say(self, *lines: str) -> None:
        self.connection.sendall("".join(f"{line}\r\n" for line in lines).encode())

    def ask(self, line: str) -> str:
        self.say(line)
        return self._heard.readline().decode("ascii").removesuffix("\r\n")

    def rest(self) -> bytes:
        """Everything received until the connection is closed."""
        return self._heard.read()

    def close(self) -> None:
        self._heard.close()
        self.connection.close()


@contextmanager
def serving(*options: str) -> Iterator[Served]:
    """Serve on a free port until the end of the block."""
    command = [sys.executable, "-m", "analogrig.cli", "serve", "--port", "0", "--json", *options]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout is None:
                raise RuntimeError("no standard output")
            yield Served(process, json.loads(process.stdout.readline()))
        finally:
            process.kill()


def ended(served: Served, statuses: Sequence[int] = (0,)) -> str:
    """Await the end of a server. Return its standard error.

    :raises AssertionError: another exit status than those expected.
    """
    _, said = served.process.communicate(timeout=LONG_S)
    if served.process.returncode not in statuses:
        raise AssertionError(f"ended with {served.process.returncode}: {said}")
    return said
