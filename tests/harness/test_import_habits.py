"""What other tools write: each file is read, or refused in one line with a cure."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analogrig.cli import main
from analogrig.run import Run
from analogrig_imports import column_reader, columns
from tests.harness.commands import error_of

SAMPLES, PERIOD_S = 60, 0.01
U = np.where(np.arange(SAMPLES) // 7 % 2, 1.0, -1.0)
Y = np.round(np.cumsum(U) / 16, 6)


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files here: a process for each of many files takes long."""
    monkeypatch.setattr(columns, "_ask", lambda _, request: column_reader.answer(json.loads(request)))


@dataclass(frozen=True)
class File:
    """A file of another tool, and what the recording must be."""

    content: str | bytes
    name: str = "a.csv"
    arguments: tuple[str, ...] = ("--input", "u", "--output", "y", "--time", "t")
    missing: tuple[int, ...] = ()
    """Samples that must be missing."""
    period_s: float = PERIOD_S
    unit: str = "V"
    """Unit of the output."""
    says: tuple[str, ...] = ()


def rows(text: Callable[[int], str], count: int = SAMPLES) -> str:
    return "".join(text(k) + "\n" for k in range(count))


def row(k: int, separator: str = ",") -> str:
    return separator.join((f"{k * PERIOD_S:.2f}", f"{U[k]:g}", f"{Y[k]:.6f}"))


def table(header: str = "t,u,y\n", separator: str = ",") -> str:
    return header + rows(lambda k: row(k, separator))


def stamped(stamp: Callable[[int], str], header: str = "time,u,y") -> str:
    return f"{header}\n" + rows(lambda k: f"{stamp(k)},{U[k]:g},{Y[k]:.6f}")


def with_mark(mark: str) -> str:
    return "t,u,y\n" + rows(lambda k: f"{k * PERIOD_S:.2f},{U[k]:g},{mark if k in (20, 21) else f'{Y[k]:.6f}'}")


TIME = ("--input", "u", "--output", "y", "--time", "time")
MARKS = (
    "\u221e", "-\u221e", "OVER", "+OVER", "Over Range", "overload", "OL", "OVF", "NA", "N/A", "#N/A", "null", "None",
    "1.#INF", "-1.#IND", "1.#QNAN", "Infinity", "9.9E+37", "9.91E37", "", "-", "---", "***", "?", "invalid",
)  # fmt: skip

LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\n***End_of_"
    "Header***\t\n\t\nChannels\t2\t\t\nSamples\t60\t60\t\nY_Unit_Label\tV\tmm\t\nX_Dimension\tTime\tTime\t\nX0\t0.0\t0.0\t\n"
    "Delta_X\t0.01\t0.01\t\n***End_of_Header***\t\t\t\nX_Value\tu\ty\tComment\n"
)

READ: Mapping[str, File] = {
    "index of pandas": File(",t,u,y\n" + rows(lambda k: f"{k},{row(k)}")),
    "instants as index of pandas": File(table(",u,y\n"), arguments=(*TIME[:4], "--time", "0")),
    "time stamps as index of pandas": File(
        stamped(lambda k: f"2024-03-01 12:00:00.{k:02d}0000", ",u,y"), arguments=(*TIME[:4], "--time", "0")
    ),
    "units below the names": File(table("t,u,y\ns,V,mm\n"), unit="mm"),
    "units in brackets below the names": File(table("t,u,y\n[s],[V],[mm]\n"), unit="mm"),
    "words for units below the names": File(table("t,u,y\nseconds,Volts,mm\n"), unit="mm"),
    "milliseconds below the names": File(table("t,u,y\nms,V,mm\n"), period_s=1e-5, unit="mm"),
    "units beside the names": File(table("t / ms,u in V,y / mm\n"), period_s=1e-5, unit="mm"),
    "unit joined to the name of the time": File(table("t_ms,u,y\n"), period_s=1e-5),
    "unit of the time in skipped lines": File(
        table("Logger\nt (ms),u (V),y (mm)\n"),
        arguments=("--input", "1", "--output", "2", "--time", "0", "--skip-lines", "2"), period_s=1e-5, unit="mm",
    ),
    "unit line among skipped lines": File(
        table("t,u,y\nms,V,mm\n"),
        arguments=("--input", "1", "--output", "2", "--time", "0", "--skip-lines", "2"), period_s=1e-5, unit="mm",
    ),
    "no unit of the time": File(table(), says=("column t states no unit: read as seconds; pass --time-unit",)),
    "unit of the time on the command line": File(
        table(), arguments=("--input", "u", "--output", "y", "--time", "t", "--time-unit", "ms"), period_s=1e-5
    ),
    "no unit of the signals": File(table(), says=("as no unit is stated",)),
    "ISO with Z": File(stamped(lambda k: f"2024-03-01T23:59:59.{k:02d}Z"), arguments=TIME),
    "ISO across midnight": File(
        stamped(
            lambda k: f"2024-02-{'29 00:00:00' if k > 49 else '28 23:59:59'}.{(k + 50) % 100:02d}",
        ),
        arguments=TIME,
    ),
    "ISO with an offset": File(stamped(lambda k: f"2024-03-01T12:00:00.{k:02d}+01:00"), arguments=TIME),
    "ISO with nanoseconds": File(
        stamped(lambda k: f"2024-03-01T12:00:00.{k * 1000:09d}"), arguments=TIME, period_s=1e-6
    ),
    "time of the day": File(stamped(lambda k: f"12:00:00.{k:02d}"), arguments=TIME),
    "time of the day across midnight": File(
        stamped(lambda k: f"{'00:00:00' if k > 49 else '23:59:59'}.{(k + 50) % 100:02d}"), arguments=TIME
    ),
    "half of the day": File(stamped(lambda k: f"11:59:59.{k:02d} PM"), arguments=TIME),
    "day before month": File(stamped(lambda k: f"31.12.2024 12:00:00.{k:02d}"), arguments=TIME),
    "zone in the header": File(stamped(lambda k: f"12:00:00.{k:02d}", "time [UTC],u,y"), arguments=TIME),
    "Fortran": File(
        " t u y\n" + rows(lambda k: f" {k * PERIOD_S:.4f} {U[k]:.1f} {Y[k]:.6E}".replace("E", "D")), name="a.dat"
    ),
    "three digits of an exponent": File(
        "t u y\n" + rows(lambda k: f"{k * PERIOD_S:.4f} {U[k]:.1f} {Y[k]:.6f}{'+000' if k == 20 else ''}")
    ),
    "text above the header": File(
        table("Record Length,60\nSample Interval,0.01\n\nTIME,CH1,CH2\n"),
        arguments=("--input", "CH1", "--output", "CH2", "--time", "TIME"),
    ),
    "names in a comment": File(table("# t u y\n", " "), name="a.txt"),
    "index in a name": File(table("t,u[1],y[2]\n"), arguments=("--input", "u[1]", "--output", "y[2]", "--time", "t")),
    "LabVIEW": File(LABVIEW + table("", "\t"), name="a.lvm", arguments=(*TIME[:4], "--time", "X_Value"), unit="mm"),
    "rate of LabVIEW": File(LABVIEW + table("", "\t"), name="a.lvm", arguments=TIME[:4], unit="mm"),
    "text called dat": File(table("t u y\n", " "), name="a.dat"),
    "text of an unknown name": File(table("t\tu\ty\n", "\t"), name="a.asc"),
    "gap": File("t,u,y\n" + rows(lambda k: row(k if k < 30 else k + 10), 50), missing=tuple(range(30, 40)),
                says=("10 rows are missing on the grid of column t",)),
    "two gaps": File(
        "t,u,y\n" + "".join(f"{row(k)}\n" for k in range(SAMPLES) if k not in (7, 30, 31)), missing=(7, 30, 31)
    ),
    "gap in time stamps": File(
        "time,u,y\n" + "".join(f"12:00:00.{k:02d},{U[k]:g},{Y[k]}\n" for k in range(SAMPLES) if k != 9), missing=(9,),
        arguments=TIME,
    ),
    **{f"mark {mark}": File(with_mark(mark), missing=(20, 21)) for mark in MARKS},
}  # fmt: skip


@pytest.mark.parametrize("habit", READ)
def test_file_is_read(habit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = READ[habit]
    path, out = tmp_path / file.name, tmp_path / "out.npz"
    path.write_bytes(file.content if isinstance(file.content, bytes) else file.content.encode())
    assert main(["import", str(path), *file.arguments, "--out", str(out)]) == 0, capsys.readouterr().err
    told = capsys.readouterr().out
    check(Run.load(out), file)
    assert all(each in told for each in file.says), told


def check(run: Run, file: File) -> None:
    """The samples, the missing ones, the period and the unit are those of the file."""
    assert run.conditions.sample_period_s == pytest.approx(file.period_s, rel=1e-6)
    assert tuple(np.flatnonzero(run.missing)) == file.missing
    assert run.samples == SAMPLES
    for at, (name, expected) in enumerate(zip(run.conditions.program.measured, (U, Y), strict=True)):
        channel = run.conditions.channels[name]
        values = (channel.low_v + run.codes[:, at] * channel.lsb_v)[~run.missing]
        assert np.abs(values - expected[~run.missing]).max() <= channel.lsb_v
    assert run.conditions.channels[run.conditions.program.measured[1]].unit == file.unit


def mat(**variables: Any) -> Callable[[Path], None]:
    from scipy.io import savemat

    return lambda path: savemat(path, variables)


def hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in (("t", np.arange(SAMPLES) * PERIOD_S), ("u", U), ("y", Y)):
            file[f"d/{name}"] = values[None, :]


def array_of_structs() -> Any:
    signals = np.zeros((1, 2), dtype=[("values", object)])
    signals[0, 0]["values"], signals[0, 1]["values"] = U[:, None], Y[:, None]
    return {"time": np.arange(SAMPLES) * PERIOD_S, "signals": signals}


def npy(path: Path) -> None:
    table = np.zeros(SAMPLES, [("t", "f8"), ("u", "f8"), ("y", "f8")])
    table["t"], table["u"], table["y"] = np.arange(SAMPLES) * PERIOD_S, U, Y
    np.save(path, table)


def renamed(suffix: str, write: Callable[[Path], None]) -> Callable[[Path], None]:
    def made(path: Path) -> None:
        write(path.with_suffix(suffix))
        path.with_suffix(suffix).rename(path)

    return made


NAMES = {"d": ("d.t", "d.u", "d.y"), "s": ("s.time", "s.signals[0].values", "s.signals[1].values")}
BINARY: Mapping[str, tuple[str, Callable[[Path], None], tuple[str, ...]]] = {
    "struct": ("a.mat", mat(d={"t": np.arange(SAMPLES) * PERIOD_S, "u": U, "y": Y}), NAMES["d"]),
    "structs of Simulink": ("a.mat", mat(s=array_of_structs()), NAMES["s"]),
    "structs counted from 1": (
        "a.mat", mat(s=array_of_structs()), ("s.time", "s.signals(1).values", "s.signals(2).values"),
    ),
    "index behind the path": (
        "a.mat", mat(s=array_of_structs()), ("s.time", "s.signals.values[0]", "s.signals.values[1]"),
    ),
    "struct of version 7.3": ("a.mat", hdf5, NAMES["d"]),
    "MATLAB called dat": ("a.dat", renamed(".mat", mat(t=np.arange(SAMPLES) * PERIOD_S, u=U, y=Y)), ("t", "u", "y")),
    "NumPy called dat": ("a.dat", renamed(".npy", npy), ("t", "u", "y")),
    "HDF5 called h5": ("a.h5", hdf5, NAMES["d"]),
}  # fmt: skip


@pytest.mark.parametrize("habit", BINARY)
def test_binary_file_is_read(habit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name, write, (time, u, y) = BINARY[habit]
    write(tmp_path / name)
    named = ["--time", time, "--input", u, "--output", y]
    assert main(["import", str(tmp_path / name), *named, "--out", str(tmp_path / "out.npz")]) == 0, (
        capsys.readouterr().err
    )
    check(Run.load(tmp_path / "out.npz"), File(""))


def wav(riff: int | None = None, data: int | None = None, extra: bytes = b"") -> bytes:
    """Two channels of floats at 100 Hz; sizes as stated, or the right ones."""
    samples = np.stack([U, Y], axis=1).astype("<f4").tobytes()
    layout = b"fmt " + struct.pack("<IHHIIHH", 16, 3, 2, 100, 800, 8, 32)
    body = b"WAVE" + layout + extra + b"data" + struct.pack("<I", len(samples) if data is None else data) + samples
    return b"RIFF" + struct.pack("<I", len(body) if riff is None else riff) + body


LIST = b"LIST" + struct.pack("<I", 26) + b"INFOISFT\x0e\x00\x00\x00Lavf59.27.100\x00"
WAVES = {
    "whole": wav(),
    "ffmpeg to a pipe": wav(0xFFFFFFFF, 0xFFFFFFFF),
    "ffmpeg to a pipe, with its name": wav(0xFFFFFFFF, 0xFFFFFFFF, LIST),
    "sox to a pipe": wav(0x7FFFF024, 0x7FFFF000),
    "arecord to a pipe": wav(0x80000024, 0x80000000),
    "arecord of 2 GiB": wav(0x7FFFFFFF, 0x7FFFFFDB),
    "GStreamer to a pipe": wav(0, 0),
    "size of RIFF unknown alone": wav(0xFFFFFFFF),
    "size of data unknown alone": wav(None, 0xFFFFFFFF),
    "writer that was killed": wav(0, 0, LIST),
}


@pytest.mark.parametrize("writer", WAVES)
def test_sound_of_unknown_length_is_read_to_its_end(writer: str, tmp_path: Path) -> None:
    (tmp_path / "a.wav").write_bytes(WAVES[writer])
    named = ["--input", "0", "--output", "1", "--out", str(tmp_path / "out.npz")]
    assert main(["import", str(tmp_path / "a.wav"), *named]) == 0
    check(Run.load(tmp_path / "out.npz"), File(""))


REFUSED: Mapping[str, tuple[str, File]] = {
    "cut sound": ("is cut off", File(wav()[:-100], "a.wav", ("--input", "0", "--output", "1"))),
    "TDMS": ('TdmsFile.read("a.tdms").as_dataframe().to_csv("a.csv")', File(b"TDSm" + bytes(60), "a.tdms")),
    "old workbook": ("export its table as CSV", File(b"\xd0\xcf\x11\xe0" + bytes(60), "a.xls")),
    "constant columns": (
        "columns u and y are constant, which is no data: record the plant in motion",
        File("t,u,y\n" + rows(lambda k: f"{k * PERIOD_S:.2f},1,2")),
    ),
    "constant columns beside others": (
        "which is no data: name others: there are v",
        File("t,u,y,v\n" + rows(lambda k: f"{k * PERIOD_S:.2f},1,2,{k}")),
    ),
    "unknown words below the names": ("perhaps units", File(table("t,u,y\nfoo,qux,baz\n"))),
    "time that is none": (
        "must be a time, not in mm: pass --time-unit, or --rate HZ", File(table("t,u,y\nmm,V,mm\n")),
    ),
    "unit that is no time": (
        "time_unit must be a unit of time, such as ms, not 'mm'",
        File(table(), arguments=(*TIME[:4], "--time", "t", "--time-unit", "mm")),
    ),
    "uneven instants": (
        "sample periods off an even grid: resample the data, or pass --rate HZ",
        File("t,u,y\n" + rows(lambda k: f"{k * PERIOD_S + 0.003 * (k % 3):.3f},{U[k]},{Y[k]}")),
    ),
    "instants that fall": (
        "row 5 is no later than the one before", File("t,u,y\n" + rows(lambda k: row(k if k != 5 else 2))),
    ),
    "month or day": (
        "02.03.2024 after 01.03.2024: write dates as YYYY-MM-DD",
        File(stamped(lambda k: f"{1 + k // 40:02d}.03.2024 12:00:00.{k:02d}"), arguments=TIME),
    ),
    "date apart from its time": (
        "dates apart from their times by a space need another separator",
        File("time u y\n" + rows(lambda k: f"2024-03-01 12:00:00.{k:02d} {U[k]} {Y[k]}"), arguments=TIME),
    ),
    "column of marks": ("holds no number", File("t,u,y\n" + rows(lambda k: f"{k * PERIOD_S:.2f},{U[k]},OVER"))),
}  # fmt: skip


@pytest.mark.parametrize("habit", REFUSED)
def test_file_is_refused_in_one_line_with_a_cure(habit: str, tmp_path: Path) -> None:
    says, file = REFUSED[habit]
    (tmp_path / file.name).write_bytes(file.content if isinstance(file.content, bytes) else file.content.encode())
    told = error_of("import", str(tmp_path / file.name), *file.arguments, "--out", str(tmp_path / "out.npz"))
    assert says in told and told.count("\n") == 1, told
