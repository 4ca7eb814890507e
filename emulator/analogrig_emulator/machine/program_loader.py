"""Program files on their way to a patch: read, compiled, and their errors given advice that was tried.

The layers below name edits that may cure an error. Here each is tried before an error carries it, in words.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from analogrig_emulator.exceptions import ProgramError
from analogrig_emulator.machine.compiler import compile_equations
from analogrig_emulator.machine.formula import suggestion
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.program_circuit import ProgramCircuit
from analogrig_emulator.machine.program_file import Equations, read_equations
from analogrig_emulator.machine.suspension import PROGRAMS
from analogrig_emulator.machine.tried_edits import advising

_MOST_BYTES = 65536


def read_program(path: str | Path) -> Equations:
    """Program of a file. Raises ProgramError that names the file, the place and the cure."""
    if Path(path).exists() and not Path(path).is_file():
        raise ProgramError(f"{path}: cannot be read: it is no regular file")
    try:
        with Path(path).open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except OSError as cause:
        raise ProgramError(f"{path}: cannot be read: {cause.strerror or cause}") from cause
    return parse_program(data, str(path))


def parse_program(data: bytes | str, where: str) -> Equations:
    """Program of a file's content; where: its name in error messages. Raises ProgramError like read_program()."""
    data = data.encode() if isinstance(data, str) else data
    try:
        return _parsed(data)
    except ProgramError as cause:
        raise ProgramError(f"{where}: {cause}") from cause


@functools.lru_cache(maxsize=32)
def _parsed(data: bytes) -> Equations:
    if len(data) > _MOST_BYTES:
        raise ProgramError(f"larger than {_MOST_BYTES} bytes")
    try:
        return equations_of(tomllib.loads(data.decode("utf-8-sig")))
    except UnicodeDecodeError as cause:
        raise ProgramError(f"is no UTF-8 text: byte {cause.start} does not fit; save it as UTF-8") from None
    except ValueError as cause:  # a TOMLDecodeError, or a number of too many digits
        raise ProgramError(f"is no TOML: {cause}") from None
    except RecursionError:
        raise ProgramError("is nested too deeply") from None


def equations_of(table: Mapping[str, Any]) -> Equations:
    """Program of a file's tables. Raises ProgramError that names the place and the cure."""
    with advising(table):
        return read_equations(table)


def circuit_of(equations: Equations) -> ProgramCircuit:
    """Circuit that solves the equations: that of the diagram that the file names, or else their patch.

    Raises ProgramError like compile_program(), and for an unknown diagram or one with other parameters and channels.
    """
    if not equations.diagram:
        return compile_program(equations)
    if equations.diagram not in PROGRAMS:
        raise ProgramError(f"diagram: unknown {equations.diagram[:40]!r}{suggestion(equations.diagram, PROGRAMS)}")
    program = PROGRAMS[equations.diagram]
    pots = [name for name, row in equations.parameters.items() if row.pot]
    if pots != list(program.values) or equations.channels != program.channels:
        raise ProgramError(
            f"diagram {equations.diagram}: it has the parameters {', '.join(program.values)} and the channels"
            f" {', '.join(program.channels)}; leave out diagram, or name these"
        )
    return program


def load_patch(path: str | Path) -> PatchedProgram:
    """Patch that solves the equations of a program file, also if the file names a diagram.

    Raises ProgramError that names the file, the place and the cure.
    """
    equations = read_program(path)
    try:
        return compile_program(equations)
    except ProgramError as cause:
        raise cause.at(str(path)) from cause


@functools.lru_cache(maxsize=32)
def compile_program(equations: Equations) -> PatchedProgram:
    """Patch that solves the equations.

    Raises ProgramError naming the term that cannot be patched, and what to change.
    """
    with advising(equations.table):
        return compile_equations(equations)
