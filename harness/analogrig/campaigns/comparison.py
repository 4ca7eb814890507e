"""Comparison of two sets of results: which quantities are significantly worse or better.

The unit is the seed: with one seed both sides, and all cells of a campaign, saw the same noise and the same draws. Each
quantity is reduced to one number a seed: its mean over all trials with that seed. Differences at common seeds are
tested by a sign-flip permutation test, which is exact for any distribution. Sides without a common seed are tested by
permuting the seeds between them. The p-values of all quantities are adjusted together (Holm 1979), so that the
family-wise error rate is at most ``alpha``.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.campaigns.rows import Row, changes
from analogrig.campaigns.sides import Observation, valid
from analogrig.plant import PARAMETERS

EXACT_UP_TO = 14
"""Largest number of differences for which all sign patterns are enumerated."""

LOST_ESTIMATE = 1.0
"""Relative error assigned to a trial without a final estimate of M, B, K where the other side's has one."""

RESAMPLES, _AT_ONCE = 99_999, 1_000

PAIRED, UNPAIRED = "sign flips, paired by seed", "permutation of seeds"

Word = Literal["worse", "better", "no difference shown"]


@dataclass(frozen=True)
class Quantity:
    """Quantity to compare; smaller is better."""

    name: str
    unit: str
    of: Callable[[Row, Row | None], Sequence[float]]
    """Values of a trial, limited to those that the other side's trial has too, if there is one."""


@dataclass(frozen=True)
class Difference:
    """Difference in one quantity between the two sides."""

    quantity: str
    unit: str
    a: float
    b: float
    """Means over the seeds."""
    seeds: int
    test: str
    p: float
    adjusted_p: float
    word: Word

    @property
    def shown(self) -> bool:
        """True if the difference is statistically significant."""
        return self.word != "no difference shown"


@dataclass(frozen=True)
class Comparison:
    differences: tuple[Difference, ...]
    alpha: float
    trials: tuple[int, int]
    """Number of valid trials on each side."""
    inconclusive: tuple[int, int]
    """Number of inconclusive trials on each side; they are not compared."""
    identical: tuple[int, int]
    """Trials with bit-identical estimates on both sides, and trials that both sides played."""

    @property
    def is_same(self) -> bool:
        """True if both sides played the same trials with bit-identical estimates."""
        same, both = self.identical
        return same == both > 0

    @property
    def least_seeds(self) -> int:
        """Smallest number of common seeds with which any difference can be significant."""
        return 1 + math.ceil(math.log2(max(1, len(self.differences)) / self.alpha))

    @property
    def worse(self) -> bool:
        return any(each.word == "worse" for each in self.differences)


def compare(a: Sequence[Observation], b: Sequence[Observation], alpha: float = 0.01) -> Comparison:
    """Comparison of ``b`` with ``a``. The same two sides give the same result."""
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"alpha must be between 0 and 1, not {alpha:g}")
    ours, theirs = valid(a), valid(b)
    common = ours.keys() & theirs.keys()
    found = [each for quantity in QUANTITIES if (each := _difference(quantity, ours, theirs)) is not None]
    return Comparison(
        differences=_worded(found, alpha),
        alpha=alpha,
        trials=(len(ours), len(theirs)),
        inconclusive=(len(a) - len(ours), len(b) - len(theirs)),
        identical=(sum(ours[key]["theta"] == theirs[key]["theta"] for key in common), len(common)),
    )


def _latencies(trial: Row, other: Row | None) -> list[float]:
    others = changes(trial if other is None else other)
    both = [(mine.latency_n, his.latency_n) for mine, his in zip(changes(trial), others, strict=False)]
    return [mine for mine, his in both if mine is not None and his is not None]


def _missed(trial: Row, _: Row | None) -> list[float]:
    return [float(change.missed) for change in changes(trial) if change.bound_n is not None]


def _false_alarms(trial: Row, _: Row | None) -> list[float]:
    return [trial["false_alarms"] / trial["armed"]] if trial["armed"] else []


def _error(i: int) -> Callable[[Row, Row | None], list[float]]:
    def errors(trial: Row, other: Row | None) -> list[float]:
        if trial["errors"]:
            return [abs(trial["errors"][i])]
        return [LOST_ESTIMATE] if other is not None and other["errors"] else []

    return errors


QUANTITIES = (
    Quantity("latency", "samples", _latencies),
    Quantity("missed", "of the visible changes", _missed),
    Quantity("false alarms", "per sample", _false_alarms),
    *(Quantity(f"error of {name}", "relative", _error(i)) for i, name in enumerate(PARAMETERS)),
)


def _difference(quantity: Quantity, a: Mapping[Any, Row], b: Mapping[Any, Row]) -> Difference | None:
    common = [key for key in a if key in b]
    if common:
        mine = _by_seed(quantity, {key: a[key] for key in common}, b)
        others = _by_seed(quantity, {key: b[key] for key in common}, a)
        seeds = [seed for seed in mine if seed in others]
        x, y = (np.array([side[seed] for seed in seeds]) for side in (mine, others))
        p, test = (sign_flip_p(y - x), PAIRED) if seeds else (1.0, PAIRED)
    else:
        x, y = (np.array(list(_by_seed(quantity, side, {}).values())) for side in (a, b))
        p, test = (permutation_p(x, y), UNPAIRED) if len(x) and len(y) else (1.0, UNPAIRED)
    if not (len(x) and len(y)):
        return None
    return Difference(
        quantity.name, quantity.unit, float(x.mean()), float(y.mean()), len(x), test, p, p, "no difference shown"
    )


def _by_seed(quantity: Quantity, side: Mapping[Any, Row], other: Mapping[Any, Row]) -> dict[int, float]:
    values: dict[int, list[float]] = {}
    for key, trial in side.items():
        values.setdefault(trial["seed"], []).extend(quantity.of(trial, other.get(key)))
    return {seed: statistics.fmean(each) for seed, each in sorted(values.items()) if each}


def sign_flip_p(differences: NDArray[np.float64]) -> float:
    """Two-sided p-value of the mean difference under random exchange of signs."""
    moved = differences[differences != 0.0]
    observed = abs(moved.sum())
    if not len(moved):
        return 1.0
    if len(moved) <= EXACT_UP_TO:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(moved))))
        return float(np.mean(np.abs(signs @ moved) >= observed * (1.0 - 1e-12)))
    rng = np.random.default_rng(0)
    extreme = sum(
        int((np.abs((2.0 * rng.integers(0, 2, (n, len(moved))) - 1.0) @ moved) >= observed * (1.0 - 1e-12)).sum())
        for n in _portions()
    )
    return (extreme + 1) / (RESAMPLES + 1)


def permutation_p(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Two-sided p-value of the difference of means under random permutation of the sides."""
    pooled, n = np.concatenate((x, y)), len(x)
    pooled = pooled - pooled.mean()
    observed = abs(pooled[:n].sum())
    rng = np.random.default_rng(0)
    extreme = sum(
        int(
            (np.abs(rng.permuted(np.tile(pooled, (k, 1)), axis=1)[:, :n].sum(axis=1)) >= observed * (1.0 - 1e-12)).sum()
        )
        for k in _portions()
    )
    return (extreme + 1) / (RESAMPLES + 1)


def _portions() -> list[int]:
    return [min(_AT_ONCE, RESAMPLES - first) for first in range(0, RESAMPLES, _AT_ONCE)]


def _worded(found: Sequence[Difference], alpha: float) -> tuple[Difference, ...]:
    """Differences with Holm-adjusted p-values, and the conclusion from each."""
    adjusted: dict[int, float] = {}
    floor = 0.0
    for rank, i in enumerate(sorted(range(len(found)), key=lambda i: found[i].p)):
        floor = max(floor, min(1.0, (len(found) - rank) * found[i].p))
        adjusted[i] = floor
    return tuple(
        Difference(**{**vars(each), "adjusted_p": adjusted[i], "word": _word(each, adjusted[i], alpha)})
        for i, each in enumerate(found)
    )


def _word(difference: Difference, p: float, alpha: float) -> Word:
    if p > alpha:
        return "no difference shown"
    return "worse" if difference.b > difference.a else "better"
