"""Reference of the isolation: after an alarm, the parameter that has changed, in float64.

It follows harness/docs/background/estimator.md and the manual est_isolation.h. Poles come from the roots of A, and the
hypotheses from linear algebra over all onsets at once.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import Change, SteppedFlag
from analogrig.estimator_config import EstimatorConfig
from analogrig.testing.reference.estimator import ReferenceEstimator, ReferenceStep

KEPT_N, PAST_N, SETTLED_N = 40, 4, 100
"""Samples that are kept, those of them before the earliest onset or not yet processed, and samples after an alarm at
which theta counts as the plant."""

ONSETS_N = (20, 12, 7, 4, 2, 1)
"""Samples from each onset that is tried to the alarm."""

SLICES_N = 18
"""Slices of work per sample."""

SURE, MORE_LIKELY, ALONE, NOT_BY_CHANCE, BETWEEN = 3.0, 0.4, 2.0, 11.0, 2.0
"""Evidence, in nats: over another parameter, over two others, over itself with a second one, for a second one, and for
an onset between two samples."""

WORTH_TELLING = 0.15
EXTENT_KNOWN = 4000.0
PRIOR, UNKNOWN = 0.5, 1e-3

NEAR = 0.12
"""Distance from a limit at which rounding, or the sum of likelihoods to 0.03, may decide [nats]."""

SINGLE = (Change.MASS, Change.DAMPING, Change.STIFFNESS)
_PUSH = 3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReferenceDiagnosis:
    """A change that was named."""

    change: Change
    onset_n: int
    """Samples from the onset to the alarm."""
    extent: float


class ReferencePlant:
    """Mechanics in units of samples, from theta and C of an estimator."""

    def __init__(self, estimator: ReferenceEstimator, force_zero: float) -> None:
        """:raises ValueError: theta is no plant."""
        config = estimator.config
        self.nk = config.nk
        self.a = np.array([1.0, *estimator.theta[:2]])
        self.b = np.array(estimator.theta[2 : 2 + config.nb])
        self.offset = estimator.theta[-1] if config.offset else 0.0
        self.c = [*estimator.whitener.c, 0.0, 0.0][:2]
        rest = float(self.a.sum())
        if not 1e-6 <= self.a[2] < 1.0 or rest < 1e-6:
            raise ValueError("no plant")
        poles = np.log(np.roots(self.a).astype(complex))
        p, q = -float(poles.sum().real), float(poles.prod().real)
        if q <= 0.0 or -self.a[1] / (2.0 * math.sqrt(self.a[2])) < -0.9:
            raise ValueError("no plant")
        lag = p / q
        self.gain = float(self.b.sum()) / rest
        self.rest = self.offset / rest + self.gain * force_zero
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


class ReferenceIsolation:
    """Isolation beside one estimator."""

    def __init__(self, estimator: ReferenceEstimator) -> None:
        config: EstimatorConfig = estimator.config
        self._estimator = estimator
        self._applies = (
            config.isolation
            and config.na == 2
            and config.nb + config.nk <= 3
            and config.trigger == "cusum"
            and config.edge_instants != "anywhere"
        )
        self._kept: deque[tuple[float, float, float]] = deque(maxlen=KEPT_N)  # u, y, innovation; newest last
        self._plant: ReferencePlant | None = None
        self._is_quiet = False
        self._since_n = 0
        self._is_active = False
        self._waiting_n = 0
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
        return self._work(self._plant) if self._is_active and self._plant is not None else None

    def _keep(self, u: float, y: float, step: ReferenceStep) -> None:
        self._kept.append((u, y, step.innovation))
        if self._is_active:
            self._waiting_n += 1
            if self._waiting_n > KEPT_N - PAST_N or self._since_n >= SETTLED_N or step.alarm:
                self._stop()
        elif step.flags & SteppedFlag.GATHERING:
            self._kept.clear()
            self._is_quiet = False
        elif step.statistic <= 0.0 and self._since_n >= SETTLED_N:
            self._is_quiet = True
            self._take_plant()
        if step.alarm:
            self._start()

    def _stop(self) -> None:
        self._is_active = self._is_quiet = False
        self._waiting_n = 0

    def _take_plant(self) -> None:
        try:
            self._plant = ReferencePlant(self._estimator, self._estimator.config.force_zero)
        except ValueError:
            self._plant = None

    def _start(self) -> None:
        earliest_n = len(self._kept) - PAST_N
        was_quiet = self._is_quiet
        self._stop()
        self._since_n = 0
        if not was_quiet or earliest_n < 1 or self._plant is None:
            return
        self._is_active = True
        self._onsets = np.minimum(ONSETS_N, earliest_n)
        self._waiting_n = int(self._onsets[0])
        self._worked_n, self._slices_left = 0, 0
        self._nats = 0.5 / self._estimator.trigger.noise_variance
        self._residuals = [self._ago(self._waiting_n)[2], self._ago(self._waiting_n + 1)[2]]
        self._past = np.zeros((2, len(ONSETS_N), 4))  # whitened effects, newest first
        self._matrix = np.zeros((len(ONSETS_N), 4, 4))
        self._vector = np.zeros((len(ONSETS_N), 4))

    def _ago(self, n: int) -> tuple[float, float, float]:
        return self._kept[-1 - n]

    # ---- work

    def _work(self, plant: ReferencePlant) -> ReferenceDiagnosis | None:
        """Spend the slices of one sample."""
        left = SLICES_N
        named, found = None, None
        while left and self._waiting_n:
            if not self._slices_left:
                self._slices_left = self._slices_of_next()
            spent = min(left, self._slices_left)
            left -= spent
            self._slices_left -= spent
            if self._slices_left:
                break
            fit = self._process(plant, self._waiting_n - 1)
            self._waiting_n -= 1
            if fit is not None:
                self.is_doubtful |= named is None and fit.is_doubtful
                named = named or fit.named()
                found = fit.diagnosis(named) if named else None
        if found:
            self._is_active = False  # the first diagnosis after an alarm is the one that is sent
        return found

    def _slices_of_next(self) -> int:
        worked_n = self._worked_n + 1
        if worked_n > self._onsets[0]:
            return 1 + 2 * len(ONSETS_N)
        return 1 + int(np.count_nonzero(worked_n + self._onsets > self._onsets[0]))

    def _process(self, plant: ReferencePlant, ago: int) -> Fit | None:
        """Enter the sample so long ago into all onsets; return their fit after the alarm."""
        self._worked_n += 1
        self._enter_residual(plant, ago)
        ages_n = self._worked_n + self._onsets - self._onsets[0]
        older, first = self._driving(plant, ago)
        drives = np.where((ages_n == 1)[:, np.newaxis], [*first, 1.0], [*older, 0.0])
        now = drives - plant.c[0] * self._past[0] - plant.c[1] * self._past[1]
        now[ages_n < 1] = 0.0
        self._past = np.array([now, self._past[0]])
        self._matrix += self._nats * now[:, :, np.newaxis] * now[:, np.newaxis, :]
        self._vector += self._nats * now * self._residuals[0]
        return self._fit() if self._worked_n > self._onsets[0] else None

    def _enter_residual(self, plant: ReferencePlant, ago: int) -> None:
        """Whiten y less the response of the plant before the change."""
        out = sum(a * self._ago(ago + i)[1] for i, a in enumerate(plant.a))
        out -= sum(b * self._ago(ago + i + plant.nk)[0] for i, b in enumerate(plant.b)) + plant.offset
        out -= plant.c[0] * self._residuals[0] + plant.c[1] * self._residuals[1]
        self._residuals = [out, self._residuals[0]]

    def _driving(self, plant: ReferencePlant, ago: int) -> tuple[list[float], list[float]]:
        """Inputs of the effects of M, B and K: for an onset before, and for one at the sample before."""
        zero = self._estimator.config.force_zero
        u = [self._ago(ago + i)[0] - zero for i in range(len(plant.b) + plant.nk + 1)]
        y = [self._ago(ago + i)[1] for i in range(3)]
        force = sum(b * u[i + plant.nk] for i, b in enumerate(plant.b))
        spring = float(plant.spring @ (np.array(y) - plant.rest))
        damper = float(plant.damper @ (np.array(y) - plant.rest))
        direct = plant.b[0] if plant.nk == 0 else 0.0
        first_force = direct * u[0] + (plant.gain * plant.hold - direct) * u[1]
        rise = y[0] - y[1]
        first_spring = plant.hold * (y[1] + rise / 3.0 - plant.rest)
        first_damper = plant.hold * plant.lag * rise
        return (
            [spring + damper - force, -damper, -spring],
            [first_spring + first_damper - first_force, -first_damper, -first_spring],
        )

    # ---- verdict

    def _fit(self) -> Fit:
        push = self._matrix[:, _PUSH, :]
        known = push[:, _PUSH] + UNKNOWN
        share = push[:, :_PUSH] / known[:, np.newaxis]
        matrix, vector = self._matrix[:, :_PUSH, :_PUSH], self._vector[:, :_PUSH]
        pushed = matrix - share[:, :, np.newaxis] * push[:, np.newaxis, :_PUSH]
        pushed_vector = vector - share * self._vector[:, _PUSH, np.newaxis]
        gain = self._vector[:, _PUSH] ** 2 / known - BETWEEN
        return Fit(
            np.concatenate([matrix, pushed]) + PRIOR * np.eye(3),
            np.concatenate([vector, pushed_vector]),
            np.concatenate([np.zeros(len(ONSETS_N)), gain]),
            np.tile(self._onsets, 2),
        )


class Fit:
    """Likelihoods of all hypotheses: one or two changed parameters, at each onset."""

    def __init__(self, matrix: Array, vector: Array, gain: Array, onsets: NDArray[np.int64]) -> None:
        known = np.einsum("nii->ni", matrix)
        change = vector / known
        alone = gain[:, np.newaxis] + vector * change
        self.any_alone = np.logaddexp.reduce(alone, axis=0, initial=0.0)
        best = alone.argmax(axis=0)
        ranked = np.sort(np.array([alone[onsets == onset].max(axis=0) for onset in np.unique(onsets)]), axis=0)
        self._is_onset_doubtful = (ranked[-1] - ranked[max(-2, -len(ranked))] < NEAR) & (len(ranked) > 1)
        at = (best, np.arange(3))
        self.known, self.change, self.onset_n = known[at], change[at], onsets[best]
        self.any_pair: dict[frozenset[int], float] = {}
        self.beside = np.zeros(3)
        for i, j in itertools.combinations(range(3), 2):
            part = np.ix_(range(len(gain)), (i, j), (i, j))
            inverse = np.linalg.inv(matrix[part])
            x = np.einsum("nij,nj->ni", inverse, vector[:, (i, j)])
            both = gain + np.einsum("ni,ni->n", x, vector[:, (i, j)])
            self.any_pair[frozenset((i, j))] = float(np.logaddexp.reduce(both, initial=0.0))
            lack = np.maximum(WORTH_TELLING - np.abs(x), 0.0)
            relevant = both[:, np.newaxis] - lack**2 / np.einsum("nii->ni", inverse)
            self.beside[i] = max(self.beside[i], relevant[:, 1].max())
            self.beside[j] = max(self.beside[j], relevant[:, 0].max())

    @property
    def is_doubtful(self) -> bool:
        """True if rounding may decide what is named, or its onset."""
        low, high = self.named(-NEAR), self.named(NEAR)
        return low != high or (high in SINGLE and bool(self._is_onset_doubtful[SINGLE.index(high)]))

    def named(self, more: float = 0.0) -> Change | None:
        """The change that is sure with ``more`` evidence, if one is."""
        one = int(self.any_alone.argmax())
        others = [other for other in range(3) if other != one]
        if any(self.any_pair[frozenset((one, other))] - self.any_alone[one] > NOT_BY_CHANCE - more for other in others):
            return Change.SEVERAL
        extent = self._extent(one)
        likely = self.any_alone[one] - 0.5 * (extent + 1.0 / extent - 2.0)
        is_sure = (
            self.known[one] > EXTENT_KNOWN * (1.0 - 0.1 * more)
            and likely - self.beside[one] >= ALONE - more
            and likely - self.any_pair[frozenset(others)] >= MORE_LIKELY - more
            and all(likely - self.any_alone[other] >= SURE - more for other in others)
        )
        return SINGLE[one] if is_sure else None

    def diagnosis(self, change: Change) -> ReferenceDiagnosis:
        """Onset and extent of a change that was named."""
        if change not in SINGLE:
            return ReferenceDiagnosis(change, 0, 1.0)
        one = SINGLE.index(change)
        return ReferenceDiagnosis(change, int(self.onset_n[one]), self._extent(one))

    def _extent(self, one: int) -> float:
        """New value over old one, from 1 - old/new for M and new/old - 1 for B and K."""
        if SINGLE[one] is Change.MASS:
            return 1.0 / max(1.0 - float(self.change[one]), 0.01)
        return max(1.0 + float(self.change[one]), 0.01)
