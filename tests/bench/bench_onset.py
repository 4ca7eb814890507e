"""Dating of pot changes from the samples: coverage of the interval, and its width beside the least
that any could have. Trials of tests.harness.dating_trials; fixed seeds.

python -m tests.bench.bench_onset [jump] [ramp] [still] [several]
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from analogrig.judging.statistics import lower_rate
from analogrig.rigs.rig import Rig
from analogrig_instruments.by_hand import PlannedChange, contradictions
from analogrig_instruments.dating.instants import Instant, NoInstant, TurnInstants, date_jump
from tests.harness.allowed import open_allowed
from tests.harness.dating_trials import Clock, Several, Trial, still
from tests.served.serving import serving

from .figure import Figure

JUMPS_N, RAMPS_N, STILL_N, SEVERAL_N = 500, 100, 100, 50
CLOCKS: tuple[Clock, ...] = ("card", "free")

WRONG_BY_N = (2, 5, 10, 30, 100)
SIZES = {"below 10 %": 0.1, "below 20 %": 0.2, "below 40 %": 0.4, "more": 1.0}
"""Largest change of each class, as a part of the larger value."""
WRONG_N = 25
"""Number of records in which every given instant is wrong."""

Found = TypeVar("Found", Instant, TurnInstants)


def jumps(trials: int = JUMPS_N) -> Iterator[Figure]:
    """Changes of 5 to 50 % of one or two parameters; at 99 % confidence the coverage is above its first bound."""
    for clock in CLOCKS:
        name = f"jump, clock {clock}"
        pairs, each_ms = _searched(Trial.jump, Trial.date_jump, Instant, clock, trials)
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
        pairs, each_ms = _searched(Trial.ramp, Trial.date_turn, TurnInstants, clock, trials)
        begins = [_holds(found.begin, of.sample) for of, found in pairs]
        ends = [_holds(found.end, of.sample + of.ramp_n) for of, found in pairs]
        yield _coverage(f"{name}: begins within the interval", begins, trials)
        yield _coverage(f"{name}: ends within the interval", ends, trials)
        yield _width(f"{name}: mean width of the begin", [found.begin for _, found in pairs], "of ramps of 20 to 600")
        yield Figure(f"{name}: CPU time", each_ms, "ms")


def _searched(
    play: Callable[[int, Clock], Trial],
    search: Callable[[Trial], Found | NoInstant],
    kind: type[Found],
    clock: Clock,
    trials: int,
) -> tuple[list[tuple[Trial, Found]], float]:
    """Trials in which something was found, with it; and the CPU time of one search, ms."""
    played = [play(seed, clock) for seed in range(trials)]
    begun_s = time.process_time()
    found = [search(trial) for trial in played]
    each_ms = 1e3 * (time.process_time() - begun_s) / trials
    return [(trial, each) for trial, each in zip(played, found, strict=True) if isinstance(each, kind)], each_ms


def _holds(interval: Instant, sample: int) -> bool:
    return interval.low <= sample <= interval.high


def _width(name: str, intervals: Sequence[Instant], remark: str) -> Figure:
    widths = np.array([each.high - each.low + 1 for each in intervals])
    return Figure(name, float(widths.mean()), f"samples; median {np.median(widths):.0f}; {remark}")


def quiet(trials: int = STILL_N) -> Iterator[Figure]:
    """Records in which a planned pot change was left out."""
    for clock in CLOCKS:
        said = [isinstance(still(seed, clock).date_jump(), NoInstant) for seed in range(trials)]
        yield _coverage(f"no turn, clock {clock}: said so", said, trials)


def several(records: int = SEVERAL_N) -> Iterator[Figure]:
    """Eight pot changes a record, each searched between its neighbours; then with wrong instants given."""
    for clock in CLOCKS:
        yield from _told(f"several, clock {clock}", [Several.of(seed, clock) for seed in range(records)])
    with _served() as rig:
        every = [Several.of(seed, "card", rig) for seed in range(records)]
    yield from _told("several, served", every)
    yield from _wrong("several, served", every[:WRONG_N])


@contextlib.contextmanager
def _served() -> Iterator[Rig]:
    with (
        serving() as instrument,
        tempfile.TemporaryDirectory() as folder,
        open_allowed(str(instrument.rigs_file(Path(folder)))) as rig,
    ):
        yield rig


def _told(name: str, every: Sequence[Several]) -> Iterator[Figure]:
    held, unseen, silent = [], 0, []
    for record in every:
        for change, alone in record.stretches():
            search = range(alone.start + 1, alone.stop - 1)
            found = date_jump(record.signals, change.before, change.after, search, within=alone)
            held.append(isinstance(found, Instant) and _holds(found, change.sample))
            unseen += isinstance(found, NoInstant)
            silent.append(not _doubted(record, change, alone, 0))
    yield _coverage(f"{name}: instants within the interval", held, len(held))
    yield Figure(f"{name}: nothing found", unseen, f"of {len(held)}")
    yield _coverage(f"{name}: true instants that are not doubted", silent, len(silent))


def _wrong(name: str, every: Sequence[Several]) -> Iterator[Figure]:
    """Figures by the error of the given instant, either way, and by the size of the change."""
    for error_n in WRONG_BY_N:
        said: dict[str, list[bool]] = {size: [] for size in SIZES}
        for record in every:
            for change, alone in record.stretches():
                said[_size(change)] += [_doubted(record, change, alone, each) for each in (-error_n, error_n)]
        by_size = ", ".join(f"{size}: {np.mean(each):.2f} of {len(each)}" for size, each in said.items())
        share = float(np.mean(np.concatenate(list(said.values()))))
        yield Figure(f"{name}: doubted if wrong by {error_n} samples", share, by_size)


def _size(change: PlannedChange) -> str:
    (old, new), *_ = change.before.changes_to(change.after).values()
    part = 1.0 - min(old, new) / max(old, new)
    return next(size for size, most in SIZES.items() if part < most)


def _doubted(record: Several, change: PlannedChange, alone: range, error_n: int) -> bool:
    """True if the change alone contradicts an instant that is given ``error_n`` samples off."""
    first = alone.start - 1
    told = dataclasses.replace(change, sample=change.sample - first + error_n)
    return bool(contradictions(record.signals.part(first, alone.stop), [told], first))


def _coverage(name: str, held: list[bool], trials: int) -> Figure:
    remark = (
        f"of {len(held)}; {trials - len(held)} of {trials} trials without an onset"
        if len(held) < trials
        else f"of {trials}"
    )
    return Figure(name, sum(held) / len(held), remark, bounds=(lower_rate(sum(held), len(held), 0.99), 1.0))


PARTS: Mapping[str, Callable[[], Iterator[Figure]]] = {"jump": jumps, "ramp": ramps, "still": quiet, "several": several}


def figures(*parts: str) -> Iterator[Figure]:
    """Figures of the named parts, or of all."""
    for part in parts or PARTS:
        yield from PARTS[part]()


if __name__ == "__main__":
    for figure in figures(*sys.argv[1:]):
        print(figure, flush=True)
