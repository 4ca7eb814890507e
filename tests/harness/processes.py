"""What the operating system says about processes."""

from __future__ import annotations

from pathlib import Path


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def descendants(pid: int) -> list[int]:
    """Children, and theirs."""
    return [each for child in children(pid) for each in (child, *descendants(child))]
