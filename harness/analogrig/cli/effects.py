"""``analogrig effects``: what matters at 12 bits."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli.options import FILE, add_command, add_json
from analogrig.cli.terminal import PASSED, show, show_result, working


def add(commands: Any) -> None:
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
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig.reporting import effects

    if arguments.out is not None and arguments.out.suffix != ".svg":
        from analogrig.errors import ConfigurationError

        raise ConfigurationError(f"{arguments.out}: the file's name must end with .svg")
    if arguments.out is not None:
        from analogrig.output import move_aside

        move_aside(arguments.out)
    with working("playing each fault"):
        table = effects.measure([arguments.set] if arguments.set else ["shock", "front"])
    if arguments.out is not None:
        effects.write_picture(table, arguments.out)
    if arguments.json:
        show_result(effects.as_json(table), arguments)
    else:
        show(effects.text(table))
    return PASSED
