"""Differences between two plans, by the key names of their files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

SHOWN, LONGEST = 3, 60
"""Number of differences named in one line, and characters shown of each value."""

_ABSENT = object()


def differences(a: Any, b: Any, name: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield each value that differs between two tables of plain values: its dotted name and both values."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in sorted(a.keys() | b.keys()):
            yield from differences(a.get(key, _ABSENT), b.get(key, _ABSENT), f"{name}.{key}" if name else key)
    elif isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        for i, (mine, other) in enumerate(zip(a, b, strict=True)):
            yield from differences(mine, other, f"{name}[{i}]")
    elif a != b:
        yield name, _said(a), _said(b)


def named(found: Sequence[tuple[str, str, str]], sides: tuple[str, str]) -> str:
    """First few differences, as part of a line."""
    more = f", and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return ", ".join(f"{name} is {a} {sides[0]} and {b} {sides[1]}" for name, a, b in found[:SHOWN]) + more


def _said(value: Any) -> str:
    text = "absent" if value is _ABSENT else repr(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
