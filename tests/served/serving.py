"""`analogrig serve` in another process, its server in a thread, and clients of it."""

from __future__ import annotations

import asyncio
import json
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analogrig.config import locate
from analogrig.program import Program
from analogrig.scenario import DEFAULT_SEED
from analogrig_instruments.simulator.served import ServedDescription
from analogrig_instruments.simulator.server import Server
from analogrig_instruments.simulator.tcp_server import TcpServer
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

    said: dict[str, Any]
    """First line of its output."""

    @property
    def port(self) -> int:
        return int(self.said["port"])

    @property
    def address(self) -> str:
        return str(self.said["address"])

    def rigs_file(self, folder: Path, *, self_test: bool = False, template: str = RIG) -> Path:
        """Rigs file with the rig ``bench``: this instrument, correctly wired."""
        path = folder / "rigs.toml"
        path.write_text(template.format(address=self.address, self_test=str(self_test).lower()))
        return path

    def lucidac_file(self, folder: Path) -> str:
        """Shipped rig of a LUCIDAC at this address."""
        path = folder / "lucidac.toml"
        path.write_text(locate("rigs", "lucidac").read_text().replace("//127.0.0.1", f"//{self.address}"))
        return str(path)

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=LONG_S)

    def client(self) -> Client:
        return Client(self.connect())


@dataclass(frozen=True)
class ServedByProcess(Served):
    """Running server in another process."""

    process: subprocess.Popen[str]

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
def serving(*options: str) -> Iterator[ServedByProcess]:
    """Serve on a free port until the end of the block."""
    command = [sys.executable, "-m", "analogrig.cli", "serve", "--port", "0", "--json", *options]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout is None:
                raise RuntimeError("no standard output")
            yield ServedByProcess(json.loads(process.stdout.readline()), process)
        finally:
            process.kill()


def ended(served: ServedByProcess, statuses: Sequence[int] = (0,)) -> str:
    """Await the end of a server. Return its standard error.

    :raises AssertionError: another exit status than those expected.
    """
    _, said = served.process.communicate(timeout=LONG_S)
    if served.process.returncode not in statuses:
        raise AssertionError(f"ended with {served.process.returncode}: {said}")
    return said


@contextmanager
def serving_in_thread(*defects: str, rig: str = "emulator", program: str = "front") -> Iterator[Served]:
    """Serve a rig with defects in a thread of this process until the end of the block: sooner than another process."""
    with in_thread(Server(ServedDescription.load(rig, defects).set_up(Program.load(program), DEFAULT_SEED))) as served:
        yield served


@contextmanager
def in_thread(server: TcpServer) -> Iterator[Served]:
    """Run a server in a thread of this process until the end of the block."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    try:
        listening = asyncio.run_coroutine_threadsafe(server.listen("127.0.0.1", 0), loop)
        host, port = listening.result(LONG_S)
        yield Served({"port": port, "address": f"{host}:{port}"})
    finally:
        asyncio.run_coroutine_threadsafe(server.close(), loop).result(LONG_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(LONG_S)
        loop.close()
