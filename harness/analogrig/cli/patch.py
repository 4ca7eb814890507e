"""``analogrig patch``: a program file as a patch of the analogue computer."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli.options import FILE, add_command, add_json
from analogrig.cli.terminal import PASSED, show, show_plain, show_result

if TYPE_CHECKING:
    from analogrig.program import Program
    from analogrig_emulator import PatchedProgram
    from analogrig_emulator.machine.that_sheet import ThatSheet

_SAMPLES = 800

_CARD_RATE_HZ = 20_000.0
"""Sample rate of the usual rigs."""
_LEAST_SETTLING_N, _SETTLING_N, _MOST_SETTLING_N = 10, 100, 200
"""Samples in which a plant settles: the fewest, the usual ones and the most that need no note."""


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
    add_json(command)
    command.set_defaults(command=_patch)


def _patch(arguments: argparse.Namespace) -> int:
    from analogrig.config import locate
    from analogrig.output import move_aside
    from analogrig.program import Program
    from analogrig.rigs.emulator import emulator_errors
    from analogrig.storage import replace_file
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
        files: dict[str, Any] = {"files": [str(path) for path in wanted]}
        if that is not None:
            files |= {"speed": that.speed, "slow": that.slow, "cables": [vars(cable) for cable in that.cables]}
        show_result(
            {"program": program.name, "full": full, "dials": dials(program, program.values), **files}, arguments
        )
    else:
        show_plain((scaling_sheet(program) if that is None else that.text()).rstrip("\n"))
        if that is None:
            for line in _notes(loaded):
                show(line)
        for path in wanted:
            show(f"written: {path}")
    return PASSED


def _notes(program: Program) -> list[str]:
    """Reasons to choose another speed, which only a run would show: as failures of the device."""
    period_s = 1.0 / _CARD_RATE_HZ
    if program.settling_s is None:
        return []
    settling_n = program.settling_s / (program.equations.speed * period_s)
    if _LEAST_SETTLING_N <= settling_n <= _MOST_SETTLING_N:
        return []
    speed = program.settling_s / (_SETTLING_N * period_s)
    note = f"note: the plant settles in {settling_n:.3g} samples of {1e6 * period_s:g} us: write speed"
    return [f"{note} = {float(f'{speed:.2g}'):g} for {_SETTLING_N}, unless excitation or rig suit it"]


def _check_options(arguments: argparse.Namespace) -> None:
    """:raises ConfigurationError: the options exclude each other, or name a wrong file."""
    from analogrig.errors import ConfigurationError

    if arguments.drawing is not None and arguments.drawing.suffix != ".svg":
        raise ConfigurationError(f"{arguments.drawing}: the file's name must end with .svg")
    if arguments.drawing is not None and arguments.drawing == arguments.netlist:
        raise ConfigurationError(f"{arguments.drawing}: named for the drawing and for the netlist: name two files")
    if arguments.netlist is not None and arguments.machine == "that":
        raise ConfigurationError("--netlist: there is no deck of THE ANALOG THING: leave out --machine that")


def _that_sheet(program: PatchedProgram) -> ThatSheet:
    """:raises ConfigurationError: the program does not fit the machine."""
    from analogrig.errors import ConfigurationError
    from analogrig_emulator import EmulatorError
    from analogrig_emulator.machine.that_sheet import ThatSheet

    try:
        return ThatSheet(program)
    except EmulatorError as error:
        raise ConfigurationError(str(error)) from error


def _deck(program: PatchedProgram) -> str:
    """Deck of the patch under the square wave of the machine, between the levels of the trial play."""
    from analogrig_emulator import SOURCE, TICKS_PER_SAMPLE, Deck, Excitation, SuspensionComputer
    from analogrig_emulator.machine.compiler import MACHINE_V
    from analogrig_emulator.machine.sheet import diagram_lines

    computer = SuspensionComputer(program)
    (name, quantity), *_ = program.equations.inputs.items()
    low_v, high_v = (level * MACHINE_V / program.scales.full(name) for level in quantity.trial)
    excitation = Excitation(low_v=low_v, high_v=high_v)
    rate_hz = computer.sample_rate_hz
    edges = {SOURCE: excitation.edges(0, _SAMPLES * TICKS_PER_SAMPLE, rate_hz)}
    title = ". ".join([f"program {program.name}", *diagram_lines(program)])
    return Deck(computer.circuit, _SAMPLES, rate_hz, edges, title=title).text()
