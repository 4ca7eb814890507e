"""Detectors at the same measured ARL0: the shipped device, the thesis's triggers, a GLR test that knows the plants, and
estimators of packages from PyPI.

python -m tests.bench.bench_detectors [--quick] [DETECTOR ...]

The level of each detector is calibrated by the first alarms of fresh devices whose plant does not change: counting the
alarms of one long run would measure a device that its own alarms have altered. The ARL0 at that level is measured again
with other seeds. ``--quick`` is for a look at the table, with a low ARL0 and few runs.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.answers import Samples
from analogrig.bench import Bench
from analogrig.campaigns.together import direct_bench
from analogrig.judging.courses import first_at_level
from analogrig.judging.information import change_information
from analogrig.judging.statistics import lower_rate, upper_rate
from analogrig.judging.verdict import judge
from analogrig.run import Run
from analogrig.scenario import PotChange, Scenario

from .detectors import CANDIDATES, CHANGES, HOLD_OFF_N, PACKAGES, SIGNS, WARM_UP_N, Candidate, changed_plant, emulator
from .figure import Figure

FIRST_CHANGE_N, INSTANTS_N, AFTER_N = 600, 100, 300
"""Earliest sample of a change; number of instants, one period of the excitation; samples after the change."""

CALIBRATION_SEED, CONTROL_SEED, CHANGE_SEED = 10_000, 20_000, 30_000
"""First seeds."""

CONFIDENCE = 0.95

LEVEL_RATIO = 1.005
"""Precision of the calibrated levels."""

JOBS = 2

NOTE = f"""\
All detectors meet the same samples, from the shipped emulator. The changes are 20 % upwards or
downwards; those of B and K at once have opposite directions. They spread over a period of the
excitation.

A level is calibrated by the first alarms of fresh devices. The ARL0 of the table is measured with
other seeds, and has its {CONFIDENCE:.0%} confidence interval. Warm-up: {WARM_UP_N} samples. Hold-off, but for
ours: {HOLD_OFF_N} samples.

A delay is the mean over the detected changes, divided by the mean information bound. In brackets:
two standard errors either side. A change without an alarm within {AFTER_N} samples is missed. Alarms
after the detection are repeated ones.

The GLR test knows the equations of the plant before and after every change. It does not know the
amplifiers of the computer. The detectors of packages take the size of the prediction error. The
mean between faults alarms mostly just after it is armed: its ARL0 holds for this length of runs
alone.
"""
"""Paragraphs below the table."""


@dataclass(frozen=True)
class Effort:
    """Numbers of runs."""

    arl0: float = 1e4
    """Mean time between false alarms to which the levels are calibrated, in samples."""
    calibration_runs: int = 40
    control_runs: int = 60
    run_n: int = 10_000
    """Armed samples of these runs."""
    trials: int = 64
    """Runs of each change."""


QUICK = Effort(arl0=200.0, calibration_runs=3, control_runs=3, run_n=500, trials=2)


def figures(effort: Effort = Effort(), names: Sequence[str] = tuple(CANDIDATES), jobs: int = JOBS) -> Iterator[Figure]:
    """Figures of the detectors whose packages are installed."""
    if missing := {package for name in names for package in CANDIDATES[name].missing}:
        print(f"absent: {', '.join(sorted(missing))}: .venv/bin/pip install --no-deps {' '.join(PACKAGES)}")
    present = [name for name in names if not CANDIDATES[name].missing]
    if jobs == 1:
        for name in present:
            yield from measure(name, effort)
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        rows = {name: pool.submit(measure, name, effort) for name in reversed(present)}  # the last one takes longest
        for name in present:
            yield from rows[name].result()


def measure(name: str, effort: Effort) -> list[Figure]:
    """Calibrate a detector and return its row of the table."""
    candidate = CANDIDATES[name]
    level = calibrate(candidate, effort)
    value, setting = candidate.setting(level)
    versions = ", ".join(f"{package} {importlib.metadata.version(package)}" for package in candidate.packages)
    return [
        Figure(f"{name}: setting", value, setting, versions),
        _arl0_figure(name, candidate, level, effort),
        *_change_figures(name, candidate, level, effort),
        Figure(f"{name}: CPU time", _cost_us(candidate, level, effort), "us a sample"),
    ]


# --------------------------------------------------------------------------------------------------------- false alarms


def calibrate(candidate: Candidate, effort: Effort) -> float:
    """Lowest level with the ARL0 asked, by bisection on the same runs."""
    first_alarms = _first_alarms_by_level(candidate, effort)
    low, high = candidate.levels
    while high / low > LEVEL_RATIO:
        level = math.sqrt(low * high)
        if _arl0(first_alarms(level), effort)[0] < effort.arl0:
            low = level
        else:
            high = level
    return high


def _first_alarms_by_level(candidate: Candidate, effort: Effort) -> Callable[[float], NDArray[np.int64]]:
    """Function from a level to ``_first_alarms`` of the calibration runs.

    Up to its first alarm a device does not depend on its level. If it reports its statistic, the runs are played once.
    """
    seeds = range(CALIBRATION_SEED, CALIBRATION_SEED + effort.calibration_runs)
    bench = _bench(candidate, candidate.levels[1])
    if not bench.dut.datasheet.statistic:
        return lambda level: _first_alarms(candidate, level, seeds, effort)
    highest = [np.maximum.accumulate(run.statistic[WARM_UP_N:]) for run in _healthy(bench, seeds, effort)]
    return lambda level: np.array([np.searchsorted(each, level) for each in highest])


def _first_alarms(candidate: Candidate, level: float, seeds: Sequence[int], effort: Effort) -> NDArray[np.int64]:
    """Armed samples before the first alarm of each run; ``run_n`` without one."""
    runs = _healthy(_bench(candidate, level), seeds, effort)
    return np.array([run.alarm_index[0] - WARM_UP_N if len(run.alarm_index) else effort.run_n for run in runs])


def _arl0(first_alarms: NDArray[np.int64], effort: Effort) -> tuple[float, tuple[float, float], int, int]:
    """ARL0, its confidence interval, number of alarms and exposure in samples.

    First alarms of fresh devices are independent, whatever bursts follow them.
    """
    alarms = int(np.count_nonzero(first_alarms < effort.run_n))
    exposure = int(first_alarms.sum()) + alarms
    low, high = (bound(alarms, exposure, 0.5 * (1.0 + CONFIDENCE)) for bound in (lower_rate, upper_rate))
    return _inverse(alarms / exposure), (_inverse(high), _inverse(low)), alarms, exposure


def _inverse(rate: float) -> float:
    return 1.0 / rate if rate else math.inf


def _arl0_figure(name: str, candidate: Candidate, level: float, effort: Effort) -> Figure:
    seeds = range(CONTROL_SEED, CONTROL_SEED + effort.control_runs)
    arl0, bounds, alarms, exposure = _arl0(_first_alarms(candidate, level, seeds, effort), effort)
    return Figure(f"{name}: ARL0", arl0, "samples", f"{alarms} alarms in {exposure}", bounds=bounds)


def _healthy(bench: Bench, seeds: Sequence[int], effort: Effort) -> Iterator[Run]:
    """Runs without a change."""
    scenario = dataclasses.replace(Scenario.load("healthy"), samples=WARM_UP_N + effort.run_n)
    return (_sound(bench.play(scenario, seed)) for seed in seeds)


def _bench(candidate: Candidate, level: float) -> Bench:
    return direct_bench(emulator(), candidate.device(level), alarms_only=True)


def _sound(run: Run) -> Run:
    """The run, which nothing may have cut short."""
    assert not run.conditions.faults, run.conditions.faults
    return run


# -------------------------------------------------------------------------------------------------------------- changes


@dataclass(frozen=True)
class _Trial:
    """One change, and the alarms of the device."""

    latency_n: int | None
    bound_n: int
    before: int
    """Alarms before the change."""
    after: int
    """Alarms after the one that detected it."""


def _change_figures(name: str, candidate: Candidate, level: float, effort: Effort) -> Iterator[Figure]:
    """Mean delays over the mean bounds, with two standard errors either side; misses; false alarms."""
    bench = _bench(candidate, level)
    trials = {what: [_play_change(bench, what, trial, effort) for trial in range(effort.trials)] for what in CHANGES}
    for what, played in trials.items():
        detected = [each for each in played if each.latency_n is not None]
        if len(detected) < 2:
            continue
        latency, bound = np.array([(each.latency_n, each.bound_n) for each in detected], dtype=float).T
        ratio = latency.mean() / bound.mean()
        error = (latency - ratio * bound).std(ddof=1) / math.sqrt(len(detected)) / bound.mean()
        bounds = (float(ratio - 2.0 * error), float(ratio + 2.0 * error))
        yield Figure(f"{name}: mean delay, {what}", float(ratio), "mean bounds", bounds=bounds)
    missed = {what: sum(each.latency_n is None for each in played) for what, played in trials.items()}
    by_change = ", ".join(f"{what}: {count}" for what, count in missed.items())
    yield Figure(f"{name}: missed", sum(missed.values()), f"of {effort.trials * len(trials)}", by_change)
    every = [each for played in trials.values() for each in played]
    before, after = sum(each.before for each in every), sum(each.after for each in every)
    yield Figure(f"{name}: false alarms", before + after, "alarms", f"{before} before the change, {after} repeated")


def _play_change(bench: Bench, what: str, trial: int, effort: Effort) -> _Trial:
    """Play one change; the instants spread over a period of the excitation."""
    instant = FIRST_CHANGE_N + trial * 37 % INSTANTS_N
    plant = changed_plant(what, SIGNS[trial % len(SIGNS)])
    change = PotChange(instant, plant.parameters())
    scenario = dataclasses.replace(Scenario.load("healthy"), samples=instant + AFTER_N, changes=(change,))
    seed = CHANGE_SEED + 1000 * list(CHANGES).index(what) + trial
    run = _sound(bench.play(scenario, seed))
    bound_n = first_at_level(change_information(run)[0], math.log(effort.arl0))
    assert bound_n is not None, f"{what} at {instant}, seed {seed}: not detectable"
    verdict = judge(run)
    before = sum(index < instant for index in verdict.false_alarms)
    return _Trial(verdict.changes[0].latency_n, bound_n, before, len(verdict.false_alarms) - before)


# ----------------------------------------------------------------------------------------------------------------- cost


def _cost_us(candidate: Candidate, level: float, effort: Effort) -> float:
    """CPU time a sample in one healthy run, with its adapter; the least of three."""
    bench = _bench(candidate, level)
    (run,) = _healthy(bench, [CONTROL_SEED], effort)
    u, y, *_ = run.codes.T
    block = Samples(0, np.ascontiguousarray(u), np.ascontiguousarray(y), np.ones(run.samples, np.bool_))
    times_s = []
    for _ in range(3):
        bench.dut.start()
        begun_s = time.process_time()
        list(bench.dut.play([block]))
        times_s.append(time.process_time() - begun_s)
    return 1e6 * min(times_s) / run.samples


def main(words: Sequence[str]) -> None:
    """Print the figures; bench.json keeps those of all detectors with full effort."""
    names = [word for word in words if word != "--quick"] or list(CANDIDATES)
    for figure in figures(QUICK if "--quick" in words else Effort(), names):
        print(figure, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
