"""Measures of the isolation: how often the class is right, how soon against the isolation bound, and the extent.

Faults of the channels are added to the codes of simulated plants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.estimator_c.est_driver import CHANGES, Estimator, Isolated
from tests.estimator_c.performance import Settings
from tests.estimator_c.plants import (
    CODES,
    DISPLACEMENT_RANGE_M,
    PERIOD_S,
    VARIANCE_LSB2,
    Array,
    Excitation,
    Mechanics,
    Trials,
    simulate,
)

LEARNT_N = 600
ONSET_SPAN_N = 100
HORIZON_N = 150
SAMPLES = LEARNT_N + ONSET_SPAN_N + HORIZON_N
LN_CERTAIN = float(np.log(20.0))
FACTORS = np.exp(np.linspace(np.log(0.25), np.log(4.0), 111))
"""Magnitudes of a rival; the best is interpolated."""
PAIRED = np.linspace(-0.6, 0.6, 31)
"""Logarithms of the magnitudes of each of two that change at once; between them courses are taken for linear, which is
good to 0.2 codes where the displacement is 1000."""
AT_ONCE = 20
"""Trials that are worked on together, so that all pairs of magnitudes fit into memory."""

Change = Mapping[str, float]
"""Factors of "M", "B", "K"; those that do not change are absent."""

FAULTS = CHANGES[CHANGES.index("several") + 1 :]
"""Faults of a channel, such as "force offset"."""

SIZES = {
    "force offset": (20.0, 1000.0),
    "force gain": (0.05, 0.5),
    "force noise": (20.0, 200.0),
    "displacement offset": (5.0, 200.0),
    "displacement gain": (0.05, 0.5),
    "displacement noise": (3.0, 20.0),
}
"""Least and largest size of those that have one: codes, part of the gain, rms codes. Its logarithm is drawn evenly; of
an offset and a gain also the sign."""


@dataclass(frozen=True)
class Isolation:
    """Outcomes of one change, over t trials."""

    reported: float
    """Share of the trials in which a class was reported within the horizon."""
    right: float
    """Share of the reports that named the true class."""
    mean_n: float
    """Samples from the change to the report, HORIZON_N where there was none."""
    bound_n: float
    """Mean of the isolation bounds of these very trials; NaN if not asked for."""
    bound_of_pairs_n: float
    """The same if two others at once count as a rival too; NaN if several had changed, or if not asked for."""
    bound_of_all_n: float
    """The same if offsets and gains of the channels count as well."""
    within_twice: float
    """Share of the trials in which the report came within twice the bound of that trial."""
    error: float
    """Largest relative error of the extent in 95 % of the right reports, at the report; NaN if several had changed."""
    error_refined: float
    """The same at the end of the run."""


def changed(plant: Mechanics, change: Change) -> Mechanics:
    """The plant after the change."""
    for parameter, factor in change.items():
        plant = plant.scaled(parameter, factor)
    return plant


def play(plant: Mechanics, change: Change, excitation: Excitation, trials: int, seed: int) -> Trials:
    """Onset and phase at random."""
    onset = np.random.default_rng([seed, 1]).integers(LEARNT_N, LEARNT_N + ONSET_SPAN_N, trials)
    return simulate((plant, changed(plant, change)), onset, excitation, SAMPLES, seed)


def truth(change: Change) -> str:
    """The class that should be reported."""
    return next(iter(change)) if len(change) == 1 else "several"


def judged(
    found: Isolated, played: Trials, change: Change, bound_n: Array, bound_of_pairs_n: Array, bound_of_all_n: Array
) -> Isolation:
    """The measures of these diagnoses; the bounds are (t,)."""
    reported, right = found.change != "undecided", found.change == truth(change)
    taken_n = np.where(reported, found.at - played.onset, HORIZON_N)
    errors = [float("nan")] * 2
    if len(change) == 1 and right.any():
        factor = change[truth(change)]
        errors = [float(np.percentile(np.abs(e[right] / factor - 1.0), 95)) for e in (found.extent, found.refined)]
    return Isolation(
        reported=float(reported.mean()),
        right=float(right.sum() / max(reported.sum(), 1)),
        mean_n=float(taken_n.mean()),
        bound_n=float(bound_n.mean()),
        bound_of_pairs_n=float(bound_of_pairs_n.mean()),
        bound_of_all_n=float(bound_of_all_n.mean()),
        within_twice=float((taken_n <= 2.0 * bound_n).mean()),
        error=errors[0],
        error_refined=errors[1],
    )


def measure(
    estimator: Estimator,
    settings: Settings,
    plant: Mechanics,
    change: Change,
    excitation: Excitation,
    trials: int,
    seed: int,
    *,
    bounded: bool = True,
    against_two: bool = True,
) -> Isolation:
    """Play the change in so many trials.

    :param bounded: with the bounds of these trials, which take a while.
    :param against_two: with those against two changes at once too, which take longer.
    """
    played = play(plant, change, excitation, trials, seed)
    assert estimator.init(**settings)
    found = estimator.isolate(played.u, played.y, played.onset)
    bound_n = bound_of_pairs_n = bound_of_all_n = np.full(trials, np.nan)
    if bounded:
        bound_n = bounds(plant, change, excitation, played.onset, seed)
    if bounded and against_two and len(change) == 1:
        bound_of_pairs_n = np.maximum(bound_n, bounds_of_pairs(plant, change, excitation, played.onset, seed))
        of_faults_n = bounds_of_faults(plant, change, excitation, played.onset, seed)
        bound_of_all_n = np.maximum(bound_of_pairs_n, of_faults_n)
    return judged(found, played, change, bound_n, bound_of_pairs_n, bound_of_all_n)


def faulty(
    fault: str, u: Array, y: Array, onset: NDArray[np.int64], rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Codes (t, n) of force and displacement with a fault after ``onset``, and the sizes (t,) drawn for it.

    :param fault: one of FAULTS. A stuck channel keeps the code of the onset; a delay is of one sample; a gain is
        counted from code 0.
    """
    channel, kind = fault.split(" ")
    codes = u if channel == "force" else y
    trials, samples = codes.shape
    size = np.ones(trials)
    if fault in SIZES:
        least, most = SIZES[fault]
        size = least * np.exp(rng.uniform(0.0, np.log(most / least), trials))
        if kind != "noise":
            size *= rng.choice((-1.0, 1.0), trials)
    wrong = {
        "offset": lambda: codes + np.round(size)[:, None],
        "gain": lambda: np.round(codes * (1.0 + size)[:, None]),
        "delay": lambda: np.roll(codes, 1, axis=1),
        "stuck": lambda: np.repeat(codes[np.arange(trials), onset][:, None], samples, axis=1),
        "noise": lambda: codes + np.round(rng.normal(size=codes.shape) * size[:, None]),
    }[kind]()
    codes = np.where(np.arange(samples) > onset[:, None], wrong, codes)
    return (codes, y, size) if channel == "force" else (u, codes, size)


def diagnose_fault(
    estimator: Estimator,
    settings: Settings,
    plant: Mechanics,
    fault: str,
    excitation: Excitation,
    trials: int,
    seed: int,
) -> tuple[Isolated, NDArray[np.int64]]:
    """The diagnoses of so many trials with this fault, and its onsets."""
    played = play(plant, {}, excitation, trials, seed)
    u, y, _ = faulty(fault, played.u, played.y, played.onset, np.random.default_rng([seed, 2]))
    assert estimator.init(**settings)
    return estimator.isolate(u, y, played.onset), played.onset


def bounds(
    plant: Mechanics, change: Change, excitation: Excitation, onset: NDArray[np.int64], seed: int
) -> NDArray[np.float64]:
    """(t,) samples after which the trials of ``play`` separate the truth from every single rival at its best by ln 20.

    All know the onset, and the course up to it. HORIZON_N where the data do not.
    """
    first = excitation.first_edges(np.random.default_rng(seed), len(onset))
    course = _courses(plant, [changed(plant, change)], excitation, first, onset)[0]
    least = np.full(course.shape, np.inf)
    for rival in "MBK":
        if rival != truth(change):
            others = _courses(plant, [plant.scaled(rival, f) for f in FACTORS], excitation, first, onset)
            least = np.minimum(least, _least(_divergence(course, others)))
    return _separated(least)


def bounds_of_pairs(
    plant: Mechanics, change: Change, excitation: Excitation, onset: NDArray[np.int64], seed: int
) -> NDArray[np.float64]:
    """``bounds`` of a single change; the rival is a change of both other parameters at once, or of either.

    Where no force acts, a change of M by f moves the plant exactly as one of B and of K by 1/f does, and so on round:
    the valley in which the rivals lie is narrow, and runs to where the next edge of the force comes.
    """
    first = excitation.first_edges(np.random.default_rng(seed), len(onset))
    one, two = (name for name in "MBK" if name != truth(change))
    step = 1e-3

    def rivals(up: float, right: float) -> list[Mechanics]:
        return [plant.scaled(one, np.exp(f + up)).scaled(two, np.exp(g + right)) for f in PAIRED for g in PAIRED]

    out = np.empty(len(onset))
    for at in range(0, len(onset), AT_ONCE):
        part = slice(at, at + AT_ONCE)
        course, *others = (
            _courses(plant, plants, excitation, first[part], onset[part])
            for plants in ([changed(plant, change)], rivals(0.0, 0.0), rivals(step, 0.0), rivals(0.0, step))
        )
        slopes = [(other - others[0]) / step for other in others[1:]]
        out[part] = _separated(_least_nearby(course - others[0], slopes).min(axis=0) / (2.0 * VARIANCE_LSB2))
    return out


def bounds_of_faults(
    plant: Mechanics, change: Change, excitation: Excitation, onset: NDArray[np.int64], seed: int
) -> NDArray[np.float64]:
    """``bounds`` of a single change; the rivals are an offset and a gain of either channel, of any size.

    An offset of the force is a force that acts from the onset on, its gain a common factor of M, B and K.
    """
    first = excitation.first_edges(np.random.default_rng(seed), len(onset))
    step = 1e-3
    stiffer = plant
    for parameter in "MBK":
        stiffer = stiffer.scaled(parameter, 1.0 + step)
    course, unchanged, other = _courses(plant, [changed(plant, change), plant, stiffer], excitation, first, onset)
    pushed = plant.response(np.arange(1.0, HORIZON_N + 1.0))[0][:, None]
    effects = (np.ones_like(course), unchanged, np.broadcast_to(pushed, course.shape), other - unchanged)
    rest = course - unchanged
    least = np.full(course.shape, np.inf)
    for effect in effects:
        rr, re, ee = (np.cumsum(a * b, axis=0) for a, b in ((rest, rest), (rest, effect), (effect, effect)))
        left = rr - np.divide(re**2, ee, out=np.zeros_like(re), where=ee > 0.0)
        least = np.minimum(least, left / (2.0 * VARIANCE_LSB2))
    return _separated(least)


def _least_nearby(rest: Array, slopes: list[Array]) -> Array:
    """(p, n, t) the least sums of squares up to each sample of rests (p, n, t) less multiples of the two slopes, each
    multiple within the cell of the grid that belongs to it."""
    one, two = slopes
    half = float(PAIRED[1] - PAIRED[0]) / 2.0
    rr, r1, r2, s11, s12, s22 = (
        np.cumsum(a * b, axis=1)
        for a, b in ((rest, rest), (rest, one), (rest, two), (one, one), (one, two), (two, two))
    )
    with np.errstate(all="ignore"):
        x = np.clip(np.nan_to_num((s22 * r1 - s12 * r2) / (s11 * s22 - s12**2)), -half, half)
        y = np.clip(np.nan_to_num((r2 - s12 * x) / s22), -half, half)
        x = np.clip(np.nan_to_num((r1 - s12 * y) / s11), -half, half)
    return np.asarray(np.maximum(rr - 2.0 * (x * r1 + y * r2) + x**2 * s11 + 2.0 * x * y * s12 + y**2 * s22, 0.0))


def _divergence(course: Array, others: Array) -> Array:
    """(f, n, t) nats after each sample."""
    return np.asarray(np.cumsum((others - course) ** 2, axis=1) / (2.0 * VARIANCE_LSB2))


def _separated(least: Array) -> Array:
    """(t,) samples after which the best rival (n, t) falls behind by ln 20."""
    reached = least >= LN_CERTAIN
    return np.asarray(np.where(reached.any(axis=0), reached.argmax(axis=0) + 1.0, float(HORIZON_N)))


def _least(divergence: Array) -> Array:
    """(f, n, t) at evenly spaced f: the least over f (n, t), by a parabola through the three lowest."""
    at = np.clip(divergence.argmin(axis=0), 1, len(divergence) - 2)[None]
    low, mid, high = (np.take_along_axis(divergence, at + i, axis=0)[0] for i in (-1, 0, 1))
    curvature = low + high - 2.0 * mid
    with np.errstate(all="ignore"):
        least = mid - (high - low) ** 2 / (8.0 * curvature)
    return np.asarray(np.maximum(np.where(curvature > 0.0, least, mid), 0.0))


def _courses(
    plant: Mechanics, plants: list[Mechanics], excitation: Excitation, first: Array, onset: NDArray[np.int64]
) -> Array:
    """(plants, HORIZON_N, t) codes of displacement in the samples after the onset, the plant as it was up to there."""
    half_n = excitation.half_period_n * (1.0 + excitation.drift_ppm * 1e-6)
    force_n = plant.force_range_n * excitation.part_of_range

    def level(k: NDArray[np.int64]) -> Array:
        return ((np.floor((k - first) / half_n) + 1.0) % 2.0) * force_n

    def rest_n(k: NDArray[np.int64]) -> Array:
        return k + 1.0 - (first + (np.floor((k - first) / half_n) + 1.0) * half_n)

    class Course:
        """Responses of plants from rest, (plants, t) each."""

        def __init__(self, who: list[Mechanics]) -> None:
            self.first, self.second = np.array([each.poles() for each in who]).T[:, :, None]
            self.stiffness = np.array([each.stiffness_n_per_m for each in who])[:, None]
            self.transition = np.stack([each.transition(1.0) for each in who])[:, :, :, None]
            self.whole = self.response(np.ones(1))
            self.x, self.v = np.zeros((2, len(who), len(onset)))

        def response(self, span_n: Array) -> tuple[Array, Array]:
            """Mechanics.response() of all plants (plants, ...)."""
            first, second = self.first, self.second
            a, b = (np.exp(pole * span_n * PERIOD_S) for pole in (first, second))
            gap = (first - second) * self.stiffness
            return 1.0 / self.stiffness + ((second * a - first * b) / gap).real, (first * second * (a - b) / gap).real

        def step(self, k: NDArray[np.int64]) -> None:
            (xx, xv), (vx, vv) = self.transition.transpose(1, 2, 0, 3)
            now = level(k)
            x = xx * self.x + xv * self.v + self.whole[0] * now
            v = vx * self.x + vv * self.v + self.whole[1] * now
            jump = level(k + 1) - now
            (edges,) = np.nonzero(jump)
            for part, kick in zip((x, v), self.response(rest_n(k)[edges]), strict=True):
                part[:, edges] += kick * jump[edges]
            self.x, self.v = x, v

    believed = Course([plant])
    for back in range(400, 0, -1):
        believed.step(onset - back)
    played = Course(plants)
    played.x, played.v = (np.repeat(part, len(plants), axis=0) for part in (believed.x, believed.v))
    out = np.empty((len(plants), HORIZON_N, len(onset)))
    for k in range(HORIZON_N):
        played.step(onset + k)
        out[:, k] = played.x
    return out * (CODES / DISPLACEMENT_RANGE_M)
