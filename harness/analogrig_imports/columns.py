"""Columns of numbers in files of other tools, read by a process of its own (column_reader.py)."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig import RecordingError

MOST_S = 600.0
"""Longest time of the process that reads a file."""


@dataclass(frozen=True, eq=False)
class ColumnFile:
    """Names of all columns of a file, those that were read, (n,) float64 each, and the sample rate if it states one."""

    names: tuple[str, ...]
    columns: Mapping[str, NDArray[np.float64]]
    rate_hz: float | None
    blank_lines: int
    """Blank lines between rows of text, which are skipped."""
    units: Mapping[str, str]
    """Units that the file states beside the names of the wanted columns."""
    channels: tuple[str, ...]
    """Names in the array ``channels`` of an archive, as ``analogrig emulate`` writes it."""


def read_columns(path: Path, wanted: Sequence[str] = (), skip_lines: int = 0) -> ColumnFile:
    """Read columns of text, or of a NumPy, MATLAB, MF4, Parquet or WAV file, by its first bytes or its suffix.

    :param skip_lines: lines of text before the header or the first row.
    :raises RecordingError: the file or a column cannot be read.
    """
    if not path.is_file():
        raise RecordingError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    with tempfile.TemporaryDirectory(prefix="analogrig-") as folder:
        out = Path(folder) / "columns.npz"
        request = {"file": str(path.absolute()), "wanted": list(wanted), "skip_lines": skip_lines, "out": str(out)}
        answer = _ask(path, json.dumps(request))
        if "error" in answer:
            raise RecordingError(f"{path}: {answer['error']}")
        columns = {}
        if wanted:
            with np.load(out, allow_pickle=False) as file:
                columns = {name: file[str(i)] for i, name in enumerate(wanted)}
    told = {name: answer[name] for name in ("rate_hz", "blank_lines", "units")}
    return ColumnFile(tuple(answer["names"]), columns, **told, channels=tuple(answer["channels"]))


def _ask(path: Path, request: str) -> dict[str, Any]:
    """Answer of the reader.

    :raises RecordingError: it crashed, or took too long.
    """
    # Modules of the current folder are as little trusted as the file, which often lies beside them.
    paths = [each for each in sys.path if each not in ("", str(Path.cwd()))]
    settings = {"OPENBLAS_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::", "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-P", "-m", "analogrig_imports.column_reader", request]
    try:
        reader = subprocess.run(
            command,
            env=os.environ | settings,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=MOST_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise RecordingError(f"{path}: reading it took longer than {MOST_S:g} s") from None
    try:
        answer: dict[str, Any] = json.loads(reader.stdout)
    except ValueError:
        status = reader.returncode
        why = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        said = reader.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2]
        last = f" ({said[:200]})" if said else ""
        raise RecordingError(f"{path}: its reader {why}{last}: the file is damaged, or too large") from None
    return answer
