"""When a pot was turned, learned from the samples: the likeliest instant, and between which instants it lies.

Where an operator sets the pots, or a command that takes its time, nobody knows the sample at which the plant changed.
The samples tell: the plant as it was explains those up to the instant, the plant as it then is those after it
(``analogrig.hardware.dating.two_filter``). What else is not known is estimated with it: M, B, K before and after, since
a real rig
is some per cent beside its nominal values, the offsets of both channels, and where in a sample period the edges of the
force come.

The interval holds every instant that the likelihood ratio does not refuse, and the asked part of the likelihood over
the range. It is wide where the change could not be seen: a mass or a damper that changes while nothing moves shows at
the next edge of the force.
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
    Array,
    Backwards,
    Columns,
    EdgePlace,
    Forwards,
    PlantModel,
    Signals,
    joined,
    scan,
)
from analogrig.plant import PARAMETERS, Plant

CONFIDENCE = 0.95

WINDOW_N = 500
"""Samples before and after the range that are looked at: they tell the plant as it was, and as it then is."""

_NOMINAL = 0.1
"""Standard deviation of the logarithms of M, B, K before the change, about what was asked for: components, gains."""
_TURNED = 0.1
"""... of what each becomes over what it was, about what was asked for, if it is to change ..."""
_LEFT_ALONE = 0.005
"""... and if it is not: what one mass, damper and spring do not explain of a rig moves it a little ..."""
_UNKNOWN = 0.5
"""... and if nobody says what the plant becomes."""
_OFFSET = 100.0
"""Standard deviation of the offset of either channel, in the rms of its noise ..."""
_OFFSET_MOVES = 2.0
"""... and of what that of the force moves with the pots: the amplifiers around them have offsets of their own."""
_PLACE = 0.3
"""Standard deviation of where in a sample period the edges come, on average."""
_LOCKED = 0.05
"""Half width in which they do where the generator follows the card's clock, or nearly."""
_TOO_NARROW = 1.5
"""Variance of what is left of the samples, in that of the noise, with which the edges may come elsewhere after all."""
_HELD = 1e-3
"""Standard deviation of an offset of the displacement that the offsets of the force are to go with."""

_ROUNDS = 8
_SETTLED = 5e-3
"""A logarithm of M, B or K that moves less does so linearly: what is left out is 0.02 of the noise."""
_LONGEST_MOVE = 0.3
"""Of such a logarithm in one round."""
_LEAST_FIT_N = 30
"""Fewer samples tell nothing of a plant."""

_MOST_LEFT = 1000.0
"""... and so where nothing changes."""
_LEAST_NOISE, _LEAST_NOISE_FORCE = 8e-4, 2.5e-4
"""Of the swing of displacement and force, rms: about that of 12 bits at full range. A finer card tells no more, since
real components (dielectric absorption above all) are not one mass, damper and spring to better than that."""
_RISING = 0.5
"""Twice the logarithm of the likelihood ratio of two neighbours, above which they are no part of a still stretch."""
_LEAST_DOUBT = 1.3
"""With it the intervals hold the instants of machines of real components as often as they say."""
_SETTLING_N = 20
"""Innovations after which a filter that began with any state has come to rest."""
_LAGS_N = 30
"""Samples over which what wanders slowly is summed."""

_CHANCE = 2.0 * math.log(20.0)
"""By so much, in twice the logarithm of the likelihood, must a change explain the samples better than none; beyond
what the best of so many instants does by chance."""
_MOST_UNEXPLAINED = 25.0
"""Variance of what is left of the samples, in that of the noise: with more they are not those of such a plant ..."""


@dataclass(frozen=True)
class Instant:
    """The instant of a change as a sample, which is the last one that cannot tell."""

    sample: int
    """The likeliest."""
    low: int
    """The earliest of the interval ..."""
    high: int
    """... and the latest, both included."""


@dataclass(frozen=True)
class NoInstant:
    """Nothing in the samples can be called the instant of the change."""

    reason: str
    unchanged: bool = False
    """The plant does not seem to have changed at all."""


def date_jump(
    signals: Signals,
    before: Plant,
    after: Plant | None,
    search: range,
    *,
    within: range | None = None,
    confidence: float = CONFIDENCE,
) -> Instant | NoInstant:
    """The instant at which the plant jumped.

    :param before: as it was asked for; what it really is may be some per cent beside it.
    :param after: as it was asked for; None: nobody knows.
    :param search: the samples (indices of ``signals``) one of which is the instant.
    :param within: the samples in which the plant changes no other time; None: the whole signals.
    :param confidence: with which the interval holds the instant.
    :raises ValueError: the range is empty, or leaves the record or ``within``.
    """
    problem, guess = Problem.of(signals, before, after, search, within).fitted()
    guess, profile = problem.solved(guess)
    if profile.unexplained > _TOO_NARROW and guess.edges != ANYWHERE:
        other = problem.solved(dataclasses.replace(guess, half_width=ANYWHERE.half_width))
        guess, profile = min((guess, profile), other, key=lambda each: float(each[1].cost.min()))
    cost = profile.cost / doubt(guess, profile.unexplained)
    objection = problem.objection(float(profile.cost.min()), profile.unexplained, guess) or problem.beyond(cost)
    return objection or interval(cost, np.arange(search.start, search.stop), confidence)


def interval(cost: Array, samples: NDArray[np.int64], confidence: float) -> Instant:
    """The instant, from twice the negative logarithms of the likelihoods of ``samples``, which ascend."""
    likelihood = np.exp(-0.5 * (cost - cost.min()))
    best_first = np.argsort(cost, kind="stable")
    held = np.cumsum(likelihood[best_first]) / likelihood.sum()
    inside = cost - cost.min() <= NormalDist().inv_cdf(0.5 + 0.5 * confidence) ** 2
    inside[best_first[: int(np.searchsorted(held, confidence)) + 1]] = True
    low, high = samples[np.flatnonzero(inside)[[0, -1]]].tolist()
    return Instant(int(samples[best_first[0]]), low, high)


def doubt(guess: Guess, unexplained: float) -> float:
    """By what twice the logarithm of a likelihood ratio is divided, since a rig is not quite what it is taken for."""
    return max(_LEAST_DOUBT, guess.colour, unexplained)


_COMMON, _OWN = 2, 4
_BOTH = 1 + _COMMON + 2 * _OWN
_OLD = np.r_[0 : 1 + _COMMON + _OWN]
_NEW = np.r_[0 : 1 + _COMMON, 1 + _COMMON + _OWN : _BOTH]
"""Where the columns of each filter are among the known one and those of all that is not known."""
_LOGARITHMS = np.r_[1:_OWN, 1 + _OWN : 2 * _OWN]
"""Where those of M, B, K are in what is not known of the one plant and the other."""


@dataclass(frozen=True, eq=False)
class Guess:
    """Best values so far of what is not known."""

    offset: float
    """Of the displacement, in the rms of its noise."""
    place: float
    """Of the edges in a sample period, on average."""
    half_width: float
    """... and how far beside it."""
    old: Array
    """(4,): offset of the force in the rms of its noise; logarithms of M, B, K over what was asked for."""
    new: Array
    """(4,): the same of the plant after the change."""
    sample: int
    """Of the change, in the window."""
    left: float = 1.0
    """Variance of the innovations before and after the range, in what it is expected to be."""
    colour: float = 1.0
    """How many times as far as white noise the innovations go astray in the long run, as a variance."""

    @property
    def edges(self) -> EdgePlace:
        return ANYWHERE if self.half_width == ANYWHERE.half_width else EdgePlace(self.place, self.half_width)

    def moved(self, move: Move) -> Self:
        """Nothing too far at once, and the edges' place within the sample period."""
        limits = np.array([np.inf, *[_LONGEST_MOVE] * len(PARAMETERS)])
        (offset, place), old, new = np.split(move.unknowns, [_COMMON, _COMMON + _OWN])
        return dataclasses.replace(
            self,
            offset=self.offset + float(offset),
            place=min(max(self.edges.mean + float(place), 0.0), 1.0),
            old=self.old + np.clip(old, -limits, limits),
            new=self.new + np.clip(new, -limits, limits),
            sample=move.sample,
        )

    def near(self, other: Guess) -> bool:
        """Whether M, B and K of both plants are the same."""
        return bool(np.abs(np.append(self.old - other.old, self.new - other.new)[_LOGARITHMS]).max() < _SETTLED)


@dataclass(frozen=True, eq=False)
class Move:
    """To better values."""

    unknowns: Array
    """(10,): offset, place, old, new."""
    sample: int


@dataclass(frozen=True, eq=False)
class Profile:
    """The likelihood of each instant, with the best of all that is not known."""

    cost: Array
    """(candidates,): twice its negative logarithm, but for a constant."""
    unexplained: float
    """Variance of what is left of the samples at the likeliest instant, in that of the noise."""
    move: Move


@dataclass(frozen=True, eq=False)
class Problem:
    """A window of a record, the instants in it at which a plant may have changed, and what is known beforehand."""

    signals: Signals
    search: range
    """As it was asked for."""
    candidates: slice
    """The same in the window."""
    before: Plant
    after: Plant
    moves: Array
    """(4,): standard deviations of the differences between ``new`` and ``old`` of a guess."""
    left: float = 1.0
    """By how much the variance of the noise was raised."""

    @classmethod
    def of(cls, signals: Signals, before: Plant, after: Plant | None, search: range, within: range | None) -> Self:
        if search.step != 1 or not 0 <= search.start < search.stop <= len(signals):
            raise ValueError(f"{search} is empty or leaves the {len(signals)} samples of the record")
        alone = within or range(len(signals))
        if not alone.start <= search.start < search.stop <= alone.stop:
            raise ValueError(f"{search} leaves {alone}, in which the plant changes no other time")
        first = max(search.start - WINDOW_N, alone.start, 0)
        changed = before.changes_to(after or before)
        turned = [_UNKNOWN if after is None else _TURNED if name in changed else _LEFT_ALONE for name in PARAMETERS]
        return cls(
            _no_better(signals.part(first, min(search.stop + WINDOW_N, alone.stop))),
            search,
            slice(search.start - first, search.stop - first),
            before,
            after or before,
            np.array([_OFFSET_MOVES, *turned]),
        )

    def fitted(self) -> tuple[Problem, Guess]:
        """What is not known, from the samples before the range and those after it; and the same problem with as much
        noise as there is, if that is more: real components are not quite a mass, a damper and a spring."""
        guess = self.fit()
        if guess.left < _TOO_NARROW:
            return self, guess
        more = math.sqrt(guess.left)
        noisier = dataclasses.replace(
            self.signals, noise_n=self.signals.noise_n * more, noise_m=self.signals.noise_m * more
        )
        problem = dataclasses.replace(self, signals=noisier, left=guess.left)
        return problem, problem.fit()

    def fit(self) -> Guess:
        """From the samples before the range, and those after it, each by themselves."""
        zero = np.zeros(_OWN)
        guess = Guess(0.0, ANYWHERE.mean, ANYWHERE.half_width, zero, zero, self.candidates.start)
        earlier, later = (
            self.signals.part(0, self.candidates.start),
            self.signals.part(self.candidates.stop, len(self.signals)),
        )
        known = np.array([_OFFSET, _PLACE, _OFFSET, *[_NOMINAL] * len(PARAMETERS)])
        fit = _settled(earlier, self.before, guess, known)
        locked = _settled(earlier, self.before, dataclasses.replace(fit.guess, half_width=_LOCKED), known)
        if locked.cost < fit.cost:
            fit = locked
        known = np.array([_HELD, fit.place_deviation, *np.hypot(self.moves, known[_COMMON:])])
        after = _settled(later, self.after, fit.guess, known)
        every = [fit.innovation, after.innovation]
        settled = np.concatenate([each[_SETTLING_N:] for each in every])
        left = float(settled @ settled) / len(settled) if len(settled) >= _LEAST_FIT_N else 1.0
        return dataclasses.replace(after.guess, old=fit.guess.old, new=after.guess.old, left=left, colour=colour(every))

    def filters(self, guess: Guess) -> tuple[Forwards, Backwards]:
        """Of the plant as it was, and of the plant as it then is."""
        old, new = self.models(guess)
        later = np.arange(len(self.signals)) >= guess.sample
        course = _course(
            np.where(later[:, None, None], new.transition, old.transition),
            np.where(later[:, None], new.inputs(self.signals, guess.new[0]), old.inputs(self.signals, guess.old[0])),
            self.signals,
            guess.offset,
        )
        return (
            Forwards.of(old, self.signals, Columns.of(old, self.signals, course, (guess.offset, guess.old[0]))),
            Backwards.of(new, self.signals, Columns.of(new, self.signals, course, (guess.offset, guess.new[0]))),
        )

    def models(self, guess: Guess) -> tuple[PlantModel, PlantModel]:
        """Of the plant as it was, and as it then is."""
        return (
            PlantModel.of(beside(self.before, guess.old), guess.edges, self.signals),
            PlantModel.of(beside(self.after, guess.new), guess.edges, self.signals),
        )

    def profile(self, guess: Guess) -> Profile:
        """All instants, what is not known being near the guess."""
        old, new = self.filters(guess)
        at = self.candidates
        state, vector = (np.zeros((at.stop - at.start, 2, _BOTH)) for _ in range(2))
        state[:, :, _OLD], vector[:, :, _NEW] = old.state[at], new.vector[at]
        form, log = joined(state, old.covariance[at], vector, new.information[at])
        form[:, _OLD[:, None], _OLD] += old.misfit[at]
        form[:, _NEW[:, None], _NEW] += new.misfit[at]
        form += self._known(guess)
        unknowns, fit = _minimum(form)
        cost = fit + log + old.log[at] + new.log[at]
        best = int(cost.argmin())
        return Profile(
            cost, float(fit[best]) / max(1, int(self.signals.valid.sum())), Move(unknowns[best], at.start + best)
        )

    def solved(self, guess: Guess) -> tuple[Guess, Profile]:
        """All instants with the best values of what is not known, from those near it."""
        for _ in range(_ROUNDS):
            profile = self.profile(guess)
            last, guess = guess, guess.moved(profile.move)
            if guess.near(last):
                break
        return guess, profile

    def objection(self, cost: float, unexplained: float, guess: Guess) -> NoInstant | None:
        """Why the likeliest instant, of that cost, is none; None if it is one."""
        if unexplained > _MOST_UNEXPLAINED or self.left > _MOST_LEFT:
            return NoInstant(
                f"what a plant that changes once leaves of the samples has {unexplained * self.left:.3g} times the"
                " variance of their noise"
            )
        known = np.array([_OFFSET, _PLACE, _OFFSET, *[_NOMINAL] * len(PARAMETERS)])
        none = _settled(self.signals, self.before, guess, known, rounds=1).cost
        chance = _CHANCE + 2.0 * math.log(len(self.search))
        if none - cost < chance * doubt(guess, unexplained):
            return NoInstant(
                f"nothing in the samples {self._searched} shows that the plant has changed", unchanged=True
            )
        return None

    def beyond(self, cost: Array) -> NoInstant | None:
        """Why the likeliest of the instants that have these costs is none: towards an end of the range they fall."""
        best = int(cost.argmin())
        inwards = {0: 1, len(cost) - 1: len(cost) - 2}.get(best)
        if inwards is not None and len(cost) > 1 and cost[inwards] - cost[best] > _RISING:
            return NoInstant(f"the plant seems to have changed before or after the samples {self._searched}")
        return None

    @property
    def _searched(self) -> str:
        return f"{self.search.start} to {self.search.stop - 1}"

    def _known(self, guess: Guess) -> Array:
        """(11, 11): what is known beforehand, as a quadratic form."""
        nominal = [_OFFSET, *[_NOMINAL] * len(PARAMETERS)]
        rows = np.zeros((_COMMON + 2 * _OWN, _BOTH))
        rows[0, [0, 1]] = np.array([guess.offset, 1.0]) / _OFFSET
        rows[1, [0, 2]] = np.array([guess.edges.mean - ANYWHERE.mean, 1.0]) / _PLACE
        for i in range(_OWN):
            old, new = 1 + _COMMON + i, 1 + _COMMON + _OWN + i
            rows[_COMMON + i, [0, old]] = np.array([guess.old[i], 1.0]) / nominal[i]
            rows[_COMMON + _OWN + i, [0, old, new]] = np.array([guess.new[i] - guess.old[i], -1.0, 1.0]) / self.moves[i]
        return rows.T @ rows


def _no_better(signals: Signals) -> Signals:
    """The same with at least the noise that stands for what one mass, damper and spring do not explain of a rig."""
    if not signals.valid.any():
        return signals
    return dataclasses.replace(
        signals,
        noise_n=max(signals.noise_n, _LEAST_NOISE_FORCE * float(np.ptp(signals.force_n[signals.valid]))),
        noise_m=max(signals.noise_m, _LEAST_NOISE * float(np.ptp(signals.displacement_m[signals.valid]))),
    )


def colour(innovations: Sequence[Array]) -> float:
    """Of stretches of innovations the long-run variance, at least 1: what wanders slowly, as by dielectric absorption,
    weighs more than noise of its size. By Bartlett's window (Newey and West 1987)."""
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
    """What samples of one plant say."""

    guess: Guess
    """With offset, place and ``old`` as they say."""
    place_deviation: float
    """Standard deviation with which the place is known then: that of before, where the samples have no edge."""
    cost: float = 0.0
    """Twice the negative logarithm of the likelihood."""
    innovation: Array = field(default_factory=lambda: np.zeros(0))


def _settled(signals: Signals, plant: Plant, guess: Guess, known: Array, rounds: int = _ROUNDS) -> _PlantFit:
    """From a guess; too few samples say nothing.

    :param known: (6,) standard deviations of what is known beforehand: the guess.
    """
    fit = _PlantFit(guess, float(known[1]))
    first = guess
    for _ in range(rounds if len(signals) >= _LEAST_FIT_N else 0):
        last = fit.guess
        model = PlantModel.of(beside(plant, last.old), last.edges, signals)
        transitions = np.broadcast_to(model.transition, (len(signals), 2, 2))
        course = _course(transitions, model.inputs(signals, last.old[0]), signals, last.offset)
        filtered = Forwards.of(model, signals, Columns.of(model, signals, course, (last.offset, last.old[0])))
        rows = np.zeros((_COMMON + _OWN, 1 + _COMMON + _OWN))
        rows[:, 0] = [last.offset - first.offset, last.edges.mean - first.edges.mean, *(last.old - first.old)]
        rows[:, 1:] = np.eye(_COMMON + _OWN)
        rows /= known[:, None]
        form = filtered.misfit[-1] + rows.T @ rows
        unknowns, left = _minimum(form[None])
        fit = _PlantFit(
            last.moved(Move(np.append(unknowns[0], np.zeros(_OWN)), last.sample)),
            float(np.linalg.inv(form[1:, 1:])[1, 1] ** 0.5),
            float(left[0] + filtered.log[-1]),
            filtered.innovation @ np.append(1.0, unknowns[0]),
        )
        if fit.guess.near(last):
            break
    return fit


def _minimum(form: Array) -> tuple[Array, Array]:
    """Of quadratic forms (m, 1 + u, 1 + u) over 1 and u unknowns: where (m, u) and what (m,)."""
    at = np.asarray(-np.linalg.solve(form[:, 1:, 1:], form[:, 1:, :1])[:, :, 0], dtype=np.float64)
    return at, np.asarray(form[:, 0, 0] + (form[:, 0, 1:] * at).sum(axis=1))


def _course(transitions: Array, inputs: Array, signals: Signals, offset: float) -> Array:
    """(n, 2): the state at each sample, from that at the first one which explains the displacement best (least
    squares). Nothing says that a window begins at rest.

    :param offset: of the displacement, in the rms of its noise.
    """
    factors = np.concatenate([np.eye(2)[None], transitions[:-1]])
    terms = np.zeros((len(signals), 2, 3))
    terms[0, :, 1:] = np.eye(2)
    terms[1:, :, 0] = inputs[:-1]
    forced, free = np.split(scan(factors, terms), [1], axis=2)
    left = signals.displacement_m / signals.noise_m - offset - forced[:, 0, 0]
    first = np.linalg.lstsq(free[signals.valid, 0], left[signals.valid])[0]
    return np.asarray(forced[:, :, 0] + free @ first)


def beside(plant: Plant, own: Array) -> Plant:
    """The plant whose M, B, K are beside those asked for by the logarithms in ``own`` (4,)."""
    for name, log in zip(PARAMETERS, own[1:].tolist(), strict=True):
        plant = plant.scaled(name, math.exp(log))
    return plant
