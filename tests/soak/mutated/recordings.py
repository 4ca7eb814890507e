"""Recordings that are none, or no longer: what is changed in them is drawn from a seed."""

from __future__ import annotations

import io
import json
import random
import struct
import warnings
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.soak.mutated.nasty import brief, replace_one

Members = dict[str, NDArray[Any]]

Mutated = tuple[bytes, str]
"""The file, and what was done to it."""


def mutated(whole: bytes, rng: random.Random) -> Mutated:
    """One change, by far most often to the header or an array: there the archive is sound, and the reader goes on."""
    kinds: tuple[tuple[Callable[[bytes, random.Random], Mutated], int], ...] = (
        (_header, 55),
        (_array, 25),
        (_flipped, 6),
        (_cut, 3),
        (_archive, 11),
    )
    change = rng.choices([kind for kind, _ in kinds], [weight for _, weight in kinds])[0]
    return change(whole, rng)


def read(whole: bytes) -> Members:
    with np.load(io.BytesIO(whole), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def written(members: Members) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **members)
    return file.getvalue()


def header(whole: bytes) -> dict[str, Any]:
    """Its conditions."""
    return dict(json.loads(str(read(whole)["header"]))["conditions"])


def with_header(whole: bytes, change: Callable[[Any], None]) -> bytes:
    """With another header; ``change`` is given its conditions."""
    members = read(whole)
    header = json.loads(str(members["header"]))
    change(header["conditions"])
    return written(members | {"header": np.array(json.dumps(header))})


def _header(whole: bytes, rng: random.Random) -> Mutated:
    members = read(whole)
    header = json.loads(str(members["header"]))
    tables = [header if rng.random() < 0.03 else header["conditions"] for _ in range(rng.choice((1, 1, 2)))]
    done = [replace_one(rng, table) for table in tables]
    return written(members | {"header": np.array(json.dumps(header))}), f"header: {'; '.join(done)}"


_KINDS = ("uint8", "uint16", "int8", "int64", "uint64", "float32", "float64", "complex128", "bool", "<U7", "M8[s]")


def _array(whole: bytes, rng: random.Random) -> Mutated:
    members = read(whole)
    name = rng.choice([each for each in members if each != "header"])
    array = members[name]
    how = rng.choice(("values", "values", "values", "kind", "shape", "absent", "added", "swapped"))
    if how == "values":
        members[name] = _other_values(array, rng)
    elif how == "kind":
        members[name] = np.zeros(array.shape, rng.choice(_KINDS))
    elif how == "shape":
        shape: Any = rng.choice((array[:-1], array[:0], array[None], array.ravel(), np.concatenate([array, array])))
        members[name] = shape
    elif how == "absent":
        del members[name]
    elif how == "added":
        members["../evil"] = array
    else:
        other = rng.choice([each for each in members if each not in ("header", name)])
        members[name], members[other] = members[other], array
    return written(members), f"array {name}: {how}"


def _other_values(array: NDArray[Any], rng: random.Random) -> NDArray[Any]:
    """Random array of the same type and shape; an empty one gets a row."""
    out = np.array(array if array.size else np.zeros((3, *array.shape[1:]), array.dtype))
    if out.dtype.kind == "f":
        value: Any = rng.choice((np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-45, 0.0))
    elif out.dtype.kind == "b":
        value = rng.choice((True, False))
    else:
        limits = np.iinfo(out.dtype)
        value = rng.choice((limits.min, limits.max, 0, 1, limits.max // 2))
    where = rng.choice((slice(None), slice(0, 1), slice(-1, None), slice(len(out) // 2, None), slice(None, None, 2)))
    out[where] = value
    return out


def _flipped(whole: bytes, rng: random.Random) -> Mutated:
    out, places = bytearray(whole), [rng.randrange(len(whole)) for _ in range(rng.choice((1, 1, 3, 20)))]
    for place in places:
        out[place] ^= 1 << rng.randrange(8)
    return bytes(out), f"bits at {brief(places)}"


def _cut(whole: bytes, rng: random.Random) -> Mutated:
    length = rng.randrange(len(whole))
    return whole[:length], f"cut to {length}"


def _archive(whole: bytes, rng: random.Random) -> Mutated:
    """Tricks of the zip format."""
    members = {name: _npy(array) for name, array in read(whole).items()}
    name = rng.choice(list(members))
    how = rng.choice(_TRICKS)
    file = io.BytesIO()
    warnings.filterwarnings("ignore", "Duplicate name")
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if how == "deflated" else zipfile.ZIP_STORED) as archive:
        for each, content in members.items():
            if each == name and how in _CONTENTS:
                content = _CONTENTS[how](content)  # noqa: PLW2901 - the one that is another
            kind = zipfile.ZIP_DEFLATED if how == "bomb" and each == name else None
            archive.writestr(f"{each}.npy", content, kind)
        if how == "twice":
            archive.writestr(f"{name}.npy", members[name][: len(members[name]) // 2])
        if how == "many":
            for i in range(8_000):
                archive.writestr(f"m{i}.npy", b"")
        if how == "comment":
            archive.comment = b"\x1b[2J" * 10_000
    return _patched(file.getvalue(), how, rng), f"archive: {how} ({name})"


_TRICKS = ("twice", "deflated", "bomb", "size", "claimed", "crc", "many", "comment", "pickle", "long", "offset")


def _npy(array: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def _claiming(content: bytes) -> bytes:
    """An array that says that it is huge."""
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000000, 4), }"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head) + 1) + head + b"\n" + content[-64:]


_PICKLED = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"

_CONTENTS: dict[str, Callable[[bytes], bytes]] = {
    "bomb": lambda _: bytes(50_000_000),
    "claimed": _claiming,
    "pickle": lambda _: b"\x93NUMPY\x01\x00\x46\x00" + _PICKLED.ljust(69) + b"\n",
    "long": lambda _: b"\x93NUMPY\x02\x00\xff\xff\xff\x7f" + b"(" * 200_000,
}


def _patched(archive: bytes, how: str, rng: random.Random) -> bytes:
    """The fields of the last entry in the directory that say where and how large a member is, and its checksum."""
    at = archive.rfind(b"PK\x01\x02")
    places = {"crc": 16, "size": 24, "offset": 42}
    if how not in places:
        return archive
    out = bytearray(archive)
    out[at + places[how] : at + places[how] + 4] = struct.pack("<I", rng.choice((0, 1, 2**31, 2**32 - 2)))
    return bytes(out)
