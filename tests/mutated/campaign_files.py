"""Journals and results of a campaign, forged: lines with a sound checksum that no campaign writes."""

from __future__ import annotations

import json
import random
import zlib

from tests.mutated.nasty import replace_one

Mutated = tuple[bytes, str]


def mutated(whole: bytes, kind: str, rng: random.Random) -> Mutated:
    """A journal or the results with one other value, or damaged bytes."""
    if rng.random() < 0.2:
        at = rng.randrange(len(whole))
        other = rng.choice((b"", b"\xff", b"[" * 100_000, b"\n" * 900_000))
        return whole[:at] + other + whole[at + 1 :], f"bytes at {at}"
    if kind == "results":
        table = json.loads(whole)
        what = replace_one(rng, table)
        return json.dumps(table).encode(), what
    lines = whole.splitlines()
    at = rng.choice((0, len(lines) - 1, rng.randrange(len(lines))))
    entry = json.loads(lines[at].partition(b" ")[2])
    what = replace_one(rng, entry)
    lines[at] = journal_line(entry)
    return b"\n".join(lines) + b"\n", f"line {at}: {what}"


def journal_line(entry: object) -> bytes:
    """With the checksum of the journal's format."""
    text = json.dumps(entry, sort_keys=True, separators=(",", ":")).encode()
    return b"%08x %s" % (zlib.crc32(text), text)
