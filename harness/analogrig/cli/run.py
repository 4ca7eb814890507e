"""``analogrig run``: play a scenario and judge."""

from __future__ import annotations

import argparse
import os
from typing import Any

from analogrig.cli.options import (
    add_can_log,
    add_command,
    add_dut,
    add_output,
    add_time_limit,
    add_what_to_play,
    changes_of_dut,
    opened,
    trust_of,
)
from analogrig.cli.playing import can_log, output_folder, play


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "run",
        "play a scenario on a rig through a device, and judge the device's alarms",
        "run --seed 7",
        "run --scenario slow --dut inproc --out build/slow",
        "run --rig emulator-0-10v --dut qemu-m4 --json",
    )
    add_what_to_play(command)
    add_dut(command, default=os.environ.get("ANALOGRIG_DUT", ""), shown="$ANALOGRIG_DUT, that of the scenario, or host")
    add_output(command)
    add_can_log(command)
    add_time_limit(command)
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    with output_folder(arguments) as output, opened(arguments) as (rig, scenario, seed):
        from analogrig.devices.dut import open_dut

        device = arguments.dut or scenario.dut or "host"
        log = can_log(output, arguments)
        with open_dut(device, allow=trust_of(arguments), listener=log, **changes_of_dut(arguments)) as dut:
            return play(rig, dut, scenario, seed, output, arguments, log)
