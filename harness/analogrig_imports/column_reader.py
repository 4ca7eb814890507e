"""Reader of columns of numbers in files of other tools: ``python -m analogrig.recordings.column_reader REQUEST``.

It runs in a process of its own with bounded memory and time, because a damaged or hostile file may exhaust the memory
or crash the library that reads it. Nothing in a file is executed: no pickles, no formulas, no links to other files.
REQUEST is a JSON object: ``file``; ``wanted``, the columns to read; ``skip_lines``; ``out``, the .npz to write them to.
The answer is a JSON object on standard output: ``names``, ``rate_hz``, ``blank_lines``, ``units`` and
``channels``, or ``error``.
"""

from __future__ import annotations

import array
import csv
import json
import os
import re
import resource
import sys
import tempfile
import warnings
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.plant import MAX_SAMPLES

MOST_MEMORY_BYTES = 4 << 30
"""Address space of the process, libraries included."""

MOST_PROCESSOR_S = 300

MOST_COLUMNS = 4096
"""Largest number of columns of a file."""

_LONGEST_LINE = 1 << 16
_MOST_NAME = 120
_MOST_TEXT_BYTES = 4096
"""Largest array of texts that is read."""

_SAMPLED_LINES = 40
"""Lines at the start of a text from which its delimiter is found."""

_NAME_AND_UNIT = re.compile(r"(.*?)\s*[\[(]([^\[\]()\d][^\[\]()]*)[\])]")  # x[2] is part of an array

_MOST_FOOTER = 20
"""Lines at the end of a text whose unwanted columns are looked at, too."""

_CHUNK_BYTES = 1 << 20
_SPACES = " "
"""Delimiter of cells that stand apart by any number of spaces."""
_DELIMITERS = (";", "\t", ",", _SPACES)
_NO_TEXT = {
    b"\xff\xfe": "is UTF-16 text: save it as UTF-8",
    b"\xfe\xff": "is UTF-16 text: save it as UTF-8",
    b"PK\x03\x04": "is a workbook or an archive: export its table as CSV",
    b"\x1f\x8b": "is compressed: unpack it",
}
"""Files that are no delimited text, by their first bytes."""

Column = NDArray[np.float64]


class ColumnError(Exception):
    """A file that cannot be read, in one line without its name."""


@dataclass
class Table:
    """Columns of a file: (n,) float64 each, read on demand."""

    columns: dict[str, Callable[[], Column]] = field(default_factory=dict)
    rate_hz: float | None = None
    """Sample rate that the file states; None if it states none."""
    units: dict[str, str] = field(default_factory=dict)
    """Units that the file states beside the names of columns."""
    channels: list[str] = field(default_factory=list)
    """Names in the array ``channels`` of an archive, as analogrig writes it."""
    refused: dict[str, str] = field(default_factory=dict)
    """What the file holds beside columns, by name."""

    def add_typed(self, name: str, dtype: np.dtype[Any], shape: Sequence[int], load: Callable[[], Any]) -> None:
        """Add an array of NumPy, or each field of a structured one as ``name.field``; texts are left out."""
        for field_name in dtype.names or ():
            each = dtype[field_name]
            label = f"{name}.{field_name}" if name else field_name
            self.add_typed(label, each.base, (*shape, *each.shape), partial(_field_of, load, field_name))
        if dtype.hasobject and sum(size != 1 for size in shape) == 0:
            self.refused[name] = "Python objects"
        if dtype.kind in "buifcO":
            self.add(name, shape, load if not dtype.hasobject else partial(_refuse_objects, name))

    def add(self, name: str, shape: Sequence[int], load: Callable[[], Any]) -> None:
        """Add an array as one column, or as the columns ``name[0]``, ``name[1]``, ... along its longest axis.

        Arrays of other shapes are left out.

        :raises ColumnError: it is too long, or there are too many columns.
        """
        long = [size for size in shape if size != 1]
        if max(long, default=1) > MAX_SAMPLES:
            raise ColumnError(f"{name[:_MOST_NAME]} has {max(long)} samples, more than {MAX_SAMPLES}")
        if len(long) == 1:
            self._put(name, lambda: _numbers(name, load()).reshape(-1))
        elif len(long) == 2 and min(long) <= MOST_COLUMNS:
            for j in range(min(long)):
                self._put(f"{name}[{j}]", partial(_row_of, name, load, j))

    def _put(self, name: str, load: Callable[[], Column]) -> None:
        if len(self.columns) == MOST_COLUMNS:
            raise ColumnError(f"more than {MOST_COLUMNS} columns")
        self.columns[name] = load if name not in self.columns else partial(_refuse_namesakes, name)


def _field_of(load: Callable[[], Any], name: str) -> Any:
    return load()[name]


def _refuse_objects(name: str) -> Any:
    raise ColumnError(
        f"{name[:_MOST_NAME] or 'the array'} holds Python objects, which are not loaded; save numbers, as float64"
    )


def _refuse_namesakes(name: str) -> Any:
    raise ColumnError(f"several columns are called {name[:_MOST_NAME]!r}; give each a name of its own")


def _row_of(name: str, load: Callable[[], Any], j: int) -> Column:
    """Row or column j of an array, along its longest axis."""
    square = np.squeeze(_numbers(name, load()))
    return square[:, j] if square.shape[0] >= square.shape[1] else square[j]


def _numbers(name: str, values: Any) -> Column:
    """:raises ColumnError: they are no real numbers."""
    found = np.asarray(values)
    if found.dtype.kind not in "buif":
        raise ColumnError(f"{name[:_MOST_NAME]} holds no real numbers, but {found.dtype}")
    return found.astype(np.float64)


# --------------------------------------------------------------------------------------------------------------- text


def _lines(file: IO[str]) -> Iterator[str]:
    """:raises ColumnError: a line is too long."""
    for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), 1):
        if len(line) == _LONGEST_LINE:
            raise ColumnError(f"line {number} has more than {_LONGEST_LINE} characters")
        yield line


def _number(cell: str, delimiter: str) -> float:
    """:raises ValueError: it is no number."""
    text = cell.strip()
    if not text:
        return float("nan")
    if "_" in text or not text.isascii():
        raise ValueError(text)  # Python would read 1_0 as 10, and the digits of every script
    return float(text.replace(",", ".") if delimiter != "," else text)


def _is_word(cell: str) -> bool:
    """True unless the cell is a number; an empty one is a word, too."""
    return not cell.strip() or not _are_numbers([cell], ";")


def _are_numbers(cells: Sequence[str], delimiter: str) -> bool:
    try:
        return any(cell.strip() for cell in cells) and not any(
            np.isnan(_number(cell, delimiter)) for cell in cells if cell.strip()
        )
    except ValueError:
        return False


def read_text(path: Path, wanted: Sequence[str], skip_lines: int) -> tuple[list[str], dict[str, Column], int]:
    """Names and wanted columns of delimited text, and the blank lines between its rows.

    Without a header the names are 0, 1, ...

    :raises ColumnError: a line has no such cell, or no number there.
    """
    _check_text(path, skip_lines)
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        lines = enumerate(_lines(file), 1)
        rest = ((k, line) for k, line in islice(lines, skip_lines, None) if line[0] != "#")
        first = next((each for each in rest if each[1].strip()), None)
        if first is None:
            raise ColumnError("holds no line of text")
        start = list(islice(rest, _SAMPLED_LINES))
        rows = chain(start, rest)
        delimiter = _delimiter(first[1], [line for _, line in start if line.strip()])
        cells = [cell.strip() for cell in _cells(first[1], delimiter)]
        has_header = not _are_numbers(cells, delimiter)
        names = cells if has_header else [str(j) for j in range(len(cells))]
        while names and not names[-1]:
            names.pop()
        if len(names) > MOST_COLUMNS:
            raise ColumnError(f"more than {MOST_COLUMNS} columns")
        places = [_place(name, names, _cure_of_names(names)) for name in wanted]
        found: list[array.array[float]] = []
        blank_lines = 0
        if wanted:
            found, blank_lines = _read_rows(rows if has_header else chain([first], rows), names, places, delimiter)
    return names, {name: np.frombuffer(column) for name, column in zip(wanted, found, strict=True)}, blank_lines


def _read_rows(
    lines: Iterable[tuple[int, str]], names: Sequence[str], places: Sequence[int], delimiter: str
) -> tuple[list[array.array[float]], int]:
    """Numbers at these places of every line, and the blank lines between the first and the last.

    :raises ColumnError: a line has no such cell, or no number there.
    """
    found = [array.array("d") for _ in places]
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
        first = first or row
        last.append((number, row))
        if len(row) > len(names) and any(cell.strip() for cell in row[len(names) :]):
            raise ColumnError(
                f"line {number} has {len(row)} cells, the first line {len(names)}: cells with decimal commas need"
                " another separator, such as semicolons"
            )
        for place, column in zip(places, found, strict=True):
            try:
                column.append(_number(row[place], delimiter))
            except (IndexError, ValueError):
                if not found[0] and all(map(_is_word, row)):
                    raise ColumnError(
                        f"line {number} holds no number, perhaps units: delete it, or pass --skip-lines {number} and"
                        " name the columns 0, 1, ..."
                    ) from None
                where = f"line {number}, column {names[place][:_MOST_NAME]}"
                why = f"{row[place][:40]!r} is no number" if place < len(row) else "the line has no such cell"
                raise ColumnError(f"{where}: {why}; mend or delete the line") from None
    _check_footer(first, last, names, delimiter)
    return found, blank_lines


def _check_footer(
    first: Sequence[str], last: Iterable[tuple[int, Sequence[str]]], names: Sequence[str], delimiter: str
) -> None:
    """Refuse a summary below the samples, which may have numbers in the wanted columns.

    :param last: last rows with the numbers of their lines.
    :raises ColumnError: a column that begins with a number has text in them.
    """
    numeric = [place for place, cell in enumerate(first) if _are_numbers([cell], delimiter)]
    for number, row in last:
        for place in numeric:
            if place < len(row) and row[place].strip() and not _are_numbers([row[place]], delimiter):
                raise ColumnError(
                    f"line {number}, column {names[place][:_MOST_NAME]}: {row[place][:40]!r} is no number, perhaps a"
                    " footer: mend or delete the line"
                )


def _check_text(path: Path, skip_lines: int) -> None:
    """Refuse at once what is no text, or has too many lines: to parse it would take a minute.

    :raises ColumnError: it is such a file.
    """
    rows = -skip_lines
    with path.open("rb") as file:
        start = file.read(_CHUNK_BYTES)
        for first_bytes, what in _NO_TEXT.items():
            if start.startswith(first_bytes):
                raise ColumnError(what)
        if b"\0" in start[:4096]:
            raise ColumnError("holds bytes of zero: UTF-16, or no text; save it as text in UTF-8")
        for chunk in chain([start], iter(partial(file.read, _CHUNK_BYTES), b"")):
            rows += chunk.count(b"\n") - sum(chunk.count(blank) for blank in (b"\n\n", b"\n\r", b"\n#"))
            if rows > MAX_SAMPLES + 1:
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
        numbers = sum(_are_numbers([cell], delimiter) for cell in cells) / len(cells) if cells else 0.0
        return {len(row) for row in rows_of_cells} <= {len(_cells(first, delimiter))}, numbers

    possible = [each for each in _DELIMITERS if len(_cells(first, each)) > 1]
    return max(possible, key=merit, default=_SPACES)


def _cells(line: str, delimiter: str) -> list[str]:
    return line.split() if delimiter == _SPACES else next(csv.reader([line], delimiter=delimiter))


def _cure_of_names(names: Sequence[str]) -> str:
    """Cure if names suggest a wrong first line or a wrong encoding."""
    if any("\ufffd" in name for name in names):
        return "; the file is no UTF-8: save it as UTF-8"
    return "; --skip-lines N leaves out text above the header"


def unit_in_name(column: str) -> str:
    """Unit in brackets at the end of a column's name, such as mm of ``stroke [mm]``; empty without one."""
    found = _NAME_AND_UNIT.fullmatch(column.strip())
    return found[2].strip() if found else ""


def _without_unit(column: str) -> str:
    found = _NAME_AND_UNIT.fullmatch(column.strip())
    return found[1] if found and "\ufffd" not in column else column


def _place(name: str, names: Sequence[str], cure: str = "") -> int:
    """Place of a name, which may lack its unit.

    :raises ColumnError: there is no such name, or more than one.
    """
    places = [i for i, each in enumerate(names) if each == name]
    places = places or [i for i, each in enumerate(names) if _without_unit(each) == name]
    if len(places) == 1:
        return places[0]
    if places:
        raise ColumnError(f"{len(places)} columns are called {name[:_MOST_NAME]!r}")
    shown = ", ".join(each[:_MOST_NAME] for each in names[:20]) + (", ..." if len(names) > 20 else "")
    raise ColumnError(f"no column is called {name[:_MOST_NAME]!r}; there are {shown or 'none'}{cure}")


def _refusal(refused: Mapping[str, str]) -> str:
    """Names and kinds of what is not loaded, and the cure."""
    shown = [f"{name[:_MOST_NAME] or 'the array'} ({kind})" for name, kind in refused.items()]
    return f"not loaded: {', '.join(shown[:20])}{', ...' if len(shown) > 20 else ''}; save numbers, as float64"


# --------------------------------------------------------------------------------------------------------------- NumPy


def open_npy(path: Path) -> Table:
    """Table of an array: the fields of a structured one, or the columns 0, 1, ... of one with two dimensions."""
    with path.open("rb") as file:
        shape, dtype = _npy_header(file)
    table = Table()

    def load() -> Any:
        return np.load(path, mmap_mode="r", allow_pickle=False)  # a map cannot be larger than its file

    if dtype.names:
        table.add_typed("", dtype, shape, load)
        return table
    table.add_typed("0" if sum(size != 1 for size in shape) <= 1 else "", dtype, shape, load)
    columns = {name.strip("[]"): load for name, load in table.columns.items()}
    return Table(columns, refused=table.refused)


def open_npz(path: Path) -> Table:
    """Table of the arrays of an archive."""
    archive = zipfile.ZipFile(path)
    table = Table()
    for info in archive.infolist()[: MOST_COLUMNS + 1]:
        with archive.open(info) as member:
            shape, dtype = _npy_header(member)
        name = info.filename.removesuffix(".npy")
        if not dtype.hasobject and np.prod(shape, dtype=float) * dtype.itemsize > info.file_size:
            raise ColumnError(f"{name[:_MOST_NAME]} declares the shape {shape}, larger than its member of the archive")
        table.add_typed(name, dtype, shape, partial(_npz_member, archive, info))
        if name == "channels" and dtype.kind == "U" and info.file_size < _MOST_TEXT_BYTES:
            channels = _npz_member(archive, info).reshape(-1).tolist()
            table.channels = channels if all(each.isprintable() for each in channels) else []
    return table


def _npy_header(member: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    start = member.read(len(np.lib.format.magic(1, 0)))
    if not start.startswith(np.lib.format.MAGIC_PREFIX):
        raise ColumnError("holds no array of NumPy, perhaps a pickle, which is not loaded; write it with numpy.save")
    version = tuple(start[-2:])
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(member)
    return shape, dtype


def _npz_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Any:
    with archive.open(info) as member:
        return np.lib.format.read_array(member, allow_pickle=False)


# -------------------------------------------------------------------------------------------------------------- MATLAB


def open_matlab(path: Path) -> Table:
    """Table of the numeric variables of a .mat file of version 4 to 7.3."""
    with path.open("rb") as file:
        is_hdf5 = b"\x89HDF\r\n\x1a\n" in file.read(4096)
    if is_hdf5:
        return _open_hdf5(path)
    import scipy.io

    table = Table()
    for name, shape, kind in scipy.io.whosmat(path):
        if kind not in {"cell", "struct", "object", "function", "char", "opaque", "unknown", "sparse"}:
            table.add(name, shape, partial(_mat_variable, path, name))
        else:
            table.refused[name] = kind
    return table


def _mat_variable(path: Path, name: str) -> Any:
    import scipy.io

    return scipy.io.loadmat(path, variable_names=[name])[name]


def _open_hdf5(path: Path) -> Table:
    """Table of the data sets at the top of an HDF5 file; links to other files are not followed."""
    try:
        import h5py
    except ImportError:
        raise ColumnError("MATLAB files of version 7.3 need h5py: pip install h5py") from None
    file = h5py.File(path, "r")
    table = Table()
    for name in islice(file, MOST_COLUMNS + 1):
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            continue
        found = file[name]
        if isinstance(found, h5py.Group):
            table.refused[name] = "struct"
        elif found.shape and not found.external and not found.is_virtual:
            table.add(name, found.shape, partial(found.__getitem__, ()))
    return table


# ------------------------------------------------------------------------------------------------------- measurements


def open_mf4(path: Path) -> Table:
    """Table of the channels of a measurement; ``name@GROUP`` where several groups have the name."""
    try:
        from asammdf import MDF
    except ImportError:
        raise ColumnError("measurement files need asammdf: pip install asammdf") from None
    measurement = MDF(path, raise_on_multiple_occurrences=False)
    table = Table()
    for name, places in islice(measurement.channels_db.items(), MOST_COLUMNS + 1):
        for group, index in places[:MOST_COLUMNS]:
            samples = int(measurement.groups[group].channel_group.cycles_nr)
            label = name if len(places) == 1 else f"{name}@{group}"
            table.add(label, (samples,), partial(_mf4_channel, measurement, group, index))
            channel = measurement.groups[group].channels[index]
            table.units[label] = (channel.conversion and channel.conversion.unit) or channel.unit or ""
    return table


def _mf4_channel(measurement: Any, group: int, index: int) -> Any:
    """Values of a channel. Its conversion is done here: the library would evaluate formulas.

    :raises ColumnError: it has another conversion than a straight line.
    """
    signal = measurement.get(group=group, index=index, raw=True)
    conversion = signal.conversion
    kind = 0 if conversion is None else conversion.conversion_type
    if kind == 0:
        return signal.samples
    if kind == 1:
        return conversion.a * np.asarray(signal.samples, np.float64) + conversion.b
    raise ColumnError(f"{signal.name[:_MOST_NAME]} has a conversion other than a straight line; export physical values")


def open_parquet(path: Path) -> Table:
    """Table of the numeric columns; an instant becomes seconds since the first one."""
    try:
        from pyarrow import parquet, types
    except ImportError:
        raise ColumnError("Parquet files need pyarrow: pip install pyarrow") from None
    file = parquet.ParquetFile(path)
    table = Table()
    for kind in file.schema_arrow:
        if any(each(kind.type) for each in (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal)):
            table.add(kind.name, (file.metadata.num_rows,), partial(_parquet_column, file, kind.name))
            table.units[kind.name] = (kind.metadata or {}).get(b"unit", b"").decode("utf-8", "replace")
        elif types.is_timestamp(kind.type):
            table.add(kind.name, (file.metadata.num_rows,), partial(_parquet_instants, file, kind.name))
    return table


def _parquet_column(file: Any, name: str) -> Any:
    column = file.read(columns=[name], use_threads=False).column(0)
    return column.cast("float64").to_numpy(zero_copy_only=False)


def _parquet_instants(file: Any, name: str) -> Any:
    column = file.read(columns=[name], use_threads=False).column(0)
    instants = column.cast("timestamp[ns]").cast("int64").to_numpy(zero_copy_only=False)
    return (instants - instants[0]) * 1e-9


def open_wav(path: Path) -> Table:
    """Table of the channels 0, 1, ...; whole numbers are scaled to -1..1."""
    from scipy.io import wavfile

    with path.open("rb") as file:
        start = file.read(8)
    stated, size = int.from_bytes(start[4:], "little"), path.stat().st_size
    if start.startswith(b"RIFF") and stated > size:
        raise ColumnError(f"is cut off: {size} of the {stated + 8} bytes that its header states; copy it once more")
    rate_hz, values = wavfile.read(path)
    scaled = np.asarray(values)
    if scaled.dtype.kind == "u":
        scaled = (scaled - 128.0) / 128.0
    elif scaled.dtype.kind == "i":
        scaled = scaled / -float(np.iinfo(scaled.dtype).min)
    table = Table(rate_hz=float(rate_hz) or None)
    for j, channel in enumerate(np.atleast_2d(scaled.T)[:MOST_COLUMNS]):
        table.add(str(j), channel.shape, partial(np.asarray, channel))
    return table


FORMATS: Mapping[str, tuple[str, Callable[[Path], Table] | None]] = {
    ".csv": ("CSV", None),
    ".tsv": ("CSV", None),
    ".txt": ("CSV", None),
    ".npy": ("NumPy", open_npy),
    ".npz": ("NumPy", open_npz),
    ".mat": ("MATLAB", open_matlab),
    ".mf4": ("MF4", open_mf4),
    ".parquet": ("Parquet", open_parquet),
    ".wav": ("WAV", open_wav),
}
"""Name and opening of each format by suffix; delimited text has none."""


class Columns(NamedTuple):
    """Columns of a file."""

    names: list[str]
    """Names of all of them."""
    columns: dict[str, Column]
    """The wanted ones."""
    rate_hz: float | None = None
    """Sample rate that the file states."""
    blank_lines: int = 0
    """Blank lines between rows of text."""
    units: Mapping[str, str] = MappingProxyType({})
    """Units that the file states beside the names of the wanted columns."""
    channels: Sequence[str] = ()
    """Names in the array ``channels`` of an archive."""


def read(path: Path, wanted: Sequence[str], skip_lines: int = 0) -> Columns:
    """Columns of a file.

    :raises ColumnError: a wanted column is not there, or cannot be read.
    """
    opening = FORMATS[path.suffix.lower()][1]
    if opening is None:
        names, columns, blank_lines = read_text(path, wanted, skip_lines)
        full = {name: names[_place(name, names)] for name in wanted}
        units = {name: unit for name, each in full.items() if (unit := unit_in_name(each))}
        return Columns(names, columns, None, blank_lines, units)
    table = opening(path)
    names = list(table.columns)
    refusal = f"; {_refusal(table.refused)}" if table.refused else ""
    full = {name: names[_place(name, names, refusal)] for name in wanted}
    units = {name: unit[:_MOST_NAME] for name, each in full.items() if (unit := _unit(table, each))}
    columns = {name: table.columns[each]() for name, each in full.items()}
    return Columns(names, columns, table.rate_hz, 0, units, table.channels)


def _unit(table: Table, name: str) -> str:
    return table.units.get(name) or unit_in_name(name)


def answer(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Answer to a request, as the module describes it."""
    path = Path(asked["file"])
    try:
        found = read(path, asked["wanted"], asked["skip_lines"])
        if found.columns:
            named: dict[str, Any] = {str(i): column for i, column in enumerate(found.columns.values())}
            np.savez(asked["out"], **named)
    except ColumnError as error:
        return {"error": str(error)}
    except MemoryError:
        return {"error": f"needs more than {MOST_MEMORY_BYTES >> 30} GiB of memory"}
    except Exception as error:  # noqa: BLE001 - the libraries raise anything on damaged files
        cause = re.sub(r"\s+", " ", str(error))[:200] or type(error).__name__
        return {"error": f"damaged, or no {FORMATS[path.suffix.lower()][0]} file: {cause}"}
    told = found._asdict() | {"units": dict(found.units)}
    del told["columns"]
    return told


def main(request: str) -> None:
    """Answer one request."""
    asked = json.loads(request)
    tempfile.tempdir = str(Path(asked["out"]).parent)  # asammdf leaves a file there
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_PROCESSOR_S, MOST_PROCESSOR_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")  # of libraries, about damaged files
    sys.stdout.write(json.dumps(answer(asked)))
    sys.stdout.flush()
    os._exit(0)  # destructors of half-open files would write to standard error


if __name__ == "__main__":
    main(sys.argv[1])
