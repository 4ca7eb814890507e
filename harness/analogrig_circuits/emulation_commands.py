"""``analogrig emulate``, ``netlist`` and ``effects``: the emulated computer without a device."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli import (
    FILE,
    PASSED,
    add_command,
    add_json,
    add_what_to_play,
    files_read,
    open_what_to_play,
    progress_line,
    show,
    show_plain,
    show_result,
    show_work,
)


def add_emulate(commands: Any) -> None:
    command = add_command(
        commands,
        "emulate",
        "play a scenario on a rig alone, and write volts and codes to a file",
        "emulate --out build/signals.csv",
        "emulate --scenario slow --program bump-stop --seed 7 --out build/signals.npz",
    )
    add_what_to_play(command)
    command.add_argument(
        "--out",
        type=Path,
        default=Path("build/signals.csv"),
        metavar=FILE,
        help="file of the signals, .csv or .npz (default: %(default)s)",
    )
    add_json(command)
    command.set_defaults(command=_emulate)


def add_netlist(commands: Any) -> None:
    command = add_command(
        commands,
        "netlist",
        "write the emulated computer as a SPICE deck for ngspice",
        "netlist --out build/thesis.cir",
        "netlist --program two-mass --seed 7",
    )
    add_what_to_play(command)
    command.add_argument("--out", type=Path, metavar=FILE, help="file of the deck (default: standard output)")
    add_json(command)
    command.set_defaults(command=_netlist)


def add_effects(commands: Any) -> None:
    command = add_command(
        commands,
        "effects",
        "measure each fault of a real machine by itself, in LSB at 12 bits",
        "effects --set front",
        "effects --out build/effects.svg",
    )
    command.add_argument("--set", choices=("shock", "front"), help="parameter set (default: both)")
    command.add_argument("--out", type=Path, metavar=FILE, help="picture of the table, an .svg file")
    add_json(command)
    command.set_defaults(command=_effects)


def _emulate(arguments: argparse.Namespace) -> int:
    from analogrig.output import move_aside

    if arguments.out.suffix in (".csv", ".npz"):
        move_aside(arguments.out, files_read(arguments))
    from analogrig.reporting import lamps_text
    from analogrig_circuits.export import write_signals

    with open_what_to_play(arguments) as (rig, scenario, seed):
        written = write_signals(rig, scenario, seed, arguments.out, progress=progress_line())
    if arguments.json:
        show_result({"file": str(arguments.out), "seed": seed, **written}, arguments)
    else:
        show(f"{arguments.out}: {written['samples']} samples, {written['clipped']} of them with a clipped channel")
        show(f"overload lamps: {lamps_text(written['overloads'])}")
    return PASSED


def _netlist(arguments: argparse.Namespace) -> int:
    from analogrig.output import move_aside, replace_file

    if arguments.out is not None:
        move_aside(arguments.out, files_read(arguments))
    from analogrig_circuits.export import netlist

    with open_what_to_play(arguments) as (rig, scenario, seed):
        deck = netlist(rig, scenario, seed)
    text = deck.text()
    if arguments.out is not None:
        with replace_file(arguments.out) as file:
            file.write(text.encode("ascii"))
    if arguments.json:
        where = {"deck": text} if arguments.out is None else {"file": str(arguments.out)}
        show_result({**where, "samples": deck.samples, "seed": seed}, arguments)
    elif arguments.out is None:
        show_plain(text.rstrip("\n"))
    else:
        show(f"{arguments.out}: {deck.samples} samples; run it with: ngspice -b -r out.raw {arguments.out}")
    return PASSED


def _effects(arguments: argparse.Namespace) -> int:
    from analogrig import ConfigurationError
    from analogrig.output import move_aside
    from analogrig_circuits import effects_page

    if arguments.out is not None:
        if arguments.out.suffix != ".svg":
            raise ConfigurationError(f"{arguments.out}: the file's name must end with .svg")
        move_aside(arguments.out)
    with show_work("playing each fault"):
        table = effects_page.measure([arguments.set] if arguments.set else ["shock", "front"])
    if arguments.out is not None:
        effects_page.write_picture(table, arguments.out)
    if arguments.json:
        show_result(effects_page.as_json(table), arguments)
    else:
        show(effects_page.text(table))
    return PASSED
