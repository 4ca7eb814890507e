"""Cells of text tables as numbers: decimal commas, Fortran's exponents, instants, and what is written for none."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Callable

_NONE = frozenset(
    "na n/a nan null none nil inf infinity \u221e ovr over overload overloaded overflow overrange underrange ovf ovl"
    " ovld ovrng ol oor outofrange under error err invalid bad clip clipped 1inf 1ind 1qnan 1snan 1j".split()
)
"""What spreadsheets, instruments and runtimes of C write where there is no number, without signs and marks."""
_MARKS = re.compile(r"[\s\-+*#?.<>_]")

_LEAST_NONE = 9.9e37
"""Readings from here on stand for an overload or for none (SCPI-99, volume 1, 7.2.1.4 and 7.2.1.5)."""

_FORTRAN = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))[dDqQ]([+-]?\d+)|([+-]?\d*\.\d*)([+-]\d{3})")
"""Exponents with D or Q, and those of three digits, which have no letter."""

_DATE = re.compile(r"(\d{4})[-/.](\d\d?)[-/.](\d\d?)|\d{1,2}[-/. ](?:\d{1,2}|[A-Za-z]{3})[-/. ]\d{2,4}")
_CLOCK = re.compile(
    rf"(?:({_DATE.pattern})(?:[Tt ]\s*|$))?(?:(\d{{1,2}}):(\d\d):(\d\d)(?:[.,:](\d+))?)?\s*([AaPp][Mm])?"
    r"\s*(?:(Z|UTC|GMT)|([+-])(\d\d):?(\d\d))?(?:\[[\w/+-]+\])?"
)
_DAY_S = 86400
_LONGEST = 64
"""Characters of the longest cell that is compared with patterns."""


def number(cell: str, delimiter: str) -> float:
    """Number in a cell; not a number where the cell is blank, or says that there was none.

    :raises ValueError: it is neither.
    """
    text = cell.strip()
    if "_" in text or not text.isascii():
        return _unusual(text)  # Python would read 1_0 as 10, and the digits of every script
    try:
        value = float(text.replace(",", ".") if delimiter != "," else text)
    except ValueError:
        return _unusual(text)
    return value if abs(value) < _LEAST_NONE else float("nan")


def _unusual(text: str) -> float:
    """:raises ValueError: it is no number."""
    if len(text) > _LONGEST:
        raise ValueError(text)
    bare = _MARKS.sub("", text.lower())
    if not bare or bare in _NONE:
        return float("nan")
    found = _FORTRAN.fullmatch(text)
    if found is None:
        raise ValueError(text)
    return float(f"{found[1] or found[3]}e{found[2] or found[4]}")


class Instants:
    """Reader of the time stamps of one column: seconds since the first, from dates and times of the day."""

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None
        self._day, self._date, self._last_s = 0, "", 0

    def __call__(self, cell: str) -> float:
        """Seconds since the first stamp; not a number for a blank cell.

        A time without a date that falls by half a day is of the next day.

        :raises ValueError: it is no time stamp, or its day cannot be told from its month.
        """
        text = cell.strip().strip('"')
        if not text:
            return float("nan")
        found = _CLOCK.fullmatch(text) if len(text) <= _LONGEST else None
        if found is None or not ((found[1] and found[2]) or found[5]):
            raise ValueError(text)
        date, year, month, day, hours, minutes, seconds, fraction, half, _, sign, ahead_h, ahead_min = found.groups()
        hour = int(hours or 0) % 12 + 12 * (half.lower() == "pm") if half else int(hours or 0)
        clock_s = 3600 * hour + 60 * int(minutes or 0) + int(seconds or 0)
        ahead_s = int(f"{sign}1") * (3600 * int(ahead_h) + 60 * int(ahead_min)) if sign else 0
        whole_s = clock_s - ahead_s + _DAY_S * self._days(date or "", year, month, day, clock_s)
        part_s = float(f"0.{fraction}") if fraction else 0.0
        if self._first is None:
            self._first = whole_s, part_s
        return (whole_s - self._first[0]) + (part_s - self._first[1])

    def _days(self, date: str, year: str, month: str, day: str, clock_s: int) -> int:
        if year:
            return dt.date(int(year), int(month), int(day)).toordinal()
        if self._first is not None and date != self._date:
            raise ValueError(f"{date} after {self._date}: write dates as YYYY-MM-DD")
        if not date and clock_s < self._last_s - _DAY_S / 2:
            self._day += 1
        self._date, self._last_s = date, clock_s
        return self._day


def reader_of(first: str, delimiter: str) -> Callable[[str], float]:
    """Reader of a column that begins with this cell: of time stamps if it is one, or else of numbers."""
    try:
        number(first, delimiter)
    except ValueError:
        try:
            Instants()(first)
        except ValueError:
            pass
        else:
            return Instants()
    return lambda cell: number(cell, delimiter)


def is_date(cell: str) -> bool:
    """True for a date without its time, which a space has cut off."""
    return len(cell) <= _LONGEST and _DATE.fullmatch(cell.strip()) is not None


def is_word(cell: str, delimiter: str) -> bool:
    """True for text that is neither a number nor a time stamp, nor says that there was none; blank is none either."""
    try:
        reader_of(cell, delimiter)(cell)
    except ValueError:
        return True
    return False


def are_data(cells: list[str], delimiter: str) -> bool:
    """True if one of the cells is a number or a time stamp, and none is a word."""
    try:
        values = [reader_of(cell, delimiter)(cell) for cell in cells]
    except ValueError:
        return False
    return any(value == value for value in values)  # noqa: PLR0124 - not a number
