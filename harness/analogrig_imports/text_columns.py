"""Reader of columns in delimited text: CSV of spreadsheets, pandas and oscilloscopes, LabVIEW's measurement files."""

from __future__ import annotations

import array
import csv
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.plant import MAX_SAMPLES
from analogrig_imports.cells import Instants, are_data, is_date, is_word, reader_of
from analogrig_imports.column_names import MOST_NAME, ColumnError, has_all, known_unit, place, unit_in_name

MOST_COLUMNS = 4096
"""Largest number of columns of a file."""

_LONGEST_LINE = 1 << 16
_SAMPLED_LINES = 40
"""Rows from which the delimiter is found."""
_SEARCHED_LINES = 200
"""Lines at the start among which is the header with the wanted names."""
_MOST_FOOTER = 20
"""Lines at the end of a text whose unwanted columns are looked at, too."""
_CHUNK_BYTES = 1 << 20
_SPACES = " "
"""Delimiter of cells that stand apart by any number of spaces."""
_DELIMITERS = (";", "\t", ",", _SPACES)
_LABVIEW = "LabVIEW Measurement"
"""First cell of a measurement file of LabVIEW."""

Line = tuple[int, str]
"""Number, from 1, and text."""


class TextColumns(NamedTuple):
    """Columns of a text."""

    names: list[str]
    """Names of all of them; those without one, or without a header, are called by their place: 0, 1, ..."""
    columns: dict[str, NDArray[np.float64]]
    """The wanted ones, (n,) each."""
    blank_lines: int
    """Blank lines between rows."""
    units: dict[str, str]
    """Units of the wanted columns that the text states."""
    rate_hz: float | None
    """Sample rate that LabVIEW states."""


def _lines(file: IO[str]) -> Iterator[str]:
    """:raises ColumnError: a line is too long."""
    for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), 1):
        if len(line) == _LONGEST_LINE:
            raise ColumnError(f"line {number} has more than {_LONGEST_LINE} characters")
        yield line


def read_text(path: Path, wanted: Sequence[str], skip_lines: int) -> TextColumns:
    """Wanted columns of delimited text, whose header is its first line, or the first that has the wanted names.

    :raises ColumnError: there is no such column, or a line has no number there.
    """
    _check_text(path, skip_lines)
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        lines = enumerate(_lines(file), 1)
        skipped = deque(islice(lines, skip_lines), maxlen=2)
        start = list(islice(lines, _SEARCHED_LINES))
        at = _first_line(start, wanted)
        (_, first), rest = start[at], [each for each in start[at + 1 :] if not _is_comment(each)]
        rows = chain(rest, (each for each in lines if not _is_comment(each)))
        first = first.removeprefix("#")
        sample = [line for _, line in rest[:_SAMPLED_LINES] if line.strip()]
        delimiter = _delimiter(first, sample)
        cells = [cell.strip() for cell in _cells(first, delimiter)]
        has_header = not are_data(cells, delimiter)
        while has_header and cells and not cells[-1]:
            cells.pop()
        names = [(has_header and cell) or str(j) for j, cell in enumerate(cells)]
        if len(names) > MOST_COLUMNS:
            raise ColumnError(f"more than {MOST_COLUMNS} columns")
        places = [place(name, names, _cure_of_names(names)) for name in wanted]
        stated, rate_hz = _labview(start[:at], names)
        if not has_header:
            rows = chain([start[at]], rows)
            stated |= _units_above([line for _, line in skipped], len(names), delimiter)
        elif rest and (below := _units_below(rest, names, places, delimiter)):
            stated |= below
            rows = chain(rest[1:], (each for each in lines if not _is_comment(each)))
        found, blank_lines, stamped = _read_rows(rows, names, places, delimiter) if wanted else ([], 0, [])
    units = {name: stated.get(names[j], "") or unit_in_name(names[j]) for name, j in zip(wanted, places, strict=True)}
    units |= dict.fromkeys((wanted[k] for k in stamped), "s")
    columns = {name: np.frombuffer(column) for name, column in zip(wanted, found, strict=True)} if wanted else {}
    return TextColumns(names, columns, blank_lines, {name: unit for name, unit in units.items() if unit}, rate_hz)


def _is_comment(line: Line) -> bool:
    return line[1].startswith("#")


def _first_line(start: Sequence[Line], wanted: Sequence[str]) -> int:
    """Index of the line with the names, or of the first row.

    :raises ColumnError: there is no line of text.
    """
    filled = [k for k, (_, line) in enumerate(start) if line.strip()]
    plain = [k for k in filled if not _is_comment(start[k])]
    if not plain:
        raise ColumnError("holds no line of text")
    if start[plain[0]][1].startswith(_LABVIEW):
        ends = [k for k in plain if "***End_of_Header***" in start[k][1]]
        return next((k for k in plain if ends and k > ends[-1]), plain[0])

    def names(k: int, delimiter: str) -> list[str]:
        return [cell.strip() for cell in _cells(start[k][1].removeprefix("#"), delimiter)]

    if wanted and not all(name.isdecimal() for name in wanted):
        for k in [plain[0], *filled]:
            if any(has_all(wanted, names(k, delimiter)) for delimiter in _DELIMITERS):
                return k
    return plain[0]


def _labview(above: Sequence[Line], names: Sequence[str]) -> tuple[dict[str, str], float | None]:
    """Units of the channels, and the rate, as LabVIEW's lines above the columns state them."""
    if not above or not above[0][1].startswith(_LABVIEW):
        return {}, None
    stated = {cells[0]: cells[1:] for _, line in above if (cells := line.rstrip("\r\n").split("\t"))}
    units = dict(zip(names[1:], stated.get("Y_Unit_Label", ()), strict=False))
    steps_s = [step.replace(",", ".") for step in stated.get("Delta_X", ()) if step.strip()]
    try:
        period_s = float(steps_s[0]) if len(set(steps_s)) == 1 else 0.0
    except ValueError:
        period_s = 0.0
    return units, 1.0 / period_s if period_s > 0.0 else None


def _unit(cell: str) -> str:
    """Text of a cell that states a unit, without brackets; empty for anything else."""
    text = cell.strip().strip("[]()").strip()
    return text if known_unit(text) else ""


def _units_below(rest: Sequence[Line], names: Sequence[str], places: Sequence[int], delimiter: str) -> dict[str, str]:
    """Units in the line below the names; none if that is no such line.

    :raises ColumnError: its words are no units.
    """
    number, line = rest[0]
    row = [cell.strip() for cell in _cells(line, delimiter)]
    filled = [cell for cell in row if cell]
    if not filled or not all(is_word(cell, delimiter) for cell in filled):
        return {}
    units = {name: _unit(cell) or cell for name, cell in zip(names, row, strict=False) if cell}
    if not any(_unit(row[j]) for j in places or range(len(row)) if j < len(row)):
        raise ColumnError(
            f"line {number} holds no number, perhaps units: delete it, or pass --skip-lines {number} and"
            " name the columns 0, 1, ..."
        )
    return units


def _units_above(skipped: Sequence[str], columns: int, delimiter: str) -> dict[str, str]:
    """Units in skipped lines that have as many cells as the rows, by name of the column."""
    units: dict[str, str] = {}
    for line in skipped:
        cells = [cell.strip() for cell in _cells(line.removeprefix("#"), delimiter)]
        if len(cells) == columns:
            units |= {str(j): unit for j, cell in enumerate(cells) if (unit := unit_in_name(cell) or _unit(cell))}
    return units


def _read_rows(
    lines: Iterable[Line], names: Sequence[str], places: Sequence[int], delimiter: str
) -> tuple[list[array.array[float]], int, list[int]]:
    """Numbers at these places of every line, the blank lines between the first and the last, columns of time stamps.

    :raises ColumnError: a line has no such cell, or no number there.
    """
    found = [array.array("d") for _ in places]
    readers: list[Callable[[str], float]] = []
    blank_lines = blank_here = 0
    first: list[str] = []
    last: deque[tuple[int, list[str]]] = deque(maxlen=_MOST_FOOTER)
    for number, line in lines:
        if not line.strip():
            blank_here += bool(found[0])
            continue
        blank_lines, blank_here = blank_lines + blank_here, 0
        if len(found[0]) == MAX_SAMPLES:
            raise ColumnError(_too_many(MAX_SAMPLES))
        row = _cells(line, delimiter)
        last.append((number, row))
        if not first:
            first = row
            readers = [reader_of(row[j] if j < len(row) else "", delimiter) for j in places]
        if len(row) > len(names) and any(cell.strip() for cell in row[len(names) :]):
            raise ColumnError(f"line {number} has {len(row)} cells, the first line {len(names)}: {_cure_of_cells(row)}")
        for at, column, reader in zip(places, found, readers, strict=True):
            try:
                column.append(reader(row[at]))
            except (IndexError, ValueError) as error:
                where = f"line {number}, column {names[at][:MOST_NAME]}"
                why = f"{row[at][:40]!r} is no number" if at < len(row) else "the line has no such cell"
                if "YYYY" in str(error):
                    why = str(error)
                raise ColumnError(f"{where}: {why}; mend or delete the line") from None
    _check_footer(first, last, names, delimiter)
    return found, blank_lines, [k for k, reader in enumerate(readers) if isinstance(reader, Instants)]


def _cure_of_cells(row: Sequence[str]) -> str:
    """Cure for a row with more cells than the header."""
    if any(map(is_date, row)):
        return "dates apart from their times by a space need another separator, such as semicolons"
    return "cells with decimal commas need another separator, such as semicolons"


def _check_footer(
    first: Sequence[str], last: Iterable[tuple[int, Sequence[str]]], names: Sequence[str], delimiter: str
) -> None:
    """Refuse a summary below the samples, which may have numbers in the wanted columns.

    :param last: last rows with the numbers of their lines.
    :raises ColumnError: a column that begins with a number has text in them.
    """
    numeric = [j for j, cell in enumerate(first) if are_data([cell], delimiter)]
    for number, row in last:
        for j in numeric:
            if j < len(row) and is_word(row[j], delimiter):
                raise ColumnError(
                    f"line {number}, column {names[j][:MOST_NAME]}: {row[j][:40]!r} is no number, perhaps a"
                    " footer: mend or delete the line"
                )


def _check_text(path: Path, skip_lines: int) -> None:
    """Refuse at once what is no text, or has too many lines: to parse it would take a minute.

    :raises ColumnError: it is such a file.
    """
    rows = -skip_lines
    with path.open("rb") as file:
        start = file.read(_CHUNK_BYTES)
        if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise ColumnError("is UTF-16 text: save it as UTF-8")
        if b"\0" in start[:4096]:
            raise ColumnError("holds bytes of zero: UTF-16, or no text; save it as text in UTF-8")
        for chunk in chain([start], iter(partial(file.read, _CHUNK_BYTES), b"")):
            rows += chunk.count(b"\n") - sum(chunk.count(blank) for blank in (b"\n\n", b"\n\r", b"\n#"))
            if rows > MAX_SAMPLES + _SEARCHED_LINES:
                raise ColumnError(_too_many(MAX_SAMPLES))


def _too_many(samples: int) -> str:
    return f"has more than {samples} samples; cut it into files of fewer lines"


def _delimiter(first: str, rows: Sequence[str]) -> str:
    """Delimiter that gives as many cells in each row as in the first line; of several, the one with most numbers.

    If none does, the one with most numbers.
    """

    def merit(delimiter: str) -> tuple[bool, float]:
        rows_of_cells = [_cells(row, delimiter) for row in rows]
        cells = [cell for row in rows_of_cells for cell in row]
        numbers = sum(are_data([cell], delimiter) for cell in cells) / len(cells) if cells else 0.0
        return {len(row) for row in rows_of_cells} <= {len(_cells(first, delimiter))}, numbers

    possible = [each for each in _DELIMITERS if len(_cells(first, each)) > 1]
    return max(possible, key=merit, default=_SPACES)


def _cells(line: str, delimiter: str) -> list[str]:
    return line.split() if delimiter == _SPACES else next(csv.reader([line], delimiter=delimiter), [])


def _cure_of_names(names: Sequence[str]) -> str:
    """Cure if names suggest a wrong first line or a wrong encoding."""
    if any("\ufffd" in name for name in names):
        return "; the file is no UTF-8: save it as UTF-8"
    return "; --skip-lines N leaves out text above the header"
