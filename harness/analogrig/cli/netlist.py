"""``analogrig netlist``: the computer as a SPICE deck."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from analogrig.cli.options import add_what_to_play, opened
from analogrig.cli.terminal import PASSED, show


def add(commands: Any) -> None:
    command = commands.add_parser("netlist", help="the emulated computer as a SPICE deck, which ngspice runs unchanged")
    add_what_to_play(command)
    command.add_argument("--out", type=Path, metavar="FILE", help="where the deck goes (default: standard output)")
    command.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig.reporting.netlist import netlist
    from analogrig.storage import replacing

    with opened(arguments) as (rig, scenario, seed):
        deck = netlist(rig, scenario, seed)
    text = deck.text()
    if arguments.out is not None:
        with replacing(arguments.out) as file:
            file.write(text.encode("ascii"))
    if arguments.json:
        where = {"deck": text} if arguments.out is None else {"file": str(arguments.out)}
        show(json.dumps({**where, "samples": deck.samples, "seed": seed}))
    elif arguments.out is None:
        show(text.rstrip("\n"))
    else:
        show(f"{arguments.out}: {deck.samples} samples; run it with: ngspice -b -r out.raw {arguments.out}")
    return PASSED
