"""``analogrig patch``: a program file as a patch of the analogue computer."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli import FILE, PASSED, add_command, add_json, show, show_plain, show_result

if TYPE_CHECKING:
    from analogrig import Program
    from analogrig.rigs import Performance
    from analogrig_emulator import PatchedProgram
    from analogrig_emulator.machine.that_sheet import ThatSheet

_SAMPLES = 800

_RUN_DECK = "; run it with: ngspice -b -r out.raw "

_CARD_RATE_HZ = 20_000.0
"""Sample rate of the usual rigs."""
_LEAST_SETTLING_N, _MOST_SETTLING_N = 10, 200
"""Samples in which a plant settles: the fewest and the most that need no note."""

_SETTLINGS_N = (100, 50, 150, 25, 190, 12)
"""Samples in which a plant should settle, in the order in which they are tried."""

_REAL_RIG, _DRAWS = "emulator-real", 6
"""Rig of real parts, and how many of its machines are tried."""


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "patch",
        "compile a program file, and print its scaling sheet",
        "patch dc-motor",
        "patch motor.toml --drawing build/motor.svg --netlist build/motor.cir",
        "patch front --machine that --drawing build/front.svg",
    )
    command.add_argument("program", metavar="PROGRAM", help="program file, or the name of a shipped one")
    command.add_argument(
        "--machine",
        choices=("own", "that"),
        default="own",
        help="own: scaling sheet of the equations' patch on the emulated computer; that: patch sheet for THE ANALOG"
        " THING (default: own)",
    )
    command.add_argument(
        "--drawing", type=Path, metavar=FILE, help="drawing of the patch on that machine, an .svg file"
    )
    command.add_argument(
        "--netlist", type=Path, metavar=FILE, help="SPICE deck of the own machine's patch, for ngspice"
    )
    command.add_argument(
        "--rig",
        default="emulator",
        metavar="RIG",
        help="emulated rig whose sample period and codes are printed (default: %(default)s)",
    )
    add_json(command)
    command.set_defaults(command=_patch)


def _patch(arguments: argparse.Namespace) -> int:
    from analogrig import Program
    from analogrig.config import locate
    from analogrig.output import move_aside, replace_file
    from analogrig.rigs import emulator_errors
    from analogrig_emulator import SuspensionComputer, compile_program
    from analogrig_emulator.machine.drawing import patch_drawing
    from analogrig_emulator.machine.sheet import dials, scaling_sheet
    from analogrig_emulator.machine.that_drawing import that_drawing

    _check_options(arguments)
    wanted = [path for path in (arguments.drawing, arguments.netlist) if path is not None]
    file = locate("programs", arguments.program)
    for path in wanted:
        move_aside(path, [file])
    loaded = Program.load(str(file))
    with emulator_errors(f"{file}: "):
        program = compile_program(loaded.equations)
        SuspensionComputer(loaded.circuit)  # refuses what a run would
    played, offset_v = _performance(loaded, arguments.rig)
    period_s = played.sample_period_s * played.time_scale
    that = _that_sheet(program) if arguments.machine == "that" else None
    texts = {}
    if arguments.drawing is not None:
        texts[arguments.drawing] = patch_drawing(program) if that is None else that_drawing(that)
    if arguments.netlist is not None:
        texts[arguments.netlist] = _deck(program)
    for path, text in texts.items():
        with replace_file(path) as out:
            out.write(text.encode())
    if arguments.json:
        full = {name: program.scales.full(name) for name in program.equations.quantities}
        channels = {name: vars(channel) for name, channel in played.channels.items()}
        sampled = {"sample_period_s": played.sample_period_s, "time_scale": played.time_scale, "channels": channels}
        sampled |= {"amplifier_offset_v": offset_v, "model": _model(loaded, period_s)}
        files: dict[str, Any] = {"files": [str(path) for path in wanted]}
        if that is not None:
            files |= {"speed": that.speed, "slow": that.slow, "cables": [vars(cable) for cable in that.cables]}
        show_result(
            {"program": program.name, "full": full, "dials": dials(program, program.values), **sampled, **files},
            arguments,
        )
    else:
        show_plain((scaling_sheet(program) if that is None else that.text()).rstrip("\n"))
        if that is None:
            show_plain("\n".join(_model_lines(loaded, period_s)))
            lines = (
                *_sample_lines(played, arguments.rig, offset_v),
                *_notes(loaded),
                *_input_notes(program),
                *_table_notes(program),
                *_track_notes(loaded),
                *_overload_notes(loaded),
            )
            for line in lines:
                show(line)
        for path in wanted:
            show(f"written: {path}{_RUN_DECK + str(path) if path == arguments.netlist else ''}")
    return PASSED


def _performance(program: Program, rig: str) -> tuple[Performance, float]:
    """Sample period and channels of a program on an emulated rig, and the largest offset of its amplifiers in V.

    :raises ConfigurationError: the rig is not emulated, or cannot play the program.
    """
    import dataclasses

    from analogrig import ConfigurationError, Scenario, open_rig
    from analogrig.rigs import is_emulated

    with open_rig(rig) as opened:
        if not is_emulated(opened):
            raise ConfigurationError(f"--rig {rig}: is not emulated; name an emulated rig, such as emulator")
        played = opened.perform(dataclasses.replace(Scenario.of_program(program), changes=()), 0)
        computer = opened.description()["computer"]
        measured = (computer["values"] or {}).get("offset_v", {}).values()
        return played, max(computer["offset_v"], *map(abs, measured), 0.0)


def _model(program: Program, period_s: float) -> dict[str, Any]:
    """Equations and parameters of a program; of a linear one also its state space, continuous and sampled."""
    import numpy as np

    equations = program.equations
    model: dict[str, Any] = {
        "equations": [line for line in map(str.strip, equations.table["equations"].splitlines()) if line],
        "parameters": {
            name: {"value": each.value, "unit": each.unit.text if each.unit else ""}
            for name, each in equations.parameters.items()
        },
        "states": list(equations.states),
    }
    if program.is_linear:
        from scipy.linalg import expm

        n = len(equations.states)
        (generator,) = program.generators([[equations.values[name] for name in program.parameters]])
        step = expm(np.vstack([generator[:n], np.zeros(n + 1)]) * period_s)
        matrices = {"A": generator[:n, :n], "B": generator[:n, n], "C": generator[n, :n]}
        matrices |= {"F": step[:n, :n], "G": step[:n, n]}
        model |= {name: each.tolist() for name, each in matrices.items()}
    return model


def _model_lines(program: Program, period_s: float) -> list[str]:
    """Equations, parameters and state space, as text."""
    model = _model(program, period_s)
    parameters = ", ".join(f"{name} = {each['value']:g} {each['unit']}" for name, each in model["parameters"].items())
    lines = ["", "Model, in units and seconds of the plant", *(f"  {line}" for line in model["equations"])]
    lines += [f"  with {parameters}"] if parameters else []
    if "F" in model:
        driven, output = program.channels[:2]
        states = f"x = ({', '.join(model['states'])}), u = {driven}, y = {output}"
        lines += [
            f"  {states}: x' = A x + B u, y = C x; x(k+1) = F x(k) + G u(k) every {period_s:g} s, u held",
            *(f"  {name} = {_matrix_text(model[name])}" for name in ("A", "B", "C", "F", "G")),
        ]
    return [*lines, ""]


def _matrix_text(rows: Any) -> str:
    """Matrix or vector as C writes it."""
    if isinstance(rows, list):
        return f"{{ {', '.join(map(_matrix_text, rows))} }}"
    return f"{rows:.9g}"


def _sample_lines(played: Performance, rig: str, offset_v: float) -> list[str]:
    """Sample period, codes and noise that a device gets, one line each."""
    period_s = played.sample_period_s
    lines = [
        f"samples of the rig {rig}: {period_s:.4g} s of the machine, {period_s * played.time_scale:.4g} s of the plant"
    ]
    for name, channel in played.channels.items():
        volts = f"{channel.low_v:g} V + code * {channel.lsb_v:.6g} V"
        lines.append(
            f"  {name}: {volts}, code 0 to {channel.codes - 1}; 1 V is {channel.unit_per_v:.6g} {channel.unit};"
            f" noise {channel.noise_lsb:g} LSB rms, before quantisation"
        )
    if offset_v:
        lines.append(
            f"  amplifiers have offsets of up to {1e3 * offset_v:g} mV, so y differs from a linear model by a constant:"
            " a filter estimates it as a state"
        )
    return lines


def _notes(program: Program) -> list[str]:
    """Reasons to choose another speed, which only a run would show: as failures of the device."""
    from analogrig_emulator.machine.tried_edits import played_edit, text_of

    period_s = 1.0 / _CARD_RATE_HZ
    if program.settling_s is None:
        return []
    settling_n = program.settling_s / (program.equations.speed * period_s)
    if _LEAST_SETTLING_N <= settling_n <= _MOST_SETTLING_N:
        return []
    note = f"note: the plant settles in {settling_n:.3g} samples of {1e6 * period_s:g} us"
    for wanted_n in _SETTLINGS_N:
        speed = float(f"{program.settling_s / (wanted_n * period_s):.2g}")
        edit = played_edit(program.equations.table, [{("speed",): speed}])
        if edit is not None and edit["speed",] == speed:
            return [f"{note}: {text_of(edit)} for {wanted_n}, unless excitation or rig suit it"]
    return [note]


def _input_notes(program: PatchedProgram) -> list[str]:
    """Inputs that move in the trial play alone."""
    driven, *others = program.equations.inputs
    names = " and ".join(others)
    return [f"note: {names}: moves in the trial play; a run holds it at 0 V and drives {driven}"] if others else []


def _table_notes(program: PatchedProgram) -> list[str]:
    """Tables of the file that the trial play leaves."""
    notes = []
    for stage in (each.stage for each in program.patch if each.stage.function):
        source, reach = stage.cords[0].source, program.reach[stage.cords[0].source]
        (first, _), *_, (last, _) = program.equations.functions[stage.function].points
        if reach.low < first or reach.high > last:
            notes.append(
                f"note: {stage.function}: {source} is {reach.low:.4g} to {reach.high:.4g} in the trial play, its points"
                f" are {first:g} to {last:g}: the outer pieces go on beyond them"
            )
    return notes


def _track_notes(program: Program) -> list[str]:
    """Values that turn pots to where only some draws of real parts reach."""
    from analogrig_emulator.machine.compiler import TRACK

    circuit, equations = program.circuit, program.equations
    notes = []
    for pot, row in circuit.pots.items():
        parameters = [equations.parameters[name] for name in row.settings if name in equations.parameters]
        ends = {
            f"{name} = {value:g}": {name: value}
            for name, each in zip(row.settings, parameters, strict=False)
            for value in (each.value, each.low, each.high)
        }
        for what, change in (ends or {"the program": {}}).items():
            coefficient = circuit.pot_coefficient(pot, {**equations.values, **change})
            if not TRACK[0] <= coefficient <= TRACK[1]:
                notes.append(
                    f"note: {what} turns pot {pot} to {coefficient:.4g} of its track, and every draw of real parts"
                    f" reaches {TRACK[0]:g} to {TRACK[1]:g}: emulator-real may refuse it"
                )
    return notes


def _overload_notes(program: Program) -> list[str]:
    """Draws of real parts that a run without a scenario overloads: errors of parts may drive products to infinity."""
    from analogrig import AnalogrigError, Scenario, open_rig

    if program.circuit.is_linear:
        return []
    scenario, seeds = Scenario.of_program(program), []
    with open_rig(_REAL_RIG) as rig:
        for seed in range(_DRAWS):
            with contextlib.suppress(AnalogrigError):  # a pot at the end of its track is noted by itself
                played = rig.perform(scenario, seed)
                for _ in played.blocks:
                    pass
                if played.hindsight().lamps:
                    seeds.append(seed)
    listed = ", ".join(map(str, seeds))
    return [f"note: a run on {_REAL_RIG} overloads {len(seeds)} of {_DRAWS} machines: seeds {listed}"] if seeds else []


def _check_options(arguments: argparse.Namespace) -> None:
    """:raises ConfigurationError: the options exclude each other, or name a wrong file."""
    from analogrig import ConfigurationError

    if arguments.drawing is not None and arguments.drawing.suffix != ".svg":
        raise ConfigurationError(f"{arguments.drawing}: the file's name must end with .svg")
    if arguments.drawing is not None and arguments.drawing == arguments.netlist:
        raise ConfigurationError(f"{arguments.drawing}: named for the drawing and for the netlist: name two files")
    if arguments.netlist is not None and arguments.machine == "that":
        raise ConfigurationError("--netlist: there is no deck of THE ANALOG THING: leave out --machine that")


def _that_sheet(program: PatchedProgram) -> ThatSheet:
    """:raises ConfigurationError: the program does not fit the machine."""
    from analogrig import ConfigurationError
    from analogrig_emulator import EmulatorError
    from analogrig_emulator.machine.that_sheet import ThatSheet

    try:
        return ThatSheet(program)
    except EmulatorError as error:
        raise ConfigurationError(str(error)) from error


def _deck(program: PatchedProgram) -> str:
    """Deck of the patch under the square wave of the machine, between the levels of the trial play."""
    from analogrig_emulator import SOURCE, TICKS_PER_SAMPLE, Deck, Excitation, SuspensionComputer
    from analogrig_emulator.machine.patched_program import MACHINE_V
    from analogrig_emulator.machine.sheet import diagram_lines

    computer = SuspensionComputer(program)
    (name, quantity), *_ = program.equations.inputs.items()
    low_v, high_v = (level * MACHINE_V / program.scales.full(name) for level in quantity.trial)
    excitation = Excitation(low_v=low_v, high_v=high_v)
    rate_hz = computer.sample_rate_hz
    edges = {SOURCE: excitation.edges(0, _SAMPLES * TICKS_PER_SAMPLE, rate_hz)}
    title = ". ".join([f"program {program.name}", *diagram_lines(program)])
    return Deck(computer.circuit, _SAMPLES, rate_hz, edges, title=title).text()
