"""Typed configuration: TOML files into frozen dataclasses, their kinds, and the locations of the shipped files.

Every key is checked against the dataclass. An unknown key, a wrong type or a value out of range is a one-line error
with file, table and key. Nothing read from a file is ever executed.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import pkgutil
import re
import tomllib
import types
import typing
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from analogrig.entry_points import EntryPoint, of_group
from analogrig.errors import ConfigurationError

__all__ = [
    "Kinds",
    "build",
    "check_range",
    "fixtures",
    "locate",
    "plain",
    "read_bounded",
    "read_toml",
    "suggest",
    "to_toml",
]
"""Names for packages beside the core."""

T = TypeVar("T")

Kind = Literal["scenarios", "rigs", "devices", "campaigns", "programs"]

MAX_FILE_BYTES = 1_000_000

MOST_NUMBER = 1e30
"""Largest magnitude of any quantity in any unit; beyond it even a product overflows."""

MOST_INTEGER = 2**63 - 1

MOST_SHOWN = 200

MOST_PARTS = 32
"""Most parts of a dotted key, for which tomllib needs quadratic time."""


def fixtures() -> Path:
    """The folder of the shipped scenarios, rigs and devices."""
    return _folder("fixtures", "fixtures")


def estimator_c() -> Path:
    """The folder of the estimator's C sources."""
    return _folder("estimator_c", "estimator_c")


def generated_c() -> Path:
    """The folder of the C that comes from the message catalogue: codecs of the device's messages."""
    return _folder("estimator_c/generated", "build/generated")


def _folder(in_package: str, in_checkout: str) -> Path:
    installed = Path(__file__).parent / in_package
    return installed if installed.is_dir() else Path(__file__).parents[2] / in_checkout


def suggest(name: str, known: Collection[str], *, cutoff: float = 0.6) -> str:
    """End of an error about an unknown name: the known name that is most like it; empty if none is.

    :param cutoff: least similarity, from 0 to 1.
    """
    near = difflib.get_close_matches(name, known, 1, cutoff)
    return f": did you mean {near[0]!r}?" if near else ""


def locate(kind: Kind, name: str | Path) -> Path:
    """The TOML file of a shipped ``name``, or of a user's own path.

    :raises ConfigurationError: there is no such file.
    """
    name = str(name)
    if name.endswith(".toml") or "/" in name:
        path = Path(name)
        if _is_file(path):
            return path
        raise ConfigurationError(f"{_brief(name)}: {'is a directory' if path.is_dir() else 'no such file'}")
    path = fixtures() / kind / f"{name}.toml"
    if _is_file(path):
        return path
    known = ", ".join(names(kind))
    raise ConfigurationError(f"no {kind[:-1]} is called {_quote(name)}: there are {known}, or give a .toml file")


def _is_file(path: Path) -> bool:
    """:raises ConfigurationError: the system will not even look."""
    try:
        return path.is_file()
    except OSError as error:
        raise ConfigurationError(f"{_brief(str(path))}: {error.strerror or error}") from error


def names(kind: Kind) -> list[str]:
    """The shipped names of a kind, sorted."""
    return sorted(path.stem for path in (fixtures() / kind).glob("*.toml"))


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Contents of a regular file of at most ``most_bytes``.

    :raises ConfigurationError: it is a directory, FIFO or device, or larger.
    :raises OSError: it cannot be read.
    """
    if path.exists() and not path.is_file():
        raise ConfigurationError(f"{_brief(str(path))}: not a file")
    with path.open("rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise ConfigurationError(f"{_brief(str(path))}: larger than {most_bytes} bytes")
    return data


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as plain values.

    :raises ConfigurationError: it cannot be read, is too large, or is not TOML.
    """
    return toml_of(read_file(path), path)


def read_file(path: Path) -> bytes:
    """Bytes of a TOML file.

    :raises ConfigurationError: it cannot be read, or is too large.
    """
    try:
        return read_bounded(path, MAX_FILE_BYTES)
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:  # a null character in its name
        raise ConfigurationError(f"{path}: {error}") from error


def toml_of(data: bytes, path: Path) -> dict[str, Any]:
    """Plain values of a TOML file's bytes; errors name its path.

    :raises ConfigurationError: they are not TOML.
    """
    try:
        text = data.decode("utf-8-sig")
        _check_keys(text)
        return tomllib.loads(text)
    except RecursionError as error:
        raise ConfigurationError(f"{path}: not valid TOML: nested too deep") from error
    except ValueError as error:  # among them TOMLDecodeError, UnicodeDecodeError, too long a number
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from error


def _check_keys(text: str) -> None:
    """:raises ValueError: a key has too many parts."""
    if max(part.partition("#")[0].count(".") for part in re.split(r"[=,{\n]", text)) >= MOST_PARTS:
        raise ValueError(f"a key has more than {MOST_PARTS} parts")


def plain(value: Any) -> Any:
    """Plain values, of any depth, without the entries that are None; tuples become lists."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items() if item is not None}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def to_toml(table: Mapping[str, Any]) -> str:
    """Plain values as TOML that ``read_toml`` gives back: the scalars first, then the tables. None is left out.

    :raises ConfigurationError: a text that no file can hold, such as half a surrogate pair.
    """
    import tomli_w

    values = plain(table)
    try:
        json.dumps(values, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        found = error.object[error.start : error.end]
        raise ConfigurationError(f"TOML holds no text with {found!a}, which stands for no character") from error
    return tomli_w.dumps(values, multiline_strings=not _has_carriage_returns(values))


def _has_carriage_returns(value: Any) -> bool:
    """True if a text of ``value`` has one: a multi-line text of TOML would be read back without it."""
    if isinstance(value, Mapping):
        return any(map(_has_carriage_returns, value.values()))
    return (
        any(map(_has_carriage_returns, value)) if isinstance(value, list) else isinstance(value, str) and "\r" in value
    )


def build(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """``table`` as an instance of the dataclass ``cls``; ``where`` (file and table) leads every error.

    Field types may be bool, int, float, str, Literal, a dataclass, Mapping[str, X], tuple[X, ...], and unions of these.
    The value of a dataclass may be an instance of it.

    :raises ConfigurationError: unknown or missing key, wrong type, or a value that ``cls`` refuses by ValueError.
    """
    fields, hints = _fields(typing.cast(Any, cls))
    for key in table:
        if key not in fields:
            raise ConfigurationError(f"{where}: unknown key {_quote(key)} (known: {', '.join(fields)})")
    for name, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in table:
            raise ConfigurationError(f"{where}: missing key {name!r}")
    values = {key: convert(hints[key], value, f"{where}: {key}") for key, value in table.items()}
    try:
        return cls(**values)
    except (ValueError, ArithmeticError, ConfigurationError, _emulator_error()) as error:
        table_name = where.rpartition(": ")[2]
        raise ConfigurationError(f"{where}: {str(error).removeprefix(f'{table_name}: ')}") from error


def _emulator_error() -> type[Exception]:
    """Type of the emulator's errors, whose import takes longer than all others of this module together."""
    from analogrig_emulator import EmulatorError

    return EmulatorError


@functools.cache
def _fields(cls: type[Any]) -> tuple[dict[str, dataclasses.Field[Any]], dict[str, Any]]:
    """Fields of a dataclass that a table may set, and the types of all its fields, by name."""
    return {field.name: field for field in dataclasses.fields(cls) if field.init}, typing.get_type_hints(cls)


def convert(hint: Any, value: Any, where: str) -> Any:
    """A plain value as the type ``hint``, as for a field of ``build``; ``where`` leads every error.

    :raises ConfigurationError: it is of another type.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(arguments, value, where)
    if origin is Literal:
        if value in arguments:
            return value
        raise ConfigurationError(f"{where}: must be one of {', '.join(map(repr, arguments))}, not {_quote(value)}")
    if dataclasses.is_dataclass(hint):
        cls = typing.cast(Any, hint)
        return value if isinstance(value, cls) else build(cls, _expect(dict, value, "a table", where), where)
    if origin is tuple:
        return _convert_tuple(arguments, value, where)
    if origin in (Mapping, dict):
        table = _expect(dict, value, "a table", where)
        return {key: convert(arguments[1], item, f"{where}.{key}") for key, item in table.items()}
    return _convert_scalar(hint, value, where)


def _convert_union(arguments: tuple[Any, ...], value: Any, where: str) -> Any:
    if (kinds := _by_kind(arguments)) and isinstance(value, dict):
        if "kind" not in value:
            raise ConfigurationError(f"{where}: missing key 'kind'")
        kind = convert(Literal[tuple(kinds)], value["kind"], f"{where}: kind")
        return convert(kinds[kind], value, where)
    some = [argument for argument in arguments if argument is not types.NoneType]
    if len(some) == 1:
        return convert(some[0], value, where)
    problems = []
    for argument in some:
        try:
            return convert(argument, value, where)
        except ConfigurationError as error:
            problems.append(str(error).removeprefix(f"{where}: "))
    raise ConfigurationError(f"{where}: {'; or '.join(problems)}")


def _by_kind(arguments: tuple[Any, ...]) -> dict[str, Any]:
    """Tables of a union by the required value of their ``kind``; empty if that does not distinguish them."""
    hints = [typing.get_type_hints(each).get("kind") for each in arguments if dataclasses.is_dataclass(each)]
    if len(hints) < len(arguments) or not all(typing.get_origin(hint) is Literal for hint in hints):
        return {}
    return {kind: table for hint, table in zip(hints, arguments, strict=True) for kind in typing.get_args(hint)}


def _convert_tuple(arguments: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    items = _expect(list, list(value) if isinstance(value, tuple) else value, "an array", where)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return tuple(convert(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(items))
    if len(items) != len(arguments):
        raise ConfigurationError(f"{where}: must have {len(arguments)} elements, not {len(items)}")
    return tuple(
        convert(hint, item, f"{where}[{i}]") for i, (hint, item) in enumerate(zip(arguments, items, strict=True))
    )


def _convert_scalar(hint: Any, value: Any, where: str) -> Any:
    if hint is Any:
        return value
    if hint is float:
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MOST_NUMBER:
            return float(value) + 0.0  # -0.0 becomes 0.0, for generators of random numbers refuse it as a width
        raise ConfigurationError(f"{where}: must be a number within +-{MOST_NUMBER:g}, not {_quote(value)}")
    if hint is int and (isinstance(value, bool) or (isinstance(value, int) and abs(value) > MOST_INTEGER)):
        raise ConfigurationError(f"{where}: must be a whole number below 2^63, not {_quote(value)}")
    words = {int: "a whole number", bool: "true or false", str: "a text"}
    return _expect(hint, value, words[hint], where)


def _expect(kind: type[T], value: Any, words: str, where: str) -> T:
    if isinstance(value, kind):
        return value
    raise ConfigurationError(f"{where}: must be {words}, not {_quote(value)}")


def _quote(value: Any) -> str:
    """A value in an error, in one line of bounded length."""
    return "a longer one" if isinstance(value, int) and abs(value) > MOST_INTEGER else _brief(repr(value))


def _brief(text: str) -> str:
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


def check_range(table: object, name: str, low: float, high: float) -> None:
    """Check a number, or a tuple of numbers, in a field of a dataclass.

    :raises ValueError: one is NaN or outside ``low`` to ``high``; the message names the field.
    """
    value = getattr(table, name)
    for each in value if isinstance(value, tuple) else (value,):
        if not low <= each <= high:
            raise ValueError(f"{name} must be {low:g} to {high:g}, not {each:g}")


class Kinds(Mapping[str, type[T]], Generic[T]):
    """Subclasses of ``base`` by kind, each imported when it is asked for.

    A package adds kinds as entry points of ``group``. It cannot replace one of ours. Whoever installs the package
    trusts it: a file may then name the kind.
    """

    def __init__(self, base: type[T], group: str, own: Mapping[str, str] | None = None) -> None:
        """``own`` are our kinds as ``module:class``."""
        self._base = base
        self._group = group
        self._own = own or {}

    def __getitem__(self, kind: str) -> type[T]:
        """Class of a kind.

        :raises KeyError: there is none.
        :raises ConfigurationError: the package that adds the kind cannot be imported, or names no subclass.
        """
        if kind in self._own:
            own: type[T] = pkgutil.resolve_name(self._own[kind])
            return own
        return self._load(self._added[kind])

    def __contains__(self, kind: object) -> bool:
        return kind in self._own or kind in self._added

    def __iter__(self) -> Iterator[str]:
        return iter((*self._own, *self._added))

    def __len__(self) -> int:
        return len(self._own) + len(self._added)

    @property
    def added(self) -> tuple[str, ...]:
        """Kinds that packages add."""
        return tuple(self._added)

    @property
    def ignored(self) -> Mapping[str, str]:
        """Kinds that packages add in vain, with the reason."""
        return {
            point.name: f"ignored: {point} cannot replace a kind that there is"
            for point in self._points
            if point.name in self._own or self._added[point.name] is not point
        }

    @functools.cached_property
    def _points(self) -> list[EntryPoint]:
        return of_group(self._group)

    @functools.cached_property
    def _added(self) -> Mapping[str, EntryPoint]:
        """Entry points by kind; the first of each is used."""
        return {point.name: point for point in reversed(self._points) if point.name not in self._own}

    def _load(self, point: EntryPoint) -> type[T]:
        loaded = point.load("kind")
        where = f"kind {point.name!r}: {point}"
        if not (isinstance(loaded, type) and issubclass(loaded, self._base)):
            raise ConfigurationError(f"{where} is no subclass of {self._base.__name__}")
        if (kind := getattr(loaded, "kind", point.name)) != point.name:
            raise ConfigurationError(f"{where} states the kind {kind!r}")
        for name, hint in self._base.__annotations__.items():
            if str(hint).startswith("ClassVar") and not hasattr(loaded, name):
                raise ConfigurationError(f"{where} has no {name}")
        return loaded
