"""Templates of messages, to be written from samples or read as an answer.

In a line of text a field such as ``{u:d}`` has a name and a type; two braces stand for one. The parser is a regular
expression of its own with possessive quantifiers, so the time for a line is linear in its length. A binary record has
packed fields such as ``{u:u16}``, and constant bytes in hexadecimal digits.
"""

from __future__ import annotations

import contextlib
import functools
import re
import struct
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import anycrc
import numpy as np
from numpy.typing import NDArray

__all__ = ["checksum_of"]
"""Names for packages beside the core."""

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


def _read_hexadecimals(words: Sequence[bytes]) -> NDArray[np.float64]:
    """Values of C's ``%a``; infinite if a double cannot hold one."""
    try:
        return np.array([*map(float.fromhex, b" ".join(words).decode().split(" "))], np.float64)
    except (ValueError, OverflowError):  # nan(...), or too large for a double
        values = np.full(len(words), np.inf)
        for at, word in enumerate(words):
            with contextlib.suppress(OverflowError):
                values[at] = float.fromhex(word.partition(b"(")[0].decode())
        return values


def _read_each(value: Callable[[bytes], float]) -> Callable[[Sequence[bytes]], NDArray[np.float64]]:
    return lambda words: np.array([value(word) for word in words], np.float64)


def _read_bits(words: Sequence[bytes]) -> NDArray[np.float64]:
    return np.frombuffer(bytes.fromhex(b"".join(words).decode()), ">f4").astype(np.float64)


_NOT_FINITE = r"[+-]?(?i:nan(?:\(\w*+\))?|inf(?:inity)?)"

_DECIMAL = rf" *+([+-]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][+-]?[0-9]++)?|{_NOT_FINITE})"

_HEXADECIMAL = rf" *+([+-]?0[xX][0-9a-fA-F]++(?:\.[0-9a-fA-F]*+)?(?:[pP][+-]?[0-9]{{1,6}})?|{_NOT_FINITE})"


_TYPES = {
    "d": _Text(r" *+([+-]?[0-9]{1,18})", _read_decimals, "%d", round),
    "x": _Text(r" *+((?:0[xX])?[0-9a-fA-F]{1,15})", _read_each(lambda word: int(word, 16)), "%x", round),
    "g": _Text(_DECIMAL, _read_decimals, "%.9g"),
    "a": _Text(_HEXADECIMAL, _read_hexadecimals, "%s", lambda value: float(value).hex().encode()),
    "f32": _Text(r" *+([0-9a-fA-F]{8})", _read_bits, "%s", lambda value: struct.pack(">f", value).hex().encode()),
    "b": _Text(
        r" *+((?i:true|false)|[01])",
        _read_each(lambda word: word.lower() in (b"true", b"1")),
        "%s",
        lambda value: b"true" if value else b"false",
    ),
}
"""Types of numbers in text."""

_WORD = "s"
"""Type of a field whose text is ignored."""


@dataclass(frozen=True)
class Checksum:
    """Checksum over what precedes its field."""

    bits: int
    compute: Callable[[bytes], int]

    @property
    def digits(self) -> int:
        """Hexadecimal digits of its value."""
        return -(-self.bits // 4)


_SHORT = {"crc16": "CRC16-IBM-3740", "crc32": "CRC32-ISO-HDLC"}
"""Names that a device file may use for a CRC, beside those of the catalogue of CRCs."""


def checksum_of(name: str) -> Checksum:
    """Checksum by its name: xor, or a CRC such as CRC-16/MODBUS.

    :raises ValueError: there is none of that name, or several.
    """
    if name == "xor":
        return Checksum(8, lambda content: functools.reduce(int.__xor__, content, 0))
    wanted = _SHORT.get(name) or re.sub(r"^CRC-(?=\d)", "CRC", re.sub(r"[/ _]", "-", name.upper()))
    if wanted == "CRC16":
        raise ValueError(f"checksum: {name} is the name of several: CRC-16/ARC, CRC-16/MODBUS, CRC-16/CCITT-FALSE, ...")
    wanted = anycrc.aliases.get(wanted, wanted)
    bits = re.match(r"CRC(\d+)", wanted)
    if wanted not in anycrc.models or bits is None:
        raise ValueError(f"checksum: unknown {name!r}: use xor, crc16, crc32, or a CRC such as CRC-16/MODBUS")
    return Checksum(int(bits[1]), anycrc.Model(wanted).calc)


CHECKSUM = "checksum"
"""Name of its field."""

PAD = "_"
"""Name of fields without a meaning. It may be there several times."""


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
    if twice := [name for name in names if names.count(name) > 1 and name != PAD]:
        raise ValueError(f"{key}: the field {twice[0]} is there twice")
    return tuple(parts)


def _check_known(key: str, fields: Sequence[TemplateField], names: Sequence[str]) -> None:
    """:raises ValueError: a field has another name than ``names``."""
    for field in fields:
        if field.name not in names:
            raise ValueError(f"{key}: has no field {field.name} (known: {', '.join((*names, CHECKSUM))})")


class Writer:
    """Writer of lines of text."""

    def __init__(self, key: str, text: str, names: Sequence[str], checksum: Checksum | None = None) -> None:
        """:raises ValueError: the template is wrong, or has other fields than ``names``."""
        parts = parse(key, text, (*_TYPES,))
        self.fields = tuple(part for part in parts if isinstance(part, TemplateField) and part.name != CHECKSUM)
        _check_known(key, self.fields, names)
        self._prepare = [_TYPES[field.type].prepare for field in self.fields]
        split = _split_at_checksum(key, parts, checksum)
        self._checksum = checksum if split is not None else None
        self._head = b"".join(_format(part) for part in parts[:split])
        self._tail = b"" if split is None else b"".join(_format(part) for part in parts[split + 1 :])

    def contents(self, columns: Sequence[NDArray[Any]], n: int) -> list[bytes]:
        """Contents of ``n`` messages, from the values of each field."""
        prepared = [
            values.tolist() if prepare is None else list(map(prepare, values.tolist()))
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
        raise ValueError(f"{key}: has a field {CHECKSUM}: set checksum, such as to CRC-16/MODBUS")
    if parts[position] != TemplateField(CHECKSUM, "x"):
        raise ValueError(f"{key}: the field {CHECKSUM} must have the type x")
    if any(isinstance(part, TemplateField) for part in parts[position + 1 :]):
        raise ValueError(f"{key}: no field may follow {CHECKSUM}")
    return position


class Reader:
    """Reader of lines of text."""

    def __init__(
        self,
        key: str,
        text: str,
        ignored: Callable[[str], bool],
        checksum: Checksum | None = None,
        states: Collection[int | str] = (),
    ) -> None:
        """Prepare to read; fields whose name is ``ignored``, and those of the type s, have no value.

        :param states: values of ``alarm`` that are alarms; empty: all but 0.
        :raises ValueError: the template is wrong.
        """
        parts = parse(key, text.rstrip("\r\n"), (*_TYPES, _WORD))
        if any("\n" in part or "\r" in part for part in parts if isinstance(part, str)):
            raise ValueError(f"{key}: must be one line")
        if any(isinstance(part, TemplateField) and part.name == CHECKSUM for part in parts):
            _split_at_checksum(key, parts, checksum)
        self.fields: list[TemplateField] = []
        self._states = frozenset(str(state).encode() for state in states)
        pattern, is_json = "", text.lstrip().startswith("{{")
        for part, after in zip(parts, (*parts[1:], ""), strict=True):
            if isinstance(part, str):
                # A space stands for any number of spaces; in JSON it may be left out.
                literal = re.sub(r"(\\ )+", " ++", re.escape(part))
                beside = r"( \+\+)?(\\?[][{}:,])( \+\+)?"
                pattern += re.sub(beside, r" *+\2 *+", literal) if is_json else literal
                continue
            if isinstance(after, TemplateField) and part.type not in _FIXED:
                raise ValueError(f"{key}: nothing separates {part.name} from {after.name}")
            pattern += self._add(part, after, checksum, ignored=ignored(part.name))
        self._match = re.compile(f"{pattern} *+".encode()).fullmatch
        names = [each.name for each in self.fields]
        self._checksum = checksum if CHECKSUM in names else None
        self._index = names.index("index") if "index" in names else 0
        self._base = 16 if names and self.fields[self._index].type == "x" else 10

    def _add(self, part: TemplateField, after: str | TemplateField, checksum: Checksum | None, *, ignored: bool) -> str:
        """Pattern of a field, which is added to ``fields`` if it is read."""
        if part.type == _WORD:
            end = after[0] if isinstance(after, str) and after else "\n"
            if not (part.name == "alarm" and self._states):
                return f"[^{re.escape(end)}]*+"
            self.fields.append(part)
            return f"([^{re.escape(end)}]*+)"
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
            covered, told = line[: match.start(last)], int(match[last], 16)
            if self._checksum.compute(covered) != told:
                raise ChecksumError(covered, told)
        return match.groups()

    def index(self, words: Any) -> int:
        """Value of the field ``index``."""
        return int(words[self._index], self._base)

    def values(self, words: Sequence[Any], names: Sequence[str]) -> NDArray[np.float64]:
        """Values (n, k) of the fields called ``names`` in n answers."""
        out = np.empty((len(words), len(names)))
        if words:
            for field, column in zip(self.fields, zip(*words, strict=True), strict=True):
                if field.name not in names:
                    continue
                values: Any = column if field.type == _WORD else _TYPES[field.type].read(column)
                if field.name == "alarm" and self._states:
                    texts = column if field.type == _WORD else [b"%d" % value for value in values]
                    values = [text.strip() in self._states for text in texts]
                out[:, names.index(field.name)] = values
        return out


class ChecksumError(ValueError):
    """An answer has the form of its template and a wrong checksum."""

    def __init__(self, covered: bytes, told: int) -> None:
        super().__init__("wrong checksum")
        self.covered = covered
        """Bytes that the checksum covers."""
        self.told = told
        """Checksum in the answer."""


_LEAST_BITS = 16
"""Bits of checksums in all that a CRC must reproduce: fewer may agree by chance."""


def fitting_checksums(errors: Sequence[ChecksumError], bits: int) -> list[str]:
    """Names of the checksums of so many bits that are right for all answers; with "byte-swapped" where that is so."""
    if len(errors) * bits < _LEAST_BITS:
        return []
    models = [name for name in anycrc.models if re.fullmatch(rf"CRC{bits}-.*", name)]
    fitting = []
    for name in [*models, *(["xor"] if bits == checksum_of("xor").bits else [])]:
        compute = checksum_of(name).compute
        wanted = [compute(error.covered) for error in errors]
        swapped = [int.from_bytes(value.to_bytes(bits // 8, "little"), "big") for value in wanted if bits % 8 == 0]
        told = [error.told for error in errors]
        fitting += [name] * (wanted == told) or [f"{name}, byte-swapped"] * (swapped == told)
    return fitting


_LITTLE = {"u8": "u1", "i8": "i1", "u16": "<u2", "i16": "<i2", "u32": "<u4", "i32": "<i4", "f32": "<f4", "f64": "<f8"}

TYPES = _LITTLE | {f"{name}be": code.replace("<", ">") for name, code in _LITTLE.items() if "<" in code}
"""numpy's name of each type. ``be`` stands for big-endian; the others are little-endian."""

WHOLE = tuple(name for name in TYPES if name[0] != "f")
"""Types of whole numbers."""

_SIGNALS = ("u", "y")
"""Fields whose values must fit; an index wraps around."""

Prefix = Callable[[int], bytes]
"""Bytes in front of a content of so many bytes that its checksum covers too."""


def bytes_of(key: str, text: str) -> bytes:
    """Bytes of hexadecimal digits.

    :raises ValueError: the text is something else.
    """
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise ValueError(f"{key}: bytes are pairs of hexadecimal digits, such as 'aa 55', not {text!r}") from None


@dataclass(frozen=True)
class PackedRecord:
    """Layout of a record."""

    fields: tuple[TemplateField, ...]
    layout: np.dtype[np.void]
    """Its fields and constant bytes; the names of the latter are not those of fields."""
    constant: bytes
    """The record with zeros in all fields."""
    mask: bytes
    """Ones at its constant bytes."""
    checksum: Checksum | None
    prefix: Prefix

    @classmethod
    def of(cls, key: str, text: str, checksum: Checksum | None, prefix: Prefix) -> PackedRecord:
        """Record of a template.

        :raises ValueError: the template is wrong.
        """
        fields, members, constant, mask = [], [], b"", b""
        for i, part in enumerate(parse(key, text, (*TYPES,))):
            if isinstance(part, str):
                literal = bytes_of(key, part)
                size, code = len(literal), f"V{len(literal)}"
                if not literal:
                    continue
            else:
                literal, code = b"", TYPES[part.type]
                size = np.dtype(code).itemsize
                fields.append(part)
            is_named = isinstance(part, TemplateField) and part.name != PAD
            members.append((part.name if is_named else f"-{i}", code))  # type: ignore[union-attr]
            constant += literal.ljust(size, b"\0")
            mask += (b"\xff" if literal else b"\0") * size
        names = [field.name for field in fields]
        if CHECKSUM in names:
            _check_checksum(key, checksum, fields[names.index(CHECKSUM)], is_last=members[-1][0] == CHECKSUM)
        used = checksum if CHECKSUM in names else None
        return cls(tuple(fields), np.dtype(members), constant, mask, used, prefix)

    @property
    def size(self) -> int:
        return self.layout.itemsize

    def checksum_of(self, content: bytes) -> bytes:
        """Bytes of the checksum field, by the bytes before it; none without such a field."""
        if self.checksum is None:
            return b""
        value = self.checksum.compute(self.covered(content))
        return np.array([value]).astype(self.layout[CHECKSUM]).tobytes()

    def covered(self, content: bytes) -> bytes:
        """Bytes that the checksum of a content covers."""
        return self.prefix(len(content)) + content[: self.size - self.layout[CHECKSUM].itemsize]


def _check_checksum(key: str, checksum: Checksum | None, field: TemplateField, *, is_last: bool) -> None:
    """:raises ValueError: the field of the checksum has another type or place, or no checksum is named."""
    if checksum is None:
        raise ValueError(f"{key}: has a field {CHECKSUM}: set checksum, such as to CRC-16/MODBUS")
    if field.type not in WHOLE or 8 * np.dtype(TYPES[field.type]).itemsize < checksum.bits:
        wanted = next((f"u{bits}" for bits in (8, 16, 32) if bits >= checksum.bits), "")
        cure = f"use the type {wanted} or {wanted}be" if wanted else "no type holds it"
        raise ValueError(f"{key}: the checksum has {checksum.bits} bits: {cure}")
    if not is_last:
        raise ValueError(f"{key}: nothing may follow {CHECKSUM}")


class RecordWriter:
    """Writer of records."""

    def __init__(self, key: str, text: str, names: Sequence[str], checksum: Checksum | None, prefix: Prefix) -> None:
        """:raises ValueError: the template is wrong, or has other fields than ``names``."""
        self.record = PackedRecord.of(key, text, checksum, prefix)
        self.fields = tuple(field for field in self.record.fields if field.name not in (CHECKSUM, PAD))
        _check_known(key, self.fields, names)

    def contents(self, columns: Sequence[NDArray[Any]], n: int) -> list[bytes]:
        """Contents of ``n`` messages, from the values of each field.

        :raises ValueError: a value does not fit its field.
        """
        record, size = self.record, self.record.size
        out = np.frombuffer(bytearray(record.constant * n), record.layout)
        for field, values in zip(self.fields, columns, strict=True):
            if field.name in _SIGNALS and field.type in WHOLE and len(values):
                limits = np.iinfo(TYPES[field.type])
                worst = values[np.argmax(np.abs(values.astype(np.float64)))]
                if not limits.min <= worst <= limits.max:
                    raise ValueError(
                        f"{field.name} = {worst} does not fit the type {field.type} of send: use a wider one"
                    )
            out[field.name] = values.astype(record.layout[field.name])
        data = out.tobytes()
        contents = [data[at : at + size] for at in range(0, len(data), size)]
        if record.checksum is None:
            return contents
        checked_n = size - record.layout[CHECKSUM].itemsize
        return [content[:checked_n] + record.checksum_of(content) for content in contents]


class RecordReader:
    """Reader of records."""

    def __init__(
        self, key: str, text: str, checksum: Checksum | None, prefix: Prefix, states: Collection[int | str] = ()
    ) -> None:
        """``states`` are the values of ``alarm`` that are alarms; empty: all but 0.

        :raises ValueError: the template is wrong.
        """
        self.record = PackedRecord.of(key, text, checksum, prefix)
        if not self.record.fields:
            raise ValueError(f"{key}: a record needs fields, such as {{alarm:u8}}{{a1:f32}}")
        self.fields = [field for field in self.record.fields if field.name != PAD]
        self._states = np.array([state for state in states if isinstance(state, int)])
        self._is_any = not states
        self._has_constant = any(self.record.mask)
        self._mask, self._constant = (int.from_bytes(each) for each in (self.record.mask, self.record.constant))

    def read(self, content: bytes) -> bytes | None:
        """The content; None if it is not of this template.

        :raises ChecksumError: its checksum is wrong.
        """
        record = self.record
        if len(content) != record.size:
            return None
        if self._has_constant and int.from_bytes(content) & self._mask != self._constant:
            return None
        if not content.endswith(record.checksum_of(content)):
            raise ChecksumError(record.covered(content), int(np.frombuffer(content, record.layout)[CHECKSUM][0]))
        return content

    def index(self, words: Any) -> int:
        """Value of the field ``index``."""
        return int(np.frombuffer(words, self.record.layout)["index"][0])

    def values(self, words: Sequence[Any], names: Sequence[str]) -> NDArray[np.float64]:
        """Values (n, k) of the fields called ``names`` in n answers."""
        records = np.frombuffer(b"".join(words), self.record.layout)
        out = np.empty((len(words), len(names)))
        for i, name in enumerate(names):
            is_state = name == "alarm" and not self._is_any
            with np.errstate(invalid="ignore"):  # of a signalling NaN, which the caller reports
                out[:, i] = np.isin(records[name], self._states) if is_state else records[name]
        return out


def hexadecimal(content: bytes) -> str:
    """Bytes in a message."""
    shown = content[:32].hex(" ")
    return f"{shown} ... ({len(content)} bytes)" if len(content) > 32 else re.sub(r"^$", "nothing", shown)


AnswerReader = Reader | RecordReader
"""Reader of the contents of lines or frames, as answers."""

SampleWriter = Writer | RecordWriter
"""Writer of the contents of lines or frames, from samples."""
