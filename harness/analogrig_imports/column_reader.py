"""Reader of columns of numbers in files of other tools: ``python -m analogrig_imports.column_reader REQUEST``.

It runs in a process of its own with bounded memory and time, because a damaged or hostile file may exhaust the memory
or crash the library that reads it. Nothing in a file is executed: no pickles, no formulas, no links to other files.
REQUEST is a JSON object: ``file``; ``wanted``, the columns to read; ``skip_lines``; ``out``, the .npz to write them to.
The answer is a JSON object on standard output: ``names``, ``rate_hz``, ``blank_lines``, ``units`` and
``channels``, or ``error``.
"""

from __future__ import annotations

import json
import os
import re
import resource
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.plant import MAX_SAMPLES
from analogrig_imports.column_names import MOST_NAME, ColumnError, place, unit_in_name
from analogrig_imports.text_columns import MOST_COLUMNS, read_text

MOST_MEMORY_BYTES = 4 << 30
"""Address space of the process, libraries included."""

MOST_PROCESSOR_S = 300

_STREAMED_BYTES = 0x7FF00000
"""Least size that stands for an unknown one: writers to a pipe state 2 or 4 GiB, or nearly so."""
_MOST_DEPTH = 4
"""Structs within structs that are read."""
_MOST_TEXT_BYTES = 4096
"""Largest array of texts that is read."""

Column = NDArray[np.float64]


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
            raise ColumnError(f"{name[:MOST_NAME]} has {max(long)} samples, more than {MAX_SAMPLES}")
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
        f"{name[:MOST_NAME] or 'the array'} holds Python objects, which are not loaded; save numbers, as float64"
    )


def _refuse_namesakes(name: str) -> Any:
    raise ColumnError(f"several columns are called {name[:MOST_NAME]!r}; give each a name of its own")


def _row_of(name: str, load: Callable[[], Any], j: int) -> Column:
    """Row or column j of an array, along its longest axis."""
    square = np.squeeze(_numbers(name, load()))
    return square[:, j] if square.shape[0] >= square.shape[1] else square[j]


def _numbers(name: str, values: Any) -> Column:
    """:raises ColumnError: they are no real numbers."""
    found = np.asarray(values)
    if found.dtype.kind not in "buif":
        raise ColumnError(f"{name[:MOST_NAME]} holds no real numbers, but {found.dtype}")
    return found.astype(np.float64)


_CURES = {
    "struct": "in MATLAB: s = load('FILE'); s = s.NAME; save('flat.mat', '-struct', 's')",
    "opaque": "in MATLAB: load FILE; t = seconds(NAME.Time); x = NAME.Variables; save('flat.mat', 't', 'x')",
}
"""Lines that turn what is not loaded into arrays, by its kind."""


def _refusal(path: Path, refused: Mapping[str, str]) -> str:
    """Names and kinds of what is not loaded, and the cure."""
    shown = [f"{name[:MOST_NAME] or 'the array'} ({kind})" for name, kind in refused.items()]
    name, kind = next(iter(refused.items()))
    cure = _CURES.get(kind, "save numbers, as float64").replace("FILE", path.name).replace("NAME", name[:MOST_NAME])
    return f"not loaded: {', '.join(shown[:20])}{', ...' if len(shown) > 20 else ''}; {cure}"


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
            raise ColumnError(f"{name[:MOST_NAME]} declares the shape {shape}, larger than its member of the archive")
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
        if kind == "struct":
            before = len(table.columns)
            _add_struct(table, name, _mat_variable(path, name))
            if len(table.columns) == before:
                table.refused[name] = kind
        elif kind not in {"cell", "object", "function", "char", "opaque", "unknown", "sparse"}:
            table.add(name, shape, partial(_mat_variable, path, name))
        else:
            table.refused[name] = kind
    return table


def _mat_variable(path: Path, name: str) -> Any:
    import scipy.io

    return scipy.io.loadmat(path, variable_names=[name])[name]


def _add_struct(table: Table, name: str, struct: Any, depth: int = 0) -> None:
    """Add the numbers in the fields of a struct as ``name.field``, of an array of them as ``name[i].field``."""
    elements = np.asarray(struct).reshape(-1)
    for i, element in enumerate(elements[:MOST_COLUMNS]):
        label = name if len(elements) == 1 else f"{name}[{i}]"
        for field_name in struct.dtype.names or ():
            value = np.asarray(element[field_name])
            if value.dtype.names and depth < _MOST_DEPTH:
                _add_struct(table, f"{label}.{field_name}", value, depth + 1)
            elif value.dtype.kind in "buif":
                table.add(f"{label}.{field_name}", value.shape, partial(np.asarray, value))
            elif value.dtype.kind != "U":
                table.refused[f"{label}.{field_name}"] = "cell" if value.dtype.hasobject else value.dtype.name


def _open_hdf5(path: Path) -> Table:
    """Table of the data sets at the top of an HDF5 file; links to other files are not followed."""
    try:
        import h5py
    except ImportError:
        raise ColumnError("MATLAB files of version 7.3 need h5py: pip install h5py") from None
    table = Table()
    _add_group(table, "", h5py.File(path, "r"))
    return table


def _add_group(table: Table, prefix: str, group: Any, depth: int = 0) -> None:
    """Add the data sets of a group of HDF5, which is a struct of MATLAB, and those of its groups as ``name.field``."""
    import h5py

    for key in islice(group, MOST_COLUMNS + 1):
        name = f"{prefix}{key}"
        if not isinstance(group.get(key, getlink=True), h5py.HardLink) or key.startswith("#"):
            continue
        found = group[key]
        if isinstance(found, h5py.Group):
            if depth < _MOST_DEPTH:
                _add_group(table, f"{name}.", found, depth + 1)
        elif found.dtype.kind == "O":
            table.refused[name] = "cell"
        elif found.shape and not found.external and not found.is_virtual:
            table.add(name, found.shape, partial(found.__getitem__, ()))


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
    raise ColumnError(f"{signal.name[:MOST_NAME]} has a conversion other than a straight line; export physical values")


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


def _whole_wav(path: Path) -> BytesIO:
    """The file, with the sizes that a writer to a pipe could not know.

    :raises ColumnError: it ends before the size that its header states.
    """
    data = bytearray(path.read_bytes())
    at = 12  # of the first chunk
    while data[:4] == b"RIFF" and at + 8 <= len(data):
        stated, rest = int.from_bytes(data[at + 4 : at + 8], "little"), len(data) - at - 8
        is_streamed = stated >= _STREAMED_BYTES or (stated == 0 and rest > 0)
        if data[at : at + 4] == b"data":
            if is_streamed:
                data[at + 4 : at + 8] = rest.to_bytes(4, "little")
            elif stated > rest:
                raise ColumnError(
                    f"is cut off: {len(data)} of the {at + 8 + stated} bytes that its header states; copy it once more"
                )
            data[4:8] = (len(data) - 8).to_bytes(4, "little")
            break
        at += 8 + stated + stated % 2
    return BytesIO(bytes(data))


def open_wav(path: Path) -> Table:
    """Table of the channels 0, 1, ...; whole numbers are scaled to -1..1."""
    from scipy.io import wavfile

    rate_hz, values = wavfile.read(_whole_wav(path))
    scaled = np.asarray(values)
    if scaled.dtype.kind == "u":
        scaled = (scaled - 128.0) / 128.0
    elif scaled.dtype.kind == "i":
        scaled = scaled / -float(np.iinfo(scaled.dtype).min)
    table = Table(rate_hz=float(rate_hz) or None)
    for j, channel in enumerate(np.atleast_2d(scaled.T)[:MOST_COLUMNS]):
        table.add(str(j), channel.shape, partial(np.asarray, channel))
    return table


Opening = Callable[[Path], Table]

FORMATS: Mapping[str, tuple[str, Opening | None]] = {
    ".csv": ("CSV", None),
    ".tsv": ("CSV", None),
    ".txt": ("CSV", None),
    ".dat": ("CSV", None),
    ".lvm": ("LabVIEW", None),
    ".npy": ("NumPy", open_npy),
    ".npz": ("NumPy", open_npz),
    ".mat": ("MATLAB", open_matlab),
    ".mf4": ("MF4", open_mf4),
    ".parquet": ("Parquet", open_parquet),
    ".wav": ("WAV", open_wav),
}
"""Name and opening of each format by suffix; delimited text has none."""

_STARTS: Mapping[bytes, tuple[str, Opening | None]] = {
    b"\x93NUMPY": FORMATS[".npy"],
    b"MATLAB 5.0": FORMATS[".mat"],
    b"MATLAB 7.3": FORMATS[".mat"],
    b"\x89HDF": FORMATS[".mat"],
    b"MDF ": FORMATS[".mf4"],
    b"PAR1": FORMATS[".parquet"],
    b"RIFF": FORMATS[".wav"],
}
"""The same by the first bytes, whatever the suffix is."""

_FOREIGN = {
    b"TDSm": "is a TDMS file of LabVIEW: pip install npTDMS pandas, and python -c 'from nptdms import TdmsFile;"
    ' TdmsFile.read("FILE").as_dataframe().to_csv("STEM.csv")\'',
    b"\xd0\xcf\x11\xe0": "is a workbook or an archive: export its table as CSV",
    b"PK\x03\x04": "is a workbook or an archive: export its table as CSV",
    b"\x1f\x8b": "is compressed: unpack it",
}
"""What is read by no opening, and the cure, by the first bytes."""


def format_of(path: Path) -> tuple[str, Opening | None]:
    """Name and opening of the format that a file has: by its first bytes, or else by its suffix; text by default.

    :raises ColumnError: no format here has these first bytes.
    """
    with path.open("rb") as file:
        start = file.read(16)
    by_suffix = FORMATS.get(path.suffix.lower(), FORMATS[".csv"])
    found = next((each for first, each in _STARTS.items() if start.startswith(first)), by_suffix)
    if found[1] is None and (foreign := next((each for each in _FOREIGN if start.startswith(each)), None)):
        raise ColumnError(_FOREIGN[foreign].replace("FILE", path.name).replace("STEM", path.stem))
    return found


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
    opening = format_of(path)[1]
    if opening is None:
        text = read_text(path, wanted, skip_lines)
        return Columns(text.names, text.columns, text.rate_hz, text.blank_lines, text.units)
    table = opening(path)
    names = list(table.columns)
    refusal = f"; {_refusal(path, table.refused)}" if table.refused else ""
    full = {name: names[place(name, names, refusal)] for name in wanted}
    units = {name: unit[:MOST_NAME] for name, each in full.items() if (unit := _unit(table, each))}
    columns = {name: table.columns[each]() for name, each in full.items()}
    return Columns(names, columns, table.rate_hz, 0, units, table.channels)


def _unit(table: Table, name: str) -> str:
    return table.units.get(name) or unit_in_name(name)


def answer(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Answer to a request, as the module describes it."""
    path, kind = Path(asked["file"]), ""
    try:
        kind = format_of(path)[0]
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
        return {"error": f"damaged, or no {kind} file: {cause}"}
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
