"""``analogrig calibrate --recording``: a program becomes the twin of measured data."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from analogrig.cli.terminal import FAILED, PASSED, show, show_result, show_work

if TYPE_CHECKING:
    from analogrig.hardware.calibration.recorded import FittedParameter, Residual


def fit_recording(arguments: argparse.Namespace) -> int:
    """Fit a program to a recording, and keep it as a program file with the fitted values."""
    from analogrig.config import locate
    from analogrig.errors import ConfigurationError
    from analogrig.hardware.calibration.recorded import SETTLING_N, RecordedPlant, fit_program
    from analogrig.output import move_aside
    from analogrig.rigs.emulator import ComputerDescription
    from analogrig.run import Run
    from analogrig.storage import replace_file
    from analogrig_emulator import load_program

    if arguments.pots is not None:
        raise ConfigurationError("--pots is for --rig: the pots of a twin of a recording are continuous")
    file = locate("programs", arguments.program)
    move_aside(arguments.out, (file, arguments.recording))
    run = Run.load(arguments.recording)
    computer = ComputerDescription(op_amp=arguments.op_amp, components=arguments.components or "nominal")
    plant = RecordedPlant(load_program(file), run, computer, arguments.seed)
    settling_n = SETTLING_N if arguments.settle is None else arguments.settle
    span = plant.span(*_span(arguments, "span", run.samples), settling_n)
    check = plant.span(*_span(arguments, "check", run.samples), settling_n) if arguments.check else None
    with show_work("fitting"):
        twin = fit_program(plant, span)
        checked = plant.difference(twin.values, check) if check else None
    unit = run.conditions.channels["displacement"].unit
    is_twin = arguments.most_rms is None or (checked or twin.fit).rms <= arguments.most_rms
    lines = [
        *(_parameter_line(each) for each in twin.estimates),
        f"samples {span.first} to {span.end - 1}, fitted: {_words(twin.fit, unit)}",
    ]
    if check and checked:
        lines.append(f"samples {check.first} to {check.end - 1}, not fitted: {_words(checked, unit)}")
    if is_twin:
        with replace_file(arguments.out) as out:
            out.write(_program_toml(file, twin.values, lines, arguments).encode("utf-8"))
    if arguments.json:
        table = {"program": str(file), "recording": str(arguments.recording), "unit": unit, "plays": twin.plays}
        table |= {"parameters": [vars(each) for each in twin.estimates], "fit": vars(twin.fit)}
        table |= {"check": checked and vars(checked), "file": str(arguments.out) if is_twin else None}
        show_result(table, arguments)
    else:
        unkept = f"no twin: more than {arguments.most_rms or 0.0:g} {unit}; nothing kept"
        show("\n".join([*lines, f"kept as {arguments.out}" if is_twin else unkept]))
    return PASSED if is_twin else FAILED


def _parameter_line(each: FittedParameter) -> str:
    return f"{each.name:12} {each.value:12.6g} +- {each.standard_error:9.3g} {each.unit:10} {each.place}"


def _words(difference: Residual, unit: str) -> str:
    return f"within {difference.rms:.4g} {unit} rms, largest {difference.largest:.4g}"


def _span(arguments: argparse.Namespace, option: str, samples: int) -> tuple[int, int]:
    from analogrig.errors import ConfigurationError
    from analogrig.hardware.calibration.recorded import span_of

    text = getattr(arguments, option)
    try:
        return span_of(text) if text is not None else (0, samples)
    except ValueError as error:
        raise ConfigurationError(f"--{option}: {error}") from error


def _program_toml(file: Path, values: Mapping[str, float], lines: Sequence[str], arguments: argparse.Namespace) -> str:
    """The program file with fitted values, and their origin as comments."""
    from analogrig.config import read_toml, to_toml
    from analogrig.identity import Identity
    from analogrig.reporting.tables import provenance

    table = read_toml(file)
    for name, value in values.items():
        table["parameters"][name]["value"] = value
    made_by = provenance(Identity.here(arguments.command_line, arguments.started))
    heading = [
        f"Program {arguments.program} as fitted to {arguments.recording}.",
        *lines,
        *(f"{name}: {' '.join(value.split())}" for name, value in made_by),
    ]
    return "".join(f"# {line}\n" for line in heading) + "\n" + to_toml(table)
