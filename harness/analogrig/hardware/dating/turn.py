"""A pot that a hand turns, slowly: when it began to turn and when it stood, learned from the samples.

As ``jump``, but that between the two instants the plant is on its way. How a hand goes nobody knows: it may
turn evenly, or begin and end gently (least jerk; Flash and Hogan 1985). Both are tried, and the intervals are those of
whatever the samples do not refuse. Two pots that jump one after the other are such a turn too, with a plant between
them that is known. The plants at both ends are those that the samples before and after the range tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig.hardware.dating.jump import CONFIDENCE, Guess, Instant, NoInstant, Problem, beside, doubt, interval
from analogrig.hardware.dating.two_filter import Array, Backwards, EdgePlace, Forwards, PlantModel, Signals, joined
from analogrig.plant import PARAMETERS, Plant

Indices = NDArray[np.int64]

_PARTS = 33
"""Of the way, at which the plant is worked out; between them it is interpolated."""
_GRID_N = 16
"""Instants that are tried at a time, for begin and end each."""
_ZOOMS = 12
_LIKELY = 12.0
"""Twice the logarithm of the likelihood ratio to the best, up to which a pair of instants is looked at more closely."""
_BESIDE = 0.03
"""Of the time of a turn: its instants may lie so far beside, since the way is not quite one of the shapes; the pots'
load alone makes it 2 %."""
_FINE_N = 8
"""Instants within an interval that show its ends well enough."""


@dataclass(frozen=True)
class TurnInstants:
    """From the last sample that cannot tell of it to the first at which the plant has become another one."""

    begin: Instant
    end: Instant

    def wider(self, search: range, part: float) -> TurnInstants:
        """By a part of the time that it takes, within the range."""
        more = round(part * (self.end.sample - self.begin.sample))
        begin, end = (
            Instant(each.sample, max(each.low - more, search.start), min(each.high + more, search.stop - 1))
            for each in (self.begin, self.end)
        )
        return TurnInstants(begin, end)


Shape = Callable[[Array], Array]
"""Of a way: the part of it that is gone after a part of the time."""


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
    """When a pot began to turn and when it stood, both in ``search``; other arguments as of
    ``analogrig.hardware.dating.onset``.

    :param middle: two pots jumped, one after the other, and between the two the plant was this one.
    :raises ValueError: the range is empty, or leaves the record or ``within``.
    """
    problem, guess = Problem.of(signals, before, after, search, within).fitted()
    ways = _Ways.of(problem, guess) if middle is None else _Ways.stopping(problem, guess, middle)
    shapes = (_evenly, _gently) if middle is None else (_evenly,)
    every = [_zoomed(ways, shape, problem.candidates, confidence) for shape in shapes]
    every.sort(key=lambda tried: float(tried.cost.min()))
    best = every[0]
    at = int(best.cost.argmin())
    unexplained = float(best.fit[at]) / max(1, int(problem.signals.valid.sum()))
    if objection := problem.objection(float(best.cost[at]), unexplained, guess):
        return objection
    if best.begin[at] == problem.candidates.start or best.end[at] == problem.candidates.stop - 1:
        return NoInstant(f"the turn seems to go on beyond the samples {search.start} to {search.stop - 1}")
    doubted = doubt(guess, max(unexplained, float(best.on_the_way[at])))
    likely = [tried for tried in every if tried.cost.min() - best.cost[at] <= _LIKELY * doubted]
    shift = search.start - problem.candidates.start
    found = TurnInstants(
        _over([_instant(tried.begin, tried.cost / doubted, confidence) for tried in likely], shift),
        _over([_instant(tried.end, tried.cost / doubted, confidence) for tried in likely], shift),
    )
    return found.wider(search, _BESIDE if middle is None else 0.0)


@dataclass(frozen=True, eq=False)
class _Tried:
    """Pairs (p,) of instants and what the samples say of them."""

    begin: Indices
    end: Indices
    cost: Array
    """Twice the negative logarithm of the likelihood."""
    fit: Array
    """What is left of the samples."""
    on_the_way: Array
    """... of those between the two, of each on average."""


def _zoomed(ways: _Ways, shape: Shape, candidates: slice, confidence: float) -> _Tried:
    """Pairs that lie closer and closer about the likeliest, until they show the intervals."""
    spans = [(candidates.start, candidates.stop - 1)] * 2
    for _ in range(_ZOOMS):
        begins, ends = (_instants(*span) for span in spans)
        tried = ways.tried(begins, ends, shape)
        if all(_fine(each, tried.cost, confidence) for each in (tried.begin, tried.end)):
            break
        likely = tried.cost - tried.cost.min() <= _LIKELY
        spans = [
            _around(each[likely], 2 * _step(grid), candidates)
            for each, grid in ((tried.begin, begins), (tried.end, ends))
        ]
    return tried


def _instants(first: int, last: int) -> Indices:
    return np.unique(np.linspace(first, last, _GRID_N).round().astype(np.int64))


def _step(instants: Indices) -> int:
    return int(np.diff(instants).max(initial=1))


def _around(instants: Indices, beside: int, candidates: slice) -> tuple[int, int]:
    low, high = int(instants.min()) - beside, int(instants.max()) + beside
    return max(low, candidates.start), min(high, candidates.stop - 1)


def _marginal(instants: Indices, cost: Array) -> tuple[Indices, Array]:
    """The instants that are tried, each once, and the cost of each over all its pairs."""
    once, at = np.unique(instants, return_inverse=True)
    likelihood = np.zeros(len(once))
    np.add.at(likelihood, at, np.exp(-0.5 * (cost - cost.min())))
    return once, -2.0 * np.log(np.maximum(likelihood, np.finfo(np.float64).tiny))


def _fine(instants: Indices, cost: Array, confidence: float) -> bool:
    once, marginal = _marginal(instants, cost)
    if _step(once) == 1:
        return True
    found = interval(marginal, once, confidence)
    return int(((once >= found.low) & (once <= found.high)).sum()) >= _FINE_N


def _instant(instants: Indices, cost: Array, confidence: float) -> Instant:
    """With an interval that reaches to the next instants that were tried and refused."""
    once, marginal = _marginal(instants, cost)
    found, between = interval(marginal, once, confidence), _step(once) - 1
    return Instant(int(instants[cost.argmin()]), found.low - between, found.high + between)


def _over(found: Sequence[Instant], shift: int) -> Instant:
    """Over all shapes, the likeliest one first."""
    return Instant(
        found[0].sample + shift, min(each.low for each in found) + shift, max(each.high for each in found) + shift
    )


@dataclass(frozen=True, eq=False)
class _Ways:
    """All that is needed to go from the one plant to the other, between any two instants."""

    signals: Signals
    old: Forwards
    new: Backwards
    offset: float
    """Of the displacement, in the rms of its noise."""
    parts: Array
    """(_PARTS, 12): transition, response and edge, covariance of the edge, offset of the force, along the way."""

    @classmethod
    def of(cls, problem: Problem, guess: Guess) -> Self:
        old, new = beside(problem.before, guess.old), beside(problem.after, guess.new)
        parts = np.linspace(0.0, 1.0, _PARTS).tolist()
        offsets = np.linspace(guess.old[0], guess.new[0], _PARTS).tolist()
        rows = [
            _row(problem.signals, old.on_the_way(new, part), guess.edges, offset)
            for part, offset in zip(parts, offsets, strict=True)
        ]
        return cls(problem.signals, *problem.filters(guess), guess.offset, np.array(rows))

    @classmethod
    def stopping(cls, problem: Problem, guess: Guess, middle: Plant) -> Self:
        """All the way the plant is one that has of each parameter the old or the new value."""
        turned = problem.before.changes_to(middle)
        own = [guess.new[1 + i] if name in turned else guess.old[1 + i] for i, name in enumerate(PARAMETERS)]
        offset = 0.5 * float(guess.old[0] + guess.new[0])
        row = _row(problem.signals, beside(middle, np.array([offset, *own])), guess.edges, offset)
        return cls(problem.signals, *problem.filters(guess), guess.offset, np.tile(row, (_PARTS, 1)))

    def tried(self, begins: Indices, ends: Indices, shape: Shape) -> _Tried:
        """Every pair in which the end is after the begin; those that take longest first."""
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
            a, b, c, d, gx, gv, ex, ev, exx, exv, evv, offset = self._at(shape((k + 0.5) / lengths[on]))
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
        form, met = joined(state, covariance, self.new.vector[end][:, :, :1], self.new.information[end])
        fit = fit + own + form[:, 0, 0] + self.new.misfit[end, 0, 0]
        return _Tried(begin, end, fit + log + met + self.new.log[end], fit, own / lengths)

    def _at(self, part: Array) -> Array:
        """(12, p): the columns of ``parts`` at these parts of the way."""
        place = part * (_PARTS - 1)
        lower = np.minimum(place.astype(np.int64), _PARTS - 2)
        beyond = (place - lower)[:, None]
        return np.asarray((self.parts[lower] * (1.0 - beyond) + self.parts[lower + 1] * beyond).T)


def _row(signals: Signals, plant: Plant, edges: EdgePlace, offset: float) -> Array:
    """(12,) of ``_Ways.parts``."""
    model = PlantModel.of(plant, edges, signals)
    covariance = model.edge_covariance[[0, 0, 1], [0, 1, 1]]
    return np.concatenate([model.transition.ravel(), model.response, model.edge, covariance, [offset]])


def _evenly(part: Array) -> Array:
    return part


def _gently(part: Array) -> Array:
    """With the least jerk."""
    return part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
