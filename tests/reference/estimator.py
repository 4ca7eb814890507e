"""Reference implementation of the estimator in plain Python and float64.

It follows harness/docs/background/estimator.md and the manual est.h, not the C. It is not optimised.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from analogrig.catalogue import SteppedFlag
from analogrig.estimator_config import EstimatorConfig
from tests.reference.regression import Covariance, Vector, Whitener, differences, dot, is_stable, to_delta, to_plain
from tests.reference.trigger import Meaning, ReferenceTrigger

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

DISPLACED, DISPLACED_SUM = 0.5, 1.5
"""Part of the energy that a displaced edge must explain, and the sum of the excess that suffices."""

SLOPE_N = 5
"""Samples after an edge of u within which another one is part of a slope."""

BRIDGED_MAX, BRIDGE_PRECISION = 8, 0.6
"""Longest gap that is bridged, and smallest precision of the whitening at which it is."""

OUTLIER_BRIDGED = 255
"""Number of predicted samples that stands for an outlier: its y was predicted, and its u is known."""

AT_EDGE_N = 3
"""Samples after an edge in which an outlier is one at the edge."""

CODE_LIMIT = 1e6
"""Code beyond which no sample is predicted."""

NEAR = 0.03
"""Relative distance from a threshold at which rounding may decide that A has moved."""

NEAR_SETTLED, NEAR_LIMITED = 0.5, 0.1
"""The same of the excess of the noise variance over 1, when the whitening may begin anew, and when P is limited."""

ROUNDED = 4e-7
"""Relative rounding of the sums that the noise variance of the whitening is the difference of."""

NEAR_SUM = 0.01
"""The same of the evidence that edges are displaced."""

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


@dataclass
class Displacement:
    """Innovations after an edge, compared with the effect of displacing it."""

    energy: float = 0.0
    along: float = 0.0
    span: float = 0.0

    def enter(self, innovation: float, effect: float) -> None:
        """Enter an innovation and the effect on it."""
        self.along += innovation * effect
        self.span += effect**2
        self.energy += innovation**2

    @property
    def part(self) -> float:
        """Part of the energy that a displacement explains."""
        whole = self.span * self.energy
        return self.along**2 / whole if whole > 0.0 else 0.0


class Refresh(Enum):
    """Next step of a refresh of C."""

    WAITS = 0
    COMPARES = 1
    TAKES = 2


class ReferenceEstimator:
    """One estimator."""

    def __init__(self, config: EstimatorConfig) -> None:
        self.config = config
        c = [*config.c, *([0.0] * config.na)][: config.na]
        n = config.parameters
        prior = [config.p0] * n
        if config.offset:
            prior[-1] = config.p0_offset
        self._is_delta = config.trigger == "cusum"
        self.delta = self._zero
        """Estimate after the last step, for differences of the samples less the first one."""
        self.reference = (0.0, 0.0)  # codes of the first sample
        self.covariance = Covariance(prior)
        self.whitener = Whitener(c)
        self.trigger = ReferenceTrigger(config)
        self.counters = dict.fromkeys(COUNTERS, 0)
        self.u: Vector = []  # newest first, like y and residuals; empty after a gap
        self.y: Vector = [0.0] * config.na
        self.residuals = [0.0] * config.nc
        self.pending = self._past_n
        self.settled = False  # the gains of the whitening have converged to C
        self.variance = 1.0  # of the noise of the last equation, in variances of e
        self.equations = 0  # since C was last considered
        self.refresh = Refresh.WAITS
        self.since_n = 0  # samples since an edge of u
        self.same_n = 0  # samples of constant y since an edge of u
        self.doubt: Doubt | None = None
        self.displacement = Displacement()
        self.misfit = 0.0  # evidence that each edge is displaced otherwise
        self.edges_vary = False
        self.bridged_n = 0  # samples before the next one whose y was predicted
        self.edge_outliers = [False] * 3  # an outlier came right after the last edge, and those before
        self.slipped: Vector | None = None  # delta after a slip, valid from the next sample on
        self._is_doubtful = False
        self._forms: tuple[tuple[float, float], NDArray[np.float64]] | None = None
        """Reference, and theta as linear forms in delta."""
        self.deviation = 0.0  # predicted standard deviation of the last innovation, in codes

    @property
    def _past_n(self) -> int:
        return max(self.config.na, self.config.nb + self.config.nk - 1)

    @property
    def _zero(self) -> Vector:
        """Parameters of theta = 0."""
        a = [1.0, *([0.0] * self.config.na)]
        return [*(to_delta(a) if self._is_delta else a)[1:], *([0.0] * (self.config.parameters - self.config.na))]

    def _plain(self, delta: Vector, lead: float = 1.0) -> Vector:
        """Parameters of the model of est.h, from those for differences. ``lead``: coefficient of y(k)."""
        if not self._is_delta:
            return list(delta)
        first, last = self.config.na, self.config.na + self.config.nb
        out = [*to_plain([lead, *delta[:first]])[1:], *to_plain(delta[first:last]), *delta[last:]]
        if self.config.offset:
            u, y = self.reference
            out[-1] += delta[first - 1] * y - delta[last - 1] * u
        return out

    @property
    def theta(self) -> Vector:
        """Estimate after the last step, as in the model of est.h."""
        return self._plain(self.delta)

    @property
    def deviations(self) -> Vector:
        """Standard deviations of theta."""
        if self._forms is None or self._forms[0] != self.reference:
            columns = [self._plain(unit, 0.0) for unit in np.eye(self.config.parameters).tolist()]
            self._forms = (self.reference, np.transpose(columns))
        variances = self.covariance.variances(self._forms[1])
        return [math.sqrt(each * self.trigger.noise_variance) for each in variances]

    @property
    def is_doubtful(self) -> bool:
        """True if rounding may have decided a threshold: of A and C, of the edges, of the trigger or its scale."""
        scale = self.trigger.scale
        return self._is_doubtful or self.trigger.is_doubtful or scale.is_doubtful or scale.correlation.is_doubtful

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
        is_saturated = self._is_saturated(u, y)
        u, y = (u, y) if is_saturated else self._less_reference(u, y)
        if is_saturated or self._is_stuck(u, y):
            self.counters["refused"] += 1
            self.counters["saturated" if is_saturated else "stuck"] += 1
            self._gap()
            return self._stepped(statistic, SteppedFlag.REFUSED)
        self.counters["updated"] += 1
        self._enter_input(u)
        step = self._gather() if self.pending else self._equation(y)
        self._store_output(y - step.innovation if self.bridged_n else y)
        return step

    def _store_output(self, y: float) -> None:
        """Store an output, or its prediction."""
        self.y = [y, *self.y][: self.config.na]
        if self.bridged_n and abs(y) > CODE_LIMIT:
            self._forget()

    def _stepped(
        self, statistic: float, flags: int = 0, innovation: float = 0.0, *, alarm: bool = False
    ) -> ReferenceStep:
        is_idle = 0 < self.config.idle_n <= self.since_n
        return ReferenceStep(innovation, statistic, alarm, flags | (SteppedFlag.IDLE if is_idle else 0))

    def _gather(self) -> ReferenceStep:
        """Store a sample without an equation of its own, and do the work that the last one left."""
        self.pending -= 1
        self.bridged_n = 0
        self.delta, self.slipped = self.slipped or self.delta, None
        if self.refresh is Refresh.TAKES:
            self._take_c()
            self.equations = 0
        self.refresh = Refresh.WAITS
        if self.pending:
            return self._stepped(self.trigger.statistic, SteppedFlag.GATHERING)
        self.whitener.restart()
        self.trigger.scale.correlation.forget()
        self.residuals = [0.0] * self.config.nc
        self.settled = False
        self.counters["restarts"] += 1
        return self._stepped(self.trigger.statistic, SteppedFlag.GATHERING | SteppedFlag.RESTARTED)

    # ---- samples

    def _is_saturated(self, u: float, y: float) -> bool:
        low, high = self.config.code_low, self.config.code_high
        return not (low < u < high and low < y < high)

    def _less_reference(self, u: float, y: float) -> tuple[float, float]:
        if not (self._is_delta and self.config.offset):
            return u, y
        if not self.counters["updated"]:
            self.reference = (u, y)
        return u - self.reference[0], y - self.reference[1]

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
        if edge and 0 < self.bridged_n < OUTLIER_BRIDGED:  # the instant of the edge is unknown
            self.since_n += 1
            self._forget()
            self.u = [u]
            return
        is_slope = self.since_n < SLOPE_N
        if edge:
            self.edge_outliers = [False, *self.edge_outliers[:2]]
        self.since_n = 0 if edge else self.since_n + 1
        instants = "anywhere" if self.edges_vary else self.config.edge_instants
        if edge and instants == "anywhere":
            self.pending = max(self.pending, self.config.na)
        may_slip = instants == "may-slip" and self.config.trigger == "cusum"
        if edge and may_slip and not is_slope and not self.trigger.scale.is_on_trial:
            self._begin_doubt()

    def _begin_doubt(self) -> None:
        if self.doubt is not None and self.trigger.has_rival:
            return
        self.doubt = Doubt(list(self.delta))
        if not self.pending and self.config.nk == 0:  # one sample early, it would have entered the equation before
            self.doubt.early = [self.delta[self.config.na] * (self.u[0] - self.u[1])]
        last = self._residual(self.whitener.past[0], self.delta) if self.whitener.past else 0.0
        self.displacement = Displacement(2.0 * DOUBT_N * last**2)
        self.trigger.begin_doubt()

    def _forget(self) -> None:
        self.u, self.doubt = [], None
        self.pending = max(self.pending, self._past_n)

    def _gap(self) -> None:
        """Bridge a sample that is not good, or let the equations begin anew."""
        if not self.u:
            return
        bridges = self._can_bridge
        if self.doubt is not None:
            if bridges and self.doubt.age_n < DOUBT_N - 1:  # its last sample decides, and must be good
                self.doubt.age_n += 1
            elif self.trigger.end_doubt() is Meaning.SLIP:
                self._slip(self.doubt.theta)
                bridges = False
            else:
                self.doubt = None
        if bridges:
            self._bridge()
        else:
            self._forget()

    @property
    def _can_bridge(self) -> bool:
        is_white = not any(self.whitener.c)  # the equations have no state that a prediction could continue
        is_precise = bool(self.whitener.rows) and not is_white and 1.0 / self.whitener.rows[0][1] > BRIDGE_PRECISION
        is_free = not (self.pending or self.same_n or self.trigger.quiet_n or self.config.nc)
        return is_free and is_precise and self.bridged_n < BRIDGED_MAX

    def _bridge(self) -> None:
        """Predict a missing sample: u is the last one, the innovation zero."""
        self.bridged_n += 1
        self.u = [self.u[0], *self.u][: self.config.nb + self.config.nk + 1]
        self.since_n += 1
        equation = self._whitened(self.y[0])
        innovation = self._residual(equation, self.delta)
        self.whitener.past[0][-1] -= innovation
        if self.doubt is not None:
            self._enter_readings(self.doubt)
        self._store_output(self.y[0] - innovation)

    # ---- equations

    def _equation_of(self, y: float) -> Vector:
        """Regressor, followed by the target."""
        config = self.config
        outputs, inputs = [y, *self.y], self.u[config.nk : config.nk + config.nb]
        if self._is_delta:
            outputs, inputs = differences(outputs), differences(inputs)
        target, *past = outputs
        return [*(-x for x in past), *inputs, *self.residuals, *([1.0] if config.offset else []), target]

    def _whitened(self, y: float) -> Vector:
        self._limit()
        equation, self.variance = self.whitener.whiten(self._equation_of(y))
        self.settled = self.variance < SETTLED
        return equation

    @staticmethod
    def _residual(equation: Vector, delta: Vector) -> float:
        return equation[-1] - dot(equation[:-1], delta)

    def _equation(self, y: float) -> ReferenceStep:
        equation = self._whitened(y)
        innovation = self._residual(equation, self.delta)
        readings = self._rival_innovations(equation)
        gain, variance = self.covariance.measure(equation[:-1], self.variance, self.config.forgetting)
        if self.config.random_walk > 0.0:
            self.covariance.walk(self.config.random_walk)
        expires = self.doubt is not None and self.doubt.age_n >= DOUBT_N
        decision = self.trigger.enter(innovation, variance, readings, expires=expires)
        if expires:
            self._watch_edges()
        self.deviation = math.sqrt(variance * self.trigger.noise_variance)
        bridged_n, self.bridged_n = self.bridged_n, 0
        if decision is not Meaning.QUIET and not bridged_n and self._is_lone_outlier(innovation, variance):
            return self._set_aside(innovation)
        self.delta = [t + g * innovation for t, g in zip(self.delta, gain, strict=True)]
        if self.config.nc:
            self.residuals = [self._residual(equation, self.delta), *self.residuals][: self.config.nc]
        step = self._stepped(self.trigger.statistic, 0, innovation, alarm=decision is Meaning.ALARM)
        if decision is Meaning.ALARM:
            self._alarm()
        elif decision is Meaning.SLIP and self.doubt is not None:
            self._slip(self.doubt.theta)
            self._forget()
        else:
            self._watch_scale(equation, innovation**2 / variance)
            if self._considers_c:
                self._refresh()
            self.equations += 1
        return step

    def _is_lone_outlier(self, innovation: float, variance: float) -> bool:
        returns = self.since_n < AT_EDGE_N and any(self.edge_outliers[1:])
        applies = self._is_delta and self._can_bridge and not returns
        return applies and self.trigger.is_lone_outlier(innovation, variance, in_doubt=self.doubt is not None)

    def _set_aside(self, innovation: float) -> ReferenceStep:
        """Predict the output of a lone outlier, and let the next sample decide."""
        self.whitener.past[0][-1] -= innovation
        self.trigger.set_aside()
        self.doubt = None
        self.bridged_n = OUTLIER_BRIDGED
        self.edge_outliers[0] |= self.since_n < AT_EDGE_N
        return self._stepped(self.trigger.statistic, 0, innovation)

    def _watch_scale(self, equation: Vector, square: float) -> None:
        scale = self.trigger.scale
        is_end = scale.enter(
            square,
            self._residual(equation, scale.old) ** 2 if scale.is_on_trial else 0.0,
            self.since_n,
            waits=self.refresh is not Refresh.WAITS,
            quiet_n=self.trigger.quiet_n,
            excess=self.trigger.excess,
        )
        if is_end:
            self.trigger.find_hidden_change(is_doubted=self.doubt is not None)

    @property
    def _rounded(self) -> float:
        """Rounding of the noise variance in float32: C with zeros near 1 amplifies it."""
        c = [1.0, *self.whitener.c]
        return ROUNDED * dot(c, c) / max(abs(sum(c)), ROUNDED)

    @property
    def _from_settling(self) -> float:
        """Distance from where the whitening counts as settled, relative to the excess of the noise variance."""
        return abs((self.variance - 1.0) / (SETTLED - 1.0) - 1.0)

    @property
    def _considers_c(self) -> bool:
        """True if this equation includes a step of a refresh of C."""
        return bool(self.config.refresh_n) and self.equations + 1 >= self.config.refresh_n

    def _limit(self) -> None:
        """Limit the d's to the prior once the weight is low, preferably in a step with little other work."""
        long = not self.settled or self.doubt is not None or self._considers_c
        if self.covariance.weight < WEIGHT_DUE and self.covariance.exceeds_prior:
            self._is_doubtful |= self._from_settling < NEAR_LIMITED
        if self.covariance.weight < (WEIGHT_OVERDUE if long else WEIGHT_DUE):
            self.covariance.inflate(1.0)

    def _rival_innovations(self, equation: Vector) -> tuple[float, float] | None:
        """Innovations under the hypotheses of early and late edges."""
        if self.doubt is None:
            return None
        early, late = self._enter_readings(self.doubt)
        innovation = self._residual(equation, self.doubt.theta)
        self.displacement.enter(innovation, early - late)
        return innovation - early, innovation - late

    def _enter_readings(self, doubt: Doubt) -> tuple[float, float]:
        """Effects of early and late edges on the present equation."""
        config = self.config
        b = to_plain(doubt.theta[config.na : config.na + config.nb])
        if self.since_n >= config.nb + config.nk:
            b = [0.0] * config.nb
        late = -sum(b[j] * self._height(config.nk + j, doubt.age_n) for j in range(config.nb))
        early = sum(b[j] * self._height(config.nk + j - 1, doubt.age_n) for j in range(config.nb))
        doubt.early = self._whitened_effect(doubt.early, early)
        doubt.late = self._whitened_effect(doubt.late, late)
        return doubt.early[0], doubt.late[0]

    def _watch_edges(self) -> None:
        """Take edges for coming anywhere once every edge is displaced by another part of an interval."""
        self.misfit = max(0.0, self.misfit + self.displacement.part - DISPLACED)
        self._is_doubtful |= abs(self.misfit / DISPLACED_SUM - 1.0) < NEAR_SUM
        if self.misfit > DISPLACED_SUM:
            self.edges_vary = True
            self.trigger.scale.forgive()

    def _height(self, lag: int, age_n: int) -> float:
        """Height of the step of u ``lag`` samples ago; 0 for one before the edges in doubt, which is noise."""
        return self.u[lag] - self.u[lag + 1] if 0 <= lag < age_n else 0.0

    def _whitened_effect(self, past: Vector, x: float) -> Vector:
        gains = self.whitener.latest
        return [x - sum(g * w for g, w in zip(gains, past, strict=False)), *past][: max(len(gains), 1)]

    def _refresh(self) -> None:
        """Do one step of a refresh of C: check that A is reliable, compare C with A, or take C from A."""
        stage, self.refresh = self.refresh, Refresh.WAITS
        remembers_edge = (1.0 - self.config.forgetting) * self.since_n < REFRESH_MEMORIES
        if self.doubt is not None and self.trigger.has_rival:
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
        self._is_doubtful |= any(abs(step / limit - 1.0) < NEAR for limit in (REFRESH_STEP, REFRESH_STRIDE))
        if step <= REFRESH_STEP:
            self.equations = -1
            return
        near = max(NEAR_SETTLED * (SETTLED - 1.0), self._rounded)
        self._is_doubtful |= step <= REFRESH_STRIDE and abs(self.variance - SETTLED) < near
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
        b = to_plain(before[first:last])
        moved = [*b[1:], 0.0] if not self.trigger.comes_late else [0.0, *b[:-1]]
        self.slipped = [*before[:first], *to_delta(moved), *before[last:]]
        self.covariance.inflate(SLIP_DOUBT)
        self.trigger.settle()
        self.counters["slips"] += 1

    def _alarm(self) -> None:
        if self.config.trigger == "cusum":
            self.trigger.scale.begin_trial(self.delta)
        if self.config.reset == "all":
            self.delta = self._zero
        self.covariance.reset()
        self.equations, self.refresh = 0, Refresh.WAITS
        self.trigger.restart(self.config.hold_off_n)
        self.counters["alarms"] += 1
        self._forget()
