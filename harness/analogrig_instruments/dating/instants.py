"""Dates of a pot change: the most likely instants, with confidence intervals.

A pot that an operator or a slow command sets changes the plant at unknown samples. The plant before the change explains
the samples up to it, the plant after it those that follow (``analogrig_instruments.dating.two_filter``). Other unknowns
are estimated jointly: the parameters before and after, since a real rig deviates from its nominal values by some per
cent; the offsets of both channels; the place of the force's edges in a sample period.

``date_jump`` dates a change at once, ``date_turn`` one that takes time: a pot that is turned by hand, or two pots that
jump in succession. Intervals hold every instant that the likelihood-ratio test accepts, and at least the requested
share of the likelihood. They are wide where a change has no effect: a mass or a damper that changes at rest shows at
the next edge.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig import Plant
from analogrig_instruments.dating.two_filter import (
    COMMON,
    DIFFUSE,
    OWN,
    Array,
    BackwardFilter,
    EdgePlace,
    ForwardFilter,
    Motion,
    PlantModel,
    Signals,
    join,
    scan,
)

CONFIDENCE = 0.95

WINDOW_N = 500
"""Samples used before and after the search range, from which both plants are estimated."""

# Standard deviations of the unknowns before any sample is seen.
_NOMINAL = 0.1
"""Deviation of the logarithms of parameters before the change from their set values: components, gains."""
_CHANGED, _UNCHANGED, _UNKNOWN = 0.1, 0.005, 0.5
"""Deviation of each ratio of a parameter after to before from its set value: if it is to change; if not, for what the
plant does not explain of a rig; if the plant after the change is unknown."""
_OFFSET = 100.0
"""Offset of either channel, in rms of its noise."""
_OFFSET_CHANGE = 2.0
"""Change of the force's offset with the pots, in rms of its noise: the amplifiers around the pots have offsets."""
_PLACE = 0.3
"""Mean place of the edges in a sample period."""

_ANYWHERE, _LOCKED = 0.5, 0.05
"""Half width of the edges' place: of a free generator, and of one that shares the card's clock, or nearly."""
_MIDDLE = 0.5

_EXCESS = 1.5
"""Variance ratio of residuals to noise above which the edges may lie anywhere."""

_ROUNDS = 8
_CONVERGED = 5e-3
"""Largest change of the logarithms of parameters that counts as linear: the error is 0.02 of the noise."""
_LARGEST_STEP = 0.3
"""Largest change of the logarithms of parameters per iteration."""

_LEAST_NOISE, _LEAST_NOISE_FORCE = 8e-4, 2.5e-4
"""Least noise of displacement and force, rms, in parts of their swing: about that of 12 bits at full range. Real
components (dielectric absorption above all) deviate from one mass, damper and spring by as much."""
_RISE = 0.5
"""Largest cost difference of two neighbours at the end of the search range that is flat."""
_LEAST_OVERDISPERSION = 1.3
"""Gives the intervals their nominal coverage on machines of real components."""
_SETTLING_N = 20
"""Innovations after which the initial state of a filter has decayed."""
_LAGS_N = 30
"""Lags of the long-run variance."""

_CHANCE = 2.0 * math.log(20.0)
"""Least gain in cost by which a change explains the samples better than none, beyond that of the best of so many
instants by chance."""
_MOST_UNEXPLAINED, _MOST_NOISE_RATIO = 25.0, 1000.0
"""Largest variance ratios of the residuals to the noise beside the search range, and of that noise to the stated one:
beyond them the samples are not those of such a plant."""

# Turns.
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

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Instant:
    """Estimated instant of a change: the last sample that is independent of it, with its confidence interval."""

    sample: int
    low: int
    high: int
    """Ends of the interval, both included."""


@dataclass(frozen=True)
class TurnInstants:
    """Last sample before the turn has an effect, and first sample at which the plant is the new one."""

    begin: Instant
    end: Instant


@dataclass(frozen=True)
class NoInstant:
    """The samples date no change."""

    reason: str
    unchanged: bool = False
    """True if the samples show no change at all."""


def date_jump(
    signals: Signals,
    before: Plant,
    after: Plant | None,
    search: range,
    *,
    within: range | None = None,
    confidence: float = CONFIDENCE,
) -> Instant | NoInstant:
    """Estimate the instant at which the plant jumped.

    :param before: plant as set; the real one may deviate by some per cent.
    :param after: plant as set after the change; None: unknown.
    :param search: indices of ``signals``, one of which is the instant.
    :param within: indices between which the plant changes no other time; None: all.
    :param confidence: of the interval.
    :raises ValueError: ``search`` is empty, or leaves the record or ``within``.
    """
    problem = _Problem.of(signals, before, after, search, within)
    beside = problem.fit_beside()
    fit = problem.fit(beside.guess)
    if fit.unexplained > _EXCESS:
        anywhere = problem.fit(dataclasses.replace(beside.guess, half_width=_ANYWHERE))
        fit = min(fit, anywhere, key=lambda each: float(each.cost.min()))
    divisor = problem.overdispersion(beside.guess, fit.unexplained)
    if objection := problem.objection(fit, beside, divisor):
        return objection
    cost = fit.cost / divisor
    best = int(cost.argmin())
    inwards = {0: 1, len(cost) - 1: len(cost) - 2}.get(best, best)
    if len(cost) > 1 and cost[inwards] - cost[best] > _RISE:
        return NoInstant(f"the plant seems to have changed before or after the samples {problem.span}")
    return interval(cost, np.arange(search.start, search.stop), confidence)


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

    Between them the plant is on a path from the old values to the new ones. The speed of a hand is unknown: it may turn
    evenly, or begin and end gently. Both shapes are tried, and the intervals cover each that the samples do not reject.
    Other parameters and errors as for ``date_jump``.

    :param middle: plant between the jumps of two pots; None: one pot turns.
    """
    problem = _Problem.of(signals, before, after, search, within)
    beside = problem.fit_beside()
    path = _Path.of(problem, beside.guess, middle)
    shapes = (False, True) if middle is None else (False,)
    every = [path.search(gentle=gentle, confidence=confidence) for gentle in shapes]
    every.sort(key=lambda pairs: float(pairs.cost.min()))
    best = every[0]
    at = int(best.cost.argmin())
    unexplained = float(best.fit[at]) / max(1, int(problem.signals.valid.sum()))
    fit = dataclasses.replace(problem.profile(beside.guess), cost=best.cost, unexplained=unexplained)
    divisor = problem.overdispersion(beside.guess, max(unexplained, float(best.path_misfit[at])))
    if objection := problem.objection(fit, beside, divisor):
        return objection
    first, last = problem.candidates.start, problem.candidates.stop - 1
    if best.begin[at] == first or best.end[at] == last:
        return NoInstant(f"the turn seems to go on beyond the samples {problem.span}")
    likely = [pairs for pairs in every if pairs.cost.min() - best.cost[at] <= _LIKELY * divisor]
    wider_n = round(_SHAPE_ERROR * int(best.end[at] - best.begin[at])) if middle is None else 0
    found = []
    for name in ("begin", "end"):
        each = [_estimate(getattr(pairs, name), pairs.cost / divisor, confidence)[0] for pairs in likely]
        low = max(min(instant.low for instant in each) - wider_n, first)
        high = min(max(instant.high for instant in each) + wider_n, last)
        found.append(Instant(*(sample + search.start - first for sample in (each[0].sample, low, high))))
    return TurnInstants(*found)


def interval(cost: Array, samples: Indices, confidence: float) -> Instant:
    """Most likely of ``samples``, which ascend, and its confidence interval.

    :param cost: twice the negative log-likelihood of each sample.
    """
    likelihood = np.exp(-0.5 * (cost - cost.min()))
    best_first = np.argsort(cost, kind="stable")
    held = np.cumsum(likelihood[best_first]) / likelihood.sum()
    inside = cost - cost.min() <= NormalDist().inv_cdf(0.5 + 0.5 * confidence) ** 2
    inside[best_first[: int(np.searchsorted(held, confidence)) + 1]] = True
    low, high = samples[np.flatnonzero(inside)[[0, -1]]].tolist()
    return Instant(int(samples[best_first[0]]), low, high)


# ---- jumps

_OLD = np.r_[0 : 1 + COMMON + OWN]
_NEW = np.r_[0 : 1 + COMMON, 1 + COMMON + OWN : 1 + COMMON + 2 * OWN]
"""Indices of each filter's columns among the known one and all unknowns."""


@dataclass(frozen=True, eq=False)
class _Guess:
    """Current values of the unknowns."""

    unknowns: Array
    """(10,): offset of the displacement in rms of its noise; mean place of the edges less 0.5; then, for the plant
    before and for that after, the offset of the force in rms of its noise and the logarithms of the parameters over
    their set values."""
    half_width: float = _ANYWHERE
    sample: int = 0
    """Instant of the change, as an index of the window."""

    @property
    def own(self) -> tuple[Array, Array]:
        """Unknowns (4,) of the plants before and after."""
        return self.unknowns[COMMON : COMMON + OWN], self.unknowns[COMMON + OWN :]

    @property
    def edges(self) -> EdgePlace:
        place = 0.0 if self.half_width == _ANYWHERE else float(np.clip(self.unknowns[1], -0.5, 0.5))
        return EdgePlace(_MIDDLE + place, self.half_width)


@dataclass(frozen=True, eq=False)
class _ProfileLikelihood:
    """Profile likelihood: cost of each candidate instant at its best values of the unknowns."""

    guess: _Guess
    """Values of the unknowns at the most likely instant, and that instant."""
    cost: Array
    """(candidates,): twice the negative log-likelihood, up to a constant."""
    unchanged: float
    """The same without a change."""
    unexplained: float
    """Variance ratio of residuals to noise at the most likely instant."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """Window of a record with the candidate instants and what is known beforehand."""

    signals: Signals
    search: range
    """Candidates as indices of the record."""
    candidates: slice
    """Candidates as indices of the window."""
    plants: tuple[Plant, Plant]
    """Before and after, as set."""
    prior: Array
    """(10, 10): unknowns in prior standard deviations."""
    gap: float = 0.0
    """Variance that is added to the state at the instant, in units of the noise variance."""

    @classmethod
    def of(cls, signals: Signals, before: Plant, after: Plant | None, search: range, within: range | None) -> Self:
        """Problem of ``date_jump``'s arguments.

        :raises ValueError: ``search`` is empty, or leaves the record or ``within``.
        """
        if search.step != 1 or not 0 <= search.start < search.stop <= len(signals):
            raise ValueError(f"{search} is empty or leaves the {len(signals)} samples of the record")
        alone = within or range(len(signals))
        if not alone.start <= search.start < search.stop <= alone.stop:
            raise ValueError(f"{search} leaves {alone}, in which the plant changes no other time")
        first = max(search.start - WINDOW_N, alone.start, 0)
        changed = before.changes_to(after or before)
        changes = [
            _UNKNOWN if after is None else _CHANGED if name in changed else _UNCHANGED for name in before.parameters()
        ]
        deviations = [_OFFSET, _PLACE, _OFFSET, *[_NOMINAL] * (OWN - 1), _OFFSET_CHANGE, *changes]
        rows = np.eye(len(deviations))
        rows[COMMON + OWN :, COMMON : COMMON + OWN] = -np.eye(OWN)  # the plant after is known by its change
        return cls(
            _with_least_noise(signals.part(first, min(search.stop + WINDOW_N, alone.stop))),
            search,
            slice(search.start - first, search.stop - first),
            (before, after or before),
            rows / np.array(deviations)[:, None],
        )

    @property
    def span(self) -> str:
        """First and last sample of the search range, for messages."""
        return f"{self.search.start} to {self.search.stop - 1}"

    def fit_beside(self) -> _ProfileLikelihood:
        """Fit to the samples beside the search range alone; edges anywhere or locked, whichever is more likely."""
        valid = self.signals.valid.copy()
        valid[self.candidates] = False
        signals, last = dataclasses.replace(self.signals, valid=valid), self.candidates.stop - 1
        beside = dataclasses.replace(self, signals=signals, candidates=slice(last, last + 1), gap=DIFFUSE)
        anywhere = beside.fit(_Guess(np.zeros(COMMON + 2 * OWN)))
        locked = beside.fit(dataclasses.replace(anywhere.guess, half_width=_LOCKED))
        return min(anywhere, locked, key=lambda each: float(each.cost.min()))

    def fit(self, guess: _Guess) -> _ProfileLikelihood:
        """Iterate ``profile`` from ``guess`` until the parameters have converged."""
        for _ in range(_ROUNDS):
            last, fit = guess, self.profile(guess)
            guess = fit.guess
            if np.abs(np.subtract(guess.own, last.own)[:, 1:]).max() < _CONVERGED:
                break
        return fit

    def profile(self, guess: _Guess) -> _ProfileLikelihood:
        """Profile likelihood of all candidates, linear in the unknowns about ``guess``."""
        old, new = self.filters(guess)
        at = np.append(np.r_[self.candidates], len(self.signals) - 1)
        state, vector = (np.zeros((len(at), 2, 1 + COMMON + 2 * OWN)) for _ in range(2))
        state[:, :, _OLD], vector[:, :, _NEW] = old.state[at], new.vector[at]
        form, log = join(state, old.covariance[at] + self.gap * np.eye(2), vector, new.information[at])
        form[:, _OLD[:, None], _OLD] += old.misfit[at]
        form[:, _NEW[:, None], _NEW] += new.misfit[at]
        unknowns = guess.unknowns.copy()
        unknowns[1] = guess.edges.mean - _MIDDLE
        prior = np.column_stack([self.prior @ unknowns, self.prior])
        form += prior.T @ prior
        steps = -np.linalg.solve(form[:, 1:, 1:], form[:, 1:, :1])[:, :, 0]
        fit = form[:, 0, 0] + (form[:, 0, 1:] * steps).sum(axis=1)
        *cost, unchanged = (fit + log + old.log[at] + new.log[at]).tolist()
        best = int(np.argmin(cost))
        limits = np.array([np.inf, np.inf, *[np.inf, *[_LARGEST_STEP] * (OWN - 1)] * 2])
        return _ProfileLikelihood(
            dataclasses.replace(guess, unknowns=unknowns + np.clip(steps[best], -limits, limits), sample=int(at[best])),
            np.array(cost),
            unchanged,
            float(fit[best]) / max(1, int(self.signals.valid.sum())),
        )

    def motions(self, guess: _Guess, signals: Signals | None = None) -> tuple[Motion, Motion]:
        """Motions of the plants before and after; ``signals``: others than those of the window."""
        signals, offset = self.signals if signals is None else signals, float(guess.unknowns[0])
        before, after = (
            Motion.of(_deviate(plant, own), guess.edges, signals, (offset, float(own[0])))
            for plant, own in zip(self.plants, guess.own, strict=True)
        )
        return before, after

    def filters(self, guess: _Guess) -> tuple[ForwardFilter, BackwardFilter]:
        """Forward filter of the old plant and backward filter of the new one."""
        old, new = self.motions(guess)
        course = _course(old, new, guess.sample)
        return ForwardFilter.of(old, course), BackwardFilter.of(new, course)

    def overdispersion(self, guess: _Guess, unexplained: float) -> float:
        """Divisor of costs that allows for the difference between a rig and its model.

        :param guess: fitted to the samples beside the search range.
        """
        parts = self.signals.part(0, self.candidates.start), self.signals.part(self.candidates.stop, len(self.signals))
        innovations = [
            ForwardFilter.of(self.motions(guess, part)[i], np.zeros((len(part), 2))).innovation[:, 0]
            for i, part in enumerate(parts)
            if len(part)
        ]
        return max(_LEAST_OVERDISPERSION, colour(innovations), unexplained)

    def objection(self, fit: _ProfileLikelihood, beside: _ProfileLikelihood, divisor: float) -> NoInstant | None:
        """Reason to reject the most likely instant; None to accept it."""
        noise_ratio = max(1.0, beside.unexplained)
        if fit.unexplained > _MOST_UNEXPLAINED * noise_ratio or noise_ratio > _MOST_NOISE_RATIO:
            return NoInstant(
                f"the residuals of a plant that changes once have {fit.unexplained:.3g} times the noise variance"
            )
        if fit.unchanged - fit.cost.min() < (_CHANCE + 2.0 * math.log(len(self.search))) * divisor:
            reason = f"nothing in the samples {self.span} shows that the plant has changed"
            return NoInstant(reason, unchanged=True)
        return None


def _with_least_noise(signals: Signals) -> Signals:
    """Signals with at least the noise that stands for the difference between a rig and its model."""
    if not signals.valid.any():
        return signals
    return dataclasses.replace(
        signals,
        noise_n=max(signals.noise_n, _LEAST_NOISE_FORCE * float(np.ptp(signals.force_n[signals.valid]))),
        noise_m=max(signals.noise_m, _LEAST_NOISE * float(np.ptp(signals.displacement_m[signals.valid]))),
    )


def colour(innovations: Sequence[Array]) -> float:
    """Long-run variance of stretches of innovations, at least 1, by Bartlett's window (Newey and West 1987).

    Slow drift, as by dielectric absorption, counts for more than white noise of its size.
    """
    stretches = [each[_SETTLING_N:] for each in innovations if len(each) > _SETTLING_N + _LAGS_N]
    count = sum(map(len, stretches))
    if not count:
        return 1.0
    variance = sum(float(each @ each) for each in stretches) / count
    for lag in range(1, _LAGS_N):
        variance += 2.0 * (1.0 - lag / _LAGS_N) * sum(float(each[lag:] @ each[:-lag]) for each in stretches) / count
    return max(1.0, variance)


def _course(old: Motion, new: Motion, sample: int) -> Array:
    """(n, 2) state of a plant that changes at ``sample``, from the initial state that fits best (least squares)."""
    signals = old.signals
    later = np.arange(len(signals)) >= sample
    terms = np.zeros((len(signals), 2, 3))
    terms[0, :, 1:] = np.eye(2)
    terms[1:, :, 0] = np.where(later[:, None], new.known, old.known)[:-1]
    transitions = np.where(later[:, None, None], new.model.transition, old.model.transition)
    forced, free = np.split(scan(np.concatenate([np.eye(2)[None], transitions[:-1]]), terms), [1], axis=2)
    left = old.measured[:, 0] - forced[:, 0, 0]
    first = np.linalg.lstsq(free[signals.valid, 0], left[signals.valid])[0]
    return np.asarray(forced[:, :, 0] + free @ first)


def _deviate(plant: Plant, own: Array) -> Plant:
    """Plant with the logarithms of the parameters raised by ``own[1:]``."""
    for name, log in zip(plant.parameters(), own[1:].tolist(), strict=True):
        plant = plant.scaled(name, math.exp(log))
    return plant


# ---- turns


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


def _estimate(instants: Indices, cost: Array, confidence: float) -> tuple[Instant, bool]:
    """Best instant of a grid, by the marginal likelihood over all pairs; True if the grid resolves its interval.

    The interval extends to the next instants of the grid that are rejected.
    """
    once, at = np.unique(instants, return_inverse=True)
    likelihood = np.bincount(at, np.exp(-0.5 * (cost - cost.min())))
    marginal = -2.0 * np.log(np.maximum(likelihood, np.finfo(np.float64).tiny))
    found, step = interval(marginal, once, confidence), int(np.diff(once).max(initial=1))
    is_fine = step == 1 or int(((once >= found.low) & (once <= found.high)).sum()) >= _FINE_N
    return Instant(int(instants[cost.argmin()]), found.low - step + 1, found.high + step - 1), is_fine


@dataclass(frozen=True, eq=False)
class _Path:
    """Plants between the old one and the new one, and the filters at both ends."""

    problem: _Problem
    old: ForwardFilter
    new: BackwardFilter
    offset: float
    """Offset of the displacement, in rms of its noise."""
    points: Array
    """(_POINTS, 13): transition, response, edge, covariance of the edge, offset of the force."""

    @classmethod
    def of(cls, problem: _Problem, guess: _Guess, middle: Plant | None) -> Self:
        """Path of one pot, or that of two which stays at ``middle``."""
        before, after = guess.own
        if middle is None:
            old, new = (_deviate(plant, own) for plant, own in zip(problem.plants, guess.own, strict=True))
            plants = [old.interpolate(new, part) for part in np.linspace(0.0, 1.0, _POINTS).tolist()]
            offsets = np.linspace(before[0], after[0], _POINTS)
        else:
            # Each parameter of the middle plant has its old or its new deviation.
            changed = [name in problem.plants[0].changes_to(middle) for name in middle.parameters()]
            plants = [_deviate(middle, np.where([False, *changed], after, before))] * _POINTS
            offsets = np.full(_POINTS, 0.5 * (before[0] + after[0]))
        models = PlantModel.of(plants, guess.edges, problem.signals)
        points = [[*each.transition.flat, *each.response, *each.edge, *each.edge_covariance.flat] for each in models]
        return cls(
            problem, *problem.filters(guess), float(guess.unknowns[0]), np.column_stack([np.array(points), offsets])
        )

    def search(self, *, gentle: bool, confidence: float) -> _Pairs:
        """Evaluate ever finer grids about the most likely pair until they resolve both intervals."""
        first, last = self.problem.candidates.start, self.problem.candidates.stop - 1
        spans = [(first, last)] * 2
        for _ in range(_ZOOMS):
            begins, ends = (np.unique(np.linspace(*span, _GRID_N).round().astype(np.int64)) for span in spans)
            pairs = self._evaluate(begins, ends, gentle=gentle)
            if all(_estimate(each, pairs.cost, confidence)[1] for each in (pairs.begin, pairs.end)):
                break
            likely = pairs.cost - pairs.cost.min() <= _LIKELY
            margins = [2 * int(np.diff(grid).max(initial=1)) for grid in (begins, ends)]
            spans = [
                (max(int(each[likely].min()) - margin, first), min(int(each[likely].max()) + margin, last))
                for each, margin in zip((pairs.begin, pairs.end), margins, strict=True)
            ]
        return pairs

    def _evaluate(self, begins: Indices, ends: Indices, *, gentle: bool) -> _Pairs:
        """Evaluate every pair with its end after its begin, the longest first.

        A Kalman filter runs along the path of all pairs at once; only the pairs that last so long are updated.

        :param gentle: the turn begins and ends gently (least jerk; Flash and Hogan 1985), otherwise it is even.
        """
        begin, end = (each.ravel() for each in np.meshgrid(begins, ends, indexing="ij"))
        longest_first = np.argsort(begin - end, kind="stable")
        longest_first = longest_first[(begin < end)[longest_first]]
        begin, end = begin[longest_first], end[longest_first]
        signals, lengths = self.problem.signals, end - begin
        state, covariance = self.old.state[begin, :, :1], self.old.covariance[begin]
        own, log = np.zeros(len(begin)), self.old.log[begin]
        displacement = signals.displacement_m / signals.noise_m - self.offset
        for k in range(int(lengths.max())):
            on = slice(0, int((lengths > k).sum()))
            part, at = (k + 0.5) / lengths[on], begin[on] + k
            model, offset = self._interpolate(part**3 * (10.0 - 15.0 * part + 6.0 * part**2) if gentle else part)
            edges_n = signals.edges_n[at]
            known = model.inputs(signals.force_n[at] + offset * signals.noise_n, edges_n)
            state[on] = model.transition @ state[on] + known[:, :, None]
            covariance[on] = model.transition @ covariance[on] @ np.swapaxes(model.transition, 1, 2)
            covariance[on] += model.disturbances(signals.noise_n, edges_n)
            weight = signals.valid[at + 1]
            size = 1.0 + weight * covariance[on, 0, 0]
            innovation = displacement[at + 1] - state[on, 0, 0]
            own[on] += weight * innovation**2 / size
            log[on] += np.log(size)
            gain = covariance[on, :, 0] * (weight / size)[:, None]
            state[on, :, 0] += gain * innovation[:, None]
            covariance[on] -= gain[:, :, None] * covariance[on, None, 0]
        form, met = join(state, covariance, self.new.vector[end][:, :, :1], self.new.information[end])
        fit = self.old.misfit[begin, 0, 0] + own + form[:, 0, 0] + self.new.misfit[end, 0, 0]
        return _Pairs(begin, end, fit + log + met + self.new.log[end], fit, own / lengths)

    def _interpolate(self, part: Array) -> tuple[PlantModel, Array]:
        """Plants and offsets of the force at p parts of the path."""
        place = part * (_POINTS - 1)
        lower = np.minimum(place.astype(np.int64), _POINTS - 2)
        beyond = (place - lower)[:, None]
        row = self.points[lower] * (1.0 - beyond) + self.points[lower + 1] * beyond
        matrices = (row[:, at : at + 4].reshape(-1, 2, 2) for at in (0, 8))
        return PlantModel(next(matrices), row[:, 4:6], row[:, 6:8], next(matrices)), row[:, 12]
