"""``analogrig replay``: a recording, or the samples of a CAN log, through a device again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli.options import (
    FILE,
    add_can_log,
    add_capture,
    add_command,
    add_dut,
    add_output,
    add_time_limit,
    changes_of_dut,
    is_capture,
    recorded,
    trust_of,
)
from analogrig.cli.playing import can_log, output_folder, play

if TYPE_CHECKING:
    from analogrig.output import OutputFolder


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "replay",
        "play a recorded run through a device again, and judge it",
        "replay build/run/run.npz",
        "replay build/run/run.npz --dut mean-between-faults --out build/mean",
        "replay build/can/can.log --scenario thesis --dut inproc",
    )
    command.add_argument("file", type=Path, metavar=FILE, help="recording (run.npz) or CAN log")
    add_capture(command)
    add_dut(command, default=None, shown="that of the recording")
    add_output(command, default=Path("build/replay"))
    add_can_log(command)
    add_time_limit(command)
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    with output_folder(arguments) as output:
        return _replayed(arguments, output)


def _replayed(arguments: argparse.Namespace, output: OutputFolder) -> int:
    from analogrig.devices.dut import open_dut, reopen_dut
    from analogrig.errors import ConfigurationError
    from analogrig.rigs.recording import RecordingRig

    named = arguments.dut
    if named is None and is_capture(arguments.file):
        raise ConfigurationError(f"{arguments.file}: does not say which device it was: say --dut")
    with RecordingRig.of(recorded(arguments), arguments.file) as rig:
        log = can_log(output, arguments)
        changes = {"allow": trust_of(arguments), "listener": log, **changes_of_dut(arguments)}
        device, file = rig.run.conditions.dut, str(arguments.file)
        with open_dut(named, **changes) if named else reopen_dut(device, file, **changes) as dut:
            return play(rig, dut, rig.scenario(), rig.run.conditions.seed, output, arguments, log)
