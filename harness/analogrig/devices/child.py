"""Child processes: start a device's process, end it with this one, and report why it ended.

A small program, the tether (tether.c), stands between this process and the device's. It ends the device when this
process ends, even by SIGKILL.
"""

from __future__ import annotations

import contextlib
import re
import select
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from analogrig.errors import LinkClosed, LinkError

if TYPE_CHECKING:  # importing pyserial takes longer than all other imports together
    from analogrig.links.link import Wire

__all__ = ["Child", "ChildWire"]
"""Names for packages beside the core."""

PROGRAMS = Path(__file__).parents[1] / "bin"
"""Folder of the programs that the package brings."""
TETHER = PROGRAMS / "analogrig-tether"

START_TIMEOUT_S = 60.0
"""A loaded machine takes seconds to start a process. One that fails to start ends at once."""
END_TIMEOUT_S = 10.0
"""Longer than the tether waits before it kills, also on a loaded machine."""
CLOSED_TIMEOUT_S = 5.0
"""Time in which a process that has closed its line may end by itself. Its status is then known."""

_COMPLAINT = re.compile(r"[a-z][\w./-]*: ")
"""Beginning of an error message: the program's name. QEMU prints the processor's registers after it."""

T = TypeVar("T")


class Child:
    """A process that ends with this one."""

    def __init__(
        self, command: Sequence[str | Path], what: str, *, inherited: Sequence[int] = (), stdio: Sequence[int] = ()
    ) -> None:
        """Start ``command``, called ``what`` in errors; it inherits these file descriptors.

        :param stdio: descriptors of its standard input and output; by default ``first_line`` reads its output.
        :raises LinkError: the tether was not built.
        """
        self._what = what
        self._stderr = ""
        self._closed_its_line = False
        option = ("--stdio", *map(str, stdio)) if stdio else ()
        try:
            self._process = subprocess.Popen(
                [TETHER, *option, *command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                pass_fds=(*inherited, *stdio),
                process_group=0,  # Ctrl-C reaches the harness only, which then ends the device
            )
        except OSError as error:
            cure = "; run `make setup`" if isinstance(error, FileNotFoundError) else ""
            raise LinkError(f"cannot start {TETHER}: {error.strerror}{cure}") from error

    @property
    def tether_pid(self) -> int:
        return self._process.pid

    @property
    def has_ended(self) -> bool:
        return self._process.poll() is not None

    @property
    def status(self) -> int | None:
        """Exit status, negative for a signal; None while the process runs."""
        return self._process.poll()

    def connect(self, open_line: Callable[[str], T]) -> T:
        """Result of ``open_line``, called with the first line of output. If that fails, the process is ended.

        :raises LinkError: see ``first_line``.
        """
        try:
            return open_line(self.first_line())
        except BaseException:
            self.end()
            raise

    def first_line(self) -> str:
        """First line of its output.

        :raises LinkError: none came in time, or the process has ended.
        """
        stdout, line = self._process.stdout, b""
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not line.endswith(b"\n"):
            left_s = max(0.0, deadline_s - time.monotonic())
            if stdout is None or not select.select([stdout], [], [], left_s)[0]:
                raise LinkError(f"{self._what} printed nothing within {START_TIMEOUT_S} s of its start")
            received = stdout.read(1)
            if not received:
                raise LinkClosed(self.exit_report())
            line += received
        return line.decode(errors="replace").strip()

    def exit_report(self) -> str:
        """Exit status with the last error message, or else the last line, of its standard error.

        A process that only closed its line is ended. A crash keeps its status: a process that ends takes no signal.
        """
        if not (self._closed_its_line or self._ends_within(CLOSED_TIMEOUT_S)):
            self._close_input()
            ended = self._ends_within(END_TIMEOUT_S)
            self._closed_its_line = not ended or self.status in (-signal.SIGTERM, -signal.SIGKILL)
        if self._closed_its_line:
            return f"{self._what} closed its line"
        if self._process.stderr is not None and not self._process.stderr.closed:
            self._stderr += self._process.stderr.read().decode(errors="replace")
        lines = self._stderr.strip().splitlines()
        messages = [line for line in lines if _COMPLAINT.match(line)] or lines
        status = str(self._process.wait())
        with contextlib.suppress(ValueError):
            status = f"{status} ({signal.Signals(-int(status)).name})"
        return f"{self._what} ended with status {status}{f': {messages[-1]}' if messages else ''}"

    @contextlib.contextmanager
    def reports_exit(self) -> Iterator[None]:
        """Replace the message of LinkClosed by the exit report."""
        try:
            yield
        except LinkClosed as error:
            raise LinkClosed(self.exit_report()) from error

    def end(self) -> None:
        """End the process by closing the tether's input. May be called twice."""
        self._close_input()
        if self._process.stdout is not None:
            self._process.stdout.close()
        if not self._ends_within(END_TIMEOUT_S):
            self._process.kill()  # the kernel then kills the command
            self._process.wait()
        if self._process.stderr is not None:
            self._process.stderr.close()

    def _close_input(self) -> None:
        """Make the tether end the command."""
        if self._process.stdin is not None:
            self._process.stdin.close()

    def _ends_within(self, time_s: float) -> bool:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(time_s)
        return self.has_ended


class ChildWire:
    """A wire to a child process, which ends when the wire is closed."""

    def __init__(self, child: Child, wire: Wire) -> None:
        """Take over both."""
        self.child = child
        self._wire = wire
        self.name = wire.name
        self.clock = wire.clock

    def write(self, sent: bytes) -> None:
        try:  # a context manager would take longer than the exchange of a line
            self._wire.write(sent)
        except LinkClosed as error:
            raise LinkClosed(self.child.exit_report()) from error

    def read(self, timeout_s: float) -> bytes:
        try:
            return self._wire.read(timeout_s)
        except LinkClosed as error:
            raise LinkClosed(self.child.exit_report()) from error

    def close(self) -> None:
        self._wire.close()
        self.child.end()
