"""``analogrig replay``: a recording through a device again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from harness.cli.options import add_dut, add_output, changes_of_dut
from harness.cli.playing import play, prepare


def add(commands: Any) -> None:
    command = commands.add_parser("replay", help="play a recorded run through a device again, and judge it")
    command.add_argument("file", type=Path, metavar="FILE", help="a recording (run.npz)")
    add_dut(command, default=None)
    add_output(command, default=Path("build/replay"))
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from harness.dut import open_dut, reopen_dut
    from harness.rig import RecordingRig

    with RecordingRig.open(arguments.file) as rig:
        prepare(arguments.out, rig)
        changes = changes_of_dut(arguments)
        named = arguments.dut
        with open_dut(named, **changes) if named else reopen_dut(rig.run.conditions.dut, **changes) as dut:
            return play(rig, dut, rig.scenario(), rig.run.conditions.seed, arguments)
