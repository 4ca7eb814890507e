"""Reader of columns of numbers in files of other tools: ``python -m analogrig.recordings.column_reader REQUEST``.

It runs in a process of its own with bounded memory and time, because a damaged or hostile file may exhaust the memory
or crash the library that reads it. Nothing in a file is executed: no pickles, no formulas, no links to other files.
REQUEST is a JSON object: ``file``; ``wanted``, the columns to read; ``skip_lines``; ``out``, the .npz to write them to.
The answer is a JSON object on standard output: ``names`` and ``rate_hz``, or ``error``.
"""

from __future__ import annotations

import array
import csv
import json
import os
import re
import resource
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import IO, Any

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
_EXTRA = "pip install 'analogrig[import]'"
_DELIMITERS = (",", ";", "\t")

Column = NDArray[np.float64]


class ColumnError(Exception):
    """A file that cannot be read, in one line without its name."""


@dataclass
class Table:
    """Columns of a file: (n,) float64 each, read on demand."""

    columns: dict[str, Callable[[], Column]] = field(default_factory=dict)
    rate_hz: float | None = None
    """Sample rate that the file states; None if it states none."""

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
        self.columns[name] = load


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
    return float(text.replace(",", ".") if delimiter != "," else text)


def _are_numbers(cells: Sequence[str], delimiter: str) -> bool:
    try:
        return any(cell.strip() for cell in cells) and not any(
            np.isnan(_number(cell, delimiter)) for cell in cells if cell.strip()
        )
    except ValueError:
        return False


def read_text(path: Path, wanted: Sequence[str], skip_lines: int) -> tuple[list[str], dict[str, Column]]:
    """Names and wanted columns of delimited text; without a header the names are 0, 1, ...

    :raises ColumnError: a line has no such cell, or no number there.
    """
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        lines = enumerate(_lines(file), 1)
        rest = ((k, line) for k, line in islice(lines, skip_lines, None) if line.strip() and line[0] != "#")
        first = next(rest, None)
        if first is None:
            raise ColumnError("holds no line of text")
        delimiter = max(_DELIMITERS, key=first[1].count)
        cells = [cell.strip() for cell in next(csv.reader([first[1]], delimiter=delimiter))]
        has_header = not _are_numbers(cells, delimiter)
        names = cells if has_header else [str(j) for j in range(len(cells))]
        while names and not names[-1]:
            names.pop()
        if len(names) > MOST_COLUMNS:
            raise ColumnError(f"more than {MOST_COLUMNS} columns")
        places = [_place(name, names) for name in wanted]
        found = [array.array("d") for _ in wanted]
        for number, line in (rest if has_header else chain([first], rest)) if wanted else ():
            if len(found[0]) == MAX_SAMPLES:
                raise ColumnError(f"has more than {MAX_SAMPLES} samples")
            row = next(csv.reader([line], delimiter=delimiter))
            if len(row) > len(names) and any(cell.strip() for cell in row[len(names) :]):
                raise ColumnError(
                    f"line {number} has {len(row)} cells, the first line {len(names)}: cells with decimal commas need"
                    " another separator, such as semicolons"
                )
            for place, column in zip(places, found, strict=True):
                try:
                    column.append(_number(row[place], delimiter))
                except (IndexError, ValueError):
                    where = f"line {number}, column {names[place][:_MOST_NAME]}"
                    why = f"{row[place][:40]!r} is no number" if place < len(row) else "the line has no such cell"
                    raise ColumnError(f"{where}: {why}; mend or delete the line") from None
    return names, {name: np.frombuffer(column) for name, column in zip(wanted, found, strict=True)}


def _place(name: str, names: Sequence[str]) -> int:
    """:raises ColumnError: there is no such name, or more than one."""
    if names.count(name) != 1:
        raise ColumnError(_unknown(name, names))
    return names.index(name)


def _unknown(name: str, names: Sequence[str]) -> str:
    shown = ", ".join(each[:_MOST_NAME] for each in names[:20]) + (", ..." if len(names) > 20 else "")
    if name in names:
        return f"{names.count(name)} columns are called {name[:_MOST_NAME]!r}"
    return f"no column is called {name[:_MOST_NAME]!r}; there are {shown or 'none'}"


# --------------------------------------------------------------------------------------------------------------- NumPy


def open_npy(path: Path) -> Table:
    """Table of an array: the fields of a structured one, or the columns 0, 1, ... of one with two dimensions."""
    values = np.load(path, mmap_mode="r", allow_pickle=False)  # a map cannot be larger than its file
    table = Table()
    if values.dtype.names:
        for name in values.dtype.names:
            table.add(name, values[name].shape, partial(values.__getitem__, name))
        return table
    table.add("0" if sum(size != 1 for size in values.shape) <= 1 else "", values.shape, lambda: values)
    return Table({name.strip("[]"): load for name, load in table.columns.items()})


def open_npz(path: Path) -> Table:
    """Table of the arrays of an archive."""
    archive = zipfile.ZipFile(path)
    table = Table()
    for info in archive.infolist()[: MOST_COLUMNS + 1]:
        with archive.open(info) as member:
            shape, dtype = _npy_header(member)
        name = info.filename.removesuffix(".npy")
        if dtype.kind not in "buif":
            continue
        if np.prod(shape, dtype=float) * dtype.itemsize > info.file_size:
            raise ColumnError(f"{name[:_MOST_NAME]} declares the shape {shape}, larger than its member of the archive")
        table.add(name, shape, partial(_npz_member, archive, info))
    return table


def _npy_header(member: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(member)
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
    return table


def _mat_variable(path: Path, name: str) -> Any:
    import scipy.io

    return scipy.io.loadmat(path, variable_names=[name])[name]


def _open_hdf5(path: Path) -> Table:
    """Table of the data sets at the top of an HDF5 file; links to other files are not followed."""
    try:
        import h5py
    except ImportError:
        raise ColumnError(f"MATLAB files of version 7.3 need h5py: {_EXTRA}") from None
    file = h5py.File(path, "r")
    table = Table()
    for name in islice(file, MOST_COLUMNS + 1):
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            continue
        found = file[name]
        if isinstance(found, h5py.Dataset) and found.shape and not found.external and not found.is_virtual:
            table.add(name, found.shape, partial(found.__getitem__, ()))
    return table


# ------------------------------------------------------------------------------------------------------- measurements


def open_mf4(path: Path) -> Table:
    """Table of the channels of a measurement; ``name@GROUP`` where several groups have the name."""
    try:
        from asammdf import MDF
    except ImportError:
        raise ColumnError(f"measurement files need asammdf: {_EXTRA}") from None
    measurement = MDF(path, raise_on_multiple_occurrences=False)
    table = Table()
    for name, places in islice(measurement.channels_db.items(), MOST_COLUMNS + 1):
        for group, index in places[:MOST_COLUMNS]:
            samples = int(measurement.groups[group].channel_group.cycles_nr)
            label = name if len(places) == 1 else f"{name}@{group}"
            table.add(label, (samples,), partial(_mf4_channel, measurement, group, index))
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
        raise ColumnError(f"Parquet files need pyarrow: {_EXTRA}") from None
    file = parquet.ParquetFile(path)
    table = Table()
    for kind in file.schema_arrow:
        if types.is_integer(kind.type) or types.is_floating(kind.type) or types.is_boolean(kind.type):
            table.add(kind.name, (file.metadata.num_rows,), partial(_parquet_column, file, kind.name))
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

    rate_hz, values = wavfile.read(path)
    scaled = np.asarray(values)
    if scaled.dtype.kind == "u":
        scaled = (scaled - 128.0) / 128.0
    elif scaled.dtype.kind == "i":
        scaled = scaled / -float(np.iinfo(scaled.dtype).min)
    table = Table(rate_hz=float(rate_hz))
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


def read(path: Path, wanted: Sequence[str], skip_lines: int = 0) -> tuple[list[str], dict[str, Column], float | None]:
    """Names of all columns, the wanted ones, and the sample rate that the file states.

    :raises ColumnError: a wanted column is not there, or cannot be read.
    """
    opening = FORMATS[path.suffix.lower()][1]
    if opening is None:
        return (*read_text(path, wanted, skip_lines), None)
    table = opening(path)
    names = list(table.columns)
    for name in wanted:
        _place(name, names)
    return names, {name: table.columns[name]() for name in wanted}, table.rate_hz


def answer(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Answer to a request: ``names`` and ``rate_hz``, or ``error``."""
    path = Path(asked["file"])
    try:
        names, columns, rate_hz = read(path, asked["wanted"], asked["skip_lines"])
        if columns:
            named: dict[str, Any] = {str(i): column for i, column in enumerate(columns.values())}
            np.savez(asked["out"], **named)
    except ColumnError as error:
        return {"error": str(error)}
    except MemoryError:
        return {"error": f"needs more than {MOST_MEMORY_BYTES >> 30} GiB of memory"}
    except Exception as error:  # noqa: BLE001 - the libraries raise anything on damaged files
        cause = re.sub(r"\s+", " ", str(error))[:200] or type(error).__name__
        return {"error": f"damaged, or no {FORMATS[path.suffix.lower()][0]} file: {cause}"}
    return {"names": names, "rate_hz": rate_hz}


def main(request: str) -> None:
    """Answer one request."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_PROCESSOR_S, MOST_PROCESSOR_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")  # of libraries, about damaged files
    sys.stdout.write(json.dumps(answer(json.loads(request))))
    sys.stdout.flush()
    os._exit(0)  # destructors of half-open files would write to standard error


if __name__ == "__main__":
    main(sys.argv[1])
