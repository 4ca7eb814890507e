"""``analogrig thesis``: the experiments of the thesis, made again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli import PASSED, add_command, show, show_plain, show_work


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "thesis",
        "reproduce and judge every figure, number and claim of the thesis",
        "thesis",
        "thesis --out build/thesis --json",
    )
    command.add_argument(
        "--out",
        type=Path,
        default=Path("build/thesis"),
        metavar="DIR",
        help="folder for thesis.html, claims.json and recordings/ (default: %(default)s)",
    )
    command.add_argument("--json", action="store_true", help="print claims.json instead of the list of claims")
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig.output import OutputFolder
    from analogrig_thesis.reproduction import FILES, PAGE

    with OutputFolder(arguments.out, arguments.command_line, arguments.started, holds=FILES, page=PAGE) as output:
        from analogrig_thesis import reproduce

        with show_work("simulating, playing, estimating"):
            reproduction = reproduce()
        verdict = {"outcome": "passed", "valid": True, "reasons": [], "identity": output.identity().as_table()}
        output.conclude(reproduction.write, verdict)
    if arguments.json:
        show_plain(reproduction.claims().rstrip())
        return PASSED
    for chapter in reproduction.chapters:
        for claim in chapter.claims:
            show(f"{claim['ident']:18} {claim['verdict']}")
    show(f"{arguments.out / PAGE}")
    return PASSED
