"""``analogrig thesis``: the experiments of the thesis, made again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli.playing import make_folder
from analogrig.cli.terminal import PASSED, show


def add(commands: Any) -> None:
    command = commands.add_parser("thesis", help="every figure, number and claim of the thesis, made again and judged")
    command.add_argument(
        "--out",
        type=Path,
        default=Path("build/thesis"),
        metavar="DIR",
        help="where thesis.html, claims.json and recordings/ go (default: %(default)s)",
    )
    command.add_argument("--json", action="store_true", help="print claims.json instead of the list of claims")
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from analogrig_thesis import reproduce
    from analogrig_thesis.reproduction import PAGE

    make_folder(arguments.out)
    reproduction = reproduce()
    reproduction.write(arguments.out)
    if arguments.json:
        show(reproduction.claims().rstrip())
        return PASSED
    for chapter in reproduction.chapters:
        for claim in chapter.claims:
            show(f"{claim.ident:18} {claim.verdict}")
    show(f"{arguments.out / PAGE}")
    return PASSED
