"""Files of the core that one sample, one alarm and one device file pass through; part of `make metrics`.

python -m tests.traced prints the figures as JSON. A file counts when one of its functions runs.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from analogrig import Bench, Run, Scenario, judge, open_dut, open_rig
from analogrig.reporting import render

CORE = str(Path(__file__).parents[1] / "harness" / "analogrig") + os.sep

SHORT_N, LONG_N = 200, 400
"""Samples of two plays; their difference is the cost of a sample."""

DEVICE_FILE = 'kind = "inproc"\n'


@dataclasses.dataclass
class Trace:
    """Functions of the core in the order in which they run."""

    files: set[str] = dataclasses.field(default_factory=set)
    functions: set[tuple[str, str]] = dataclasses.field(default_factory=set)
    changes: int = 0
    """Calls of a function that stands in another file than the one called before."""
    last: str = ""

    def see(self, frame: FrameType, event: str, _: object) -> None:
        """Take one event of ``sys.setprofile``. Modules that are being imported do not count."""
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(CORE) or code.co_name == "<module>":
            return
        name = code.co_filename.removeprefix(CORE)
        self.files.add(name)
        self.functions.add((name, code.co_qualname))
        self.changes += name != self.last
        self.last = name


@contextmanager
def tracing() -> Iterator[Trace]:
    trace = Trace()
    sys.setprofile(trace.see)
    try:
        yield trace
    finally:
        sys.setprofile(None)


def traced(act: Callable[[], object]) -> Trace:
    """Trace of ``act`` in its second run: the first imports what it needs."""
    act()
    with tracing() as trace:
        act()
    return trace


def play(samples: int, changes: int) -> Run:
    """A play of the scenario thesis on the emulator, with its first ``changes`` changes, through ``inproc``."""
    thesis = Scenario.load("thesis")
    kept = tuple(dataclasses.replace(each, sample=samples // 2) for each in thesis.changes[:changes])
    scenario = dataclasses.replace(thesis, samples=samples, changes=kept)
    with open_rig("emulator") as rig, open_dut("inproc") as dut:
        return Bench(rig, dut).play(scenario, seed=1)


def open_file(path: str) -> None:
    with open_dut(path):
        pass


def figures() -> dict[str, int]:
    short, long = (traced(lambda n=n: play(n, 0)) for n in (SHORT_N, LONG_N))  # type: ignore[misc]
    sample = (long.changes - short.changes) / (LONG_N - SHORT_N)
    quiet, alarmed = play(1800, 0), play(1800, 1)
    assert not len(quiet.alarm_index) and len(alarmed.alarm_index)
    played = [traced(lambda n=n: play(1800, n)) for n in (0, 1)]  # type: ignore[misc]
    judged = [traced(lambda run=run: render(run, judge(run))) for run in (quiet, alarmed)]  # type: ignore[misc]
    alarm = {name for pair in (played, judged) for name, _ in pair[1].functions - pair[0].functions}
    with tempfile.NamedTemporaryFile("w", suffix=".toml") as file:
        file.write(DEVICE_FILE)
        file.flush()
        opened = traced(lambda: open_file(file.name))
    return {
        "changes of file of a sample over inproc": round(sample),
        "files whose functions run for an alarm alone": len(alarm),
        "files that opening a device file passes": len(opened.files),
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(figures()))
