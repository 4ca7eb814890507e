"""Date of a pot change that acts at once: the most likely sample, with a confidence interval.

A pot that an operator or a slow command sets changes the plant at an unknown sample. The plant before the change
explains the samples up to it, the plant after it the samples that follow (``analogrig.hardware.dating.two_filter``).
Other unknowns are estimated jointly: M, B, K before and after, since a real rig deviates from its nominal values by
some per cent; the offsets of both channels; the place of the force's edges in a sample period.

The interval holds every instant that the likelihood-ratio test accepts, and at least the requested share of the
likelihood. It is wide where a change has no effect: a mass or a damper that changes at rest shows at the next edge.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analogrig.hardware.dating.two_filter import (
    ANYWHERE,
    COMMON,
    OWN,
    Array,
    BackwardFilter,
    EdgePlace,
    ForwardFilter,
    PlantModel,
    Signals,
    join,
    scan,
)
from analogrig.plant import PARAMETERS, Plant

CONFIDENCE = 0.95

WINDOW_N = 500
"""Samples used before and after the search range, from which both plants are estimated."""

# Standard deviations of the unknowns before any sample is seen.
_NOMINAL = 0.1
"""Deviation of log M, B, K before the change from their set values: components, gains."""
_CHANGED, _UNCHANGED, _UNKNOWN = 0.1, 0.005, 0.5
"""Deviation of each ratio of M, B, K after to before from its set value: if it is to change; if not, for what one mass,
damper and spring do not explain of a rig; if the plant after the change is unknown."""
_OFFSET = 100.0
"""Offset of either channel, in rms of its noise."""
_OFFSET_CHANGE = 2.0
"""Change of the force's offset with the pots, in rms of its noise: the amplifiers around the pots have offsets."""
_PLACE = 0.3
"""Mean place of the edges in a sample period."""
_HELD = 1e-3
"""Offset of the displacement after the change about that before it, in rms of its noise."""
_PRIOR = np.array([_OFFSET, _PLACE, _OFFSET, *[_NOMINAL] * len(PARAMETERS)])
"""(6,): of the unknowns that both plants share and those of the plant before the change."""

_LOCKED = 0.05
"""Half width of the edges' place when generator and card share a clock, or nearly."""
_EXCESS = 1.5
"""Variance ratio of residuals to noise above which the noise is raised, or the edges may lie anywhere."""

_ROUNDS = 8
_CONVERGED = 5e-3
"""Largest change of log M, B, K that counts as linear: the error is 0.02 of the noise."""
_LARGEST_STEP = 0.3
"""Largest change of log M, B, K per iteration."""
_LEAST_FIT_N = 30
"""Fewest samples that a plant is fitted to."""

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
"""Largest variance ratios of the residuals to the (raised) noise, and of the raised noise to the noise: beyond them the
samples are not those of such a plant."""


@dataclass(frozen=True)
class Instant:
    """Estimated instant of a change: the last sample that is independent of it, with its confidence interval."""

    sample: int
    low: int
    high: int
    """Ends of the interval, both included."""


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
    problem, guess = Problem.of(signals, before, after, search, within).start()
    guess, profile = problem.solve(guess)
    if profile.unexplained > _EXCESS and guess.edges != ANYWHERE:
        other = problem.solve(dataclasses.replace(guess, half_width=ANYWHERE.half_width))
        guess, profile = min((guess, profile), other, key=lambda each: float(each[1].cost.min()))
    if objection := problem.objection(float(profile.cost.min()), profile.unexplained, guess):
        return objection
    cost = profile.cost / overdispersion(guess, profile.unexplained)
    if _falls_outwards(cost):
        return NoInstant(f"the plant seems to have changed before or after the samples {problem.span}")
    return interval(cost, np.arange(search.start, search.stop), confidence)


def interval(cost: Array, samples: NDArray[np.int64], confidence: float) -> Instant:
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


def overdispersion(guess: Guess, unexplained: float) -> float:
    """Divisor of costs that allows for the difference between a rig and its model."""
    return max(_LEAST_OVERDISPERSION, guess.colour, unexplained)


def _falls_outwards(cost: Array) -> bool:
    """True if the least cost lies at an end of the range and rises inwards."""
    best = int(cost.argmin())
    inwards = {0: 1, len(cost) - 1: len(cost) - 2}.get(best)
    return inwards is not None and len(cost) > 1 and bool(cost[inwards] - cost[best] > _RISE)


_BOTH = 1 + COMMON + 2 * OWN
_OLD = np.r_[0 : 1 + COMMON + OWN]
_NEW = np.r_[0 : 1 + COMMON, 1 + COMMON + OWN : _BOTH]
"""Indices of each filter's columns among the known one and all unknowns."""
_LOGARITHMS = np.r_[1:OWN, 1 + OWN : 2 * OWN]
"""Indices of log M, B, K among the unknowns of the old plant followed by those of the new one."""


@dataclass(frozen=True, eq=False)
class Guess:
    """Current values of the unknowns."""

    offset: float
    """Offset of the displacement, in rms of its noise."""
    place: float
    half_width: float
    """Mean place of the edges in a sample period, and its half width."""
    old: Array
    """(4,): offset of the force in rms of its noise; logarithms of M, B, K over their set values."""
    new: Array
    """(4,): the same for the plant after the change."""
    sample: int
    """Instant of the change, as an index of the window."""
    noise_ratio: float = 1.0
    """Variance of the innovations before and after the search range, over its expectation."""
    colour: float = 1.0
    """Long-run variance of the innovations, over that of white noise."""

    @property
    def edges(self) -> EdgePlace:
        return ANYWHERE if self.half_width == ANYWHERE.half_width else EdgePlace(self.place, self.half_width)

    def add(self, unknowns: Array, sample: int) -> Self:
        """Guess with ``unknowns`` (10,: offset, place, old, new) added, each within its largest step."""
        limits = np.array([np.inf, *[_LARGEST_STEP] * len(PARAMETERS)])
        (offset, place), old, new = np.split(unknowns, [COMMON, COMMON + OWN])
        return dataclasses.replace(
            self,
            offset=self.offset + float(offset),
            place=min(max(self.edges.mean + float(place), 0.0), 1.0),
            old=self.old + np.clip(old, -limits, limits),
            new=self.new + np.clip(new, -limits, limits),
            sample=sample,
        )

    def near(self, other: Guess) -> bool:
        """True if M, B and K of both plants have converged."""
        return bool(np.abs(np.append(self.old - other.old, self.new - other.new)[_LOGARITHMS]).max() < _CONVERGED)


@dataclass(frozen=True, eq=False)
class Profile:
    """Profile likelihood: cost of each candidate instant at its best values of the unknowns."""

    cost: Array
    """(candidates,): twice the negative log-likelihood, up to a constant."""
    unexplained: float
    """Variance ratio of residuals to noise at the most likely instant."""
    unknowns: Array
    """(10,): step to the best values there."""
    sample: int
    """Most likely instant, as an index of the window."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Window of a record with the candidate instants and what is known beforehand."""

    signals: Signals
    search: range
    """Candidates as indices of the record."""
    candidates: slice
    """Candidates as indices of the window."""
    before: Plant
    after: Plant
    changes: Array
    """(4,): prior standard deviations of ``Guess.new - Guess.old``."""
    noise_ratio: float = 1.0
    """Factor by which the variance of the noise was raised."""

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
        changes = [_UNKNOWN if after is None else _CHANGED if name in changed else _UNCHANGED for name in PARAMETERS]
        return cls(
            _with_least_noise(signals.part(first, min(search.stop + WINDOW_N, alone.stop))),
            search,
            slice(search.start - first, search.stop - first),
            before,
            after or before,
            np.array([_OFFSET_CHANGE, *changes]),
        )

    @property
    def span(self) -> str:
        """First and last sample of the search range, for messages."""
        return f"{self.search.start} to {self.search.stop - 1}"

    def start(self) -> tuple[Problem, Guess]:
        """Fit both plants; the problem returned has its noise raised to that of the residuals."""
        guess = self.fit()
        if guess.noise_ratio < _EXCESS:
            return self, guess
        more = math.sqrt(guess.noise_ratio)
        noisier = dataclasses.replace(
            self.signals, noise_n=self.signals.noise_n * more, noise_m=self.signals.noise_m * more
        )
        problem = dataclasses.replace(self, signals=noisier, noise_ratio=guess.noise_ratio)
        return problem, problem.fit()

    def fit(self) -> Guess:
        """Fit the old plant to the samples before the search range, then the new one to those after it."""
        zero = np.zeros(OWN)
        guess = Guess(0.0, ANYWHERE.mean, ANYWHERE.half_width, zero, zero, self.candidates.start)
        earlier = self.signals.part(0, self.candidates.start)
        later = self.signals.part(self.candidates.stop, len(self.signals))
        old = _fit_plant(earlier, self.before, guess, _PRIOR)
        locked = _fit_plant(earlier, self.before, dataclasses.replace(old.guess, half_width=_LOCKED), _PRIOR)
        if locked.cost < old.cost:
            old = locked
        prior = np.array([_HELD, old.place_deviation, *np.hypot(self.changes, _PRIOR[COMMON:])])
        new = _fit_plant(later, self.after, old.guess, prior)
        innovations = [old.innovation, new.innovation]
        settled = np.concatenate([each[_SETTLING_N:] for each in innovations])
        ratio = float(settled @ settled) / len(settled) if len(settled) >= _LEAST_FIT_N else 1.0
        return dataclasses.replace(
            new.guess, old=old.guess.old, new=new.guess.old, noise_ratio=ratio, colour=colour(innovations)
        )

    def filters(self, guess: Guess) -> tuple[ForwardFilter, BackwardFilter]:
        """Forward filter of the old plant and backward filter of the new one."""
        old = PlantModel.of(deviate(self.before, guess.old), guess.edges, self.signals)
        new = PlantModel.of(deviate(self.after, guess.new), guess.edges, self.signals)
        later = np.arange(len(self.signals)) >= guess.sample
        course = _course(
            np.where(later[:, None, None], new.transition, old.transition),
            np.where(later[:, None], new.inputs(self.signals, guess.new[0]), old.inputs(self.signals, guess.old[0])),
            self.signals,
            guess.offset,
        )
        return (
            ForwardFilter.of(old, self.signals, course, (guess.offset, guess.old[0])),
            BackwardFilter.of(new, self.signals, course, (guess.offset, guess.new[0])),
        )

    def profile(self, guess: Guess) -> Profile:
        """Profile likelihood of all candidates, linear in the unknowns about ``guess``."""
        old, new = self.filters(guess)
        at = self.candidates
        state, vector = (np.zeros((at.stop - at.start, 2, _BOTH)) for _ in range(2))
        state[:, :, _OLD], vector[:, :, _NEW] = old.state[at], new.vector[at]
        form, log = join(state, old.covariance[at], vector, new.information[at])
        form[:, _OLD[:, None], _OLD] += old.misfit[at]
        form[:, _NEW[:, None], _NEW] += new.misfit[at]
        form += self._prior(guess)
        unknowns, fit = _minimum(form)
        cost = fit + log + old.log[at] + new.log[at]
        best = int(cost.argmin())
        return Profile(cost, float(fit[best]) / max(1, int(self.signals.valid.sum())), unknowns[best], at.start + best)

    def solve(self, guess: Guess) -> tuple[Guess, Profile]:
        """Iterate ``profile`` from ``guess`` until M, B, K have converged."""
        for _ in range(_ROUNDS):
            profile = self.profile(guess)
            last, guess = guess, guess.add(profile.unknowns, profile.sample)
            if guess.near(last):
                break
        return guess, profile

    def objection(self, cost: float, unexplained: float, guess: Guess) -> NoInstant | None:
        """Reason to reject the most likely instant, which has ``cost``; None to accept it."""
        if unexplained > _MOST_UNEXPLAINED or self.noise_ratio > _MOST_NOISE_RATIO:
            ratio = unexplained * self.noise_ratio
            return NoInstant(f"the residuals of a plant that changes once have {ratio:.3g} times the noise variance")
        unchanged = _fit_plant(self.signals, self.before, guess, _PRIOR, rounds=1).cost
        chance = _CHANCE + 2.0 * math.log(len(self.search))
        if unchanged - cost < chance * overdispersion(guess, unexplained):
            reason = f"nothing in the samples {self.span} shows that the plant has changed"
            return NoInstant(reason, unchanged=True)
        return None

    def _prior(self, guess: Guess) -> Array:
        """(11, 11) quadratic form of the prior."""
        rows = np.zeros((COMMON + 2 * OWN, _BOTH))
        first, last = slice(COMMON + OWN), slice(COMMON + OWN, COMMON + 2 * OWN)
        rows[first, _OLD] = _deviations([guess.offset, guess.edges.mean - ANYWHERE.mean, *guess.old], _PRIOR)
        change = _deviations(guess.new - guess.old, self.changes)
        rows[last, 0], rows[last, _OLD[-OWN:]], rows[last, _NEW[-OWN:]] = change[:, 0], -change[:, 1:], change[:, 1:]
        return rows.T @ rows


def _deviations(values: Sequence[float] | Array, deviations: Array) -> Array:
    """(u, 1 + u): u values and their unknown changes, each in its prior standard deviation."""
    return np.column_stack([values, np.eye(len(values))]) / deviations[:, None]


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


@dataclass(frozen=True, eq=False)
class _PlantFit:
    """One plant fitted to samples."""

    guess: Guess
    """Guess with ``offset``, ``place`` and ``old`` fitted."""
    place_deviation: float
    """Standard deviation of the place: the prior one where the samples have no edge."""
    cost: float = 0.0
    """Twice the negative log-likelihood."""
    innovation: Array = field(default_factory=lambda: np.zeros(0))


def _fit_plant(signals: Signals, plant: Plant, first: Guess, prior: Array, rounds: int = _ROUNDS) -> _PlantFit:
    """Fit one plant to samples by Gauss-Newton; fewer than ``_LEAST_FIT_N`` samples leave ``first`` as it is.

    :param prior: (6,) standard deviations of the unknowns about ``first``.
    """
    fit = _PlantFit(first, float(prior[1]))
    for _ in range(rounds if len(signals) >= _LEAST_FIT_N else 0):
        last = fit.guess
        model = PlantModel.of(deviate(plant, last.old), last.edges, signals)
        transitions = np.broadcast_to(model.transition, (len(signals), 2, 2))
        course = _course(transitions, model.inputs(signals, last.old[0]), signals, last.offset)
        filtered = ForwardFilter.of(model, signals, course, (last.offset, last.old[0]))
        distance = [last.offset - first.offset, last.edges.mean - first.edges.mean, *(last.old - first.old)]
        rows = _deviations(distance, prior)
        form = filtered.misfit[-1] + rows.T @ rows
        unknowns, least = _minimum(form[None])
        fit = _PlantFit(
            last.add(np.append(unknowns[0], np.zeros(OWN)), last.sample),
            float(np.linalg.inv(form[1:, 1:])[1, 1] ** 0.5),
            float(least[0] + filtered.log[-1]),
            filtered.innovation @ np.append(1.0, unknowns[0]),
        )
        if fit.guess.near(last):
            break
    return fit


def _minimum(form: Array) -> tuple[Array, Array]:
    """Minimum of m quadratic forms (m, 1 + u, 1 + u) over 1 and u unknowns: its place (m, u) and value (m,)."""
    at = np.asarray(-np.linalg.solve(form[:, 1:, 1:], form[:, 1:, :1])[:, :, 0], dtype=np.float64)
    return at, np.asarray(form[:, 0, 0] + (form[:, 0, 1:] * at).sum(axis=1))


def _course(transitions: Array, inputs: Array, signals: Signals, offset: float) -> Array:
    """(n, 2) state at each sample, from the initial state that explains the displacement best (least squares).

    :param offset: offset of the displacement, in rms of its noise.
    """
    factors = np.concatenate([np.eye(2)[None], transitions[:-1]])
    terms = np.zeros((len(signals), 2, 3))
    terms[0, :, 1:] = np.eye(2)
    terms[1:, :, 0] = inputs[:-1]
    forced, free = np.split(scan(factors, terms), [1], axis=2)
    left = signals.displacement_m / signals.noise_m - offset - forced[:, 0, 0]
    first = np.linalg.lstsq(free[signals.valid, 0], left[signals.valid])[0]
    return np.asarray(forced[:, :, 0] + free @ first)


def deviate(plant: Plant, own: Array) -> Plant:
    """Plant with the logarithms of M, B, K raised by ``own[1:]``."""
    for name, log in zip(PARAMETERS, own[1:].tolist(), strict=True):
        plant = plant.scaled(name, math.exp(log))
    return plant
