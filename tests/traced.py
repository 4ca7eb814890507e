"""Files of the core that one sample, one alarm and one device file pass through; part of `make metrics`.

python -m tests.traced prints the figures as JSON, with --files the files of each instead. A file counts when one of its
functions runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from analogrig import Bench, Run, Scenario, judge, open_dut, open_rig
from analogrig.reporting import render

CORE = str(Path(__file__).parents[1] / "harness" / "analogrig") + os.sep

SHORT_N, LONG_N = 200, 400
"""Samples of two plays; their difference is the cost of a sample."""

DEVICE_FILE = 'kind = "inproc"\n'


@dataclasses.dataclass
class Trace:
    """Functions of the core in the order in which they run."""

    calls: Counter[str] = dataclasses.field(default_factory=Counter)
    """Number of calls of functions of each file."""
    functions: set[tuple[str, str]] = dataclasses.field(default_factory=set)
    changes: int = 0
    """Calls of a function that stands in another file than the one called before."""
    last: str = ""

    @property
    def files(self) -> set[str]:
        return {*self.calls}

    def see(self, frame: FrameType, event: str, _: object) -> None:
        """Take one event of ``sys.setprofile``. Modules that are being imported do not count."""
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(CORE) or code.co_name == "<module>":
            return
        name = code.co_filename.removeprefix(CORE)
        self.calls[name] += 1
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


class Walks(NamedTuple):
    """Walks through the core."""

    short: Trace
    """Play of SHORT_N samples without a change."""
    long: Trace
    """Play of LONG_N samples without a change."""
    alarm: set[str]
    """Files with functions that run only if there is an alarm."""
    opened: Trace
    """Opening of a device file."""

    @property
    def sample(self) -> set[str]:
        """Files with functions that run oftener for more samples."""
        return {name for name, calls in self.long.calls.items() if calls > self.short.calls[name]}


def walks() -> Walks:
    short, long = (traced(lambda n=n: play(n, 0)) for n in (SHORT_N, LONG_N))  # type: ignore[misc]
    quiet, alarmed = play(1800, 0), play(1800, 1)
    assert not len(quiet.alarm_index) and len(alarmed.alarm_index)
    played = [traced(lambda n=n: play(1800, n)) for n in (0, 1)]  # type: ignore[misc]
    judged = [traced(lambda run=run: render(run, judge(run))) for run in (quiet, alarmed)]  # type: ignore[misc]
    alarm = {name for pair in (played, judged) for name, _ in pair[1].functions - pair[0].functions}
    with tempfile.NamedTemporaryFile("w", suffix=".toml") as file:
        file.write(DEVICE_FILE)
        file.flush()
        opened = traced(lambda: open_file(file.name))
    return Walks(short, long, alarm, opened)


def figures(found: Walks) -> dict[str, int]:
    sample = (found.long.changes - found.short.changes) / (LONG_N - SHORT_N)
    return {
        "changes of file of a sample over inproc": round(sample),
        "files whose functions run for an alarm alone": len(found.alarm),
        "files that opening a device file passes": len(found.opened.files),
    }


def text(found: Walks) -> str:
    """Files of each walk, a heading and a file a line."""
    files = {"a sample over inproc": found.sample, "an alarm alone": found.alarm, "a device file": found.opened.files}
    return "".join(f"{walk}:\n" + "".join(f"  {name}\n" for name in sorted(names)) for walk, names in files.items())


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.traced", description="count the files of three walks")
    parser.add_argument("--files", action="store_true", help="print the files of each walk instead")
    arguments = parser.parse_args()
    found = walks()
    sys.stdout.write(text(found) if arguments.files else json.dumps(figures(found)))


if __name__ == "__main__":
    main()
