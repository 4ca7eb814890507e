"""``analogrig thesis``: the experiments of the thesis, made again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli.options import add_command
from analogrig.cli.playing import make_folder
from analogrig.cli.terminal import PASSED, show, show_plain, working


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
    from analogrig_thesis import reproduce
    from analogrig_thesis.reproduction import PAGE

    make_folder(arguments.out)
    with working("simulating, playing, estimating"):
        reproduction = reproduce()
        reproduction.write(arguments.out)
    if arguments.json:
        show_plain(reproduction.claims().rstrip())
        return PASSED
    for chapter in reproduction.chapters:
        for claim in chapter.claims:
            show(f"{claim.ident:18} {claim.verdict}")
    show(f"{arguments.out / PAGE}")
    return PASSED
