"""The command ``analogrig``, and what a command of another package needs: options, output, exit statuses.

A package adds a command as an entry point, a function that adds it to the parser:

    [project.entry-points."analogrig.commands"]
    mycommand = "my_package.my_module:add"
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analogrig.cli.command_line import main
    from analogrig.cli.compare import differences_text
    from analogrig.cli.options import (
        DEFAULT_SCENARIO,
        FILE,
        PROGRAM,
        RIG,
        RIG_NAMES,
        SCENARIO,
        add_allow,
        add_command,
        add_dut,
        add_json,
        add_rig,
        add_seed,
        add_what_to_play,
        changes_of_dut,
        count,
        files_read,
        open_what_to_play,
        port,
        trust_of,
    )
    from analogrig.cli.terminal import (
        FAILED,
        INCONCLUSIVE,
        PASSED,
        USAGE,
        complain,
        output_for_command,
        progress_line,
        show,
        show_json,
        show_plain,
        show_result,
        show_work,
    )
else:
    from analogrig.lazy import loader

    __getattr__ = loader(
        __name__,
        {
            "analogrig.cli.command_line": "main",
            "analogrig.cli.compare": "differences_text",
            "analogrig.cli.options": (
                "DEFAULT_SCENARIO FILE PROGRAM RIG RIG_NAMES SCENARIO add_allow add_command add_dut add_json add_rig "
                "add_seed add_what_to_play changes_of_dut count files_read open_what_to_play port trust_of"
            ),
            "analogrig.cli.terminal": (
                "FAILED INCONCLUSIVE PASSED USAGE complain output_for_command progress_line show show_json "
                "show_plain show_result show_work"
            ),
        },
    )

__all__ = [
    "DEFAULT_SCENARIO",
    "FAILED",
    "FILE",
    "INCONCLUSIVE",
    "PASSED",
    "PROGRAM",
    "RIG",
    "RIG_NAMES",
    "SCENARIO",
    "USAGE",
    "add_allow",
    "add_command",
    "add_dut",
    "add_json",
    "add_rig",
    "add_seed",
    "add_what_to_play",
    "changes_of_dut",
    "complain",
    "count",
    "differences_text",
    "files_read",
    "main",
    "open_what_to_play",
    "output_for_command",
    "port",
    "progress_line",
    "show",
    "show_json",
    "show_plain",
    "show_result",
    "show_work",
    "trust_of",
]
