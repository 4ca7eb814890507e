"""The tests of the core notice what is wrong with it: a few mutants by chance; `make mutate` tries all."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from estimator_c.evidence import mutate


def test_explanations_are_of_mutants_that_there_are() -> None:
    assert mutate.explained().keys() <= {mutant.key for mutant in mutate.mutants()}


def test_functions_whose_type_stands_on_a_line_of_its_own_are_altered() -> None:
    named = {mutant.function for mutant in mutate.mutants()}
    assert {"judge_hypotheses", "est_equation_update_theta", "est_scale_validate"} <= named


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("    if (a < b) {", ["    if (a <= b) {", "    if (a >= b) {", "    if (true) {", "    if (false) {"]),
        ("    x += 2U;  // 3U", ["    x -= 2U;  // 3U", "    x += 3U;  // 3U", "    x += 1U;  // 3U", "    ;"]),
        ("    const float x = -y * 0.0F;", ["    const float x = -y / 0.0F;", "    const float x = y * 0.0F;"]),
        ("    return !a && b;", ["    return !a || b;", "    return a && b;"]),
        ("    float* const x = y;", []),
    ],
    ids=["condition", "statement", "sign", "logic", "declaration"],
)
def test_operators_constants_conditions_and_statements_are_altered(line: str, expected: list[str]) -> None:
    altered = list(mutate.altered(line))
    assert set(expected) <= set(altered)
    assert len(altered) == len(set(altered))
    assert bool(altered) == bool(expected)


def test_a_resumed_run_keeps_what_neither_core_nor_tests_have_made_doubtful(tmp_path: Path) -> None:
    kept, rewritten, explained, unexplained = every = mutate.sampled(mutate.mutants(), 4)
    digests = {mutant: mutate.sources()[mutant.file, mutant.function] for mutant in every}
    outcomes = [
        mutate.Outcome(kept, "killed", "a test", digests[kept]),
        mutate.Outcome(rewritten, "killed", "a test", "another"),
        mutate.Outcome(explained, "survived", "other bits", digests[explained]),
        mutate.Outcome(unexplained, "survived", "other bits", digests[unexplained]),
    ]
    record = tmp_path / "mutation.json"
    mutate.write(record, outcomes)
    assert set(mutate.recalled(record, mutate.mutants(), {explained.key}).values()) == {outcomes[0], outcomes[2]}


SESSION = """
from estimator_c.evidence.mutate import Session
Session(
    ["-c", "/dev/null", "test_slow.py"], {}, lambda session: print(repr(session.first_failure())), deadline_s=1
).run()
"""
SLOW = """
import time

def test_slow():
    end = time.process_time() + 1.2
    while time.process_time() < end:
        pass
"""


@pytest.mark.heavy
def test_a_slow_test_does_not_count_as_one_without_end(tmp_path: Path) -> None:
    (tmp_path / "test_slow.py").write_text(SLOW)
    environment = os.environ | {"PYTHONPATH": str(mutate.ROOT)}
    command = [sys.executable, "-c", SESSION]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "''\n", done.stdout + done.stderr


@pytest.mark.heavy
def test_mutants_by_chance_are_noticed_or_explained(tmp_path: Path) -> None:
    """In a process of its own: every test there has the library of a mutant."""
    out = tmp_path / "mutation.json"
    command = [sys.executable, "-m", "estimator_c.evidence.mutate", "--sample", "6", "--out", str(out)]
    done = subprocess.run(command, cwd=mutate.ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(out.read_text())["fates"]["killed"] >= 2
