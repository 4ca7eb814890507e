"""``analogrig calibrate`` of a program: it becomes the twin of measured data, or of a rig that plays it."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from analogrig.cli import FAILED, PASSED, show, show_result, show_work

if TYPE_CHECKING:
    from analogrig import Program, Run
    from analogrig_instruments.calibration.recorded_plant import (
        FittedParameter,
        ProgramTwin,
        Reconstruction,
        RecordedPlant,
        Residual,
        Span,
    )


_MOST_OF_OUTPUT = 0.5
"""Largest rms difference of a twin to keep by default, in the rms of the fitted output about its mean."""
_MOST_UNEXPLAINED = 0.12
"""The same where the difference is not noise: the plant changed, or the program does not describe it."""


def fit_recording(arguments: argparse.Namespace) -> int:
    """Fit a program to a recording, and keep it as a program file with the fitted values."""
    from analogrig import ConfigurationError, Program, Run
    from analogrig.config import locate
    from analogrig.output import move_aside

    file = locate("programs", arguments.program)
    move_aside(arguments.out, (file, arguments.recording))
    run = Run.load(arguments.recording)
    plant = _plant(Program.load(str(file)), run, arguments)
    span = plant.span(*_span(arguments, "span", run.samples), _settling_n(arguments))
    if not arguments.check:
        return _fit(arguments, file, plant, span, None)
    check = plant.span(*_span(arguments, "check", run.samples), _settling_n(arguments), is_led_in=True)
    shared = max(span.first, check.first), min(span.end, check.end)
    if shared[0] < shared[1]:
        raise ConfigurationError(
            f"--check {check.first}:{check.end}: samples {shared[0]} to {shared[1] - 1} are fitted, too: end --span or"
            " begin --check elsewhere"
        )
    return _fit(arguments, file, plant, span, (plant, check))


def fit_rig(arguments: argparse.Namespace) -> int:
    """Fit a program to two recordings of a rig, of which one is only compared, and keep it likewise."""
    from analogrig import Program, open_rig
    from analogrig.cli import files_read, trust_of
    from analogrig.config import locate
    from analogrig.output import move_aside
    from analogrig_instruments.calibration.averages import record_program

    file = locate("programs", arguments.program)
    program = Program.load(str(file))
    move_aside(arguments.out, (file, *files_read(arguments)))
    with open_rig(arguments.rig, allow=trust_of(arguments)) as rig, show_work("recording"):
        fitted, check = (
            _plant(program, record_program(rig, program, part, arguments.seed), arguments) for part in range(2)
        )
    span, check_span = (each.span(0, each.run.samples, _settling_n(arguments)) for each in (fitted, check))
    return _fit(arguments, file, fitted, span, (check, check_span), "held")


def _plant(program: Program, run: Run, arguments: argparse.Namespace) -> RecordedPlant:
    from analogrig import ConfigurationError
    from analogrig.rigs import ComputerDescription, emulator_errors
    from analogrig_emulator import compile_program
    from analogrig_instruments.calibration.recorded_plant import RecordedPlant

    if arguments.pots is not None:
        raise ConfigurationError("--pots is for a rig with front or shock: the pots of this twin are continuous")
    computer = ComputerDescription(op_amp=arguments.op_amp, components=arguments.components or "nominal")
    with emulator_errors(f"program {program.name}: "):
        patch = compile_program(program.equations)
    return RecordedPlant(patch, run, computer, arguments.seed)


def _settling_n(arguments: argparse.Namespace) -> int:
    from analogrig_instruments.calibration.recorded_plant import SETTLING_N

    return SETTLING_N if arguments.settle is None else int(arguments.settle)


def _fit(
    arguments: argparse.Namespace,
    file: Path,
    plant: RecordedPlant,
    span: Span,
    check: tuple[RecordedPlant, Span] | None,
    reconstruction: Reconstruction | None = None,
) -> int:
    """Fit a program to a span, and keep it unless it differs too much from the samples that are only compared.

    :param reconstruction: default course of the input between its samples; None: the one that fits better.
    """
    from analogrig.output import replace_file
    from analogrig_instruments.calibration.recorded_plant import fit_program

    fixed = dict(_fixed(text, plant.program.values) for text in arguments.fix)
    chosen = arguments.reconstruction or reconstruction
    with show_work("fitting") as tell:
        twin = fit_program(plant, span, lambda plays: tell(f"{plays} plays"), reconstruction=chosen, fixed=fixed)
        checked = check and check[0].difference(twin.values, check[1], twin.reconstruction)
    unit = plant.output_unit
    if arguments.most_rms is None:
        most = _MOST_OF_OUTPUT if twin.fit.is_noise or not twin.fit.is_settled else _MOST_UNEXPLAINED
        judged, most_rms = twin.fit, most * twin.output_rms
    else:
        judged, most_rms = checked or twin.fit, arguments.most_rms
    is_twin = judged.rms <= most_rms
    lines = [
        *(_parameter_line(each) for each in twin.estimates),
        f"samples {span.first} to {span.end - 1}, fitted: {_words(twin.fit, unit)}",
    ]
    if check and checked:
        lines.append(f"samples {check[1].first} to {check[1].end - 1}, not fitted: {_words(checked, unit)}")
    caveats = [*_caveats(twin), *_check_lines(twin.fit, checked, _settling_n(arguments))]
    lines += [_reconstruction_line(twin, unit), *caveats, *_diagram_lines(plant, arguments.out)]
    if is_twin:
        with replace_file(arguments.out) as out:
            out.write(_program_toml(file, twin.values, lines, arguments).encode("utf-8"))
    if arguments.json:
        table = {"program": str(file), "unit": unit, "plays": twin.plays}
        recording, rig = (str(arguments.recording), None) if arguments.recording else (None, arguments.rig)
        table |= {"recording": recording, "rig": rig}
        table |= {"parameters": [vars(each) for each in twin.estimates], "fit": vars(twin.fit)}
        table |= {"reconstruction": twin.reconstruction, "other_rms": twin.other_rms}
        table |= {"other_is_fitted": twin.other_is_fitted, "output_rms": twin.output_rms, "caveats": caveats}
        table |= {"may_jump_between_samples": twin.may_jump_between_samples}
        table |= {"unseen": twin.unseen, "inseparable": twin.inseparable, "surplus": twin.surplus}
        table |= {"check": checked and vars(checked), "file": str(arguments.out) if is_twin else None}
        show_result(table, arguments)
    else:
        unkept = f"no twin: more than {most_rms:.4g} {unit}; nothing kept"
        show("\n".join([*lines, f"kept as {arguments.out}" if is_twin else unkept]))
    return PASSED if is_twin else FAILED


def _parameter_line(each: FittedParameter) -> str:
    if each.standard_error is None:
        return f"{each.name:12} {each.value:12.6g} {'not determined':23} {each.place}"
    return f"{each.name:12} {each.value:12.6g} +- {each.standard_error:9.3g} {each.unit:10} {each.place}"


def _reconstruction_line(twin: ProgramTwin, unit: str) -> str:
    from analogrig_instruments.calibration.recorded_plant import RECONSTRUCTIONS

    line = f"input between the samples: {twin.reconstruction}"
    if twin.other_rms is None:
        return line
    (other,) = (each for each in RECONSTRUCTIONS if each != twin.reconstruction)
    about = "within" if twin.other_is_fitted else "about"
    return f"{line} ({other}: {about} {twin.other_rms:.4g} {unit} rms)"


def _caveats(twin: ProgramTwin) -> list[str]:
    """Reasons to doubt the values, with their cures, one line each."""
    lines = []
    if twin.fit.rms > _MOST_OF_OUTPUT * twin.output_rms:
        lines.append(
            f"caveat: the machine differs by more than half of what the output moves ({twin.output_rms:.4g} rms): check"
            " program, columns, units and sample rate"
        )
    elif twin.may_jump_between_samples:
        lines.append(
            "caveat: the input jumps, and neither course of it fits much better: its edges may lie between the samples;"
            " record faster, or on the generator's clock"
        )
    elif twin.fit.is_settled and not twin.fit.is_noise:
        lines.append(
            f"caveat: the residual is {twin.fit.rms / twin.fit.noise:.0f} times the noise of the output: the plant"
            " changed, was not at rest where the span begins, or the program does not describe it; the standard errors"
            " do not hold"
        )
    if twin.unseen:
        names = ", ".join(twin.unseen)
        lines.append(f"caveat: {names}: hardly act on the output here; use another excitation, or pass --fix NAME")
    if twin.inseparable:
        names = ", ".join(twin.inseparable)
        lines.append(
            f"caveat: {names}: act alike on the output; pass --fix NAME=VALUE for {twin.surplus} of them, or use"
            " another excitation or output"
        )
    return lines


def _diagram_lines(plant: RecordedPlant, out: Path) -> list[str]:
    diagram = plant.program.equations.diagram
    if not diagram:
        return []
    return [f"note: fitted with the patch of the equations; a run of {out} plays the diagram {diagram}"]


def _check_lines(fit: Residual, checked: Residual | None, settling_n: int) -> list[str]:
    """Reasons to doubt the state in which a span begins, or that the values hold beyond the fitted one."""
    for what, each in (("fitted", fit), ("other", checked)):
        if each is not None and not each.is_settled:
            line = (
                f"caveat: the first tenth of the {what} samples differs {each.beginning:.2g} times as much as the rest:"
                f" the recording did not begin at rest; pass a --settle above {settling_n}"
            )
            return [line]
    if checked is not None and (beyond := checked.beyond(fit)):
        line = (
            f"caveat: samples that were not fitted differ {beyond:.2g} times as much as the fitted ones:"
            " the twin holds for those alone; fit a longer span, or another excitation"
        )
        return [line]
    return []


def _fixed(text: str, values: Mapping[str, float]) -> tuple[str, float]:
    """Name and value of an option NAME=VALUE; without a value that of the program."""
    from analogrig import ConfigurationError

    name, equals, value = text.partition("=")
    try:
        return name, float(value) if equals else values.get(name, 0.0)
    except ValueError:
        raise ConfigurationError(f"--fix {text[:60]}: {value[:40]!r} is no number") from None


def _words(difference: Residual, unit: str) -> str:
    return f"within {difference.rms:.4g} {unit} rms, largest {difference.largest:.4g}"


def _span(arguments: argparse.Namespace, option: str, samples: int) -> tuple[int, int]:
    from analogrig import ConfigurationError
    from analogrig_instruments.calibration.recorded_plant import span_of

    text = getattr(arguments, option)
    try:
        return span_of(text) if text is not None else (0, samples)
    except ValueError as error:
        raise ConfigurationError(f"--{option}: {error}") from error


def _program_toml(file: Path, values: Mapping[str, float], lines: Sequence[str], arguments: argparse.Namespace) -> str:
    """The program file with fitted values, and their origin as comments."""
    from analogrig.config import read_toml, to_toml
    from analogrig.identity import Identity
    from analogrig.reporting import provenance

    table = read_toml(file)
    for name, value in values.items():
        table["parameters"][name]["value"] = value
    made_by = provenance(Identity.here(arguments.command_line, arguments.started))
    heading = [
        f"Program {arguments.program} as fitted to {arguments.recording or f'the rig {arguments.rig!r}'}.",
        *lines,
        *(f"{name}: {' '.join(value.split())}" for name, value in made_by),
    ]
    return "".join(f"# {line}\n" for line in heading) + "\n" + to_toml(table)
