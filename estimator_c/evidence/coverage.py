"""Line and branch coverage of core, isolation and fit by the tests. `make coverage`.

Runs their tests on a driver built with gcov's counters (without optimisation, asserts off, one copy of every
line), and lists what none of them reached. 100 % is demanded of lines and branches.
"""

from __future__ import annotations

import gzip
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["Coverage", "main", "measured"]

ROOT = Path(__file__).parents[2]
SOURCES = tuple(ROOT / "estimator_c" / name for name in ("core", "isolation", "fit"))

ELSEWHERE = {
    "a.na == b.na": "shapes differ only where a build knows one alone: tests/estimator_c/test_est_builds.py",
    "is_supported": "only a build that leaves something out refuses here: tests/estimator_c/test_est_builds.py",
    **{
        f"EST_WITH_{what} || ": "what is left out of a build is refused there: tests/estimator_c/test_est_builds.py"
        for what in ("EDGES", "TRIGGERS", "ADAPTATION", "WATCH")
    },
    "judge_hypotheses(self, shape": "inlined here: a build for speed reads the innovation of a first sample as it is",
    "config->kind != EST_TRIGGER_CUSUM": "the sum comes here in a build without robustness: test_est_builds.py",
    "(config->refresh_n == 0U))) &&": "the end of the line above, which begins with EST_WITH_ADAPTATION",
    "autocovariance(self->c, i)": "a function in line where the lag is never 0; the line above has the call with 0",
}
"""Branches on a line with such a word cannot both be taken there, or in one build."""

OWN_BUILDS = ("test_est_builds.py", "test_est_embedding.py", "test_est_layouts.py", "test_est_users.py")
"""They compile the core for themselves, without counters."""
RATES = (
    "test_changed_parameter_is_named_in_time_and_its_extent_told",
    "test_report_comes_within_twice_the_isolation_bound_on_average",
    "test_change_that_two_others_at_once_look_like_for_long",
    "test_two_changes_at_once_are_not_taken_for_one",
    "test_random_plants_are_isolated_as_well",
    "test_false_alarms_are_rarer_than_promised",
)
"""Tests that repeat a trial hundreds of times for a rate: the others have to reach every line without them."""
KEPT = " and ".join(f"not {name}" for name in RATES)


@dataclass
class Coverage:
    """Lines and branches that the tests reached or missed: (file, line, the line's text)."""

    lines: int = 0
    branches: int = 0
    missed_lines: list[tuple[str, int, str]] = field(default_factory=list)
    missed_branches: list[tuple[str, int, str]] = field(default_factory=list)

    def add(self, name: str, line: dict[str, Any], text: str) -> None:
        """One line of gcov's report."""
        here = (name, int(line["line_number"]), text.strip())
        self.lines += 1
        if not line["count"]:
            self.missed_lines.append(here)
        if any(word in text for word in ELSEWHERE):
            return
        for branch in line["branches"]:
            self.branches += 1
            if not branch["count"]:
                self.missed_branches.append(here)


def measured(pytest_arguments: tuple[str, ...] = ()) -> Coverage:
    """Runs the tests of core, isolation and fit; raises CalledProcessError if one fails."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        tests = sorted(str(path) for path in (ROOT / "tests" / "estimator_c").glob("test_est_*.py"))
        chosen = [path for path in tests if not path.endswith(OWN_BUILDS)]
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-k", KEPT]
        command += ["-m", "not heavy"]
        command += pytest_arguments
        environment = os.environ | {"EST_COVERAGE": str(folder)}
        subprocess.run([*command, *chosen], cwd=ROOT, env=environment, check=True, stdout=subprocess.DEVNULL)
        return _read(folder)


def _read(folder: Path) -> Coverage:
    coverage = Coverage()
    merged: dict[tuple[str, int], dict[str, Any]] = {}
    for counts in sorted(folder.glob("*.gcda")):
        subprocess.run(
            ["gcov", "--json-format", "--branch-probabilities", counts.name],
            cwd=folder,
            check=True,
            stdout=subprocess.DEVNULL,
        )
    for report in sorted(folder.glob("*.gcov.json.gz")):
        for name, line in _lines(json.loads(gzip.decompress(report.read_bytes()))):
            _merge(merged, name, line)
    texts = {path.name: path.read_text().splitlines() for folder in SOURCES for path in folder.iterdir()}
    for (name, number), line in sorted(merged.items()):
        coverage.add(name, line, texts[name][number - 1])
    return coverage


def _lines(report: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for file in report["files"]:
        path = Path(file["file"])
        if path.parent.name in {folder.name for folder in SOURCES}:
            for line in file["lines"]:
                yield path.name, line


def _merge(merged: dict[tuple[str, int], dict[str, Any]], name: str, line: dict[str, Any]) -> None:
    """A line of a header, or of a function inlined twice, is counted where it landed: its counts add up."""
    known = merged.setdefault((name, line["line_number"]), {**line, "count": 0, "branches": []})
    known["count"] += line["count"]
    if len(known["branches"]) != len(line["branches"]):
        known["branches"] = known["branches"] or [dict(branch) for branch in line["branches"]]
        return
    for old, new in zip(known["branches"], line["branches"], strict=True):
        old["count"] += new["count"]


def main() -> int:
    """Prints what was missed; the exit status is 1 unless nothing was."""
    if shutil.which("gcov") is None:
        sys.stderr.write("gcov is absent: apt-get install gcc\n")
        return 2
    coverage = measured()
    for what, missed, total in (
        ("lines", coverage.missed_lines, coverage.lines),
        ("branches", coverage.missed_branches, coverage.branches),
    ):
        sys.stdout.write(f"{what}: {total - len(missed)} of {total}\n")
        for name, number, text in missed:
            sys.stdout.write(f"  {name}:{number}: {text}\n")
    return 1 if coverage.missed_lines or coverage.missed_branches else 0


if __name__ == "__main__":
    sys.exit(main())
