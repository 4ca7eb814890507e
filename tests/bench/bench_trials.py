"""Speed of closed-loop trials with circuit, card and estimator in one process, and the gain by a second process.

python -m tests.bench trials

Rates are by CPU time, which neighbours on the machine spoil less than time on the wall; of the certificate both are
given, its start included. What a second worker is worth is given by the wall too, which only means something on a
machine that is idle otherwise.
"""

from __future__ import annotations

import dataclasses
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

from analogrig.campaigns.together import DIRECT_BLOCK_SAMPLES, DirectBench, direct_bench
from analogrig.devices.registry import describe
from analogrig.rigs.description import open_rig
from analogrig.rigs.emulator import EmulatorRig
from analogrig.scenario import Scenario

from .figure import Figure

REPEATS = 5
"""Number of repetitions, of which the best is reported: the machine is shared."""

LONG_N, THESIS_LATER_N = 100_000, 20_000

_INDEPENDENT = ("--burst", "1")

LONG_CERTIFICATE = (
    "certify",
    "--dut",
    "inproc",
    "--far",
    "6e-7",
    "--confidence",
    "0.999",
    "--allowed",
    "20",
    *_INDEPENDENT,
)
"""63 million samples: the workers' start is a small part of it."""

CERTIFICATE = ("certify", "--dut", "inproc", "--far", "1e-5", "--confidence", "0.999", "--allowed", "5", *_INDEPENDENT)


def figures() -> Iterator[Figure]:
    """Rates in samples per second; seconds of the strictest certificate."""
    rig = open_rig("emulator")
    assert isinstance(rig, EmulatorRig)
    for name, scenario, count in _cases():
        for what, alarms_only in (("alarms alone", True), ("whole run", False)):
            bench = direct_bench(rig, describe("inproc"), alarms_only=alarms_only)
            yield Figure(f"trials, {name}: {what}", _rate(bench.play, scenario, count), "samples/s of CPU time")
        if scenario.samples <= DIRECT_BLOCK_SAMPLES:
            rate = _rate_together(bench, scenario, count)
            yield Figure(f"trials, {name}: whole runs, {count} together", rate, "samples/s of CPU time")
    alone, together = _processes(1), _processes(2)
    yield Figure("trials: two processes", together, "samples/s of CPU time", "one process", ratio=together / alone)
    one_s, two_s = (_certificate(*LONG_CERTIFICATE, "--workers", count)[0] for count in "12")
    yield Figure("certificate of 63 million samples, two workers", two_s, "s on the wall", "one", ratio=one_s / two_s)
    wall_s = min(_certificate(*CERTIFICATE)[0] for _ in range(REPEATS))
    cpu_s = min(_certificate(*CERTIFICATE, "--workers", "1")[1] for _ in range(REPEATS))
    yield Figure("certificate of 1.65 million samples", wall_s, "s on the wall")
    yield Figure("certificate of 1.65 million samples, one worker", cpu_s, "s of CPU time")


def _cases() -> Iterator[tuple[str, Scenario, int]]:
    healthy, thesis = Scenario.load("healthy"), Scenario.load("thesis")
    yield f"healthy, {LONG_N} samples", dataclasses.replace(healthy, samples=LONG_N), 4
    later = tuple(dataclasses.replace(change, sample=change.sample + THESIS_LATER_N) for change in thesis.changes)
    longer = dataclasses.replace(thesis, samples=thesis.samples + THESIS_LATER_N, changes=later)
    yield f"the thesis's changes in {longer.samples} samples", longer, 20
    yield f"the thesis's changes in {thesis.samples} samples", thesis, 100
    short = dataclasses.replace(thesis, samples=300, changes=(dataclasses.replace(thesis.changes[0], sample=200),))
    yield f"one change in {short.samples} samples", short, 200


def _rate(play: Callable[[Scenario, int], object], scenario: Scenario, count: int) -> float:
    """Best of REPEATS."""
    play(scenario, 0)
    best_s = float("inf")
    for _ in range(REPEATS):
        start_s = time.process_time()
        for seed in range(count):
            play(scenario, seed)
        best_s = min(best_s, time.process_time() - start_s)
    return count * scenario.samples / best_s


def _rate_together(bench: DirectBench, scenario: Scenario, count: int) -> float:
    """Rate of runs that are played together; best of REPEATS."""

    def play(_: Scenario, batch: int) -> None:
        bench.play_all(scenario, range(batch * count, (batch + 1) * count))

    return _rate(play, scenario, 2) * count


def rate_of_this_process() -> float:
    """Rate of long healthy trials, by CPU time."""
    rig = open_rig("emulator")
    assert isinstance(rig, EmulatorRig)
    _, scenario, count = next(_cases())
    return _rate(direct_bench(rig, describe("inproc"), alarms_only=True).play, scenario, count)


def _processes(count: int) -> float:
    """Sum of the rates of so many processes at the same time."""
    program = f"from {__name__} import rate_of_this_process; print(rate_of_this_process())"
    running = [subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) for _ in range(count)]
    return sum(float(process.communicate()[0]) for process in running)


def _certificate(*command: str) -> tuple[float, float]:
    """Wall-clock and CPU time of a command, start and end included. Its length does not depend on the answer."""
    before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    words = [sys.executable, "-m", "analogrig.cli", *command]
    status = subprocess.run(words, stdout=subprocess.DEVNULL, check=False).returncode
    if status not in (0, 1, 3):
        raise RuntimeError(f"{' '.join(command)} ended with {status}")
    wall_s, after = time.perf_counter() - start_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
