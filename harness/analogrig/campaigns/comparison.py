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
from analogrig.campaigns.rows import Row, is_valid, row
from analogrig.campaigns.store import Store
from analogrig.campaigns.trials import MISSED, MOST_ERRORS, Trials
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


Observation = tuple[tuple[object, ...], Row]
"""Key of a trial, seed included, and its row."""


@dataclass(frozen=True)
class Values:
    """Values of a quantity in n trials: the sum over each trial, and their number."""

    sums: NDArray[np.float64]
    counts: NDArray[np.int64]


@dataclass(frozen=True)
class Measure:
    """Quantity to compare; smaller is better."""

    name: str
    unit: str
    of: Callable[[Trials, Trials | None], Values]
    """Values of trials, limited to those that the other side's trials have too, if there are any."""


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
    ours, theirs = _valid(a), _valid(b)
    common = [key for key in ours if key in theirs]
    if not common:
        found = [each for measure in measures if (each := _unpaired(measure, ours, theirs)) is not None]
        return _comparison(found, alpha, (len(ours), len(theirs)), (len(a), len(b)), (0, 0))
    common.sort(key=lambda key: int(ours[key]["seed"]))
    seeds = np.array([ours[key]["seed"] for key in common], np.int64)
    places = np.unique(seeds, return_inverse=True)[1]
    pairing = Pairing(int(places[-1]) + 1, measures)
    pairing.add(places, *(Trials.of([side[key] for key in common]) for side in (ours, theirs)))
    return _comparison(
        pairing.differences(), alpha, (len(ours), len(theirs)), (len(a), len(b)), (pairing.identical, len(common))
    )


def _comparison(
    found: Sequence[Difference], alpha: float, valid: tuple[int, int], played: tuple[int, int], same: tuple[int, int]
) -> Comparison:
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"alpha must be between 0 and 1, not {alpha:g}")
    return Comparison(
        differences=adjust_by_holm(found, alpha),
        alpha=alpha,
        trials=valid,
        inconclusive=(played[0] - valid[0], played[1] - valid[1]),
        identical=same,
    )


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

    def add(self, places: NDArray[np.int64], a: Trials, b: Trials) -> None:
        """Add the valid trials of some seeds: all of each of these seeds, the same trials on both sides.

        :param places: (n,) places of the trials' seeds among all, rising or not.
        """
        self.identical += int(np.count_nonzero(a.theta == b.theta))
        first = int(places.min(initial=self._seeds))
        at = places - first
        unit = (first + np.arange(at.max(initial=-1) + 1)) * self._units // self._seeds
        for i, measure in enumerate(self._measures):
            x, y = (_by_place(at, measure.of(mine, other)) for mine, other in ((a, b), (b, a)))
            both = ~(np.isnan(x) | np.isnan(y))
            self._sums[i] += x[both].sum(), y[both].sum(), np.count_nonzero(both)
            self._moved[i] += np.bincount(unit[both], (y - x)[both], self._units)

    def differences(self) -> list[Difference]:
        """Differences of the measures of which both sides have values, not yet adjusted."""
        out = []
        for measure, (a, b, count), moved in zip(self._measures, self._sums.tolist(), self._moved, strict=True):
            if count:
                means, p = (a / count, b / count), sign_flip_p(moved)
                out.append(Difference(measure.name, measure.unit, *means, int(count), PAIRED, p, p, NO_DIFFERENCE))
        return out


def _by_place(places: NDArray[np.int64], values: Values) -> NDArray[np.float64]:
    """Mean of the values at each place; NaN where there are none."""
    sums, counts = (np.bincount(places, each) for each in (values.sums, values.counts))
    return np.asarray(np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0))


def _latencies(trials: Trials, other: Trials | None) -> Values:
    mine, others = trials.latency_n, (trials if other is None else other).latency_n
    width = min(mine.shape[1], others.shape[1])
    both = (mine[:, :width] >= 0) & (others[:, :width] >= 0)
    return Values(np.where(both, mine[:, :width], 0).sum(axis=1, dtype=np.float64), both.sum(axis=1))


def _missed(trials: Trials, _: Trials | None) -> Values:
    visible = trials.bound_n >= 0
    missed = visible & ((trials.change & MISSED) > 0)
    return Values(missed.sum(axis=1, dtype=np.float64), visible.sum(axis=1))


def _false_alarms(trials: Trials, _: Trials | None) -> Values:
    armed = trials.armed > 0
    rate = np.divide(trials.false_alarms, trials.armed, out=np.zeros(len(trials)), where=armed)
    return Values(rate, armed.astype(np.int64))


def _error(i: int) -> Callable[[Trials, Trials | None], Values]:
    def errors(trials: Trials, other: Trials | None) -> Values:
        error = np.abs(trials.error[:, i].astype(np.float64))
        if other is not None:
            error[np.isnan(error) & ~np.isnan(other.error[:, i])] = LOST_ESTIMATE
        known = ~np.isnan(error)
        return Values(np.where(known, error, 0.0), known.astype(np.int64))

    return errors


def _measures(estimates: Sequence[str]) -> tuple[Measure, ...]:
    """Everything that is compared; ``estimates``: names of the estimated parameters."""
    return (
        Measure("latency", "samples", _latencies),
        Measure("missed", "of the visible changes", _missed),
        Measure("false alarms", "per sample", _false_alarms),
        *(Measure(f"error of {name}", "relative", _error(i)) for i, name in enumerate(estimates[:MOST_ERRORS])),
    )


def _unpaired(measure: Measure, a: Mapping[Any, Row], b: Mapping[Any, Row]) -> Difference | None:
    sides = []
    for rows in (a.values(), b.values()):
        seeds = np.array([each["seed"] for each in rows], np.int64)
        means = _by_place(np.unique(seeds, return_inverse=True)[1], measure.of(Trials.of(list(rows)), None))
        sides.append(means[~np.isnan(means)])
    x, y = sides
    if not (len(x) and len(y)):
        return None
    p = permutation_p(x, y)
    return Difference(
        measure.name, measure.unit, float(x.mean()), float(y.mean()), len(x), UNPAIRED, p, p, NO_DIFFERENCE
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
        adjusted[i] = dataclasses.replace(found[i], adjusted_p=floor, word=_word(found[i], floor, alpha))
    return tuple(adjusted[i] for i in range(len(found)))


def _word(difference: Difference, p: float, alpha: float) -> Word:
    if p > alpha:
        return NO_DIFFERENCE
    return "worse" if difference.b > difference.a else "better"


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
        if not _valid(side.trials):
            raise RecordingError(f"{path}: holds no valid trial")
        return side
    with Store.read(path) as store:
        plan = store.plan()
        store.check_whole(plan)
        return Campaign(path, plan)


def compare_sides(a: Recorded | Campaign, b: Recorded | Campaign, alpha: float = 0.01) -> Comparison:
    """Comparison of the trials that both sides played; the devices may differ.

    :raises ConfigurationError: they are of different campaigns, or played nothing in common; names what differs.
    :raises RecordingError: a campaign's file is damaged, or holds no valid trial.
    """
    match a, b:
        case Recorded(), Recorded():
            return compare(*common_plays(a, b), alpha, a.estimates)
        case Campaign(), Campaign():
            _check_same("A and B are different campaigns", _decisive_settings(a.plan), _decisive_settings(b.plan))
            return _compare_campaigns(a, b, alpha)
    raise ConfigurationError("A and B cannot be compared: one is a campaign, the other are recordings")


def common_plays(a: Recorded, b: Recorded) -> tuple[Sequence[Observation], Sequence[Observation]]:
    """Recordings of both sides that played the same.

    :raises ConfigurationError: they played nothing in common; names what differs.
    """
    common = {key[:-1] for key, _ in a.trials} & {key[:-1] for key, _ in b.trials}
    if not common:
        _check_same("A and B played nothing in common", *(_recorded_tables(side.trials[0]) for side in (a, b)))
    ours, theirs = ([each for each in side.trials if each[0][:-1] in common] for side in (a, b))
    return ours, theirs


def _compare_campaigns(a: Campaign, b: Campaign, alpha: float) -> Comparison:
    valid, played, common = np.zeros(2, np.int64), np.zeros(2, np.int64), 0
    pairing, cells = Pairing(a.plan.spec.trials, _measures(a.plan.estimates)), _matched_cells(a.plan, b.plan)
    with Store.read(a.path) as ours, Store.read(b.path) as theirs:
        step = max(1, SEEDS_AT_ONCE // a.plan.size)
        for first in range(0, a.plan.spec.trials, step):
            window = range(first, min(first + step, a.plan.spec.trials))
            pairs: list[tuple[NDArray[np.int64], Trials, Trials]] = []
            for mine, other in enumerate(cells):
                x, y = _read(ours, a.plan, mine, window), _read(theirs, b.plan, other, window)
                valid += np.count_nonzero(x.is_valid), np.count_nonzero(y.is_valid)
                played += len(x), len(y)
                both = np.flatnonzero(x.is_valid[: len(y)] & y.is_valid[: len(x)])
                if len(both):
                    pairs.append((window.start + both, x.at(both), y.at(both)))
            if pairs:
                places, xs, ys = zip(*pairs, strict=True)
                pairing.add(np.concatenate(places), Trials.joined(xs), Trials.joined(ys))
                common += sum(map(len, places))
    for side, count in zip((a, b), valid.tolist(), strict=True):
        if not count:
            raise RecordingError(f"{side.path}: holds no valid trial")
    counts = (valid.tolist(), played.tolist())
    return _comparison(
        pairing.differences(),
        alpha,
        (counts[0][0], counts[0][1]),
        (counts[1][0], counts[1][1]),
        (pairing.identical, common),
    )


_COMPARED = ("outcome", "armed", "false_alarms", "change", "latency_n", "bound_n", "error", "theta")


def _read(store: Store, plan: Plan, cell: int, window: range) -> Trials:
    """Trials of a cell whose places are in ``window``: those from its start on, up to the end of the cell."""
    begin = cell * plan.spec.trials
    found = []
    for part, trials in store.parts(plan, range(begin + window.start, begin + window.stop), _COMPARED):
        if part.cell == cell:
            found.append(trials[max(0, window.start - part.first) : max(0, window.stop - part.first)])
    return Trials.joined(found)


def _matched_cells(a: Plan, b: Plan) -> list[int]:
    """Cells of b in the order of those of a: devices are matched by name, or by place if their names differ."""
    wanted, names = _names(a), _names(b)
    cells = b.cells()
    if set(wanted) != set(names):
        return list(range(len(cells)))
    places = {(cell.rig, names[cell.device], *cell.values.items()): i for i, cell in enumerate(cells)}
    return [places[cell.rig, wanted[cell.device], *cell.values.items()] for cell in a.cells()]


def _check_same(otherwise: str, ours: Any, theirs: Any) -> None:
    if differences := list_differences(ours, theirs, ("in A", "in B")):
        raise ConfigurationError(f"{otherwise}: {differences}")


def _names(plan: Plan) -> list[str]:
    """Names of the devices."""
    return [str(device["name"]) for device in plan.devices]


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


def _load_recordings(paths: Sequence[Path]) -> Recorded:
    estimates: tuple[str, ...] = ()
    found: dict[tuple[object, ...], tuple[Path, Row]] = {}
    for path in paths:
        key, trial, named = _load_recording(path)
        estimates = estimates or named
        if key in found:
            raise ConfigurationError(f"{found[key][0]} and {path} are of one scenario, rig and seed: which is meant?")
        found[key] = path, trial
    return Recorded(tuple((key, trial) for key, (_, trial) in found.items()), estimates)


def _load_recording(path: Path) -> tuple[Any, Row, tuple[str, ...]]:
    """Key and row of a recording, and the parameters that it estimates."""
    run = Run.load(path)
    of = run.conditions
    played = json.dumps(dict(of.scenario), sort_keys=True)  # many may have one name: what strategies draw
    machine = json.dumps(_without_names(of.rig), sort_keys=True)
    return (played, machine, of.seed), row(run, judge(run)), of.program.estimates
