"""``analogrig report``: one page over all runs below a folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from analogrig.cli import INCONCLUSIVE, PASSED, USAGE, add_command, add_json, show, show_result, show_work


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "report",
        "list all runs below a folder on one page, with their trend over builds",
        "report build",
        "report artifacts --out artifacts/index.html --json",
    )
    command.add_argument("folder", type=Path, metavar="DIR", help="folder with the folders of runs")
    command.add_argument("--out", type=Path, metavar="FILE", help="the page (default: DIR/session.html)")
    add_json(command)
    command.set_defaults(command=_run)


def _run(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from analogrig_session.session_page import PAGE_FILE, find_session, write_session

    page = arguments.out or arguments.folder / PAGE_FILE
    with show_work(f"reading the runs in {arguments.folder}"):
        session = find_session(arguments.folder, page)
        write_session(session, page)
    status = PASSED if session.runs else INCONCLUSIVE if session.unended else USAGE
    if arguments.json:
        show_result({**asdict(session), "page": str(page)}, arguments)
        return status
    for run in session.runs:
        ratio = "-" if run.ratio is None else f"{run.ratio:.2f}"
        show(
            f"{run.outcome:12} {run.folder}: {run.missed} of {run.changes} missed, {ratio} bounds,"
            f" {run.false_alarms} false alarms"
        )
    for line in session.unended:
        show(f"no result: {line}")
    for line in session.unread:
        show(f"not read: {line}")
    show(f"page: {page}")
    return status
