"""Statistics of the estimator: detection delay beside the information bound, false alarms, and errors of estimates.

Plants of tests.estimator_c.plants; at least 400 trials a cell, random phase and onset, fixed seeds, ARL0 = 1e5.

python -m tests.benchmarks.bench_statistics [delay] [free-running] [false-alarms] [false-alarms-free-running] [accuracy]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from tests.estimator_c.est_driver import Estimator, compile_driver
from tests.estimator_c.performance import (
    ARL0,
    FULL,
    FULL_FREE,
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
from tests.estimator_c.plants import FRONT, LIGHT, SHOCK, Excitation, random_plants

from .figure import Figure


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


PARTS: Mapping[str, Callable[[Estimator], Iterator[Figure]]] = {
    "delay": lambda estimator: delays(estimator, SHARED_CLOCK, {FULL: 1.3, QUARTER: 1.5}, 400),
    "free-running": lambda estimator: delays(estimator, OWN_CLOCK, {FULL_FREE: 1.5, QUARTER_FREE: 1.5}, 400),
    "false-alarms": lambda estimator: quietness(estimator, SHARED_CLOCK, FULL, 2_000_000),
    "false-alarms-free-running": lambda estimator: quietness(estimator, OWN_CLOCK, FULL_FREE, 2_000_000),
    "accuracy": lambda estimator: accuracies(estimator, SHARED_CLOCK, 1000),
}


def figures(*parts: str) -> Iterator[Figure]:
    """Figures of the named parts, or of all."""
    with tempfile.TemporaryDirectory() as folder:
        estimator = Estimator(compile_driver(Path(folder)))
        for part in parts or PARTS:
            yield from PARTS[part](estimator)


def main() -> None:
    """Print the rows of the parts named on the command line, or of all."""
    for figure in figures(*sys.argv[1:]):
        print(figure, flush=True)


if __name__ == "__main__":
    main()
