"""A soak: ``python -m tests.soak.mutated`` plays mutated files through the real commands and prints a table.

Options set how many recordings, files, logs and keys with absurd values there are; by default all that the table names.

Status 1 if one case ended otherwise than in one line, in time and in little memory; ``--one KIND:NUMBER`` repeats it.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import resource
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.soak.mutated.cases import Cases, Seeds
from tests.soak.mutated.trial import MOST_CPU_S, MOST_MB, Case, Outcome, Running, begin

_LOADED = (
    *("analogrig.bench", "analogrig.judging.verdict", "analogrig.reporting", "analogrig.reporting.run_summary"),
    *("analogrig.campaigns.conduct", "analogrig.reporting.campaign_page", "analogrig.rigs.description"),
    *("analogrig_instruments.self_test", "analogrig.recordings"),
    *("cantools", "asammdf"),
)
"""Loaded once, before the cases are forked."""

_SHOWN = 40
"""Problems that are named."""


def soaked(counts: dict[str, int], seed: int, folder: Path, one: str = "", jobs: int = 2) -> int:
    """Play the cases, print the table; returns the number of those with problems."""
    cases = Cases(Seeds.made(folder / "seeds"), folder, seed)
    for name in _LOADED:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()
    counts["keys"] = min(counts["keys"], len(cases.keys))
    only, _, which = one.partition(":")
    numbered = iter([(only, int(which))]) if one else cases.all(counts)
    table: dict[str, list[tuple[Outcome, bool]]] = defaultdict(list)
    failures = 0
    for (kind, number), case, outcome in _outcomes(cases, numbered, folder, jobs):
        problems = outcome.problems(case)
        table[case.kind].append((outcome, bool(problems)))
        failures += bool(problems)
        if one or (problems and failures <= _SHOWN):
            said = outcome.stderr.decode("utf-8", "replace")
            _say(f"{kind}:{number} {' '.join(case.argv)}\n  {case.what}\n  {', '.join(problems)}: {said[-700:]!a}")
        if not problems:
            shutil.rmtree(folder / f"{kind}-{number}", ignore_errors=True)
    _print_table(table, seed)
    return failures


Numbered = tuple[str, int]


def _outcomes(
    cases: Cases, numbered: Iterator[Numbered], folder: Path, jobs: int
) -> Iterator[tuple[Numbered, Case, Outcome]]:
    running: dict[int, tuple[Numbered, Running]] = {}
    while True:
        while len(running) < jobs and (which := next(numbered, None)) is not None:
            started = begin(cases.drawn(*which), folder)
            running[started.pid] = which, started
        if not running:
            return
        pid, status, usage = os.wait4(-1, os.WNOHANG)
        if not pid:
            time.sleep(0.002)
            for _, each in running.values():
                each.kill_if_hung()
            continue
        if pid in running:
            which, ended = running.pop(pid)
            yield which, ended.case, ended.outcome(status, usage)


def _print_table(table: dict[str, list[tuple[Outcome, bool]]], seed: int) -> None:
    _say(f"seed {seed}; at most {MOST_CPU_S:g} s of CPU and {MOST_MB} MB each\n")
    heads = ("cases", "passed", "failed", "refused", "inconcl.", "wrong", "most s", "most MB")
    _say(_row("file", heads))
    everything = [each for rows in table.values() for each in rows]
    for name, rows in (*sorted(table.items()), ("all", everything)):
        of = [sum(outcome.status == status for outcome, _ in rows) for status in (0, 1, 2, 3)]
        wrong = sum(is_wrong for _, is_wrong in rows)
        most_s = max((outcome.cpu_s for outcome, _ in rows), default=0.0)
        most_mb = max((outcome.memory_mb for outcome, _ in rows), default=0.0)
        cells = (len(rows), *of, wrong, f"{most_s:.1f}", f"{most_mb:.0f}")
        _say(_row(name, cells))


def _row(name: str, cells: Sequence[object]) -> str:
    return f"{name:18}{''.join(f'{cell:>10}' for cell in cells)}"


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak.mutated", description=__doc__)
    for name, count in (("recordings", 5000), ("files", 2000), ("logs", 500), ("keys", 1_000_000)):
        parser.add_argument(f"--{name}", type=int, default=count, metavar="N")
    parser.add_argument("--seed", type=int, default=1995)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--one", default="", metavar="KIND:NUMBER", help="repeat one case, such as files:17")
    parser.add_argument("--keep", type=Path, help="a folder in which the files of the cases with problems stay")
    arguments = parser.parse_args()
    counts = {name: getattr(arguments, name) for name in ("recordings", "files", "logs", "keys")}
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with tempfile.TemporaryDirectory() as temporary:
        folder = (arguments.keep or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        os.chdir(folder)
        return 1 if soaked(counts, arguments.seed, folder, arguments.one, arguments.jobs) else 0


if __name__ == "__main__":
    sys.exit(main())
