"""Reference of the isolation: after an alarm, the parameter that has changed or the faulty channel, in float64.

It follows harness/docs/background/estimator.md and the manual est_isolation.h. Poles come from the roots of A, and the
hypotheses from linear algebra over all onsets at once.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import Change, SteppedFlag
from analogrig.estimator_config import EstimatorConfig
from tests.reference.estimator import ReferenceEstimator, ReferenceStep

KEPT_N, PAST_N, SETTLED_N = 40, 4, 100
"""Samples that are kept, those of them before the earliest onset or not yet processed, and samples after an alarm at
which theta counts as the plant."""

ONSETS_N = (20, 13, 9, 6, 4, 3, 2, 1)
"""Samples from each onset that is tried to the alarm."""

LAGS_N = 3
"""Samples in an equation."""

SLICES_N, WEIGHED_N = 12, 22
"""Slices of work per sample, and those that a sample takes with which hypotheses are weighed."""

SURE, MORE_LIKELY, ALONE, FAULTY, NOT_BY_CHANCE = 3.0, 0.2, 2.0, 2.0, 11.0
"""Evidence, in nats: over another single change, over two parameters at once, over itself beside a second one, for a
fault on top, and for a second parameter."""

ROUNDING = 1e-6
"""Evidence that a device may lose by rounding, relative to that over no change."""

FAULT_N = 12
"""Samples from the onset of a fault to its diagnosis, at least."""

WORTH_TELLING = 0.15
EXTENT_KNOWN = 4000.0
PRIOR = 0.5
SIZES = 20.0
VARIANCE_KNOWN = 0.25

SUM_CURVE, SUM_WIDTH = 0.0866, 2.83
"""Parabola that takes the place of ln(1 + exp(-x)), and where it ends."""

HABITS_N, UNUSUAL, CLIP = 128, 4.0, 25.0
"""Samples on which the habits of the channels are based, and limits of a noisy force in usual variances."""

NEAR, NEAR_SHARE, NEAR_MOST = 0.03, 1e-5, 300_000.0
"""Distance from a limit at which rounding may decide [nats], its increase with the evidence, and the evidence beyond
which rounding may decide anything: float32 loses as much as it adds."""

NEAR_KNOWN = 2e-3
"""The same of the accuracy of an extent, relative to it."""

PARAMETERS = (Change.MASS, Change.DAMPING, Change.STIFFNESS)
FAULTS = tuple(change for change in Change if change > Change.SEVERAL)
SINGLE = (*PARAMETERS, *FAULTS)
GAINS = (Change.FORCE_GAIN, Change.DISPLACEMENT_GAIN)
LINEAR = (
    *(Change.FORCE_OFFSET, Change.FORCE_GAIN, Change.FORCE_DELAY),
    *(Change.DISPLACEMENT_OFFSET, Change.DISPLACEMENT_GAIN, Change.DISPLACEMENT_DELAY),
)
"""Faults whose effect is linear in their size. The effects are those of M, B, K, two impulses, and these."""

_PUSHES = slice(3, 5)
_EFFECTS_N = 5 + len(LINEAR)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReferenceDiagnosis:
    """A change or fault that was named."""

    change: Change
    onset_n: int
    """Samples from the onset to the last alarm."""
    extent: float
    deviation: float
    """Standard deviation of the extent."""


class ReferencePlant:
    """Mechanics in units of samples, from theta and C of an estimator."""

    def __init__(self, config: EstimatorConfig, theta: Sequence[float], c: Sequence[float]) -> None:
        """:raises ValueError: theta is no plant."""
        self.a = np.array([1.0, *theta[:2]])
        self.b = np.zeros(LAGS_N)
        self.b[config.nk : config.nk + config.nb] = theta[2 : 2 + config.nb]
        self.direct = self.b[0]
        """Share of an edge within the interval."""
        self.c = c
        rest = float(self.a.sum())
        if not 1e-6 <= self.a[2] < 1.0 or rest < 1e-6:
            raise ValueError("no plant")
        poles = np.log(np.roots(self.a).astype(complex))
        p, q = -float(poles.sum().real), float(poles.prod().real)
        if q <= 0.0 or -self.a[1] / (2.0 * math.sqrt(self.a[2])) < -0.9:
            raise ValueError("no plant")
        lag = p / q
        self.gain = float(self.b.sum()) / rest
        self.rest = (theta[-1] / rest if config.offset else 0.0) + self.gain * config.force_zero
        # Responses to forces that deflect the plant by 1, t and t^2 when static, at t = 0, -1 and -2.
        t = -np.arange(3.0)
        powers = np.array([np.ones(3), t, t**2])
        answers = np.array([np.ones(3), t - lag, t**2 - 2.0 * lag * t + 2.0 * (lag**2 - 1.0 / q)])
        self.spring = np.linalg.solve(powers, answers @ self.a)
        moving = np.array([np.zeros(3), lag * np.ones(3), 2.0 * lag * (t - lag)])
        self.damper = np.linalg.solve(powers, moving @ self.a)
        self.lag = lag
        # A force that is held for each sample comes half a sample later than one that rises evenly.
        self.hold = rest + float(answers[1] @ self.a) + 0.5 * rest


class Habits:
    """Habits of the channels while the plant is unchanged."""

    def __init__(self, edge_codes: float) -> None:
        self._least = (edge_codes / 64.0) ** 2
        self._same, self._unrest, self._known_n = np.zeros(2), 0.0, 0

    def follow(self, kept: Sequence[tuple[float, float, float]]) -> None:
        """Enter the newest sample."""
        present = squared_step([sample[0] for sample in kept])
        learns = self._known_n < HABITS_N
        most = UNUSUAL * (self._unrest + self._least)
        self._known_n += learns
        is_same = [now == last for now, last in zip(kept[-1][:2], kept[-2][:2], strict=True)]
        self._same += (np.array(is_same) - self._same) / self._known_n
        self._unrest += ((present if learns else min(present, most)) - self._unrest) / self._known_n

    @property
    def surprises(self) -> Array:
        """Evidence of a code that equals the last one for a stuck channel, by channel."""
        return -np.log(np.clip(self._same, 0.01, 0.999) if self._known_n >= HABITS_N else [0.999, 0.999])

    def unrest(self, step: float) -> float:
        """Evidence of a squared step for a noisy force."""
        ratio = step / (UNUSUAL * (self._unrest + self._least))
        return 0.375 * min(ratio, CLIP) - math.log(2.0) if self._known_n >= HABITS_N else 0.0


def squared_step(u: Sequence[float]) -> float:
    """Square of the smaller of the last two steps of u, oldest first; an edge is a step beside a small one."""
    return min((u[-1] - u[-2]) ** 2, (u[-3] - u[-2]) ** 2)


class ReferenceIsolation:
    """Isolation beside one estimator."""

    def __init__(self, estimator: ReferenceEstimator) -> None:
        config: EstimatorConfig = estimator.config
        self._estimator = estimator
        self._applies = (
            config.isolation
            and config.na == 2
            and config.nb + config.nk <= LAGS_N
            and config.trigger == "cusum"
            and config.edge_instants != "anywhere"
        )
        self._kept: deque[tuple[float, float, float]] = deque(maxlen=KEPT_N)  # u, y, innovation; newest last
        self._quiet: tuple[list[float], list[float]] | None = None  # theta and C before a change
        self._habits = Habits(config.edge_codes)
        self._since_n = self._repeated_n = 0
        self._work: Work | None = None
        self._is_named = False
        self.is_doubtful = False
        """True if rounding may have decided when a change was named, or since when."""

    def enter(self, u: float, y: float, step: ReferenceStep) -> ReferenceDiagnosis | None:
        """Enter a sample; return the diagnosis that was completed with it, if one was."""
        if not self._applies:
            return None
        self._since_n += 1
        if step.flags & (SteppedFlag.MISSING | SteppedFlag.REFUSED):
            self._kept.clear()
            self._stop()
        else:
            self._keep(u, y, step)
        return self._spend(self._work) if self._work is not None and not self._is_named else None

    def _keep(self, u: float, y: float, step: ReferenceStep) -> None:
        self._kept.append((u, y, step.innovation))
        if self._work is not None:
            self._work.waiting_n += not self._is_named
            if self._work.waiting_n > KEPT_N - PAST_N or self._since_n + self._repeated_n >= SETTLED_N:
                self._stop()
        elif step.flags & SteppedFlag.GATHERING:
            self._since_n = 0 if len(self._kept) > 1 else self._since_n  # without a gap: theta has jumped
            self._kept.clear()
            self._quiet = None
        elif step.statistic <= 0.0 and self._since_n >= SETTLED_N:
            self._quiet = (self._estimator.theta, [*self._estimator.whitener.c, 0.0, 0.0][:2])
            if len(self._kept) >= LAGS_N:
                self._habits.follow(list(self._kept)[-LAGS_N:])
        if step.alarm:
            self._start()

    def _stop(self) -> None:
        self._work = self._quiet = None

    def _start(self) -> None:
        """Start the diagnosis of an alarm. One that is under way continues."""
        if self._work is not None and not self._is_named:
            self._repeated_n += self._since_n
            self._since_n = 0
            return
        quiet, earliest_n = self._quiet, len(self._kept) - PAST_N
        self._stop()
        self._since_n = self._repeated_n = 0
        self._is_named = False
        if quiet is None or earliest_n < 1:
            return
        try:
            plant = ReferencePlant(self._estimator.config, *quiet)
        except ValueError:
            return
        onsets_n = np.minimum(ONSETS_N, earliest_n)
        self._work = Work(
            self._estimator, plant, self._habits, list(self._kept)[-int(onsets_n[0]) - LAGS_N :], onsets_n
        )

    def _spend(self, work: Work) -> ReferenceDiagnosis | None:
        """Spend the slices of one sample."""
        left = SLICES_N
        while left and work.waiting_n:
            if not work.slices_left:
                work.begin(self._kept[-work.waiting_n])
            spent = min(left, work.slices_left)
            left -= spent
            work.slices_left -= spent
            if work.slices_left:
                break
            work.waiting_n -= 1
            fit, work.fit = work.fit, None
            if fit is not None:
                self.is_doubtful |= fit.is_doubtful
                if named := fit.named():
                    self._is_named = True
                    work.waiting_n = 0
                    return fit.diagnosis(named, self._repeated_n)
        return None


class Work:
    """Work on one alarm."""

    def __init__(
        self,
        estimator: ReferenceEstimator,
        plant: ReferencePlant,
        habits: Habits,
        kept: Sequence[tuple[float, float, float]],
        onsets_n: NDArray[np.int64],
    ) -> None:
        """``kept``: samples from three before the earliest onset to the alarm."""
        self._plant, self._habits, self._onsets_n = plant, habits, onsets_n
        self._force_zero = estimator.config.force_zero
        self._nats = 0.5 / (estimator.trigger.noise_variance * estimator.trigger.scale.factor)
        self._residuals = [kept[2][2], kept[1][2]]  # whitened, newest first
        self._force = [u - self._force_zero for u, _, _ in kept[2::-1]]  # newest first
        self._displacement = [y - plant.rest for _, y, _ in kept[2::-1]]
        n = len(onsets_n)
        self._past = np.zeros((2, n, _EFFECTS_N))  # whitened effects, newest first
        self._matrix = np.zeros((n, _EFFECTS_N, _EFFECTS_N))
        self._vector = np.zeros((n, _EFFECTS_N))
        self._energy, self._unrest = np.zeros(n), np.zeros(n)
        self._same_n = np.zeros(2, np.int64)
        self._worked_n = 0
        self.waiting_n = int(onsets_n[0])
        self.slices_left = 0
        self.fit: Fit | None = None
        """Evidence with the sample that was begun last, if it is to be weighed."""

    def begin(self, sample: tuple[float, float, float]) -> None:
        """Enter a sample into all onsets; weigh the hypotheses if it is the newest, after the alarm."""
        self._worked_n += 1
        self._force = [sample[0] - self._force_zero, *self._force][: LAGS_N + 1]
        self._displacement = [sample[1] - self._plant.rest, *self._displacement][: LAGS_N + 1]
        ages_n = self._worked_n + self._onsets_n - self._onsets_n[0]
        has_begun = ages_n >= 1
        self._enter_residual()
        self._enter_effects(ages_n)
        unrest = self._habits.unrest(squared_step(self._force[LAGS_N - 1 :: -1]))
        self._unrest += has_begun * unrest
        self._energy += has_begun * self._nats * self._residuals[0] ** 2
        is_same = [x[0] == x[1] for x in (self._force, self._displacement)]
        self._same_n = np.where(is_same, self._same_n + 1, 0)
        weighs = self._worked_n > self._onsets_n[0] and self.waiting_n == 1
        self.slices_left = WEIGHED_N if weighs else 1 + math.ceil(np.count_nonzero(has_begun) / 2)
        self.fit = self._fit(ages_n) if weighs else None

    def _enter_residual(self) -> None:
        """Whiten y less the response of the plant before the change."""
        plant = self._plant
        out = float(plant.a @ self._displacement[:LAGS_N] - plant.b @ self._force[:LAGS_N])
        out -= plant.c[0] * self._residuals[0] + plant.c[1] * self._residuals[1]
        self._residuals = [out, self._residuals[0]]

    def _enter_effects(self, ages_n: NDArray[np.int64]) -> None:
        first, second, later = (self._driving(age_n) for age_n in (1, 2, 3))
        is_first = (ages_n == 1)[:, np.newaxis]
        drives = np.where(is_first, first, np.where((ages_n == 2)[:, np.newaxis], second, later))
        self._past[0][ages_n == 1, _PUSHES.stop - 1] = 1.0  # the second impulse came one sample before
        now = drives - self._plant.c[0] * self._past[0] - self._plant.c[1] * self._past[1]
        now[ages_n < 1] = 0.0
        self._past = np.array([now, self._past[0]])
        self._matrix += self._nats * now[:, :, np.newaxis] * now[:, np.newaxis, :]
        self._vector += self._nats * now * self._residuals[0]

    def _driving(self, age_n: int) -> list[float]:
        """Inputs of all effects for an onset so many samples ago, three for more."""
        return [*self._driving_plant(age_n), float(age_n == 1), 0.0, *self._driving_faults(age_n)]

    def _driving_plant(self, age_n: int) -> list[float]:
        """Inputs of the effects of M, B and K."""
        plant, f, x = self._plant, self._force, self._displacement
        if age_n > 1:
            force, spring, damper = (
                float(factors @ past[:LAGS_N]) for factors, past in ((plant.b, f), (plant.spring, x), (plant.damper, x))
            )
        else:
            force = plant.direct * f[0] + (plant.gain * plant.hold - plant.direct) * f[1]
            spring = plant.hold * (x[1] + (x[0] - x[1]) / 3.0)
            damper = plant.hold * plant.lag * (x[0] - x[1])
        return [spring + damper - force, -damper, -spring]

    def _driving_faults(self, age_n: int) -> list[float]:
        """Inputs of the effects of LINEAR: measured codes f too high leave a residual of A f less B f."""
        a, b = self._plant.a, self._plant.b
        f, x = np.array(self._force), np.array(self._displacement)
        is_wrong = np.arange(LAGS_N) < age_n
        steps_f, steps_x = f[:-1] - f[1:], x[:-1] - x[1:]
        is_late = is_wrong & (np.arange(LAGS_N) > 0)  # the present step of the force is not known
        late = np.array([0.0, *(-steps_f[:-1])])
        return [
            -float(b @ is_wrong),
            -float(b @ (is_wrong * f[:LAGS_N])),
            -float(b @ (is_late * late)),
            float(a @ is_wrong),
            float(a @ (is_wrong * x[:LAGS_N])),
            float(a @ (~is_wrong * steps_x) - b @ steps_f),
        ]

    # ---- verdict

    def _fit(self, ages_n: NDArray[np.int64]) -> Fit:
        """Evidence of all hypotheses; the impulses are eliminated from the normal equations."""
        pushes = self._matrix[:, _PUSHES, _PUSHES] + self._nats * np.eye(2)
        shares = np.linalg.solve(pushes, self._matrix[:, _PUSHES, :])
        matrix = self._matrix - np.einsum("npi,npj->nij", self._matrix[:, _PUSHES, :], shares)
        vector = self._vector - np.einsum("np,npj->nj", self._vector[:, _PUSHES], shares)
        change = np.linalg.solve(pushes, self._vector[:, _PUSHES, np.newaxis])[:, :, 0]
        gain = np.einsum("np,np->n", self._vector[:, _PUSHES], change)
        plant = matrix[:, :3, :3] + PRIOR * np.eye(3)
        hypotheses = dict(zip(PARAMETERS, _linear(gain, np.einsum("nii->ni", plant), vector[:, :3]), strict=True))
        known = np.maximum(np.einsum("nii->ni", matrix[:, 5:, 5:]), 1e-9)
        hypotheses |= zip(LINEAR, _linear(gain, known, vector[:, 5:]), strict=True)
        for index, fault in enumerate(LINEAR):
            if fault in (Change.FORCE_DELAY, Change.DISPLACEMENT_DELAY):  # the size is 1
                hypotheses[fault] = Hypothesis(
                    gain + 2.0 * vector[:, 5 + index] - known[:, index], np.ones(len(gain)), np.zeros(len(gain))
                )
        hypotheses |= self._of_codes(hypotheses[Change.FORCE_OFFSET], ages_n)
        scaled = hypotheses[Change.DISPLACEMENT_GAIN]
        counted = np.clip(scaled.change, -0.5, 1.0)  # undoing a gain scales the noise as well
        hypotheses[Change.DISPLACEMENT_GAIN] = Hypothesis(
            scaled.gain - ages_n * counted * (1.0 - 0.5 * counted), scaled.change, scaled.known
        )
        samples_n = self._worked_n - int(self._onsets_n[0])
        return Fit([hypotheses[single] for single in SINGLE], gain, plant, vector[:, :3], self._onsets_n, samples_n)

    def _of_codes(self, offset: Hypothesis, ages_n: NDArray[np.int64]) -> dict[Change, Hypothesis]:
        """Hypotheses of a stuck and of a noisy channel. A stuck force is an offset whose codes are equal."""
        usual = 0.5 * ages_n
        ratio = np.maximum(self._energy / usual, 1.0)
        noise = usual * (ratio - 1.0 - np.log(ratio))
        none, one = np.zeros(len(ages_n)), np.ones(len(ages_n))
        stuck = [
            np.where(self._same_n[channel] >= ages_n, gain + ages_n * self._habits.surprises[channel], -np.inf)
            for channel, gain in enumerate((offset.gain, self._energy))
        ]
        known = np.asarray(VARIANCE_KNOWN * ages_n, np.float64)
        return {
            Change.FORCE_STUCK: Hypothesis(stuck[0], offset.change, offset.known),
            Change.FORCE_NOISE: Hypothesis(noise + 0.5 * self._unrest, one, known),
            Change.DISPLACEMENT_STUCK: Hypothesis(stuck[1], none, none),
            Change.DISPLACEMENT_NOISE: Hypothesis(noise, one, known),
        }


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Evidence for a single change, by onset."""

    gain: Array
    """Log-likelihood over no change [nats]."""
    change: Array
    known: Array
    """Half the reciprocal variance of ``change``."""


def _linear(gain: Array, known: Array, vector: Array) -> list[Hypothesis]:
    """Hypotheses of effects with these normal equations, (onsets, effects)."""
    change = vector / known
    return [Hypothesis(gain + vector[:, i] * change[:, i], change[:, i], known[:, i]) for i in range(vector.shape[1])]


def sum_of_likelihoods(logarithms: Iterable[float]) -> float:
    """Logarithm of 1 and these likelihoods added one after another, each time to 0.03 by a parabola."""
    out = 0.0
    for each in logarithms:
        most, least = max(out, each), min(out, each)
        out = most + SUM_CURVE * max(SUM_WIDTH - (most - least), 0.0) ** 2
    return out


class Fit:
    """Likelihoods of all hypotheses: one change, or two changed parameters, at each onset."""

    def __init__(
        self,
        singles: Sequence[Hypothesis],
        gain: Array,
        matrix: Array,
        vector: Array,
        onsets_n: NDArray[np.int64],
        samples_n: int,
    ) -> None:
        """``matrix`` and ``vector``: normal equations of M, B and K."""
        gains = np.array([single.gain for single in singles])
        self.any_alone = np.array([sum_of_likelihoods(each) for each in gains.tolist()])
        self._gains, self._onsets_n, self._samples_n = gains, onsets_n, samples_n
        best = gains.argmax(axis=1)
        is_likely = gains.max(axis=1) > 0.0
        self._change = np.array([single.change[at] for single, at in zip(singles, best, strict=True)]) * is_likely
        self._known = np.array([single.known[at] for single, at in zip(singles, best, strict=True)]) * is_likely
        self._onset_n = onsets_n[best] * is_likely
        self._alone = self.any_alone - 0.5 * np.log1p(SIZES * self._change**2 * self._known)
        self._any_pair: dict[frozenset[int], float] = {}
        self._beside = np.zeros(3)
        for i, j in itertools.combinations(range(3), 2):
            part = np.ix_(range(len(gain)), (i, j), (i, j))
            inverse = np.linalg.inv(matrix[part])
            x = np.einsum("nij,nj->ni", inverse, vector[:, (i, j)])
            both = gain + np.einsum("ni,ni->n", x, vector[:, (i, j)])
            self._any_pair[frozenset((i, j))] = sum_of_likelihoods(both.tolist())
            lack = np.maximum(WORTH_TELLING - np.abs(x), 0.0)
            relevant = both[:, np.newaxis] - lack**2 / np.einsum("nii->ni", inverse)
            self._beside[i] = max(self._beside[i], relevant[:, 1].max())
            self._beside[j] = max(self._beside[j], relevant[:, 0].max())

    @property
    def is_doubtful(self) -> bool:
        """True if rounding may decide what is named, or its onset."""
        low, high = self.named(-1.0), self.named(1.0)
        return (
            self.any_alone.max() > NEAR_MOST
            or low != high
            or (high in SINGLE and len(self._likely_onsets(SINGLE.index(high))) > 1)
        )

    def _likely_onsets(self, one: int) -> NDArray[np.int64]:
        """Onsets of a change any of which may be the best one."""
        gains = self._gains[one]
        return np.unique(self._onsets_n[gains >= gains.max() - self._near(one)])

    def _near(self, one: int) -> float:
        return NEAR + NEAR_SHARE * max(float(self.any_alone[one]), 0.0)

    def named(self, nears: float = 0.0) -> Change | None:
        """The change that is sure, if one is; with so much more evidence as rounding may add, ``nears`` times."""
        one = int(self._alone.argmax())
        more = nears * self._near(one) - ROUNDING * self.any_alone[one]
        pair = max(likely for pair, likely in self._any_pair.items() if one in pair or one not in range(3))
        if pair - self.any_alone[one] > NOT_BY_CHANCE - more:
            return Change.SEVERAL
        if one in range(3):
            penalty = self._penalty(one)
            is_known = self._known[one] > EXTENT_KNOWN * (1.0 - NEAR_KNOWN * nears)
            is_sure = is_known and self._stands_alone(one, penalty, more)
            lead = SURE + penalty
        else:
            onset_n = self._onset_n[one] if not nears else self._likely_onsets(one)[-1 if nears > 0.0 else 0]
            is_sure = self._samples_n + onset_n >= FAULT_N and self.any_alone[one] - pair >= MORE_LIKELY - more
            lead = SURE + FAULTY
        others = np.delete(self._alone, one)
        return SINGLE[one] if is_sure and self._alone[one] - others.max() >= lead - more else None

    def _penalty(self, one: int) -> float:
        extent = self._extent(one)
        return 0.5 * (extent + 1.0 / extent - 2.0)

    def _stands_alone(self, one: int, penalty: float, more: float) -> bool:
        """True if a parameter alone is more likely than beside another one."""
        likely = self.any_alone[one] - penalty
        others = frozenset(range(3)) - {one}
        return bool(
            likely - self._beside[one] >= ALONE - more and likely - self._any_pair[others] >= MORE_LIKELY - more
        )

    def diagnosis(self, change: Change, repeated_n: int) -> ReferenceDiagnosis:
        """Onset and extent of a change that was named, ``repeated_n`` samples before the last alarm."""
        if change not in SINGLE:
            return ReferenceDiagnosis(change, 0, 1.0, 0.0)
        one = SINGLE.index(change)
        onset_n = int(self._onset_n[one]) + repeated_n
        if change not in (*PARAMETERS, *GAINS):
            return ReferenceDiagnosis(change, onset_n, 1.0, 0.0)
        extent, deviation = self._extent(one), math.sqrt(0.5 / float(self._known[one]))
        inverted = SINGLE[one] not in (Change.DAMPING, Change.STIFFNESS)
        return ReferenceDiagnosis(change, onset_n, extent, deviation * (extent**2 if inverted else 1.0))

    def _extent(self, one: int) -> float:
        """New value over old one, from 1 - old/new for M and gains, and new/old - 1 for B and K."""
        if SINGLE[one] is Change.MASS or SINGLE[one] in GAINS:
            return 1.0 / max(1.0 - float(self._change[one]), 0.01)
        return max(1.0 + float(self._change[one]), 0.01)
