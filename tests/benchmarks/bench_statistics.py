"""How soon the estimator sees a change against the information bound, how often it is wrong, and how well it estimates.

Plants of tests.estimator_c.plants; at least 400 trials a cell, random phase and onset, fixed seeds, ARL0 = 1e5.

python -m tests.benchmarks.bench_statistics [delay] [free-running] [false-alarms] [accuracy]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from harness.plant import physical_parameters
from tests.estimator_c.est_driver import LOCKED, MAY_SLIP, Estimator, compile_driver
from tests.estimator_c.plants import (
    CODES,
    DISPLACEMENT_RANGE_M,
    FRONT,
    LIGHT,
    PERIOD_S,
    SHOCK,
    Excitation,
    Mechanics,
    cramer_rao,
    random_plants,
    simulate,
)

from .figure import Figure

Settings = Mapping[str, float | tuple[float, float]]

ARL0 = 1e5
LEARNT_N = 1000
"""Samples before the earliest change."""
ONSET_SPAN_N = 100
HORIZON_N = 300
"""A change not noticed after so many samples is missed, and counts with that delay."""

ADAPTED: Settings = {"refresh_n": 50, "warm_up_n": 150}
"""C follows the estimate of A; until it has, the innovations are coloured, and the trigger waits."""

SHARED_CLOCK: Settings = {
    **ADAPTED, "na": 2, "nb": 2, "nk": 1, "offset": 0, "forgetting": 0.999, "edge_instants": LOCKED,
}  # fmt: skip
"""The generator on the card's clock: n = 4. With forgetting 1 the gain falls below the resolution of float32: theta
stands still before it is right, and slow plants have up to 3 false alarms in 1e5 samples."""

OWN_CLOCK: Settings = {**ADAPTED, "edge_instants": MAY_SLIP}
"""As shipped, with C following: n = 6."""

FULL, QUARTER = Excitation(), Excitation(part_of_range=0.25)
FULL_FREE = Excitation(on_samples=False, drift_ppm=20.0)
QUARTER_FREE = Excitation(part_of_range=0.25, on_samples=False, drift_ppm=20.0)


@dataclass(frozen=True)
class Delay:
    """How soon one change was noticed, over t trials; all in samples."""

    mean_n: float
    bound_n: float
    ratio: float
    error: float
    """Standard error of the ratio, by the delta method."""
    missed: int
    early: int
    """Alarms before the change."""


def delay(
    estimator: Estimator,
    settings: Settings,
    plants: tuple[Mechanics, Mechanics],
    excitation: Excitation,
    trials: int,
    seed: int,
) -> Delay:
    """Play the change in so many trials, and compare with the bound of these very trials."""
    rng = np.random.default_rng([seed, 1])
    onset = rng.integers(LEARNT_N, LEARNT_N + ONSET_SPAN_N, trials)
    samples = LEARNT_N + ONSET_SPAN_N + HORIZON_N
    played = simulate(plants, onset, excitation, samples, seed)
    assert estimator.init(**settings)
    alarms, _ = estimator.watch(played.u, played.y)
    after = np.arange(samples) > onset[:, None]
    latency = _first(alarms & after, onset)
    bound = _first(played.information >= np.log(ARL0), onset)
    ratio = latency.mean() / bound.mean()
    error = np.std(latency - ratio * bound, ddof=1) / np.sqrt(trials) / bound.mean()
    return Delay(
        mean_n=float(latency.mean()),
        bound_n=float(bound.mean()),
        ratio=float(ratio),
        error=float(error),
        missed=int((latency >= HORIZON_N).sum()),
        early=int((alarms & ~after).sum()),
    )


def _first(reached: NDArray[np.bool_], onset: NDArray[np.int64]) -> NDArray[np.int64]:
    """(t,) samples from the onset to the first True after it; HORIZON_N if there is none."""
    first = np.where(reached.any(axis=1), reached.argmax(axis=1) - onset, HORIZON_N)
    return np.minimum(first, HORIZON_N)


def changes(excitation: Excitation) -> Iterator[tuple[str, float]]:
    """The changes that the customer asks for: parameter and factor."""
    sizes = (0.05, 0.1, 0.2) if excitation.part_of_range == 1.0 else (0.1, 0.2)
    for parameter in "KBM":
        for size in sizes:
            yield from ((parameter, 1.0 + size), (parameter, 1.0 - size))


def delays(
    estimator: Estimator, settings: Settings, excitations: Mapping[Excitation, float], trials: int
) -> Iterator[Figure]:
    """One row a change; excitations with the ratio that is allowed."""
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


def false_alarms(
    estimator: Estimator, settings: Settings, plant: Mechanics, excitation: Excitation, samples: int, seed: int
) -> int:
    """Alarms in so many samples of a healthy plant, 10,000 a run, the start of each run included."""
    length, lanes = 10_000, 20
    found = 0
    for part in range(samples // (length * lanes)):
        never = np.full(lanes, length)
        played = simulate((plant, plant), never, excitation, length, seed + 1000 * part)
        assert estimator.init(**settings)
        found += int(estimator.watch(played.u, played.y)[0].sum())
    return found


def upper_rate(found: int, samples: int, confidence: float = 0.99) -> float:
    """Clopper and Pearson's bound on the rate per sample, for a fixed number of samples (Poisson limit)."""
    return float(stats.chi2.ppf(confidence, 2 * (found + 1)) / 2.0 / samples)


def quietness(
    estimator: Estimator, settings: Settings, excitation: Excitation, samples: int, random_count: int = 50
) -> Iterator[Figure]:
    """Front, shock and M = 30 each by itself; the random ones each, as the worst of them, and together."""
    named = {"front": FRONT, "shock": SHOCK, "M = 30": LIGHT}
    for seed, (name, plant) in enumerate(named.items()):
        found = false_alarms(estimator, settings, plant, excitation, samples, 100 + seed)
        yield _rate(f"{_name(excitation)}: false alarms, {name}", found, samples)
    every = [
        false_alarms(estimator, settings, plant, excitation, samples // 2, 200 + seed)
        for seed, plant in enumerate(random_plants(random_count, seed=1))
    ]
    yield _rate(f"{_name(excitation)}: false alarms, worst of {random_count} random plants", max(every), samples // 2)
    yield _rate(
        f"{_name(excitation)}: false alarms, {random_count} random plants", sum(every), samples // 2 * len(every)
    )


def _rate(name: str, found: int, samples: int) -> Figure:
    upper = upper_rate(found, samples) * ARL0
    return Figure(name, upper, "of 1/ARL0", f"limit 1 at 99 % confidence: {found} alarms in {samples} samples")


def accuracy(estimator: Estimator, settings: Settings, trials: int, samples: int = 200) -> Iterator[Figure]:
    """M, B, K of the front suspension from rest: rms error against the Cramer-Rao bound."""
    never = np.full(trials, samples)
    played = simulate((FRONT, FRONT), never, FULL, samples, seed=300)
    assert estimator.init(**settings)
    _, theta = estimator.watch(played.u, played.y)
    model = {name: settings[name] for name in ("na", "nb")}
    n_per_code, m_per_code = FRONT.force_range_n / CODES, DISPLACEMENT_RANGE_M / CODES
    found = physical_parameters(theta, model, n_per_code, m_per_code, PERIOD_S)
    truth = np.array([FRONT.mass_kg, FRONT.damping_n_s_per_m, FRONT.stiffness_n_per_m])
    errors = np.sqrt(np.mean((found / truth - 1.0) ** 2, axis=0))
    bounds = cramer_rao(FRONT, FULL, samples, seed=300, trials=trials)
    for name, error, bound in zip("MBK", errors, bounds, strict=True):
        remark = f"limit 3: {100 * error:.3f} % against {100 * bound:.3f} % after {samples} samples, {trials} trials"
        yield Figure(f"rms error of {name}", float(error / bound), "Cramer-Rao bounds", remark)


PARTS: Mapping[str, Callable[[Estimator], Iterator[Figure]]] = {
    "delay": lambda estimator: delays(estimator, SHARED_CLOCK, {FULL: 1.3, QUARTER: 1.5}, 400),
    "free-running": lambda estimator: delays(estimator, OWN_CLOCK, {FULL_FREE: 1.5, QUARTER_FREE: 1.5}, 400),
    "false-alarms": lambda estimator: quietness(estimator, SHARED_CLOCK, FULL, 2_000_000),
    "accuracy": lambda estimator: accuracy(estimator, SHARED_CLOCK, 1000),
}


def figures(*parts: str) -> Iterator[Figure]:
    """The rows of the parts named, or of all."""
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
