"""A sample of `make kills`: each command, each signal, one instant."""

from __future__ import annotations

import itertools
import signal
import sys
import threading
from pathlib import Path

import pytest

from analogrig.signals import Interrupted, interruption
from tests.soak.kills import CASES, SIGNALS, duration_s, instants, kill, prepared

SEED, KILLS = 1995, 1


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared(tmp_path_factory.mktemp("kills") / "before")


@pytest.fixture(scope="module")
def durations_s(before: Path) -> dict[str, float]:
    return {name: duration_s(case, before) for name, case in CASES.items()}


@pytest.mark.heavy
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("name", "number"), list(itertools.product(CASES, SIGNALS)))
def test_killed_command_leaves_no_process_and_no_result_that_is_none(
    name: str, number: signal.Signals, before: Path, durations_s: dict[str, float]
) -> None:
    for after_s in instants(name, number, KILLS, SEED, durations_s[name]):
        sys.stdout.write(f"{name}, {number.name} after {after_s:.3f} s\n")
        kill(CASES[name], number, before, after_s)


def test_thread_that_was_interrupted_before_it_began_is_an_interruption() -> None:
    """A pool of workers raises so when a signal comes between its making and its start."""

    def start() -> None:
        try:
            raise Interrupted("SIGTERM")
        finally:
            threading.Thread().join()

    with pytest.raises(RuntimeError, match="cannot join thread before it is started") as error:
        start()
    assert isinstance(interruption(error.value), Interrupted)
