"""Comparison of two sets of results: which quantities are significantly worse or better.

The unit is the seed: with one seed both sides, and all cells of a campaign, saw the same noise and the same draws. Each
quantity is reduced to one number a seed: its mean over all trials with that seed. Differences at common seeds are
tested by a sign-flip permutation test, which is exact for any distribution. Beyond MOST_UNITS seeds, neighbours flip
together: a subgroup of the sign flips, for which the test is exact as well. Sides without a common seed are tested by
permuting the seeds between them. The p-values of all quantities are adjusted together (Holm 1979), so that the
family-wise error rate is at most ``alpha``.

Campaigns are read from their stores some seeds at a time, for all cells.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.campaigns.plan import Plan, list_differences
from analogrig.campaigns.store import Store
from analogrig.campaigns.trials import MISSED, MOST_ERRORS, Trial, Trials, columns_of, is_valid, join
from analogrig.errors import ConfigurationError, RecordingError
from analogrig.judging.verdict import judge
from analogrig.run import Run

EXACT_UP_TO = 14
"""Largest number of differences for which all sign patterns are enumerated."""

LOST_ESTIMATE = 1.0
"""Relative error assigned to a trial without a final estimate where the other side's has one."""

RESAMPLES, _AT_ONCE = 99_999, 1_000

PAIRED, UNPAIRED = "sign flips, paired by seed", "permutation of seeds"

Word = Literal["worse", "better", "no difference shown"]
NO_DIFFERENCE: Word = "no difference shown"

MOST_UNITS = 1000
"""Largest number of units whose signs are flipped; of more seeds, neighbours are one unit."""

SEEDS_AT_ONCE = 100_000
"""Largest number of trials of each side that are in memory at once, and of seeds of which differences are."""


Observation = tuple[tuple[object, ...], Trial]
"""Key of a trial, seed included, and the trial."""


@dataclass(frozen=True)
class Measure:
    """Quantity to compare; smaller is better."""

    name: str
    unit: str
    of: Callable[[Trials, Trials], tuple[NDArray[np.float64], NDArray[np.int64]]]
    """Sum over the values of each of n trials, and their number, limited to those that the trials of the other side
    have too."""


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
    adjusted_p: float = 1.0
    word: Word = NO_DIFFERENCE

    @property
    def shown(self) -> bool:
        """True if the difference is statistically significant."""
        return self.word != NO_DIFFERENCE


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


def compare(
    a: Sequence[Observation], b: Sequence[Observation], alpha: float = 0.01, estimates: Sequence[str] = ()
) -> Comparison:
    """Comparison of ``b`` with ``a``. The same two sides give the same result.

    :param estimates: names of the estimated parameters.
    """
    measures = _measures(estimates)
    ours, theirs = ({key: trial for key, trial in side if trial.is_valid} for side in (a, b))
    counts = (len(ours), len(theirs)), (len(a) - len(ours), len(b) - len(theirs))
    common = sorted((key for key in ours if key in theirs), key=lambda key: ours[key].seed)
    if not common:
        sides = (list(ours.values()), list(theirs.values()))
        found = [each for measure in measures if (each := _unpaired(measure, *sides)) is not None]
        return _comparison(found, alpha, *counts, (0, 0))
    seeds = np.unique([ours[key].seed for key in common], return_inverse=True)[1]
    pairing = Pairing(int(seeds[-1]) + 1, measures)
    pairing.add(seeds, *(columns_of([side[key] for key in common]) for side in (ours, theirs)))
    return _comparison(pairing.differences(), alpha, *counts, (pairing.identical, len(common)))


def _comparison(found: Sequence[Difference], alpha: float, *counts: tuple[int, int]) -> Comparison:
    """Comparison; ``counts``: its last three fields."""
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"alpha must be between 0 and 1, not {alpha:g}")
    return Comparison(adjust_by_holm(found, alpha), alpha, *counts)


class Pairing:
    """Differences of all measures by seed, gathered from trials that both sides played."""

    def __init__(self, seeds: int, measures: Sequence[Measure]) -> None:
        """Start with no trials of so many seeds."""
        self._measures = measures
        self.identical = 0
        """Number of trials with the same estimates on both sides."""
        self._seeds, self._units = seeds, min(seeds, MOST_UNITS)
        self._sums: NDArray[np.float64] = np.zeros((len(measures), 3))
        """By measure: sum over the seeds of A, of B, and number of seeds."""
        self._moved: NDArray[np.float64] = np.zeros((len(measures), self._units))
        """(measures, units) sums of the differences of the seeds that flip together."""

    def add(self, seeds: NDArray[np.int64], a: Trials, b: Trials) -> None:
        """Add the valid trials of some seeds: all of each of these seeds, the same trials on both sides.

        :param seeds: (n,) numbers of the trials' seeds among all, from 0 on, in any order.
        """
        self.identical += int(np.count_nonzero(a["theta"] == b["theta"]))
        first = int(seeds.min(initial=self._seeds))
        own = seeds - first
        unit = (first + np.arange(own.max(initial=-1) + 1)) * self._units // self._seeds
        for i, measure in enumerate(self._measures):
            x, y = (_mean_by_seed(own, *measure.of(mine, other)) for mine, other in ((a, b), (b, a)))
            both = ~(np.isnan(x) | np.isnan(y))
            self._sums[i] += x[both].sum(), y[both].sum(), np.count_nonzero(both)
            self._moved[i] += np.bincount(unit[both], (y - x)[both], self._units)

    def differences(self) -> list[Difference]:
        """Differences of the measures of which both sides have values, not yet adjusted."""
        return [
            Difference(measure.name, measure.unit, a / count, b / count, int(count), PAIRED, sign_flip_p(moved))
            for measure, (a, b, count), moved in zip(self._measures, self._sums.tolist(), self._moved, strict=True)
            if count
        ]


def _mean_by_seed(
    seeds: NDArray[np.int64], sums: NDArray[np.float64], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Mean of the values of each seed; NaN where there are none."""
    total, number = np.bincount(seeds, sums), np.bincount(seeds, counts)
    return np.asarray(np.divide(total, number, out=np.full(len(total), np.nan), where=number > 0))


def _measures(estimates: Sequence[str]) -> list[Measure]:
    """Everything that is compared; ``estimates``: names of the estimated parameters."""

    def latencies(trials: Trials, other: Trials) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        width = min(each["latency_n"].shape[1] for each in (trials, other))
        latency_n = trials["latency_n"][:, :width]
        both = (latency_n >= 0) & (other["latency_n"][:, :width] >= 0)
        return np.where(both, latency_n, 0).sum(axis=1, dtype=np.float64), both.sum(axis=1)

    def missed(trials: Trials, _: Trials) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        visible = trials["bound_n"] >= 0
        return (visible & ((trials["change"] & MISSED) > 0)).sum(axis=1, dtype=np.float64), visible.sum(axis=1)

    def false_alarms(trials: Trials, _: Trials) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        armed = trials["armed"] > 0
        rate = np.divide(trials["false_alarms"], trials["armed"], out=np.zeros(len(trials)), where=armed)
        return rate, armed.astype(np.int64)

    def errors(i: int, trials: Trials, other: Trials) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        error = np.abs(trials["error"][:, i].astype(np.float64))
        error[np.isnan(error) & ~np.isnan(other["error"][:, i])] = LOST_ESTIMATE
        known = ~np.isnan(error)
        return np.where(known, error, 0.0), known.astype(np.int64)

    return [
        Measure("latency", "samples", latencies),
        Measure("missed", "of the visible changes", missed),
        Measure("false alarms", "per sample", false_alarms),
        *(
            Measure(f"error of {name}", "relative", functools.partial(errors, i))
            for i, name in enumerate(estimates[:MOST_ERRORS])
        ),
    ]


def _unpaired(measure: Measure, a: Sequence[Trial], b: Sequence[Trial]) -> Difference | None:
    """Difference of a measure between sides without a common seed; None if one has no values."""
    sides = []
    for side in (a, b):
        trials, seeds = columns_of(side), np.unique([each.seed for each in side], return_inverse=True)[1]
        means = _mean_by_seed(seeds, *measure.of(trials, trials))
        sides.append(means[~np.isnan(means)])
    x, y = sides
    if not (len(x) and len(y)):
        return None
    return Difference(
        measure.name, measure.unit, float(x.mean()), float(y.mean()), len(x), UNPAIRED, permutation_p(x, y)
    )


def sign_flip_p(differences: NDArray[np.float64]) -> float:
    """Two-sided p-value of the mean difference under random exchange of signs."""
    moved = differences[differences != 0.0]
    if not len(moved):
        return 1.0
    if len(moved) <= EXACT_UP_TO:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(moved))))
        return float(np.mean(_are_as_extreme(signs @ moved, moved.sum())))
    rng = np.random.default_rng(0)
    row_bytes = -(-len(moved) // 8)

    def draw(k: int) -> NDArray[np.float64]:
        signs = np.frombuffer(rng.bytes(k * row_bytes), np.uint8).reshape(k, row_bytes)
        are_kept = np.unpackbits(signs, axis=1, count=len(moved)).astype(np.float64)
        return np.asarray(2.0 * (are_kept @ moved) - moved.sum())

    return _resampled_p(moved.sum(), draw)


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
        word: Word = NO_DIFFERENCE if floor > alpha else "worse" if found[i].b > found[i].a else "better"
        adjusted[i] = dataclasses.replace(found[i], adjusted_p=floor, word=word)
    return tuple(adjusted[i] for i in range(len(found)))


@dataclass(frozen=True)
class Recorded:
    """Side of recordings."""

    trials: tuple[Observation, ...]
    """Trials, valid or not."""
    estimates: tuple[str, ...]
    """Estimated parameters of the first one."""


@dataclass(frozen=True)
class Campaign:
    """Side of a campaign, whose trials stay in their file."""

    path: Path
    plan: Plan


def load(path: Path) -> Recorded | Campaign:
    """Side of a campaign, of a recording, or of all recordings below a folder.

    :raises RecordingError: it cannot be read, or is no campaign that has ended, or has no valid recording.
    :raises ConfigurationError: two recordings are of one play; names them.
    """
    if path.is_dir() or path.suffix == ".npz":
        side = _load_recordings(sorted(path.rglob("*.npz")) if path.is_dir() else [path])
        if not any(trial.is_valid for _, trial in side.trials):
            raise RecordingError(f"{path}: holds no valid trial")
        return side
    with Store.read(path) as store:
        store.check_whole()
        return Campaign(path, store.plan)


def compare_sides(a: Recorded | Campaign, b: Recorded | Campaign, alpha: float = 0.01) -> Comparison:
    """Comparison of the trials that both sides played; the devices may differ.

    :raises ConfigurationError: they are of different campaigns, or played nothing in common; names what differs.
    :raises RecordingError: a campaign's file is damaged, or holds no valid trial.
    """
    if isinstance(a, Campaign) and isinstance(b, Campaign):
        _check_same("A and B are different campaigns", _decisive_settings(a.plan), _decisive_settings(b.plan))
        return _compare_campaigns(a, b, alpha)
    if not (isinstance(a, Recorded) and isinstance(b, Recorded)):
        raise ConfigurationError("A and B cannot be compared: one is a campaign, the other are recordings")
    common = {key[:-1] for key, _ in a.trials} & {key[:-1] for key, _ in b.trials}
    if not common:
        keys = (side.trials[0][0] for side in (a, b))
        tables = ({"scenario": json.loads(str(key[0])), "rig": json.loads(str(key[1]))} for key in keys)
        _check_same("A and B played nothing in common", *tables)
    ours, theirs = ([each for each in side.trials if each[0][:-1] in common] for side in (a, b))
    return compare(ours, theirs, alpha, a.estimates)


def _compare_campaigns(a: Campaign, b: Campaign, alpha: float) -> Comparison:
    valid, played, common, trials = np.zeros(2, np.int64), np.zeros(2, np.int64), 0, a.plan.spec.trials
    pairing, cells = Pairing(trials, _measures(a.plan.estimates)), _matched_cells(a.plan, b.plan)
    with Store.read(a.path) as ours, Store.read(b.path) as theirs:
        step = max(1, SEEDS_AT_ONCE // a.plan.size)
        for first in range(0, trials, step):
            window = range(first, min(first + step, trials))
            pairs: list[tuple[NDArray[np.int64], Trials, Trials]] = []
            for cell, other in enumerate(cells):
                x, y = _read(ours, cell, window), _read(theirs, other, window)
                played += len(x), len(y)
                valid += np.count_nonzero(is_valid(x)), np.count_nonzero(is_valid(y))
                both = np.flatnonzero(is_valid(x)[: len(y)] & is_valid(y)[: len(x)])
                if len(both):
                    pairs.append((first + both, x[both], y[both]))
            if pairs:
                seeds, xs, ys = zip(*pairs, strict=True)
                pairing.add(np.concatenate(seeds), join(xs), join(ys))
                common += sum(map(len, seeds))
    for side, count in zip((a, b), valid.tolist(), strict=True):
        if not count:
            raise RecordingError(f"{side.path}: holds no valid trial")
    counts = ((int(x), int(y)) for x, y in (valid, played - valid))
    return _comparison(pairing.differences(), alpha, *counts, (pairing.identical, common))


def _read(store: Store, cell: int, window: range) -> Trials:
    """Trials of a cell whose places are in ``window``: those from its start on, up to the end of the cell."""
    begin = cell * store.plan.spec.trials
    return join(
        [
            trials[max(0, window.start - part.first) : max(0, window.stop - part.first)]
            for part, trials in store.parts(range(begin + window.start, begin + window.stop))
            if part.cell == cell
        ]
    )


def _matched_cells(a: Plan, b: Plan) -> list[int]:
    """Cells of b in the order of those of a: devices are matched by name, or by place if their names differ."""
    wanted, names = ([str(device["name"]) for device in plan.devices] for plan in (a, b))
    if set(wanted) != set(names):
        return list(range(b.size))
    numbers = {(cell.rig, names[cell.device], *cell.values.items()): i for i, cell in enumerate(b.cells())}
    return [numbers[cell.rig, wanted[cell.device], *cell.values.items()] for cell in a.cells()]


def _check_same(otherwise: str, ours: Any, theirs: Any) -> None:
    if differences := list_differences(ours, theirs, ("in A", "in B")):
        raise ConfigurationError(f"{otherwise}: {differences}")


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


def _load_recordings(paths: Sequence[Path]) -> Recorded:
    estimates: tuple[str, ...] = ()
    found: dict[tuple[object, ...], tuple[Path, Trial]] = {}
    for path in paths:
        run = Run.load(path)
        of = run.conditions
        played = json.dumps(dict(of.scenario), sort_keys=True)  # many may have one name: what strategies draw
        key = (played, json.dumps(_without_names(of.rig), sort_keys=True), of.seed)
        if key in found:
            raise ConfigurationError(f"{found[key][0]} and {path} are of one scenario, rig and seed: which is meant?")
        found[key] = path, Trial.of(run, judge(run))
        estimates = estimates or of.program.estimates
    return Recorded(tuple((key, trial) for key, (_, trial) in found.items()), estimates)
