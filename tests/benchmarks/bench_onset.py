"""How well the instant of a turn is learned from the samples: coverage of its interval, and its width beside the least
that any could have. Trials of tests.harness.onsets; fixed seeds.

python -m tests.benchmarks.bench_onset [jump] [ramp] [still]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from harness.onset.jump import NoOnset, Onset
from harness.onset.turn import SlowTurn
from harness.statistics import lower_rate
from tests.harness.onsets import Clock, Trial, still

from .figure import Figure

JUMPS_N, RAMPS_N, STILL_N = 500, 100, 100
CLOCKS: tuple[Clock, ...] = ("card", "free")


def jumps(trials: int = JUMPS_N) -> Iterator[Figure]:
    """Changes of 5 to 50 % of one or two parameters; at 99 % confidence the coverage is above its first bound."""
    for clock in CLOCKS:
        played = [Trial.jump(seed, clock) for seed in range(trials)]
        begun_s = time.process_time()
        found = [trial.found() for trial in played]
        each_ms = 1e3 * (time.process_time() - begun_s) / trials
        pairs = [(trial, each) for trial, each in zip(played, found, strict=True) if isinstance(each, Onset)]
        held = [each.low <= trial.sample <= each.high for trial, each in pairs]
        yield _coverage(f"jump, clock {clock}: instants within the interval", held, trials)
        widths = np.array([each.high - each.low + 1 for _, each in pairs])
        bounds = np.array([trial.width_bound() for trial, _ in pairs])
        remark = (
            f"samples; median {np.median(widths):.0f}; nobody could tell {bounds.mean():.1f}, median"
            f" {np.median(bounds):.0f}"
        )
        yield Figure(f"jump, clock {clock}: mean width", float(widths.mean()), remark)
        yield Figure(f"jump, clock {clock}: CPU time for a range of 600 samples", each_ms, "ms")


def ramps(trials: int = RAMPS_N) -> Iterator[Figure]:
    """Even turns of 10 to 50 % of one parameter in 20 to 600 samples."""
    for clock in CLOCKS:
        played = [Trial.ramp(seed, clock) for seed in range(trials)]
        begun_s = time.process_time()
        found = [trial.turned() for trial in played]
        each_ms = 1e3 * (time.process_time() - begun_s) / trials
        pairs = [(trial, each) for trial, each in zip(played, found, strict=True) if isinstance(each, SlowTurn)]
        begins = [each.begin.low <= trial.sample <= each.begin.high for trial, each in pairs]
        ends = [each.end.low <= trial.sample + trial.ramp_n <= each.end.high for trial, each in pairs]
        yield _coverage(f"ramp, clock {clock}: begins within the interval", begins, trials)
        yield _coverage(f"ramp, clock {clock}: ends within the interval", ends, trials)
        widths = np.array([each.begin.high - each.begin.low + 1 for _, each in pairs])
        remark = f"samples; median {np.median(widths):.0f}; of ramps of 20 to 600 samples"
        yield Figure(f"ramp, clock {clock}: mean width of the begin", float(widths.mean()), remark)
        yield Figure(f"ramp, clock {clock}: CPU time", each_ms, "ms")


def quiet(trials: int = STILL_N) -> Iterator[Figure]:
    """Pots that were to be turned, and were not."""
    for clock in CLOCKS:
        said = [isinstance(still(seed, clock).found(), NoOnset) for seed in range(trials)]
        yield _coverage(f"no turn, clock {clock}: said so", said, trials)


def _coverage(name: str, held: list[bool], trials: int) -> Figure:
    remark = (
        f"of {len(held)}; {trials - len(held)} of {trials} trials without an onset"
        if len(held) < trials
        else f"of {trials}"
    )
    return Figure(name, sum(held) / len(held), remark, bounds=(lower_rate(sum(held), len(held), 0.99), 1.0))


PARTS: Mapping[str, Callable[[], Iterator[Figure]]] = {"jump": jumps, "ramp": ramps, "still": quiet}


def figures(*parts: str) -> Iterator[Figure]:
    """The rows of the parts named, or of all."""
    for part in parts or PARTS:
        yield from PARTS[part]()


if __name__ == "__main__":
    for figure in figures(*sys.argv[1:]):
        print(figure, flush=True)
