"""Names of columns, with the units that headers state beside them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from analogrig_emulator import ProgramError, Unit, parse_unit

MOST_NAME = 120
"""Characters of a name in a message."""

MOST_UNIT = 20
"""Longest unit of a column."""

_TIME = r"(?:t|time|timestamps?|elapsed)"
TIMES = re.compile(_TIME, re.IGNORECASE)
"""Usual names of a column of instants, without unit and group."""

_BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\[\]()\d][^\[\]()]*)[\])]")  # x[2] is part of an array
_BESIDE = re.compile(r"(.+?)(?:\s+in\s+|\s*/\s*|,\s*)(\S+)")
_TIME_AND_UNIT = re.compile(rf"({_TIME})_([nmu]?s|sec|msec|usec|min|h)", re.IGNORECASE)

_ASCII = MappingProxyType(
    {"\u00b5": "u", "\u03bc": "u", "\u2126": "ohm", "\u03a9": "ohm", "\u00b7": " ", "\u00b2": "^2", "\u00b3": "^3"}
)
"""Symbols of headers in the words of a program file."""

_WORDS = MappingProxyType(
    {
        **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
        **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
        **dict.fromkeys(("usec", "microsecond", "microseconds"), "us"),
        **dict.fromkeys(("volt", "volts"), "V"),
        **dict.fromkeys(("amp", "amps", "ampere", "amperes"), "A"),
        **dict.fromkeys(("newton", "newtons"), "N"),
        **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
        **dict.fromkeys(("degree", "degrees", "\u00b0"), "deg"),
    }
)
"""Words of headers in those of a program file."""


class ColumnError(Exception):
    """A file that cannot be read, in one line without its name."""


def known_unit(text: str) -> Unit | None:
    """Unit of a text in a file's header; None if no program file could write it."""
    words = _WORDS.get(text.lower(), text)
    try:
        return parse_unit("".join(_ASCII.get(each, each) for each in words)) if 0 < len(words) <= MOST_UNIT else None
    except ProgramError:
        return None


def _parts(column: str) -> tuple[str, str]:
    """Name and unit, which is empty without one."""
    text = column.strip()
    if found := _BRACKETS.fullmatch(text):
        return found[1], found[2].strip()
    if found := _TIME_AND_UNIT.fullmatch(text):
        return found[1], found[2]
    if (found := _BESIDE.fullmatch(text)) and known_unit(found[2]):
        return found[1], found[2]
    return column, ""


def unit_in_name(column: str) -> str:
    """Unit at the end of a column's name, such as mm of ``stroke [mm]`` or ``stroke / mm``; empty without one."""
    return _parts(column)[1]


def is_time(column: str) -> bool:
    """True if the name is a usual one of instants, whichever its unit and group."""
    return TIMES.fullmatch(_parts(column.partition("@")[0])[0]) is not None


def _spelt_alike(column: str) -> str:
    """Name with the indices of a path behind it, counted from 0: ``s[0].u``, ``s.u[0]`` and ``s(1).u`` are one."""
    counted = re.sub(r"\((\d+)\)", lambda found: f"[{int(found[1]) - 1}]", column)
    return re.sub(r"\[\d+\]", "", counted) + "".join(re.findall(r"\[\d+\]", counted))


def place(name: str, names: Sequence[str], cure: str = "") -> int:
    """Place of a name, which may lack its unit, or have the indices of its path elsewhere.

    :raises ColumnError: there is no such name, or more than one.
    """
    ways = (str, lambda each: _parts(each)[0] if "\ufffd" not in each else each, _spelt_alike)
    for way in ways:
        wanted = _spelt_alike(name) if way is _spelt_alike else name
        places = [i for i, each in enumerate(names) if way(each) == wanted]
        if len(places) == 1:
            return places[0]
        if places:
            raise ColumnError(f"{len(places)} columns are called {name[:MOST_NAME]!r}")
    shown = ", ".join(each[:MOST_NAME] for each in names[:20]) + (", ..." if len(names) > 20 else "")
    raise ColumnError(f"no column is called {name[:MOST_NAME]!r}; there are {shown or 'none'}{cure}")


def has_all(wanted: Sequence[str], names: Sequence[str]) -> bool:
    """True if each wanted name has a place."""
    try:
        return all(place(name, names) >= 0 for name in wanted)
    except ColumnError:
        return False


def units_of(names: Sequence[str]) -> Mapping[str, str]:
    """Units that stand in the names, by name."""
    return {name: unit for name in names if (unit := unit_in_name(name))}
