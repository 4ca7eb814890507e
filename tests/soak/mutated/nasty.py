"""Values that no file should hold, and where to put them."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

NUMBERS: tuple[int | float, ...] = (
    *(0, 1, -1, 2, 7, 1000, 65_536, 2**31, 2**53 + 1, 2**62, 2**63, -(2**63), 10**25),
    *(0.0, -0.0, 0.5, -0.5, 1.5, 1e-300, 1e-30, 1e-9, -1e-9, 1e9, 1e12, 1e30, -1e30, 1e300),
    *(float("inf"), float("-inf"), float("nan")),
)

TEXTS = (
    "",
    "x",
    "none",
    "nan",
    "\x1b[2J\x1b]0;owned\x07",
    "a\nb\rc\td",
    "\u202e\u2028\x85\x9b31m",
    "../../../etc/passwd",
    "/dev/zero",
    "A" * 100_000,
    "%s%n{0}",
    "\U0001f600",
)

OTHERS: tuple[Any, ...] = (True, False, [], {}, [[]], [0], [1.0, 2.0], {"name": "x"}, [{}], {"": ""}, list(range(1800)))

Place = tuple[str | int, ...]


def places(value: Any, place: Place = ()) -> Iterator[Place]:
    """Every path into nested tables and lists, the root left out."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*place, key)
        yield from places(item, (*place, key))


def parent(value: Any, place: Place) -> Any:
    """The table or list that holds the value at ``place``."""
    for key in place[:-1]:
        value = value[key]
    return value


def each_value(old: Any) -> Iterator[Any]:
    """Absurd values in the place of a number, and values of other types."""
    if isinstance(old, int | float) and not isinstance(old, bool):
        yield from NUMBERS
    yield from ("x", True, [], {}, None)


def value(rng: random.Random, old: Any) -> Any:
    """Another value: mostly of the same kind, so that it comes as far as possible."""
    if isinstance(old, bool) or rng.random() < 0.25:
        return rng.choice((*NUMBERS, *TEXTS, *OTHERS, None))
    if isinstance(old, int):
        near = rng.choice((-1, 1, 10, -10, 100))
        return rng.choice((*(each for each in NUMBERS if isinstance(each, int)), old + near, -old, old * 1000))
    if isinstance(old, float):
        return rng.choice((*NUMBERS, old * 1e6, old * 1e-6, -old, old * 1e15))
    if isinstance(old, str):
        return rng.choice(TEXTS)
    if isinstance(old, list) and old:
        return rng.choice(([], old * 2, old[:-1], [*old, rng.choice(NUMBERS)], old[::-1], old * 500))
    return rng.choice(OTHERS)


def replace_one(rng: random.Random, table: Any) -> str:
    """Put one other value into nested plain values, in place; returns what was done."""
    place = rng.choice(list(places(table)))
    holder, key = parent(table, place), place[-1]
    what = rng.random()
    if what < 0.08:
        del holder[key]
        return f"{place} deleted"
    if what < 0.14 and isinstance(holder, dict):
        holder[rng.choice(("unknown", "\x1b[31m", "K" * 50_000, "", "name", "kind"))] = value(rng, holder[key])
        return f"key beside {place}"
    holder[key] = value(rng, holder[key])
    return f"{place} = {brief(holder[key])}"


def brief(value: Any) -> str:
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
