"""Templates of lines and records: text with fields such as ``{u:d}``, to be written from samples or read as an answer.

A field has a name and a type. Two braces stand for one. The parser is a regular expression of its own with possessive
quantifiers, so the time for a line is linear in its length.
"""

from __future__ import annotations

import binascii
import functools
import math
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

MOST_TEMPLATE = 4_000
"""Characters of a template."""

_TOKENS = re.compile(r"(\{\{|\}\})|\{(\w+):(\w+)\}|([^{}]+)|[{}]")

_FIXED = frozenset({"f32"})
"""Types whose values need no separator."""


class TemplateField(NamedTuple):
    """A field of a template."""

    name: str
    type: str


@dataclass(frozen=True)
class _Text:
    """A type of a field of text."""

    pattern: str
    """Regular expression with one group."""
    read: Callable[[Sequence[bytes]], NDArray[np.float64]]
    """Values of many words."""
    write: str
    """Conversion of Python's bytes formatting."""
    prepare: Callable[[Any], Any] | None = None
    """Conversion of a value before that."""


def _read_decimals(words: Sequence[bytes]) -> NDArray[np.float64]:
    try:
        return np.array(words, np.bytes_).astype(np.float64)
    except ValueError:  # nan(...)
        return np.array([float(word.partition(b"(")[0]) for word in words], np.float64)


def _from_hex(word: bytes) -> float:
    """Value of C's ``%a``; infinite if a double cannot hold it."""
    try:
        return float.fromhex(word.partition(b"(")[0].decode())
    except OverflowError:
        return math.inf


def _read_hexadecimals(words: Sequence[bytes]) -> NDArray[np.float64]:
    try:
        return np.array([*map(float.fromhex, b" ".join(words).decode().split(" "))], np.float64)
    except (ValueError, OverflowError):  # nan(...), or too large for a double
        return np.array([_from_hex(word) for word in words], np.float64)


def _read_bits(words: Sequence[bytes]) -> NDArray[np.float64]:
    return np.frombuffer(bytes.fromhex(b"".join(words).decode()), ">f4").astype(np.float64)


def _read_integers(words: Sequence[bytes]) -> NDArray[np.float64]:
    return np.array([int(word, 16) for word in words], np.float64)


_NOT_FINITE = r"[+-]?(?i:nan(?:\(\w*+\))?|inf(?:inity)?)"

_DECIMAL = rf" *+([+-]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][+-]?[0-9]++)?|{_NOT_FINITE})"

_HEXADECIMAL = rf" *+([+-]?0[xX][0-9a-fA-F]++(?:\.[0-9a-fA-F]*+)?(?:[pP][+-]?[0-9]{{1,6}})?|{_NOT_FINITE})"


_TYPES = {
    "d": _Text(r" *+([+-]?[0-9]{1,18})", _read_decimals, "%d", round),
    "x": _Text(r" *+((?:0[xX])?[0-9a-fA-F]{1,15})", _read_integers, "%x", round),
    "g": _Text(_DECIMAL, _read_decimals, "%.9g"),
    "a": _Text(_HEXADECIMAL, _read_hexadecimals, "%s", lambda value: float(value).hex().encode()),
    "f32": _Text(r" *+([0-9a-fA-F]{8})", _read_bits, "%s", lambda value: struct.pack(">f", value).hex().encode()),
}
"""Types of numbers in text."""

_WORD = "s"
"""Type of a field whose text is ignored."""

BINARY = {"u8": "u1", "i8": "i1", "u16": "<u2", "i16": "<i2", "u32": "<u4", "i32": "<i4", "f32": "<f4", "f64": "<f8"}
"""numpy's name of each type of a binary record."""


@dataclass(frozen=True)
class Checksum:
    """Checksum over the text before its field, in hexadecimal digits."""

    digits: int
    compute: Callable[[bytes], int]


CHECKSUMS = {
    "xor": Checksum(2, lambda text: functools.reduce(int.__xor__, text, 0)),
    "crc16": Checksum(4, lambda text: binascii.crc_hqx(text, 0xFFFF)),
    "crc32": Checksum(8, zlib.crc32),
}
"""Checksums by name: ``crc16`` is CRC-16/CCITT-FALSE, ``crc32`` that of Ethernet and zip."""

CHECKSUM = "checksum"
"""Name of its field, which has the type x."""


def parse(key: str, text: str, types: Sequence[str]) -> tuple[str | TemplateField, ...]:
    """Literal texts and fields of a template.

    :param key: name of the template in its file; it begins every error message.
    :raises ValueError: it is no template, or a field has another type than ``types``.
    """
    if len(text) > MOST_TEMPLATE:
        raise ValueError(f"{key}: longer than {MOST_TEMPLATE} characters")
    parts: list[str | TemplateField] = []
    for token in _TOKENS.finditer(text):
        brace, name, kind, literal = token.groups()
        if name:
            if kind not in types:
                raise ValueError(f"{key}: the type of {token[0]} must be one of {', '.join(types)}")
            parts.append(TemplateField(name, kind))
        elif not (brace or literal):
            raise ValueError(f"{key}: {token[0]!r} is neither {{NAME:TYPE}} nor two braces, which stand for one")
        elif parts and isinstance(parts[-1], str):
            parts[-1] += literal or brace[0]
        else:
            parts.append(literal or brace[0])
    names = [part.name for part in parts if isinstance(part, TemplateField)]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{key}: the field {twice[0]} is there twice")
    return tuple(parts)


class Writer:
    """Writer of lines of text."""

    def __init__(self, key: str, text: str, names: Sequence[str], checksum: Checksum | None = None) -> None:
        """:raises ValueError: the template is wrong, or has other fields than ``names``."""
        parts = parse(key, text, (*_TYPES,))
        self.fields = tuple(part for part in parts if isinstance(part, TemplateField) and part.name != CHECKSUM)
        for field in self.fields:
            if field.name not in names:
                raise ValueError(f"{key}: has no field {field.name} (known: {', '.join((*names, CHECKSUM))})")
        if not text.endswith("\n"):
            raise ValueError(f"{key}: must end with \\n")
        self._prepare = [_TYPES[field.type].prepare for field in self.fields]
        split = _split_at_checksum(key, parts, checksum)
        self._checksum = checksum if split is not None else None
        self._head = b"".join(_format(part) for part in parts[:split])
        self._tail = b"" if split is None else b"".join(_format(part) for part in parts[split + 1 :])

    def lines(self, columns: Sequence[Sequence[Any]], n: int) -> list[bytes]:
        """``n`` lines from the values of each field."""
        prepared = [
            values if prepare is None else list(map(prepare, values))
            for values, prepare in zip(columns, self._prepare, strict=True)
        ]
        if not prepared:
            return [self._finish(self._head % ())] * n
        lines = [self._head % row for row in zip(*prepared, strict=True)]
        return lines if self._checksum is None else list(map(self._finish, lines))

    def _finish(self, head: bytes) -> bytes:
        if self._checksum is None:
            return head
        return b"%s%0*x%s" % (head, self._checksum.digits, self._checksum.compute(head), self._tail)


def _format(part: str | TemplateField) -> bytes:
    """Part of a template for Python's bytes formatting."""
    return _TYPES[part.type].write.encode() if isinstance(part, TemplateField) else part.replace("%", "%%").encode()


def _split_at_checksum(key: str, parts: Sequence[str | TemplateField], checksum: Checksum | None) -> int | None:
    """Position of the checksum; None if there is none.

    :raises ValueError: a field follows it, or its kind or type is wrong.
    """
    position = next(
        (i for i, part in enumerate(parts) if isinstance(part, TemplateField) and part.name == CHECKSUM), None
    )
    if position is None:
        return None
    if checksum is None:
        raise ValueError(f"{key}: has a field {CHECKSUM}: set checksum to one of {', '.join(CHECKSUMS)}")
    if parts[position] != TemplateField(CHECKSUM, "x"):
        raise ValueError(f"{key}: the field {CHECKSUM} must have the type x")
    if any(isinstance(part, TemplateField) for part in parts[position + 1 :]):
        raise ValueError(f"{key}: no field may follow {CHECKSUM}")
    return position


class Reader:
    """Reader of lines of text."""

    def __init__(self, key: str, text: str, ignored: Callable[[str], bool], checksum: Checksum | None = None) -> None:
        """Prepare to read; fields whose name is ``ignored``, and those of the type s, have no value.

        :raises ValueError: the template is wrong.
        """
        parts = parse(key, text, (*_TYPES, _WORD))
        if not text.endswith("\n") or "\n" in text[:-1] or "\r" in text:
            raise ValueError(f"{key}: must be one line that ends with \\n; \\r before it is ignored")
        if any(isinstance(part, TemplateField) and part.name == CHECKSUM for part in parts):
            _split_at_checksum(key, parts, checksum)
        self.fields: list[TemplateField] = []
        pattern = ""
        for part, after in zip(parts, (*parts[1:], ""), strict=True):
            if isinstance(part, str):
                pattern += re.escape(part.removesuffix("\n"))
                continue
            if isinstance(after, TemplateField) and part.type not in _FIXED:
                raise ValueError(f"{key}: nothing separates {part.name} from {after.name}")
            pattern += self._add(part, after, checksum, ignored=ignored(part.name))
        self._match = re.compile(f"{pattern} *+".encode()).fullmatch
        self._checksum = checksum if CHECKSUM in [each.name for each in self.fields] else None

    def _add(self, part: TemplateField, after: str | TemplateField, checksum: Checksum | None, *, ignored: bool) -> str:
        """Pattern of a field, which is added to ``fields`` if it is read."""
        if part.type == _WORD:
            end = after[0] if isinstance(after, str) and after else "\n"
            return f"[^{re.escape(end)}]*+"
        kind = _TYPES[part.type]
        if part.name == CHECKSUM and checksum is not None:
            pattern = rf"([0-9a-fA-F]{{{checksum.digits}}})"
        elif ignored:
            return kind.pattern.replace(" *+(", " *+(?:", 1)
        else:
            pattern = kind.pattern
        self.fields.append(part)
        return pattern

    def read(self, line: bytes) -> tuple[bytes, ...] | None:
        """Words of ``fields`` in a line without its end; None if it is not of this template.

        :raises ChecksumError: its checksum is wrong.
        """
        match = self._match(line)
        if match is None:
            return None
        if self._checksum is not None:
            last = len(self.fields)
            if self._checksum.compute(line[: match.start(last)]) != int(match[last], 16):
                raise ChecksumError
        return match.groups()

    def values(self, words: Sequence[tuple[bytes, ...]], names: Sequence[str]) -> NDArray[np.float64]:
        """(n, k) values of the fields called ``names`` in n lines."""
        out = np.empty((len(words), len(names)))
        if words:
            for field, column in zip(self.fields, zip(*words, strict=True), strict=True):
                if field.name in names:
                    out[:, names.index(field.name)] = _TYPES[field.type].read(column)
        return out


class ChecksumError(ValueError):
    """A line has the form of its template and a wrong checksum."""


def record(key: str, text: str) -> np.dtype[np.void]:
    """Packed little-endian record of a template of binary fields.

    :raises ValueError: the template is wrong, or has text beside its fields.
    """
    parts = parse(key, text, (*BINARY,))
    fields = [part for part in parts if isinstance(part, TemplateField)]
    if len(fields) < len(parts) or not fields:
        raise ValueError(f"{key}: a binary record has fields only, such as {{alarm:u8}}{{a1:f32}}")
    return np.dtype([(field.name, BINARY[field.type]) for field in fields])
