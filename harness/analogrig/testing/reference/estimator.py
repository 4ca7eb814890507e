"""Reference implementation of the estimator in plain Python and float64.

It follows harness/docs/background/estimator.md and the manual est.h, not the C. It is not optimised.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

from analogrig.catalogue import SteppedFlag
from analogrig.estimator_config import EstimatorConfig
from analogrig.testing.reference.regression import Covariance, Vector, Whitener, dot, is_stable
from analogrig.testing.reference.trigger import Meaning, ReferenceTrigger

DOUBT_N = 12
"""Samples after an edge during which a slip is considered."""

SLIP_DOUBT = 1000.0
"""Factor on every variance in P after a slip."""

CONTRACTION = 0.99
REFRESH_STEP = 8e-6
REFRESH_STRIDE = 0.005
REFRESH_MEMORIES = 2.0

SETTLED = 1.0001
"""Noise variance, in variances of e, below which the whitening has settled."""

WEIGHT_DUE, WEIGHT_OVERDUE = 0.5, 0.25
"""Weights below which the d's are limited: in a step with little other work, and in any step."""

NEAR = 0.1
"""Relative distance from a threshold at which rounding may decide that A has moved."""

COUNTERS = ("updated", "missing", "refused", "saturated", "stuck", "alarms", "restarts", "slips", "refreshes")
"""Counters of the estimator, by their names in est_counters_t."""


@dataclass(frozen=True)
class ReferenceStep:
    """Output for one sample."""

    innovation: float = 0.0
    """Codes; 0 where there was no equation."""
    statistic: float = 0.0
    """After this sample, before an alarm or a gap resets it."""
    alarm: bool = False
    flags: int = 0
    """SteppedFlag of the catalogue."""


@dataclass
class Doubt:
    """Hypotheses that the edges of u since a moment came one sample early or late."""

    theta: Vector
    """Estimate before the first of the edges."""
    age_n: int = 1
    early: Vector = field(default_factory=list)
    late: Vector = field(default_factory=list)
    """Effects of the early and late edges on the whitened equations, newest first."""


class Refresh(Enum):
    """Next step of a refresh of C."""

    WAITS = 0
    COMPARES = 1
    TAKES = 2


class ReferenceEstimator:
    """One estimator. ``theta`` is the estimate after the last step."""

    def __init__(self, config: EstimatorConfig) -> None:
        self.config = config
        c = [*config.c, *([0.0] * config.na)][: config.na]
        n = config.parameters
        prior = [config.p0] * n
        if config.offset:
            prior[-1] = config.p0_offset
        self.theta = [0.0] * n
        self.covariance = Covariance(prior)
        self.whitener = Whitener(c)
        self.trigger = ReferenceTrigger(config)
        self.counters = dict.fromkeys(COUNTERS, 0)
        self.u: Vector = []  # newest first, like y and residuals; empty after a gap
        self.y: Vector = [0.0] * config.na
        self.residuals = [0.0] * config.nc
        self.pending = self._past_n
        self.settled = False  # the gains of the whitening have converged to C
        self.equations = 0  # since C was last considered
        self.refresh = Refresh.WAITS
        self.since_n = 0  # samples since an edge of u
        self.same_n = 0  # samples of constant y since an edge of u
        self.doubt: Doubt | None = None
        self.slipped: Vector | None = None  # theta after a slip, valid from the next sample on
        self.is_doubtful = False  # rounding may have decided whether C was to follow A
        self.deviation = 0.0  # predicted standard deviation of the last innovation, in codes

    @property
    def _past_n(self) -> int:
        return max(self.config.na, self.config.nb + self.config.nk - 1)

    @property
    def deviations(self) -> Vector:
        """Standard deviations of theta."""
        return [math.sqrt(each * self.trigger.noise_variance) for each in self.covariance.variances]

    @property
    def slips(self) -> int:
        """Number of times the edges began to be recorded one sample earlier or later."""
        return self.counters["slips"]

    @property
    def refreshes(self) -> int:
        """Number of times C was taken from the estimate of A."""
        return self.counters["refreshes"]

    def run(self, u: Iterable[float], y: Iterable[float], valid: Iterable[bool] | None = None) -> list[ReferenceStep]:
        """Outputs for n samples, one each."""
        pairs = list(zip(u, y, strict=True))
        good = [True] * len(pairs) if valid is None else [bool(v) for v in valid]
        return [self.step(*pair, valid=v) for pair, v in zip(pairs, good, strict=True)]

    def step(self, u: float, y: float, *, valid: bool = True) -> ReferenceStep:
        """Enter one sample."""
        statistic = self.trigger.statistic
        if not valid:
            self.counters["missing"] += 1
            self._gap()
            return self._stepped(statistic, SteppedFlag.MISSING)
        if self._is_refused(u, y):
            self.counters["refused"] += 1
            self._gap()
            return self._stepped(statistic, SteppedFlag.REFUSED)
        self.counters["updated"] += 1
        self._enter_input(u)
        step = self._gather() if self.pending else self._equation(y)
        self.y = [y, *self.y][: self.config.na]
        return step

    def _stepped(
        self, statistic: float, flags: int = 0, innovation: float = 0.0, *, alarm: bool = False
    ) -> ReferenceStep:
        is_idle = 0 < self.config.idle_n <= self.since_n
        return ReferenceStep(innovation, statistic, alarm, flags | (SteppedFlag.IDLE if is_idle else 0))

    def _gather(self) -> ReferenceStep:
        """Store a sample without an equation of its own, and do the work that the last one left."""
        self.pending -= 1
        self.theta, self.slipped = self.slipped or self.theta, None
        if self.refresh is Refresh.TAKES:
            self._take_c()
            self.equations = 0
        self.refresh = Refresh.WAITS
        if self.pending:
            return self._stepped(self.trigger.statistic, SteppedFlag.GATHERING)
        self.whitener.restart()
        self.residuals = [0.0] * self.config.nc
        self.settled = False
        self.counters["restarts"] += 1
        return self._stepped(self.trigger.statistic, SteppedFlag.GATHERING | SteppedFlag.RESTARTED)

    # ---- samples

    def _is_refused(self, u: float, y: float) -> bool:
        low, high = self.config.code_low, self.config.code_high
        if not (low < u < high and low < y < high):
            self.counters["saturated"] += 1
            return True
        if not self._is_stuck(u, y):
            return False
        self.counters["stuck"] += 1
        return True

    def _is_edge(self, u: float) -> bool:
        return bool(self.u) and abs(u - self.u[0]) >= self.config.edge_codes

    def _is_stuck(self, u: float, y: float) -> bool:
        """True if y has been constant for stuck_n samples since an edge of u."""
        if y != self.y[0]:
            self.same_n = 0
        elif self.same_n or self._is_edge(u):
            self.same_n += 1
        return 0 < self.config.stuck_n <= self.same_n

    def _enter_input(self, u: float) -> None:
        edge = self._is_edge(u)
        self.u = [u, *self.u][: self.config.nb + self.config.nk + 1]
        if self.doubt is not None:
            self.doubt.age_n += 1
            if self.doubt.age_n > DOUBT_N:
                self.doubt = None
        self.since_n = 0 if edge else self.since_n + 1
        if edge and self.config.edge_instants == "anywhere":
            self.pending = max(self.pending, self.config.na)
        if edge and self.trigger.doubts_edges:
            self._begin_doubt()

    def _begin_doubt(self) -> None:
        if self.doubt is not None and self.trigger.has_rival:
            return
        self.doubt = Doubt(list(self.theta))
        if not self.pending and self.config.nk == 0:  # one sample early, it would have entered the equation before
            self.doubt.early = [self.theta[self.config.na] * (self.u[0] - self.u[1])]
        self.trigger.begin_doubt()

    def _forget(self) -> None:
        self.u, self.doubt = [], None
        self.pending = max(self.pending, self._past_n)

    def _gap(self) -> None:
        if not self.u:
            return
        if self.doubt is not None and self.trigger.end_doubt() is Meaning.SLIP:
            self._slip(self.doubt.theta)
        self._forget()

    # ---- equations

    def _regressor(self) -> Vector:
        config = self.config
        phi = [-y for y in self.y] + self.u[config.nk : config.nk + config.nb] + self.residuals
        return [*phi, 1.0] if config.offset else phi

    def _equation(self, y: float) -> ReferenceStep:
        self._limit()
        (*phi, target), variance = self.whitener.whiten([*self._regressor(), y])
        self.settled = variance < SETTLED
        innovation = target - dot(phi, self.theta)
        readings = self._rival_innovations(phi, target)
        gain, variance = self.covariance.measure(phi, variance, self.config.forgetting)
        self.theta = [t + g * innovation for t, g in zip(self.theta, gain, strict=True)]
        self._adapt(phi, target)
        self.trigger.follow_noise(innovation, variance)
        expires = self.doubt is not None and self.doubt.age_n >= DOUBT_N
        decision = self.trigger.enter(innovation, variance, readings, expires=expires)
        self.deviation = math.sqrt(variance * self.trigger.noise_variance)
        step = self._stepped(self.trigger.statistic, 0, innovation, alarm=decision is Meaning.ALARM)
        if decision is Meaning.ALARM:
            self._alarm()
        elif decision is Meaning.SLIP and self.doubt is not None:
            self._slip(self.doubt.theta)
            self._forget()
        return step

    @property
    def _considers_c(self) -> bool:
        """True if this equation includes a step of a refresh of C."""
        return bool(self.config.refresh_n) and self.equations + 1 >= self.config.refresh_n

    def _limit(self) -> None:
        """Limit the d's to the prior once the weight is low, preferably in a step with little other work."""
        long = not self.settled or self.doubt is not None or self._considers_c
        if self.covariance.weight < (WEIGHT_OVERDUE if long else WEIGHT_DUE):
            self.covariance.inflate(1.0)

    def _rival_innovations(self, phi: Vector, target: float) -> tuple[float, float] | None:
        """Innovations under the hypotheses of early and late edges."""
        doubt, config = self.doubt, self.config
        if doubt is None:
            return None
        b = doubt.theta[config.na : config.na + config.nb]
        if self.since_n >= config.nb + config.nk:
            b = [0.0] * config.nb
        late = -sum(b[j] * self._height(config.nk + j, doubt.age_n) for j in range(config.nb))
        early = sum(b[j] * self._height(config.nk + j - 1, doubt.age_n) for j in range(config.nb))
        doubt.early = self._whitened_effect(doubt.early, early)
        doubt.late = self._whitened_effect(doubt.late, late)
        innovation = target - dot(phi, doubt.theta)
        return innovation - doubt.early[0], innovation - doubt.late[0]

    def _height(self, lag: int, age_n: int) -> float:
        """Height of the step of u ``lag`` samples ago; 0 for one before the edges in doubt, which is noise."""
        return self.u[lag] - self.u[lag + 1] if 0 <= lag < age_n else 0.0

    def _whitened_effect(self, past: Vector, x: float) -> Vector:
        gains = self.whitener.latest
        return [x - sum(g * w for g, w in zip(gains, past, strict=False)), *past][: max(len(gains), 1)]

    def _adapt(self, phi: Vector, target: float) -> None:
        """Update what an equation determines besides theta."""
        config = self.config
        if config.random_walk > 0.0:
            self.covariance.walk(config.random_walk)
        if config.nc:
            self.residuals = [target - dot(phi, self.theta), *self.residuals][: config.nc]
        if self._considers_c:
            self._refresh()
        self.equations += 1

    def _refresh(self) -> None:
        """Do one step of a refresh of C: check that A is reliable, compare C with A, or take C from A."""
        stage, self.refresh = self.refresh, Refresh.WAITS
        remembers_edge = (1.0 - self.config.forgetting) * self.since_n < REFRESH_MEMORIES
        if self.doubt is not None:
            return
        if stage is Refresh.TAKES:
            self._take_c()
        elif stage is Refresh.COMPARES:
            self._compare_c()
        elif remembers_edge:
            self.refresh = Refresh.COMPARES

    @property
    def _contracted(self) -> Vector:
        return [a * CONTRACTION ** (i + 1) for i, a in enumerate(self.theta[: self.config.na])]

    def _compare_c(self) -> None:
        step = sum((new - old) ** 2 for new, old in zip(self._contracted, self.whitener.c, strict=True))
        self.is_doubtful |= any(abs(step / limit - 1.0) < NEAR for limit in (REFRESH_STEP, REFRESH_STRIDE))
        if step <= REFRESH_STEP:
            self.equations = -1
            return
        self.refresh = Refresh.TAKES
        if step > REFRESH_STRIDE or not self.settled:  # the whitening restarts with the new C
            self.pending = 1

    def _take_c(self) -> None:
        self.equations = -1
        if is_stable(self._contracted):
            self.whitener.c = self._contracted
            self.whitener.rows = [(self._contracted, 1.0) for _ in range(max(self.config.na, 1))]
            self.counters["refreshes"] += 1

    # ---- changes

    def _slip(self, before: Vector) -> None:
        """Shift the b's of the estimate ``before`` the edges by one place, since the edges moved by one sample."""
        config = self.config
        first, last = config.na, config.na + config.nb
        b = before[first:last]
        moved = [*b[1:], 0.0] if not self.trigger.comes_late else [0.0, *b[:-1]]
        self.slipped = [*before[:first], *moved, *before[last:]]
        self.covariance.inflate(SLIP_DOUBT)
        self.trigger.settle()
        self.counters["slips"] += 1

    def _alarm(self) -> None:
        if self.config.reset == "all":
            self.theta = [0.0] * len(self.theta)
        self.covariance.reset()
        self.equations, self.refresh = 0, Refresh.WAITS
        self.trigger.restart(self.config.hold_off_n)
        self.counters["alarms"] += 1
        self._forget()
