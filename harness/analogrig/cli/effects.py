"""``analogrig effects``: what matters at 12 bits."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from analogrig.cli.terminal import PASSED, show


def add(commands: Any) -> None:
    command = commands.add_parser("effects", help="what matters at 12 bits: each fault of the machine by itself")
    command.add_argument("--set", choices=("shock", "front"), help="one parameter set instead of both")
    command.add_argument("--out", type=Path, metavar="FILE", help="also draw it, as an .svg file")
    command.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig.reporting import effects

    if arguments.out is not None and arguments.out.suffix != ".svg":
        from analogrig.errors import ConfigurationError

        raise ConfigurationError(f"{arguments.out}: the file's name must end with .svg")
    table = effects.measure([arguments.set] if arguments.set else ["shock", "front"])
    if arguments.out is not None:
        effects.write_picture(table, arguments.out)
    show(json.dumps(effects.as_json(table)) if arguments.json else effects.text(table))
    return PASSED
