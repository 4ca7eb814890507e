"""One command in a process of its own that is forked from this one, with bounds of time and memory.

Fork only from a process without threads.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

MOST_CPU_S = 5.0
MOST_MB = 200

_HANGS_S = 300
"""Limit of the wall clock: nothing that is awaited takes so long, not on a loaded machine."""

_KILL_MB = 4_000
"""Limit of the address space, for the sake of the machine."""

_REFUSED = 2

_FAULT = "a fault of analogrig itself"


@dataclass(frozen=True)
class Case:
    """A command on one file that was made from a seed."""

    kind: str
    """Name of the row in the table."""
    argv: tuple[str, ...]
    what: str
    """Was done to the file."""
    asks_much: bool = False
    """It may take longer: the file asks for as much."""


@dataclass(frozen=True)
class Outcome:
    status: int
    """Negative: ended by that signal."""
    stderr: bytes
    cpu_s: float
    memory_mb: float

    def problems(self, case: Case) -> list[str]:
        """Faults of the trial; empty if there are none."""
        out: list[str] = []
        is_long = self.status == -signal.SIGXCPU
        if is_long and case.asks_much:
            return out
        if self.status not in (0, 1, 2, 3):
            what = signal.Signals(-self.status).name if self.status < 0 else str(self.status)
            out.append(f"over {MOST_CPU_S:g} s of CPU" if is_long else f"status {what}")
        lines = self.stderr.splitlines()
        if len(lines) > 1 or (self.stderr and not self.stderr.endswith(b"\n")):
            out.append(f"{len(lines)} lines")
        if self.status == _REFUSED and not lines:
            out.append("says nothing")
        text = self.stderr.decode("utf-8", "replace")
        if _FAULT in text or "Traceback" in text:
            out.append("its own fault")
        if not text.replace("\n", "").isprintable():
            out.append("control characters")
        if len(self.stderr) > _MOST_STDERR:
            out.append(f"{len(self.stderr)} bytes of stderr")
        if self.memory_mb > MOST_MB and not case.asks_much:
            out.append(f"{self.memory_mb:.0f} MB")
        return out


_MOST_STDERR = 2_000


@dataclass(frozen=True)
class Running:
    """A case that has begun."""

    case: Case
    pid: int
    stderr: Path
    deadline_s: float

    def kill_if_hung(self) -> None:
        if time.monotonic() > self.deadline_s:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)

    def outcome(self, status: int, usage: resource.struct_rusage) -> Outcome:
        text = self.stderr.read_bytes()
        self.stderr.unlink()
        return Outcome(
            os.waitstatus_to_exitcode(status), text, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0
        )


def begin(case: Case, folder: Path) -> Running:
    """In a child, whose standard error goes to a file."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    stderr = folder / f"stderr-{pid or os.getpid()}"
    if pid:
        return Running(case, pid, stderr, time.monotonic() + _HANGS_S)
    status = 125
    try:
        status = _run(case, stderr)
    finally:
        os._exit(status)


def _run(case: Case, stderr: Path) -> int:
    """In the child."""
    os.setpgrp()
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(os.open(stderr, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), 2)
    resource.setrlimit(resource.RLIMIT_CPU, (int(MOST_CPU_S), int(MOST_CPU_S) + 5))
    resource.setrlimit(resource.RLIMIT_AS, (_KILL_MB << 20, _KILL_MB << 20))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from analogrig.cli import main

    try:
        status = main(case.argv)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    sys.stdout.flush()
    sys.stderr.flush()
    return status
