"""``analogrig netlist``: the computer as a SPICE deck."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli.options import FILE, add_command, add_json, add_what_to_play, files_read, opened
from analogrig.cli.terminal import PASSED, show, show_plain, show_result


def add(commands: Any) -> None:
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
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig.output import move_aside

    if arguments.out is not None:
        move_aside(arguments.out, files_read(arguments))
    from analogrig.reporting.export import netlist
    from analogrig.storage import replacing

    with opened(arguments) as (rig, scenario, seed):
        deck = netlist(rig, scenario, seed)
    text = deck.text()
    if arguments.out is not None:
        with replacing(arguments.out) as file:
            file.write(text.encode("ascii"))
    if arguments.json:
        where = {"deck": text} if arguments.out is None else {"file": str(arguments.out)}
        show_result({**where, "samples": deck.samples, "seed": seed}, arguments)
    elif arguments.out is None:
        show_plain(text.rstrip("\n"))
    else:
        show(f"{arguments.out}: {deck.samples} samples; run it with: ngspice -b -r out.raw {arguments.out}")
    return PASSED
