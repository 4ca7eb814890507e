"""Statistics of the estimator: detection delay beside the information bound, false alarms, and errors of estimates.

Plants of tests.estimator_c.plants; at least 400 trials a cell, random phase and onset, fixed seeds, ARL0 = 1e5.

python -m tests.bench.bench_statistics [delay] [free-running] [false-alarms] [false-alarms-free-running] [accuracy]
    [shipped] [start] [random-plants] [random-plants-free-running]

The last four parts play the shipped device with its default settings. Random plants take 1e8 samples and some 100 s on
two cores for each clock, and run only if they are named.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.statistics import lower_rate
from tests.estimator_c.est_driver import Estimator, compile_driver
from tests.estimator_c.performance import (
    ARL0,
    FULL,
    FULL_FREE,
    HORIZON_N,
    OWN_CLOCK,
    QUARTER,
    QUARTER_FREE,
    SHARED_CLOCK,
    Settings,
    accuracy,
    delay,
    false_alarms,
    upper_rate,
)
from tests.estimator_c.plants import (
    FRONT,
    LIGHT,
    PERIOD_S,
    SHOCK,
    Excitation,
    Mechanics,
    plants_of_any_speed,
    random_plants,
    simulate,
)

from .false_alarms import FalseAlarms, count_false_alarms
from .figure import Figure
from .played import Played
from .shipped import ONSET_N, ONSET_SPAN_N, answers_to, exposure_n, shipped


def changes(excitation: Excitation) -> Iterator[tuple[str, float]]:
    """The changes that the customer asks for: parameter and factor."""
    sizes = (0.05, 0.1, 0.2) if excitation.part_of_range == 1.0 else (0.1, 0.2)
    for parameter in "KBM":
        for size in sizes:
            yield from ((parameter, 1.0 + size), (parameter, 1.0 - size))


def delays(
    estimator: Estimator, settings: Settings, excitations: Mapping[Excitation, float], trials: int
) -> Iterator[Figure]:
    """One figure a change; excitations with the allowed ratio."""
    for excitation, limit in excitations.items():
        for seed, (parameter, factor) in enumerate(changes(excitation)):
            found = delay(estimator, settings, (FRONT, FRONT.scaled(parameter, factor)), excitation, trials, seed)
            name = f"{_name(excitation)}: mean delay, {parameter}{100 * (factor - 1):+.0f}%"
            remark = (
                f"limit {limit}: {found.mean_n:.2f} against {found.bound_n:.2f} samples, "
                f"{found.missed} missed, {found.early} early, {trials} trials"
            )
            bounds = (found.ratio - 2 * found.error, found.ratio + 2 * found.error)
            yield Figure(name, found.ratio, "bounds", remark, bounds=bounds)


def _name(excitation: Excitation) -> str:
    part = "full range" if excitation.part_of_range == 1.0 else f"{excitation.part_of_range:g} of the range"
    edges = "" if excitation.on_samples else f", edges anywhere, {excitation.drift_ppm:g} ppm"
    return part + edges


def quietness(
    estimator: Estimator, settings: Settings, excitation: Excitation, samples: int, random_count: int = 50
) -> Iterator[Figure]:
    """Front, shock and M = 30 each by itself; the random ones each, as the worst of them, and together."""
    named = {"front": FRONT, "shock": SHOCK, "M = 30": LIGHT}
    for seed, (name, plant) in enumerate(named.items()):
        found = false_alarms(estimator, settings, plant, excitation, samples, 100 + seed)
        yield _rate(f"{_name(excitation)}: false alarms, {name}", found, samples)
    every = [
        false_alarms(estimator, settings, plant, excitation, samples, 200 + seed)
        for seed, plant in enumerate(random_plants(random_count, seed=1))
    ]
    yield _rate(f"{_name(excitation)}: false alarms, worst of {random_count} random plants", max(every), samples)
    yield _rate(f"{_name(excitation)}: false alarms, {random_count} random plants", sum(every), samples * len(every))


def _rate(name: str, found: int, samples: int) -> Figure:
    upper = upper_rate(found, samples) * ARL0
    return Figure(name, upper, "of 1/ARL0", f"limit 1 at 99 % confidence: {found} alarms in {samples} samples")


def accuracies(estimator: Estimator, settings: Settings, trials: int, samples: int = 200) -> Iterator[Figure]:
    """M, B, K of the front suspension from rest: rms error against the Cramer-Rao bound."""
    found = accuracy(estimator, settings, trials, samples)
    for name, rms, bound in zip("MBK", found.rms, found.bounds, strict=True):
        remark = f"limit 3: {100 * rms:.3f} % against {100 * bound:.3f} % after {samples} samples, {trials} trials"
        yield Figure(f"rms error of {name}", float(rms / bound), "Cramer-Rao bounds", remark)


# -------------------------------------------------------------------------------------------------- the shipped device


@dataclass(frozen=True)
class Cells:
    """Single changes of the front suspension on one clock."""

    name: str
    excitation: Excitation
    limit: float
    """Largest ratio of the mean delay to the mean bound, over all changes."""
    missing: float = 0.0
    """Share of the samples that do not arrive."""


CELLS = (
    Cells("one clock", FULL, 1.10),
    Cells("one clock, 5 % missing", FULL, 1.3, 0.05),
    Cells("one clock, 20 % missing", FULL, 1.8, 0.2),
    Cells("edges anywhere, 20 ppm", FULL_FREE, 1.2),
)

ARL0_SAMPLES = 10_000_000
"""Samples from which an ARL0 is measured."""

RUN_N, LANES = 20_000, 100
"""Samples of a run, and runs that are simulated together."""

START_N = 2_000
"""Samples of a run that shows the rate of false alarms once the trigger is armed."""

WORST = 5
"""Number of random plants with a row of their own."""


def shipped_delays(trials: int = 400, samples: int = ARL0_SAMPLES) -> Iterator[Figure]:
    """Delays of twelve changes at the measured ARL0: means over the cells, and each cell."""
    for cells in CELLS:
        alarms = healthy_alarms(FRONT, cells.excitation, samples, seed=500, missing=cells.missing)
        arl0 = alarms.exposure_n / max(alarms.alarms, 1)
        low, high = (bound(alarms.alarms, alarms.exposure_n, 0.975) for bound in (lower_rate, upper_rate))
        remark = f"{alarms.alarms} alarms in {alarms.exposure_n} samples"
        bounds = (1.0 / high, 1.0 / low if low else math.inf)
        yield Figure(f"shipped, {cells.name}: ARL0", arl0, "samples", remark, bounds=bounds)
        every = []
        for seed, (parameter, factor) in enumerate(itertools.product("KBM", (1.1, 0.9, 1.2, 0.8))):
            played = play_shipped(cells, (parameter, factor), trials, seed)
            every.append(played)
            yield played.figure(f"shipped, {cells.name}: mean delay, {parameter}{100 * (factor - 1):+.0f}%", ARL0)
        together = ShippedDelays.joined(every)
        remark = f"limit {cells.limit}; "
        yield together.figure(f"shipped, {cells.name}: mean delay, all changes", ARL0, remark)
        yield together.figure(f"shipped, {cells.name}: mean delay, all changes, bound at the measured ARL0", arl0)


@dataclass(frozen=True)
class ShippedDelays:
    """Delays of changes, and their information."""

    latency_n: NDArray[np.float64]
    """(t,); HORIZON_N for missed ones."""
    information: NDArray[np.float64]
    """(t, HORIZON_N) after each change."""

    @classmethod
    def joined(cls, parts: Sequence[ShippedDelays]) -> ShippedDelays:
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("latency_n", "information")))

    def figure(self, name: str, arl0: float, remark: str = "") -> Figure:
        """Mean delay over the mean bound at an ARL0, with two standard errors either side."""
        reached = self.information >= math.log(arl0)
        bound_n = np.where(reached.any(axis=1), reached.argmax(axis=1) + 1, HORIZON_N)
        ratio = float(self.latency_n.mean() / bound_n.mean())
        spread = (self.latency_n - ratio * bound_n).std(ddof=1)
        error = float(spread / math.sqrt(len(bound_n)) / bound_n.mean())
        missed = int((self.latency_n >= HORIZON_N).sum())
        means = f"{self.latency_n.mean():.2f} against {bound_n.mean():.2f} samples"
        bounds = (ratio - 2.0 * error, ratio + 2.0 * error)
        counts = f"at ARL0 {arl0:.3g}, {missed} missed, {len(bound_n)} trials"
        return Figure(name, ratio, "bounds", f"{remark}{means} {counts}", bounds=bounds)


def play_shipped(cells: Cells, change: tuple[str, float], trials: int, seed: int) -> ShippedDelays:
    """Play a change in so many trials."""
    rng = np.random.default_rng([seed, 2])
    onset = rng.integers(ONSET_N, ONSET_N + ONSET_SPAN_N, trials)
    samples = ONSET_N + ONSET_SPAN_N + HORIZON_N
    played = simulate((FRONT, FRONT.scaled(*change)), onset, cells.excitation, samples, seed)
    valid = rng.uniform(size=played.u.shape) >= cells.missing
    gained = np.diff(played.information, axis=1, prepend=0.0) * valid
    device = shipped()
    latency_n, information = np.full(trials, float(HORIZON_N)), np.empty((trials, HORIZON_N))
    for trial, last in enumerate(onset.tolist()):
        run = Played(played.u[trial], played.y[trial], valid[trial], gained[trial])
        later = [alarm.index - last for alarm in answers_to(device, run).alarms if alarm.index > last]
        latency_n[trial] = min([*later, HORIZON_N])
        information[trial] = np.cumsum(gained[trial])[last + 1 : last + 1 + HORIZON_N]
    return ShippedDelays(latency_n, information)


def healthy_alarms(
    plant: Mechanics, excitation: Excitation, samples: int, seed: int, missing: float = 0.0, run_n: int = RUN_N
) -> FalseAlarms:
    """False alarms of the shipped device in runs of ``run_n`` samples."""
    device = shipped()
    alarms, exposures_n = [], []
    for part in range(max(1, samples // (run_n * LANES))):
        never = np.full(min(LANES, samples // run_n), run_n)
        played = simulate((plant, plant), never, excitation, run_n, seed + 1000 * part)
        rng = np.random.default_rng([seed, part])
        for u, y in zip(played.u, played.y, strict=True):
            run = Played(u, y, rng.uniform(size=run_n) >= missing, np.zeros(run_n))
            answers = answers_to(device, run)
            alarms.append([alarm.index for alarm in answers.alarms])
            exposures_n.append(exposure_n(device, run, answers))
    return count_false_alarms(alarms, exposures_n)


def plants_of_any_speed_alarms(
    excitation: Excitation, count: int = 50, samples: int = 2_000_000, jobs: int = 2
) -> Iterator[Figure]:
    """False alarms of random plants with poles from 0.3 to 0.999: of the worst ones, and of all."""
    plants = plants_of_any_speed(count, seed=3)
    begun_s = time.monotonic()
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        rows = [
            pool.submit(healthy_alarms, plant, dataclasses.replace(excitation, half_period_n=half_n), samples, 700 + i)
            for i, (plant, half_n) in enumerate(plants)
        ]
        found = [row.result() for row in rows]
    took_s = time.monotonic() - begun_s
    name = f"shipped, {_name(excitation)}: false alarms"
    worst = sorted(zip(plants, found, strict=True), key=lambda pair: -pair[1].alarms)[:WORST]
    for rank, ((plant, half_n), each) in enumerate(worst, 1):
        pole = max(abs(np.exp(pole * PERIOD_S)) for pole in plant.poles())
        remark = f"pole {pole:.4f}, half period {half_n:g}; "
        yield _bursts(f"{name}, random plant of any speed, worst but {rank - 1}", each, remark)
    every = FalseAlarms.joined(found)
    yield _bursts(f"{name}, {count} random plants of any speed", every)
    yield Figure(f"{name}, random plants of any speed, throughput", every.exposure_n / took_s, "samples/s")


def alarms_from_the_start(excitation: Excitation, count: int = 50, samples: int = 800_000) -> Figure:
    """False alarms of random plants with poles from 0.3 to 0.999, all in the first START_N samples of a run."""
    found = FalseAlarms.joined(
        healthy_alarms(plant, dataclasses.replace(excitation, half_period_n=half_n), samples, 90_000 + i, run_n=START_N)
        for i, (plant, half_n) in enumerate(plants_of_any_speed(count, seed=3))
    )
    return _bursts(
        f"shipped, {_name(excitation)}: false alarms in samples up to {START_N}, {count} random plants", found
    )


def _bursts(name: str, found: FalseAlarms, remark: str = "") -> Figure:
    counts = f"{found.alarms} alarms in {len(found.clusters)} clusters in {found.exposure_n} samples"
    return Figure(name, found.upper_rate() * ARL0, "of 1/ARL0", f"{remark}limit 1 at 99 % confidence: {counts}")


PARTS: Mapping[str, Callable[[Estimator], Iterator[Figure]]] = {
    "delay": lambda estimator: delays(estimator, SHARED_CLOCK, {FULL: 1.3, QUARTER: 1.5}, 400),
    "free-running": lambda estimator: delays(estimator, OWN_CLOCK, {FULL_FREE: 1.5, QUARTER_FREE: 1.5}, 400),
    "false-alarms": lambda estimator: quietness(estimator, SHARED_CLOCK, FULL, 2_000_000),
    "false-alarms-free-running": lambda estimator: quietness(estimator, OWN_CLOCK, FULL_FREE, 2_000_000),
    "accuracy": lambda estimator: accuracies(estimator, SHARED_CLOCK, 1000),
    "shipped": lambda _: shipped_delays(),
    "start": lambda _: map(alarms_from_the_start, (FULL, FULL_FREE)),
    "random-plants": lambda _: plants_of_any_speed_alarms(FULL),
    "random-plants-free-running": lambda _: plants_of_any_speed_alarms(FULL_FREE),
}

LONG = {"random-plants", "random-plants-free-running"}
"""Parts that run only if they are named."""


def figures(*parts: str) -> Iterator[Figure]:
    """Figures of the named parts, or of all but the long ones; ends the program if there is no such part."""
    for part in parts:
        if part not in PARTS:
            sys.exit(f"no part of the statistics is called {part}; there are {', '.join(PARTS)}")
    with tempfile.TemporaryDirectory() as folder:
        estimator = Estimator(compile_driver(Path(folder)))
        for part in parts or (part for part in PARTS if part not in LONG):
            yield from PARTS[part](estimator)


def main() -> None:
    """Print the rows of the parts named on the command line, or of all."""
    for figure in figures(*sys.argv[1:]):
        print(figure, flush=True)


if __name__ == "__main__":
    main()
