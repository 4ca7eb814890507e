"""Measures of the estimator on simulated plants: delay against the information bound, false alarms, accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.datasheet import DEFAULT_ARL0, ModelOrders
from analogrig.judging.bursts import upper_count
from analogrig.plant import estimated_parameters
from tests.estimator_c.est_driver import LOCKED, MAY_SLIP, SHORT_WARM_UP_N, Estimator
from tests.estimator_c.plants import (
    CODES,
    DISPLACEMENT_RANGE_M,
    FRONT,
    PERIOD_S,
    Excitation,
    Mechanics,
    cramer_rao,
    simulate,
)
from tests.harness.plants import PROGRAM

Settings = Mapping[str, float | tuple[float, float]]

ARL0 = DEFAULT_ARL0
LEARNT_N = 1000
"""Samples before the earliest change."""
ONSET_SPAN_N = 100
HORIZON_N = 300
"""A change not noticed after so many samples is missed, and counts with that delay."""

ADAPTED: Settings = {"refresh_n": 40, "warm_up_n": SHORT_WARM_UP_N}
"""C follows the estimate of A; until it has, the innovations are coloured, and the trigger waits."""

SHARED_CLOCK: Settings = {
    **ADAPTED, "na": 2, "nb": 2, "nk": 1, "offset": 0, "forgetting": 0.999, "edge_instants": LOCKED,
}  # fmt: skip
"""The generator on the card's clock: n = 4. With forgetting 1 the gain falls below the resolution of float32: theta
stands still before it is right, and slow plants have up to 3 false alarms in 1e5 samples."""

OWN_CLOCK: Settings = {**ADAPTED, "edge_instants": MAY_SLIP, "forgetting": 0.99}
"""n = 6. At 20 ppm the b's must be followed this fast: 0.9925 leaves a light plant, little damped, up to 1.9
false alarms in 1e5 samples, this at most 0.4; the delay grows by 0.01 to 0.05 bounds."""

FULL, QUARTER = Excitation(), Excitation(part_of_range=0.25)
FULL_FREE = Excitation(on_samples=False, drift_ppm=20.0)
QUARTER_FREE = Excitation(part_of_range=0.25, on_samples=False, drift_ppm=20.0)


@dataclass(frozen=True)
class Delay:
    """Delays of one change over t trials, all in samples."""

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
    """Upper bound on the rate per sample, for a fixed number of samples.

    Alarms are taken as independent: those of this device come alone.
    """
    return upper_count(found, confidence, burst=1.0) / samples


@dataclass(frozen=True)
class Accuracy:
    """Errors of M, B and K of the front suspension from rest; relative, (3,) each."""

    rms: NDArray[np.float64]
    bounds: NDArray[np.float64]
    """Cramer and Rao's."""


def accuracy(estimator: Estimator, settings: Settings, trials: int, samples: int) -> Accuracy:
    """At the end of so many samples; over so many trials."""
    never = np.full(trials, samples)
    played = simulate((FRONT, FRONT), never, FULL, samples, seed=300)
    assert estimator.init(**settings)
    _, theta = estimator.watch(played.u, played.y)
    model = ModelOrders(int(str(settings["na"])), int(str(settings["nb"])))
    n_per_code, m_per_code = FRONT.force_range_n / CODES, DISPLACEMENT_RANGE_M / CODES
    found = estimated_parameters(PROGRAM, theta, model, n_per_code, m_per_code, PERIOD_S)
    truth = np.array([FRONT.mass_kg, FRONT.damping_n_s_per_m, FRONT.stiffness_n_per_m])
    rms = np.sqrt(np.mean((found / truth - 1.0) ** 2, axis=0))
    return Accuracy(rms=rms, bounds=cramer_rao(FRONT, FULL, samples, seed=300, trials=trials))
