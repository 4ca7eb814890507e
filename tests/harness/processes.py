"""What the operating system says about processes."""

from __future__ import annotations

import os
import select
from pathlib import Path

LONG_S = 600.0
"""Limit for an event that comes at once unless something is broken, also under a load of ten."""


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def descendants(pid: int) -> list[int]:
    """Children, and theirs."""
    return [each for child in children(pid) for each in (child, *descendants(child))]


def ends(pid: int, within_s: float = LONG_S) -> bool:
    """Whether a process ends in time, or has ended."""
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([fd], [], [], within_s)[0])
    finally:
        os.close(fd)
