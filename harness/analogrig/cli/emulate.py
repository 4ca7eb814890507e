"""``analogrig emulate``: the rig alone."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli.options import FILE, add_command, add_json, add_what_to_play, files_read, opened
from analogrig.cli.terminal import PASSED, progress_line, show, show_result


def add(commands: Any) -> None:
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
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig.output import move_aside

    if arguments.out.suffix in (".csv", ".npz"):
        move_aside(arguments.out, files_read(arguments))
    from analogrig.reporting.export import write_signals
    from analogrig.reporting.summary import lamps_text

    with opened(arguments) as (rig, scenario, seed):
        written = write_signals(rig, scenario, seed, arguments.out, progress=progress_line())
    if arguments.json:
        show_result({"file": str(arguments.out), "seed": seed, **written}, arguments)
    else:
        show(f"{arguments.out}: {written['samples']} samples, {written['clipped']} of them with a clipped channel")
        show(f"overload lamps: {lamps_text(written['overloads'])}")
    return PASSED
