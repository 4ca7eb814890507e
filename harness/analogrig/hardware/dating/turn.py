"""Dates of a pot change that takes time: the instants at which the pot began and ceased to turn.

Between the two instants the plant is on a path from the old values to the new ones. The speed of a hand is unknown: it
may turn evenly, or begin and end gently (least jerk; Flash and Hogan 1985). Both shapes are tried, and the intervals
cover each shape that the samples do not reject. Two pots that jump in succession are such a turn as well, with a known
plant in between. The plants at both ends are fitted to the samples before and after the search range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig.hardware.dating.jump import (
    CONFIDENCE,
    Guess,
    Instant,
    NoInstant,
    Problem,
    deviate,
    interval,
    overdispersion,
)
from analogrig.hardware.dating.two_filter import Array, BackwardFilter, ForwardFilter, PlantModel, Signals, join
from analogrig.plant import PARAMETERS, Plant

Indices = NDArray[np.int64]

_POINTS = 33
"""Points of the path at which the plant is computed; values between them are interpolated."""
_GRID_N = 16
"""Instants per grid, for begin and end each."""
_ZOOMS = 12
_LIKELY = 12.0
"""Largest cost difference to the best pair of instants that the next, finer grid covers."""
_SHAPE_ERROR = 0.03
"""Part of the turn's duration that is added to each interval, since no path has exactly one of the shapes. The load of
the pots alone makes it 2 %."""
_FINE_N = 8
"""Grid points within an interval that resolve its ends."""


@dataclass(frozen=True)
class TurnInstants:
    """Last sample before the turn has an effect, and first sample at which the plant is the new one."""

    begin: Instant
    end: Instant


Shape = Callable[[Array], Array]
"""Part of the path that is done after a part of the time."""


def date_turn(
    signals: Signals,
    before: Plant,
    after: Plant | None,
    search: range,
    *,
    middle: Plant | None = None,
    within: range | None = None,
    confidence: float = CONFIDENCE,
) -> TurnInstants | NoInstant:
    """Estimate the instants, both in ``search``, at which a pot began and ceased to turn.

    Other parameters and errors as for ``analogrig.hardware.dating.jump.date_jump``.

    :param middle: plant between the jumps of two pots; None: one pot turns.
    """
    problem, guess = Problem.of(signals, before, after, search, within).start()
    path = _Path.of(problem, guess, middle)
    every = [
        _zoom(path, shape, problem.candidates, confidence)
        for shape in ((_even, _least_jerk) if middle is None else (_even,))
    ]
    every.sort(key=lambda pairs: float(pairs.cost.min()))
    best = every[0]
    at = int(best.cost.argmin())
    unexplained = float(best.fit[at]) / max(1, int(problem.signals.valid.sum()))
    if objection := problem.objection(float(best.cost[at]), unexplained, guess):
        return objection
    if best.begin[at] == problem.candidates.start or best.end[at] == problem.candidates.stop - 1:
        return NoInstant(f"the turn seems to go on beyond the samples {problem.span}")
    divisor = overdispersion(guess, max(unexplained, float(best.path_misfit[at])))
    likely = [pairs for pairs in every if pairs.cost.min() - best.cost[at] <= _LIKELY * divisor]
    begins = [_estimate(pairs.begin, pairs.cost / divisor, confidence) for pairs in likely]
    ends = [_estimate(pairs.end, pairs.cost / divisor, confidence) for pairs in likely]
    wider_n = round(_SHAPE_ERROR * (ends[0].sample - begins[0].sample)) if middle is None else 0
    shift = search.start - problem.candidates.start
    return TurnInstants(*(_union(instants, shift, wider_n, search) for instants in (begins, ends)))


@dataclass(frozen=True, eq=False)
class _Pairs:
    """p pairs of instants and their likelihood; all arrays (p,)."""

    begin: Indices
    end: Indices
    cost: Array
    """Twice the negative log-likelihood."""
    fit: Array
    """Sum of the squared residuals of all samples, in units of their noise."""
    path_misfit: Array
    """Mean square of those between the two instants."""


def _zoom(path: _Path, shape: Shape, candidates: slice, confidence: float) -> _Pairs:
    """Evaluate ever finer grids about the most likely pair until they resolve both intervals."""
    spans = [(candidates.start, candidates.stop - 1)] * 2
    for _ in range(_ZOOMS):
        begins, ends = (np.unique(np.linspace(*span, _GRID_N).round().astype(np.int64)) for span in spans)
        pairs = path.evaluate(begins, ends, shape)
        if all(_is_fine(each, pairs.cost, confidence) for each in (pairs.begin, pairs.end)):
            break
        likely = pairs.cost - pairs.cost.min() <= _LIKELY
        spans = [
            _around(each[likely], 2 * _step(grid), candidates)
            for each, grid in ((pairs.begin, begins), (pairs.end, ends))
        ]
    return pairs


def _step(instants: Indices) -> int:
    return int(np.diff(instants).max(initial=1))


def _around(instants: Indices, margin: int, candidates: slice) -> tuple[int, int]:
    low, high = int(instants.min()) - margin, int(instants.max()) + margin
    return max(low, candidates.start), min(high, candidates.stop - 1)


def _marginal(instants: Indices, cost: Array) -> tuple[Indices, Array]:
    """Distinct instants and the marginal cost of each over all its pairs."""
    once, at = np.unique(instants, return_inverse=True)
    likelihood = np.zeros(len(once))
    np.add.at(likelihood, at, np.exp(-0.5 * (cost - cost.min())))
    return once, -2.0 * np.log(np.maximum(likelihood, np.finfo(np.float64).tiny))


def _is_fine(instants: Indices, cost: Array, confidence: float) -> bool:
    once, marginal = _marginal(instants, cost)
    if _step(once) == 1:
        return True
    found = interval(marginal, once, confidence)
    return int(((once >= found.low) & (once <= found.high)).sum()) >= _FINE_N


def _estimate(instants: Indices, cost: Array, confidence: float) -> Instant:
    """Best instant; the interval extends to the next instants of the grid that are rejected."""
    once, marginal = _marginal(instants, cost)
    found, between = interval(marginal, once, confidence), _step(once) - 1
    return Instant(int(instants[cost.argmin()]), found.low - between, found.high + between)


def _union(instants: Sequence[Instant], shift: int, wider_n: int, search: range) -> Instant:
    """First instant, with an interval that covers those of all; shifted, widened and kept within ``search``."""
    low, high = min(each.low for each in instants) + shift, max(each.high for each in instants) + shift
    return Instant(instants[0].sample + shift, max(low - wider_n, search.start), min(high + wider_n, search.stop - 1))


@dataclass(frozen=True, eq=False)
class _Path:
    """Plants between the old one and the new one, and the filters at both ends."""

    signals: Signals
    old: ForwardFilter
    new: BackwardFilter
    offset: float
    """Offset of the displacement, in rms of its noise."""
    points: Array
    """(_POINTS, 12): transition, response and edge, covariance of the edge, offset of the force."""

    @classmethod
    def of(cls, problem: Problem, guess: Guess, middle: Plant | None) -> Self:
        """Path of one pot, or that of two which stays at ``middle``."""
        if middle is None:
            old, new = deviate(problem.before, guess.old), deviate(problem.after, guess.new)
            parts, offsets = np.linspace([0.0, guess.old[0]], [1.0, guess.new[0]], _POINTS).T.tolist()
            plants = [old.on_the_way(new, part) for part in parts]
        else:
            # Each parameter of the middle plant has its old or its new deviation.
            changed = problem.before.changes_to(middle)
            own = [guess.new[1 + i] if name in changed else guess.old[1 + i] for i, name in enumerate(PARAMETERS)]
            offsets = [0.5 * float(guess.old[0] + guess.new[0])] * _POINTS
            plants = [deviate(middle, np.array([0.0, *own]))] * _POINTS
        rows = []
        for plant, offset in zip(plants, offsets, strict=True):
            model = PlantModel.of(plant, guess.edges, problem.signals)
            covariance = model.edge_covariance[[0, 0, 1], [0, 1, 1]]
            rows.append(np.concatenate([model.transition.ravel(), model.response, model.edge, covariance, [offset]]))
        return cls(problem.signals, *problem.filters(guess), guess.offset, np.array(rows))

    def evaluate(self, begins: Indices, ends: Indices, shape: Shape) -> _Pairs:
        """Evaluate every pair with its end after its begin, the longest first.

        A Kalman filter runs along the path of all pairs at once; only the pairs that last so long are updated.
        """
        begin, end = (each.ravel() for each in np.meshgrid(begins, ends, indexing="ij"))
        begin, end = begin[begin < end], end[begin < end]
        longest_first = np.argsort(begin - end, kind="stable")
        begin, end = begin[longest_first], end[longest_first]
        x, v = self.old.state[begin, :, 0].T
        p, q, r = self.old.covariance[begin][:, [0, 0, 1], [0, 1, 1]].T
        x, v, p, q, r = (each.copy() for each in (x, v, p, q, r))
        fit, log = self.old.misfit[begin, 0, 0].copy(), self.old.log[begin].copy()
        lengths, own = end - begin, np.zeros(len(begin))
        for k in range(int(lengths.max())):
            on = slice(0, int((lengths > k).sum()))
            a, b, c, d, gx, gv, ex, ev, exx, exv, evv, offset = self._interpolate(shape((k + 0.5) / lengths[on]))
            at = begin[on] + k
            force, edge = self.signals.force_n[at] + offset * self.signals.noise_n, self.signals.edges_n[at]
            x[on], v[on] = (
                a * x[on] + b * v[on] + gx * force + ex * edge,
                c * x[on] + d * v[on] + gv * force + ev * edge,
            )
            noise, jolt = self.signals.noise_n**2, edge**2
            p[on], q[on], r[on] = (
                a * a * p[on] + 2.0 * a * b * q[on] + b * b * r[on] + noise * gx * gx + jolt * exx,
                a * c * p[on] + (a * d + b * c) * q[on] + b * d * r[on] + noise * gx * gv + jolt * exv,
                c * c * p[on] + 2.0 * c * d * q[on] + d * d * r[on] + noise * gv * gv + jolt * evv,
            )
            weight = self.signals.valid[at + 1]
            size = 1.0 + weight * p[on]
            innovation = self.signals.displacement_m[at + 1] / self.signals.noise_m - self.offset - x[on]
            own[on] += weight * innovation**2 / size
            log[on] += np.log(size)
            gain, other = weight * p[on] / size, weight * q[on] / size
            x[on] += gain * innovation
            v[on] += other * innovation
            p[on], q[on], r[on] = p[on] - gain * p[on], q[on] - gain * q[on], r[on] - other * q[on]
        state = np.stack([x, v], axis=1)[:, :, None]
        covariance = np.stack([p, q, q, r], axis=1).reshape(-1, 2, 2)
        form, met = join(state, covariance, self.new.vector[end][:, :, :1], self.new.information[end])
        fit = fit + own + form[:, 0, 0] + self.new.misfit[end, 0, 0]
        return _Pairs(begin, end, fit + log + met + self.new.log[end], fit, own / lengths)

    def _interpolate(self, part: Array) -> Array:
        """(12, p) columns of ``points`` at p parts of the path."""
        place = part * (_POINTS - 1)
        lower = np.minimum(place.astype(np.int64), _POINTS - 2)
        beyond = (place - lower)[:, None]
        return np.asarray((self.points[lower] * (1.0 - beyond) + self.points[lower + 1] * beyond).T)


def _even(part: Array) -> Array:
    return part


def _least_jerk(part: Array) -> Array:
    return part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
