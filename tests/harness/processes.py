"""Processes, as the operating system shows them."""

from __future__ import annotations

import os
import select
import time
from pathlib import Path

LONG_S = 600.0
"""Limit for an event that comes at once unless something is broken, also under a load of ten."""


def children(pid: int) -> list[int]:
    """The processes that one has started; none if it has ended meanwhile."""
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except (FileNotFoundError, ProcessLookupError):
        return []


def descendants(pid: int) -> list[int]:
    """Children, and theirs."""
    return [each for child in children(pid) for each in (child, *descendants(child))]


def ends(pid: int, within_s: float = LONG_S) -> bool:
    """True if a process ends in time, or has ended."""
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([fd], [], [], within_s)[0])
    finally:
        os.close(fd)


def is_idle(pid: int) -> bool:
    """True if all threads of the process slept at one moment: only an event from outside can wake it.

    Two equal looks show that no thread has run between them.
    """
    states = _states(pid)
    return all("\nState:\tS" in state for state in states) and _states(pid) == states


def _states(pid: int) -> list[str]:
    """Status of each thread, with the number of times it was put to sleep; empty if the process has ended."""
    try:
        return [(thread / "status").read_text() for thread in sorted(Path(f"/proc/{pid}/task").iterdir())]
    except (FileNotFoundError, ProcessLookupError):
        return []


def marked(mark: str) -> list[int]:
    """The processes that have it in their environment, as what they start has too."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (process / "environ").read_bytes():
                found.append(int(process.name))
        except OSError:  # it has just ended, or is none of ours
            continue
    return found


def gone(mark: str) -> bool:
    """True if all of them end in time: none is found twice in a row, for a process has no environment during exec()."""
    deadline_s = time.monotonic() + LONG_S
    looks = 0
    while looks < 2 and time.monotonic() < deadline_s:
        looks = 0 if marked(mark) else looks + 1
        time.sleep(0.05)
    return looks == 2


def with_default_signals(*command: str | Path) -> list[str | Path]:
    """The command, started with no signal ignored, as ``nohup`` would have it: children inherit that."""
    return ["env", "--default-signal=INT,TERM,HUP", *command]
