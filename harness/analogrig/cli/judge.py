"""``analogrig judge``: a recording or a CAN log, without a device."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli.options import FILE, add_capture, add_command, add_output, recorded
from analogrig.cli.playing import conclude, output_folder


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "judge",
        "judge a recorded run or a CAN log, without a device",
        "judge build/run/run.npz",
        "judge build/can/can.log --scenario thesis --json",
    )
    command.add_argument("file", type=Path, metavar=FILE, help="recording (run.npz) or CAN log")
    add_capture(command)
    add_output(command, default=Path("build/judge"))
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    with output_folder(arguments) as output:
        from analogrig.rigs.recording import RecordingRig

        run = recorded(arguments)
        RecordingRig.of(run, arguments.file)
        return conclude(run, output, output.identity(), arguments)
