"""How well the instant of a turn is learned from the samples: coverage of its interval, and its width beside the least
that any could have. Trials of tests.harness.onsets; fixed seeds.

python -m tests.benchmarks.bench_onset [jump] [ramp] [still]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np

from harness.onset.jump import NoOnset, Onset
from harness.onset.turn import SlowTurn
from harness.statistics import lower_rate
from tests.harness.onsets import Clock, Trial, still

from .figure import Figure

JUMPS_N, RAMPS_N, STILL_N = 500, 100, 100
CLOCKS: tuple[Clock, ...] = ("card", "free")

Found = TypeVar("Found", Onset, SlowTurn)


def jumps(trials: int = JUMPS_N) -> Iterator[Figure]:
    """Changes of 5 to 50 % of one or two parameters; at 99 % confidence the coverage is above its first bound."""
    for clock in CLOCKS:
        name = f"jump, clock {clock}"
        pairs, each_ms = _searched(Trial.jump, Trial.found, Onset, clock, trials)
        yield _coverage(
            f"{name}: instants within the interval", [_holds(found, of.sample) for of, found in pairs], trials
        )
        bounds = np.array([of.width_bound() for of, _ in pairs])
        remark = f"nobody could tell {bounds.mean():.1f}, median {np.median(bounds):.0f}"
        yield _width(f"{name}: mean width", [found for _, found in pairs], remark)
        yield Figure(f"{name}: CPU time for a range of 600 samples", each_ms, "ms")


def ramps(trials: int = RAMPS_N) -> Iterator[Figure]:
    """Even turns of 10 to 50 % of one parameter in 20 to 600 samples."""
    for clock in CLOCKS:
        name = f"ramp, clock {clock}"
        pairs, each_ms = _searched(Trial.ramp, Trial.turned, SlowTurn, clock, trials)
        begins = [_holds(found.begin, of.sample) for of, found in pairs]
        ends = [_holds(found.end, of.sample + of.ramp_n) for of, found in pairs]
        yield _coverage(f"{name}: begins within the interval", begins, trials)
        yield _coverage(f"{name}: ends within the interval", ends, trials)
        yield _width(f"{name}: mean width of the begin", [found.begin for _, found in pairs], "of ramps of 20 to 600")
        yield Figure(f"{name}: CPU time", each_ms, "ms")


def _searched(
    play: Callable[[int, Clock], Trial],
    search: Callable[[Trial], Found | NoOnset],
    kind: type[Found],
    clock: Clock,
    trials: int,
) -> tuple[list[tuple[Trial, Found]], float]:
    """The trials of which something was found, with it; and the CPU time of one search, ms."""
    played = [play(seed, clock) for seed in range(trials)]
    begun_s = time.process_time()
    found = [search(trial) for trial in played]
    each_ms = 1e3 * (time.process_time() - begun_s) / trials
    return [(trial, each) for trial, each in zip(played, found, strict=True) if isinstance(each, kind)], each_ms


def _holds(interval: Onset, sample: int) -> bool:
    return interval.low <= sample <= interval.high


def _width(name: str, intervals: Sequence[Onset], remark: str) -> Figure:
    widths = np.array([each.high - each.low + 1 for each in intervals])
    return Figure(name, float(widths.mean()), f"samples; median {np.median(widths):.0f}; {remark}")


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
