"""``analogrig compare``: significant differences between two campaigns, or two folders of runs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analogrig.cli.options import FILE, add_command, add_json
from analogrig.cli.terminal import FAILED, INCONCLUSIVE, PASSED, complain, show, show_result, show_work

if TYPE_CHECKING:
    from analogrig.campaigns.differences import Comparison


def add(commands: Any) -> None:
    command = add_command(
        commands,
        "compare",
        "test two campaigns or folders of runs for differences beyond chance",
        "compare before.sqlite after.sqlite",
        "compare runs/before runs/after --alpha 0.05 --json",
    )
    command.add_argument("a", type=Path, metavar=FILE, help="A: results of a campaign, or a folder of recordings")
    command.add_argument("b", type=Path, metavar=FILE, help="B: the same of the newer build")
    command.add_argument(
        "--alpha", type=_probability, default=0.01, metavar="P", help="family-wise error rate (default: %(default)g)"
    )
    add_json(command)
    command.set_defaults(command=_run)


def _probability(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if 0.0 < value < 1.0:
        return value
    raise argparse.ArgumentTypeError(f"must be between 0 and 1, not {text[:40]!r}")


def _run(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from analogrig.campaigns.differences import PAIRED, compare_sides, load

    with show_work(f"comparing {arguments.a} and {arguments.b}"):
        found = compare_sides(load(arguments.a), load(arguments.b), arguments.alpha)
    if arguments.json:
        show_result(asdict(found), arguments)
    else:
        show(_text(found))
    if not found.differences:
        return complain("INCONCLUSIVE: the two sides have nothing that can be compared", INCONCLUSIVE)
    ours, theirs = found.inconclusive
    if theirs > ours and not found.worse:
        return complain(
            f"INCONCLUSIVE: {theirs} trials of B were inconclusive, {ours} of A: nothing is said of them", INCONCLUSIVE
        )
    seeds = max(each.seeds for each in found.differences)
    if not (found.worse or found.is_same) and found.differences[0].test == PAIRED and seeds < found.least_seeds:
        return complain(
            f"INCONCLUSIVE: too few seeds ({seeds}) to show anything at alpha {found.alpha:g}:"
            f" at least {found.least_seeds}",
            INCONCLUSIVE,
        )
    return FAILED if found.worse else PASSED


def _text(found: Comparison) -> str:
    same, both = found.identical
    ours, theirs = found.inconclusive
    lines = [
        f"A: {found.trials[0]} valid trials, B: {found.trials[1]}; theta is the same to the bit in {same} of {both}",
        *([f"inconclusive: {ours} of A, {theirs} of B"] if ours or theirs else []),
        "",
        differences_text(found),
    ]
    return "\n".join(lines)


def differences_text(found: Comparison) -> str:
    """The table of differences, and what may be said of it."""
    lines = [f"  {'':14}{'A':>11}{'B':>11}  {'unit':24}{'seeds':>6}{'p':>10}{'adjusted':>10}  test"]
    lines += [
        f"  {each.quantity:14}{each.a:11.4g}{each.b:11.4g}  {each.unit:24}{each.seeds:6}{each.p:10.2g}"
        f"{each.adjusted_p:10.2g}  {each.test}: {each.word.upper() if each.word == 'worse' else each.word}"
        for each in found.differences
    ]
    lines += ["", f"  adjusted by Holm: the chance of any wrong word is at most {found.alpha:g}"]
    return "\n".join(lines)
