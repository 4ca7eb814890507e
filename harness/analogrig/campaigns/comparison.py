"""Comparison of two sets of results: which quantities are significantly worse or better.

The unit is the seed: with one seed both sides, and all cells of a campaign, saw the same noise and the same draws. Each
quantity is reduced to one number a seed: its mean over all trials with that seed. Differences at common seeds are
tested by a sign-flip permutation test, which is exact for any distribution. Sides without a common seed are tested by
permuting the seeds between them. The p-values of all quantities are adjusted together (Holm 1979), so that the
family-wise error rate is at most ``alpha``.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.campaigns.plan import Plan, list_differences
from analogrig.campaigns.results import Results
from analogrig.campaigns.rows import Row, changes, is_valid, row
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.judging.verdict import judge
from analogrig.plant import PARAMETERS
from analogrig.run import Run

EXACT_UP_TO = 14
"""Largest number of differences for which all sign patterns are enumerated."""

LOST_ESTIMATE = 1.0
"""Relative error assigned to a trial without a final estimate of M, B, K where the other side's has one."""

RESAMPLES, _AT_ONCE = 99_999, 1_000

PAIRED, UNPAIRED = "sign flips, paired by seed", "permutation of seeds"

Word = Literal["worse", "better", "no difference shown"]


Observation = tuple[tuple[object, ...], Row]
"""Key of a trial, seed included, and its row."""


@dataclass(frozen=True)
class Measure:
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
    ours, theirs = _valid(a), _valid(b)
    common = ours.keys() & theirs.keys()
    found = [each for measure in MEASURES if (each := _difference(measure, ours, theirs)) is not None]
    return Comparison(
        differences=adjust_by_holm(found, alpha),
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


MEASURES = (
    Measure("latency", "samples", _latencies),
    Measure("missed", "of the visible changes", _missed),
    Measure("false alarms", "per sample", _false_alarms),
    *(Measure(f"error of {name}", "relative", _error(i)) for i, name in enumerate(PARAMETERS)),
)


def _difference(measure: Measure, a: Mapping[Any, Row], b: Mapping[Any, Row]) -> Difference | None:
    common = [key for key in a if key in b]
    if common:
        mine = _by_seed(measure, {key: a[key] for key in common}, b)
        others = _by_seed(measure, {key: b[key] for key in common}, a)
        seeds = [seed for seed in mine if seed in others]
        x, y = (np.array([side[seed] for seed in seeds]) for side in (mine, others))
        p, test = (sign_flip_p(y - x), PAIRED) if seeds else (1.0, PAIRED)
    else:
        x, y = (np.array(list(_by_seed(measure, side, {}).values())) for side in (a, b))
        p, test = (permutation_p(x, y), UNPAIRED) if len(x) and len(y) else (1.0, UNPAIRED)
    if not (len(x) and len(y)):
        return None
    return Difference(
        measure.name, measure.unit, float(x.mean()), float(y.mean()), len(x), test, p, p, "no difference shown"
    )


def _by_seed(measure: Measure, side: Mapping[Any, Row], other: Mapping[Any, Row]) -> dict[int, float]:
    values: dict[int, list[float]] = {}
    for key, trial in side.items():
        values.setdefault(trial["seed"], []).extend(measure.of(trial, other.get(key)))
    return {seed: statistics.fmean(each) for seed, each in sorted(values.items()) if each}


def sign_flip_p(differences: NDArray[np.float64]) -> float:
    """Two-sided p-value of the mean difference under random exchange of signs."""
    moved = differences[differences != 0.0]
    if not len(moved):
        return 1.0
    if len(moved) <= EXACT_UP_TO:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(moved))))
        return float(np.mean(_are_as_extreme(signs @ moved, moved.sum())))
    rng = np.random.default_rng(0)
    return _resampled_p(moved.sum(), lambda k: (2.0 * rng.integers(0, 2, (k, len(moved))) - 1.0) @ moved)


def permutation_p(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Two-sided p-value of the difference of means under random permutation of the sides."""
    pooled, n = np.concatenate((x, y)), len(x)
    pooled = pooled - pooled.mean()
    rng = np.random.default_rng(0)
    return _resampled_p(pooled[:n].sum(), lambda k: rng.permuted(np.tile(pooled, (k, 1)), axis=1)[:, :n].sum(axis=1))


def _are_as_extreme(sums: NDArray[np.float64], observed: float) -> NDArray[np.bool_]:
    """(k,): sums at least as far from 0 as ``observed``, but for rounding."""
    return np.abs(sums) >= abs(observed) * (1.0 - 1e-12)


def _resampled_p(observed: float, draw: Callable[[int], NDArray[np.float64]]) -> float:
    """p-value of ``observed`` among RESAMPLES sums; ``draw(k)`` yields k of them."""
    portions = (min(_AT_ONCE, RESAMPLES - first) for first in range(0, RESAMPLES, _AT_ONCE))
    return (sum(int(_are_as_extreme(draw(k), observed).sum()) for k in portions) + 1) / (RESAMPLES + 1)


def adjust_by_holm(found: Sequence[Difference], alpha: float) -> tuple[Difference, ...]:
    """Differences with Holm-adjusted p-values, and the conclusion from each."""
    adjusted: dict[int, Difference] = {}
    floor = 0.0
    for rank, i in enumerate(sorted(range(len(found)), key=lambda i: found[i].p)):
        floor = max(floor, min(1.0, (len(found) - rank) * found[i].p))
        adjusted[i] = dataclasses.replace(found[i], adjusted_p=floor, word=_word(found[i], floor, alpha))
    return tuple(adjusted[i] for i in range(len(found)))


def _word(difference: Difference, p: float, alpha: float) -> Word:
    if p > alpha:
        return "no difference shown"
    return "worse" if difference.b > difference.a else "better"


@dataclass(frozen=True)
class Side:
    """One side of a comparison."""

    trials: tuple[Observation, ...]
    """Trials, valid or not."""
    plan: Plan | None = None
    """Plan of the campaign; None: the trials come from recordings."""


def load(path: Path) -> Side:
    """Trials of a results file, of a recording, or of all recordings below a folder.

    :raises RecordingError: it cannot be read, or there is nothing valid in it.
    :raises ConfigurationError: two recordings are of one play; names them.
    """
    if path.is_dir() or path.suffix == ".npz":
        side = Side(_load_recordings(sorted(path.rglob("*.npz")) if path.is_dir() else [path]))
    else:
        results = Results.load(path)
        cells = zip(results.plan.cells(), results.rows, strict=True)
        rows = ((cell, each) for cell, its_rows in cells for each in its_rows)
        side = Side(
            tuple(((cell.rig, cell.device, *cell.values.items(), each["seed"]), each) for cell, each in rows),
            results.plan,
        )
    if not _valid(side.trials):
        raise RecordingError(f"{path}: holds no valid trial")
    return side


def match(a: Side, b: Side) -> tuple[Sequence[Observation], Sequence[Observation]]:
    """Trials of both sides that played the same; the devices may differ.

    :raises ConfigurationError: they are of different campaigns, or played nothing in common; names what differs.
    """
    if a.plan is not None and b.plan is not None:
        _check_same("A and B are different campaigns", _decisive_settings(a.plan), _decisive_settings(b.plan))
        return a.trials, _in_order(b, _names(a.plan), _names(b.plan))
    if a.plan is not None or b.plan is not None:
        raise ConfigurationError("A and B cannot be compared: one is a campaign, the other are recordings")
    common = {key[:-1] for key, _ in a.trials} & {key[:-1] for key, _ in b.trials}
    if not common:
        _check_same("A and B played nothing in common", *(_recorded_tables(side.trials[0]) for side in (a, b)))
    ours, theirs = ([each for each in side.trials if each[0][:-1] in common] for side in (a, b))
    return ours, theirs


def _check_same(otherwise: str, ours: Any, theirs: Any) -> None:
    if differences := list_differences(ours, theirs, ("in A", "in B")):
        raise ConfigurationError(f"{otherwise}: {differences}")


def _names(plan: Plan) -> list[str]:
    """Names of the devices."""
    return [str(device["name"]) for device in plan.devices]


def _in_order(side: Side, wanted: Sequence[str], names: Sequence[str]) -> Sequence[Observation]:
    """Trials with the devices numbered as on the other side, if their names match; else numbered by position."""
    if set(wanted) != set(names):
        return side.trials
    return [((key[0], wanted.index(names[int(str(key[1]))]), *key[2:]), each) for key, each in side.trials]


def _recorded_tables(trial: Observation) -> dict[str, Any]:
    (scenario, rig, _), _ = trial
    return {"scenario": json.loads(str(scenario)), "rig": json.loads(str(rig))}


def _decisive_settings(plan: Plan) -> dict[str, Any]:
    """Settings that decide what a campaign played, without its devices and names."""
    table = plan.as_table()
    spec = {key: value for key, value in table["spec"].items() if key not in _NAMES}
    if "stop" not in spec:
        del spec["chunk"]  # says who plays what, and then no more
    return {
        **spec,
        "devices": len(plan.devices),
        "scenario": _without_names(table["scenario"]),
        "rigs": [_without_names(rig) for rig in table["rigs"]],
    }


_NAMES = frozenset({"name", "description", "scenario", "rigs", "devices", "samples"})
"""Keys of a campaign's file that are irrelevant, or whose contents are in the plan."""


def _without_names(table: Mapping[str, Any]) -> dict[str, Any]:
    """Table without its name and description, unless it has nothing else."""
    rest = {key: value for key, value in table.items() if key not in {"name", "description"}}
    return rest or dict(table)


def _valid(trials: Sequence[Observation]) -> dict[tuple[object, ...], Row]:
    """Rows of the valid trials, by key."""
    return {key: each for key, each in trials if is_valid(each)}


def _load_recordings(paths: Sequence[Path]) -> tuple[Observation, ...]:
    found: dict[tuple[object, ...], tuple[Path, Row]] = {}
    for path in paths:
        key, trial = _load_recording(path)
        if key in found:
            raise ConfigurationError(f"{found[key][0]} and {path} are of one scenario, rig and seed: which is meant?")
        found[key] = path, trial
    return tuple((key, trial) for key, (_, trial) in found.items())


def _load_recording(path: Path) -> Observation:
    run = Run.load(path)
    of = run.conditions
    played = json.dumps(dict(of.scenario), sort_keys=True)  # many may have one name: what strategies draw
    machine = json.dumps(_without_names(of.rig), sort_keys=True)
    return (played, machine, of.seed), row(run, judge(run))
