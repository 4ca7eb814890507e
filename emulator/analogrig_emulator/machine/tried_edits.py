"""Advice on program files: an edit of the file that was followed, compiled and played before it is given.

An error of the compiler carries edits that may cure it. Where an edited file fails with further edits, these are
joined: the advice is followed in one go.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.circuit.components import COMPONENTS
from analogrig_emulator.circuit.nonlinear import MULTIPLIERS
from analogrig_emulator.exceptions import Edit, EmulatorError, ProgramError, UnfitError
from analogrig_emulator.machine.compiler import compile_equations
from analogrig_emulator.machine.patched_program import PatchedProgram
from analogrig_emulator.machine.program_circuit import ProgramCircuit
from analogrig_emulator.machine.program_file import read_equations
from analogrig_emulator.machine.suspension import PROGRAMS, SuspensionComputer

_MOST_TRIALS = 40
_DEEPEST = 8
_MOST_UNFIT = 3
_SAMPLES = 1500
"""Samples of a trial on the machine: those of a run without a scenario."""

_MOST_V = 12.0
_WARM_C = 40.0


@contextlib.contextmanager
def advising(table: Mapping[str, Any]) -> Iterator[None]:
    """Give an error of the block the first of its edits that plays, in words; none: it keeps its cure in words."""
    try:
        yield
    except ProgramError as error:
        if not error.edits:
            raise
        edit = played_edit(table, error.edits)
        raise error.advised(error.otherwise if edit is None else text_of(edit)) from error


def played_edit(table: Mapping[str, Any], edits: Sequence[Edit]) -> Edit | None:
    """First edit, or union of edits, with which a file plays."""
    queue: list[tuple[Edit, ...]] = [(edit,) for edit in edits]
    seen: set[str] = set()
    unfit = 0
    for _ in range(_MOST_TRIALS):
        if not queue:
            return None
        tried = queue.pop(0)
        joined = _joined(tried)
        if repr(joined) in seen:
            continue
        seen.add(repr(joined))
        try:
            check_edit(table, joined)
        except UnfitError:
            unfit += 1
            if unfit == _MOST_UNFIT:
                return None
        except ProgramError as error:
            if len(tried) < _DEEPEST:
                queue[:0] = [(*tried, edit) for edit in error.edits]
        except EmulatorError:
            continue
        else:
            return joined
    return None


def _joined(edits: tuple[Edit, ...]) -> Edit:
    """One edit for several; the last value of a place holds, swaps of equations add up."""
    joined: dict[tuple[str, ...], Any] = {}
    for place, value in itertools.chain.from_iterable(edit.items() for edit in edits):
        if place == ("equations",):
            joined[place] = {**joined.get(place, {}), **value}
        else:
            joined[place] = value
    return joined


def edited(table: Mapping[str, Any], edit: Edit) -> dict[str, Any]:
    """Tables of a file with an edit."""
    new = copy.deepcopy(dict(table))
    for (*path, key), value in edit.items():
        row = new
        for name in path:
            row = row.setdefault(name, {})
        if key == "equations" and not path:
            row[key] = _rewritten(row[key], value)
        elif value is None:
            row.pop(key, None)
        else:
            row[key] = value
    return new


def _rewritten(text: str, swaps: Mapping[str, str]) -> str:
    """Equations with parts replaced."""
    for old, new in swaps.items():
        loose = r"\s*".join(map(re.escape, re.findall(r"\w+|\W", old)))
        end = r"\b" if re.search(r"\w$", old) else ""
        text = re.sub(rf"\b{loose}{end}", new.replace("\\", r"\\"), text)
    return text


def check_edit(table: Mapping[str, Any], edit: Edit) -> None:
    """Raise EmulatorError unless the edited file compiles, and plays without overload.

    It plays on nominal and on real parts, under the square wave of a run and that of its trial play.
    """
    program = compile_equations(read_equations(edited(table, edit)))
    check_tables(program, [place[1] for place in edit if place[0] == "functions"])
    check_plays(PROGRAMS.get(program.equations.diagram, program), program)


def check_tables(program: PatchedProgram, tables: Sequence[str]) -> None:
    """Raise ProgramError for one of these tables of points if the trial play leaves it."""
    for stage in (each.stage for each in program.patch if each.stage.function in tables):
        reach = program.reach[stage.cords[0].source]
        (first, _), *_, (last, _) = program.equations.functions[stage.function].points
        if reach.low < first or reach.high > last:
            raise ProgramError(f"{stage.name}: its points do not suit the argument")


def check_plays(circuit: ProgramCircuit, program: PatchedProgram) -> None:
    """Raise EmulatorError for a play that overloads an amplifier."""
    equations = program.equations
    name, quantity = next(iter(equations.inputs.items()))
    low_v, high_v = (level * program.scales.volts(name) for level in quantity.trial)
    own_hz = equations.speed / equations.period_s
    real = replace(COMPONENTS["polypropylene"], seed=1, temperature_c=_WARM_C)
    for is_real in (False, True):
        for hertz in dict.fromkeys((Excitation().frequency_hz, min(own_hz, 5000.0))):
            computer = (
                SuspensionComputer(circuit, components=real, multiplier=MULTIPLIERS["ad633"])
                if is_real
                else SuspensionComputer(circuit)
            )
            excitation = Excitation(low_v=low_v, high_v=high_v, frequency_hz=hertz)
            peak_v = max(float(np.abs(volts).max()) for volts in computer.play(excitation, _SAMPLES))
            lit = [amp for amp, sample in computer.machine.lamps.items() if sample is not None]
            if lit or peak_v > _MOST_V:
                raise ProgramError(f"overload of {', '.join(lit) or 'a channel'}")


def text_of(edit: Edit) -> str:
    """Edit in words."""
    if list(edit) == [("equations",)]:
        names = [name.rstrip("(") for name in edit["equations",].values()]
        if len(names) == 1 and names[0].isidentifier():
            return f"did you mean {names[0]!r}?"
    parts = []
    for place, value in edit.items():
        if place == ("equations",):
            parts += [f"write {new.rstrip('(')} for {old.rstrip('(')}" for old, new in value.items()]
        elif value is None:
            parts.append(f"leave out {'.'.join(place)}")
        else:
            parts.append(f"write {'.'.join(place)} = {_toml(value)}")
    return ", ".join(parts)


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        inner = ", ".join(f"{key} = {_toml(each)}" for key, each in value.items())
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return f"{value:g}"
