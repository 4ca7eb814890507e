"""``analogrig emulate``: the rig alone."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from analogrig.cli.options import add_what_to_play, opened
from analogrig.cli.terminal import PASSED, progress_line, show


def add(commands: Any) -> None:
    command = commands.add_parser("emulate", help="the rig alone: write volts and codes to a file")
    add_what_to_play(command)
    command.add_argument(
        "--out",
        type=Path,
        default=Path("build/signals.csv"),
        metavar="FILE",
        help=".csv or .npz (default: %(default)s)",
    )
    command.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig.reporting.emulate import write_signals
    from analogrig.reporting.summary import lamps_text

    with opened(arguments) as (rig, scenario, seed):
        written = write_signals(rig, scenario, seed, arguments.out, progress=progress_line())
    if arguments.json:
        show(json.dumps({"file": str(arguments.out), "seed": seed, **written}))
    else:
        show(f"{arguments.out}: {written['samples']} samples, {written['clipped']} of them with a clipped channel")
        show(f"overload lamps: {lamps_text(written['overloads'])}")
    return PASSED
