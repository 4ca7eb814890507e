"""Commands in this process: starting a process and importing everything takes most of a second."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any, NamedTuple

from analogrig.cli import main


class Ended(NamedTuple):
    """Status and output of a command, as of a process."""

    status: int
    out: str
    err: str


def called(*arguments: str | Path, cwd: Path | None = None) -> Ended:
    """Run ``analogrig`` with these arguments."""
    with (
        contextlib.chdir(cwd or Path()),
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        try:
            status: Any = main(list(map(str, arguments)))
        except SystemExit as ended:
            status = ended.code
    return Ended(status, out.getvalue(), err.getvalue())


def output_of(*arguments: str | Path, status: int = 0) -> str:
    """Standard output of a command that ends with ``status``."""
    ended = called(*arguments)
    assert ended.status == status, ended.err
    return ended.out


def error_of(*arguments: str | Path, status: int = 2) -> str:
    """Error message of a command that ends with ``status``."""
    ended = called(*arguments)
    assert ended.status == status, ended.out + ended.err
    return ended.err
