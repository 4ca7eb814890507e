"""A device that is a process of this computer, whatever it is: started, tethered to this process, ended, mourned.

The tether is a program of its own (tether.c) between this process and the device's. It sees when this process ends, be
it by SIGKILL, and ends the device.
"""

from __future__ import annotations

import re
import select
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from analogrig.errors import LinkClosed, LinkError
from analogrig.links.wire import Wire

TETHER = Path(__file__).parents[1] / "bin" / "analogrig-tether"

START_TIMEOUT_S = 5.0
END_TIMEOUT_S = 3.0
"""Longer than the tether waits before it kills."""

_COMPLAINT = re.compile(r"[a-z][\w./-]*: ")
"""As programs begin it, with their name: QEMU adds all the registers of the processor."""


class Child:
    """The process."""

    def __init__(self, command: Sequence[str | Path], what: str, *, inherited: Sequence[int] = ()) -> None:
        """Start it; errors call it ``what``. Of our descriptors it has ``inherited``.

        :raises LinkError: the tether was not built.
        """
        self._what = what
        self._last_words = ""
        try:
            self._process = subprocess.Popen(
                [TETHER, *command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                pass_fds=inherited,
                process_group=0,  # Ctrl-C is for the harness, which then ends the device
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

    def first_line(self) -> str:
        """What it says first.

        :raises LinkError: nothing in time, or it has ended.
        """
        stdout, line = self._process.stdout, b""
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not line.endswith(b"\n"):
            left_s = max(0.0, deadline_s - time.monotonic())
            if stdout is None or not select.select([stdout], [], [], left_s)[0]:
                raise LinkError(f"{self._what} said nothing within {START_TIMEOUT_S} s of its start")
            said = stdout.read(1)
            if not said:
                raise LinkClosed(self.obituary())
            line += said
        return line.decode(errors="replace").strip()

    def obituary(self) -> str:
        """How it ended, with its last complaint, or whatever it said last."""
        try:
            status = self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return f"{self._what} closed its line"
        if self._process.stderr is not None and not self._process.stderr.closed:
            self._last_words += self._process.stderr.read().decode(errors="replace")
        lines = self._last_words.strip().splitlines()
        told = [line for line in lines if _COMPLAINT.match(line)] or lines
        return f"{self._what} ended with status {status}{f': {told[-1]}' if told else ''}"

    def end(self) -> None:
        """The end of the tether's input is the end of both. May be called twice."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        try:
            self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()  # and the kernel kills what it held
            self._process.wait()
        if self._process.stderr is not None:
            self._process.stderr.close()


class ChildWire:
    """A wire whose other end is a child: it ends with the wire, and its death is told for what it is."""

    def __init__(self, child: Child, wire: Wire) -> None:
        """Take over both."""
        self.child = child
        self._wire = wire
        self.name = wire.name
        self.clock = wire.clock

    def write(self, sent: bytes) -> None:
        try:
            self._wire.write(sent)
        except LinkClosed as error:
            raise LinkClosed(self.child.obituary()) from error

    def read(self, timeout_s: float) -> bytes:
        try:
            return self._wire.read(timeout_s)
        except LinkClosed as error:
            raise LinkClosed(self.child.obituary()) from error

    def close(self) -> None:
        self._wire.close()
        self.child.end()
