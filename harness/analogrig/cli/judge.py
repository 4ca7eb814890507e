"""``analogrig judge``: a recording or a CAN log, without a device."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli.options import add_capture, add_output, recorded
from analogrig.cli.playing import conclude, prepare


def add(commands: Any) -> None:
    command = commands.add_parser("judge", help="judge a recorded run, or a CAN log that was captured elsewhere")
    command.add_argument("file", type=Path, metavar="FILE", help="a recording (run.npz), or a CAN log")
    add_capture(command)
    add_output(command, default=Path("build/judge"))
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig.rigs.recording import RecordingRig

    run = recorded(arguments)
    prepare(arguments.out, RecordingRig.of(run, arguments.file))
    return conclude(run, arguments)
