"""CAN logs that are damaged or were never any, in every format that is read."""

from __future__ import annotations

import random
from collections.abc import Callable

Mutated = tuple[bytes, str]


def mutated(whole: bytes, suffix: str, rng: random.Random) -> Mutated:
    """One change; text formats get changed words and lines more often than changed bits."""
    is_text = suffix in {"log", "asc", "trc"}
    name = rng.choice([*_BYTES, *(_LINES if is_text else _BYTES)])
    change = (_LINES if name in _LINES else _BYTES)[name]
    return change(whole, rng), f"{suffix}: {name}"


def _flipped(whole: bytes, rng: random.Random, n: int) -> bytes:
    out = bytearray(whole)
    for _ in range(n):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _words(whole: bytes, rng: random.Random) -> bytes:
    """Some words of a line are others."""
    lines = whole.splitlines(keepends=True)
    for _ in range(rng.choice((1, 5, 50))):
        at = rng.randrange(len(lines))
        words = lines[at].split(b" ")
        words[rng.randrange(len(words))] = rng.choice(_WORDS)
        lines[at] = b" ".join(words)
    return b"".join(lines)


def _shuffled(whole: bytes, rng: random.Random) -> bytes:
    lines = whole.splitlines(keepends=True)
    start = rng.randrange(len(lines))
    part = lines[start : start + rng.choice((3, 30, 3000))]
    rng.shuffle(part)
    return b"".join([*lines[:start], *part, *lines[start + len(part) :]])


_WORDS = (
    *(b"", b"-1", b"99999999999999999999", b"nan", b"inf", b"1e308", b"(1e400)", b"can0", b"\xff\xfe", b"\x1b[2J"),
    *(b"7FF#FFFFFFFFFFFFFFFF", b"1FFFFFFF#", b"000#R9", b"123##9112233", b"A" * 100_000, b"d 255", b"Rx", b"0" * 5_000),
)

_BYTES: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "a bit": lambda whole, rng: _flipped(whole, rng, 1),
    "bits": lambda whole, rng: _flipped(whole, rng, 20),
    "a bit of the head": lambda whole, rng: _flipped(whole[:300], rng, 2) + whole[300:],
    "many bits": lambda whole, rng: _flipped(whole, rng, 1000),
    "cut": lambda whole, rng: whole[: rng.randrange(len(whole))],
    "middle missing": lambda whole, rng: whole[: (at := rng.randrange(len(whole)))] + whole[at + rng.randrange(2000) :],
    "twice": lambda whole, _: whole + whole,
    "ones": lambda whole, rng: whole[: (at := rng.randrange(len(whole)))] + b"\xff" * 64 + whole[at + 64 :],
    "nothing": lambda *_: b"",
    "noise": lambda _, rng: rng.randbytes(50_000),
    "head and noise": lambda whole, rng: whole[:144] + rng.randbytes(50_000),
    "head and zeros": lambda whole, _: whole[:300] + bytes(900_000),
}

_LINES: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "words": _words,
    "shuffled": _shuffled,
    "control characters": lambda whole, _: whole.replace(b" ", b"\x1b[31m\x00 ", 50),
    "one long line": lambda whole, _: whole[:2_000] + b"x" * 900_000 + b"\n" + whole[2_000:],
    "no line ends": lambda whole, _: whole.replace(b"\n", b" "),
    "empty lines": lambda whole, _: whole[:2_000] + b"\n" * 900_000,
    "other line ends": lambda whole, _: whole.replace(b"\n", b"\r"),
    "short lines": lambda whole, _: whole[:2_000] + b"x\n" * 400_000,
}
