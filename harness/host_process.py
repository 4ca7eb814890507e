"""The device as a process of this computer, behind a pseudo-terminal: a wire that owns its other end."""

from __future__ import annotations

import select
import subprocess
from collections.abc import Sequence
from pathlib import Path

from harness.errors import LinkClosed, LinkError
from harness.wire import PortWire

PROGRAM = Path(__file__).parent / "bin" / "analogrig-device"

START_TIMEOUT_S = 5.0
END_TIMEOUT_S = 2.0


class HostProcess:
    """Starts the host port and is the wire to it. The process ends with the wire, and when this process dies."""

    name = "pty"

    def __init__(self, arguments: Sequence[str] = (), *, program: Path = PROGRAM) -> None:
        """Start it.

        :raises LinkError: it cannot be started, or does not say where it listens.
        """
        try:
            self._process = subprocess.Popen(
                [str(program), *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                process_group=0,  # Ctrl-C is for the harness, which then ends the device
            )
        except OSError as error:
            raise LinkError(f"cannot start {program}: {error.strerror}; run `make setup`") from error
        try:
            self._wire = PortWire(self._terminal(), name=self.name)
        except BaseException:
            self._end()
            raise
        self.clock = self._wire.clock

    @property
    def pid(self) -> int:
        return self._process.pid

    def write(self, sent: bytes) -> None:
        try:
            self._wire.write(sent)
        except LinkClosed as error:
            raise LinkClosed(self._obituary()) from error

    def read(self, timeout_s: float) -> bytes:
        try:
            return self._wire.read(timeout_s)
        except LinkClosed as error:
            raise LinkClosed(self._obituary()) from error

    def close(self) -> None:
        self._wire.close()
        self._end()

    def _terminal(self) -> str:
        """The path that the process prints first."""
        stdout = self._process.stdout
        if stdout is None or not select.select([stdout], [], [], START_TIMEOUT_S)[0]:
            raise LinkError(f"the device process said nothing within {START_TIMEOUT_S} s of its start")
        path = stdout.readline().decode(errors="replace").strip()
        if not path:
            raise LinkClosed(self._obituary())
        return path

    def _obituary(self) -> str:
        try:
            return f"the device process ended with status {self._process.wait(END_TIMEOUT_S)}"
        except subprocess.TimeoutExpired:
            return f"the device process {self.pid} closed its terminal"

    def _end(self) -> None:
        """The end of its input is the end of the process; if it does not see it, it is killed."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        try:
            self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
