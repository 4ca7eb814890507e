"""Stores of a campaign, forged: values and bytes that no campaign writes."""

# ruff: noqa: S608 - the names are those of our own columns

from __future__ import annotations

import contextlib
import json
import random
import sqlite3
import zlib
from pathlib import Path

from tests.soak.mutated.nasty import replace_one

Mutated = tuple[bytes, str]


def mutated(whole: bytes, rng: random.Random, path: Path) -> Mutated:
    """A store with one other value, or damaged bytes; ``path``: a file to work in."""
    if rng.random() < 0.4:
        at = rng.randrange(len(whole))
        other = rng.choice((b"", b"\xff", bytes(rng.randbytes(64)), bytes(900_000)))
        return whole[:at] + other + whole[at + len(other) :], f"bytes at {at}"
    path.write_bytes(whole)
    with contextlib.closing(sqlite3.connect(path)) as file:
        what = rng.choice((_plan, _column, _number))(file, rng)
        file.commit()
    return path.read_bytes(), what


def _plan(file: sqlite3.Connection, rng: random.Random) -> str:
    table = json.loads(file.execute("SELECT plan FROM campaign").fetchone()[0])
    what = replace_one(rng, table)
    file.execute("UPDATE campaign SET plan = ?", (json.dumps(table),))
    return f"plan: {what}"


def _column(file: sqlite3.Connection, rng: random.Random) -> str:
    names = [row[1] for row in file.execute("PRAGMA table_info(trials)")][2:]
    name = rng.choice(names)
    raw = bytearray(zlib.decompress(file.execute(f"SELECT {name} FROM trials").fetchone()[0]))
    values: tuple[object, ...] = (
        None,
        "x",
        1e308,
        b"",
        zlib.compress(bytes(50_000_000)),
        zlib.compress(rng.randbytes(len(raw))),
    )
    value = rng.choice(values)
    with contextlib.suppress(sqlite3.IntegrityError):  # a column refuses NULL
        file.execute(f"UPDATE trials SET {name} = ?", (value,))
    return f"column {name}"


def _number(file: sqlite3.Connection, rng: random.Random) -> str:
    name, value = rng.choice(("first", "count")), rng.choice((-1, 0, 10**9, 2**62))
    with contextlib.suppress(sqlite3.IntegrityError):
        file.execute(f"UPDATE trials SET {name} = ?", (value,))
    return f"{name} = {value}"
