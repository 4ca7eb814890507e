"""Reference implementation of the estimator in plain Python and float64, as an oracle for the C.

It follows harness/docs/background/estimator.md, not the C; both agree to the precision of float32. It is not
optimised. Guards of the device (stuck or absurd readings, counters) are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum

from analogrig.estimator_config import EstimatorConfig

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

NOISE_RATE, NOISE_CLIP, NOISE_KEPT = 0.005, 9.0, 0.9851

Vector = list[float]


@dataclass(frozen=True)
class ReferenceStep:
    """Output for one sample."""

    innovation: float = 0.0
    """Codes; 0 where there was no equation."""
    statistic: float = 0.0
    alarm: bool = False


class Whitener:
    """Whitening of the noise C(z) e of consecutive equations.

    Innovations algorithm for a moving average that begins with the first equation (Brockwell and Davis, Time Series:
    Theory and Methods, 1991, section 5.3).
    """

    def __init__(self, c: Sequence[float]) -> None:
        self.c = list(c)
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next equation."""
        self.rows: list[tuple[Vector, float]] = []  # gains and variance of the equations before, newest first
        self.past: list[Vector] = []  # whitened equations, newest first

    def gains(self) -> tuple[Vector, float]:
        """Gains of the next equation, and the variance of its whitened noise in variances of e."""
        order = len(self.c)
        taps = [1.0, *self.c]
        gains, covariance = [0.0] * order, [0.0] * (order + 1)
        variance = sum(tap * tap for tap in taps)
        for lag in range(min(order, len(self.rows)), 0, -1):
            covariance[lag] = sum(taps[i] * taps[i + lag] for i in range(order + 1 - lag))
            covariance[lag] -= sum(
                covariance[m] * self.rows[lag - 1][0][m - lag - 1] for m in range(lag + 1, order + 1)
            )
            gains[lag - 1] = covariance[lag] / self.rows[lag - 1][1]
            variance -= covariance[lag] * gains[lag - 1]
        return gains, variance

    def whiten(self, equation: Sequence[float]) -> tuple[Vector, float]:
        """Whitened equation, and the variance of its noise in variances of e."""
        gains, variance = self.gains()
        out = list(equation)
        for gain, before in zip(gains, self.past, strict=False):
            out = [x - gain * w for x, w in zip(out, before, strict=True)]
        keep = max(len(self.c), 1)
        self.rows = [(gains, variance), *self.rows][:keep]
        self.past = [out, *self.past][:keep]
        return out, variance

    @property
    def latest(self) -> Vector:
        """Gains of the newest equation."""
        return self.rows[0][0]


class Covariance:
    """P in units of the noise variance, as U D U' / weight (Bierman 1977). Forgetting lowers the weight."""

    def __init__(self, prior: Sequence[float]) -> None:
        self.prior = list(prior)
        self.reset()

    def reset(self) -> None:
        """Set P to P0."""
        n = len(self.prior)
        self.d, self.weight = list(self.prior), 1.0
        self.u = [[float(i == j) for j in range(n)] for i in range(n)]

    def inflate(self, factor: float) -> None:
        """Multiply P by this factor, up to the prior."""
        self.d = [min(d * factor / self.weight, p) for d, p in zip(self.d, self.prior, strict=True)]
        self.weight = 1.0

    def measure(self, phi: Sequence[float], variance: float, forgetting: float) -> tuple[Vector, float]:
        """Enter an equation; return its gain and the variance of its innovation (Bierman, V.3; thesis Equ 3.21)."""
        n = len(self.d)
        gain = [0.0] * n
        self.weight *= forgetting
        alpha = self.weight * variance
        for j in range(n):
            f = phi[j] + sum(self.u[i][j] * phi[i] for i in range(j))
            v = self.d[j] * f
            before, alpha = alpha, alpha + f * v
            self.d[j] *= before / alpha
            for i in range(j):
                u = self.u[i][j]
                self.u[i][j] = u - f / before * gain[i]
                gain[i] += u * v
            gain[j] = v
        return [g / alpha for g in gain], alpha / self.weight

    def walk(self, variance: float) -> None:
        """Add variance * I to P (Thornton 1976: modified weighted Gram-Schmidt on (U, I))."""
        n = len(self.d)
        rows = [[*self.u[i], *(float(i == k) for k in range(n))] for i in range(n)]
        weights = [*self.d, *([variance * self.weight] * n)]

        def product(a: Vector, b: Vector) -> float:
            return sum(w * x * y for w, x, y in zip(weights, a, b, strict=True))

        for j in reversed(range(n)):
            norm = product(rows[j], rows[j])
            self.d[j] = norm
            for i in range(j):
                self.u[i][j] = product(rows[i], rows[j]) / norm
                rows[i] = [x - self.u[i][j] * y for x, y in zip(rows[i], rows[j], strict=True)]
        self.inflate(1.0)


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


def cusum(before: float, innovation: float, variance: float) -> float:
    """CUSUM of the log-likelihood ratio of a fourfold variance, at least zero."""
    return max(0.0, before + 0.375 * innovation * innovation / variance - 0.69314718)


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
        self.noise_variance = config.noise_variance
        self.u: Vector = []  # newest first, like y and residuals
        self.y: Vector = []
        self.residuals = [0.0] * config.nc
        self.pending = self._past_n
        self.settled = False  # the gains of the whitening have converged to C
        self.equations = 0  # since C was last considered
        self.refresh = Refresh.WAITS
        self.since_n = 0  # samples since an edge of u
        self.statistic = 0.0
        self.rivals = [0.0, 0.0]
        self.mean, self.mean_n = 0.0, 0
        self.quiet_n = config.warm_up_n
        self.doubt: Doubt | None = None
        self.slipped: Vector | None = None  # theta after a slip, valid from the next sample on
        self.slips = 0
        self.refreshes = 0

    @property
    def _past_n(self) -> int:
        return max(self.config.na, self.config.nb + self.config.nk - 1)

    def run(self, u: Iterable[float], y: Iterable[float], valid: Iterable[bool] | None = None) -> list[ReferenceStep]:
        """Outputs for n samples, one each."""
        pairs = list(zip(u, y, strict=True))
        good = [True] * len(pairs) if valid is None else [bool(v) for v in valid]
        return [self.step(*pair, valid=v) for pair, v in zip(pairs, good, strict=True)]

    def step(self, u: float, y: float, *, valid: bool = True) -> ReferenceStep:
        """Enter one sample."""
        if not valid:
            self._gap()
            return ReferenceStep(statistic=self.statistic)
        self._enter_input(u)
        if self.pending:
            self.pending -= 1
            self.theta, self.slipped = self.slipped or self.theta, None
            if self.refresh is Refresh.TAKES:
                self._take_c()
                self.equations = 0
            self.refresh = Refresh.WAITS
            if not self.pending:
                self.whitener.restart()
                self.residuals = [0.0] * self.config.nc
                self.settled = False
            step = ReferenceStep(statistic=self.statistic)
        else:
            step = self._equation(y)
        self.y = [y, *self.y][: self.config.na]
        return step

    # ---- samples

    def _enter_input(self, u: float) -> None:
        known = bool(self.u)
        self.u = [u, *self.u][: self.config.nb + self.config.nk + 1]
        if self.doubt is not None:
            self.doubt.age_n += 1
            if self.doubt.age_n > DOUBT_N:
                self.doubt = None
        edge = known and abs(u - self.u[1]) >= self.config.edge_codes
        self.since_n = 0 if edge else self.since_n + 1
        if edge and self.config.edge_instants == "anywhere":
            self.pending = max(self.pending, self.config.na)
        if edge and self.config.edge_instants == "may-slip" and self.config.trigger == "cusum":
            self._begin_doubt()

    def _begin_doubt(self) -> None:
        if self.doubt is not None and min(self.rivals) < self.statistic:
            return
        self.doubt = Doubt(list(self.theta))
        if not self.pending and self.config.nk == 0:  # one sample early, it would have entered the equation before
            self.doubt.early = [self.theta[self.config.na] * (self.u[0] - self.u[1])]
        self.rivals = [self.statistic, self.statistic]

    def _forget(self) -> None:
        self.u, self.doubt = [], None
        self.pending = max(self.pending, self._past_n)

    def _gap(self) -> None:
        if not self.u:
            return
        if self.doubt is not None:
            if self.statistic >= self._ceiling:
                self._slip(self.doubt.theta)
            else:
                self.statistic = min(self.statistic, *self.rivals)
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
        innovation = target - _dot(phi, self.theta)
        readings = self._rival_innovations(phi, target)
        gain, variance = self.covariance.measure(phi, variance, self.config.forgetting)
        self.theta = [t + g * innovation for t, g in zip(self.theta, gain, strict=True)]
        self._adapt(phi, target, innovation, variance)
        alarm = self._watch(innovation, readings, self._noise_before * variance)
        step = ReferenceStep(innovation, self.statistic, alarm)
        if alarm:
            self._alarm()
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
        innovation = target - _dot(phi, doubt.theta)
        return innovation - doubt.early[0], innovation - doubt.late[0]

    def _height(self, lag: int, age_n: int) -> float:
        """Height of the step of u ``lag`` samples ago; 0 for one before the edges in doubt, which is noise."""
        return self.u[lag] - self.u[lag + 1] if 0 <= lag < age_n else 0.0

    def _whitened_effect(self, past: Vector, x: float) -> Vector:
        gains = self.whitener.latest
        return [x - sum(g * w for g, w in zip(gains, past, strict=False)), *past][: max(len(gains), 1)]

    def _adapt(self, phi: Vector, target: float, innovation: float, variance: float) -> None:
        config = self.config
        self._noise_before = self.noise_variance
        if config.random_walk > 0.0:
            self.covariance.walk(config.random_walk)
        if config.nc:
            self.residuals = [target - _dot(phi, self.theta), *self.residuals][: config.nc]
        if config.noise_estimated:
            square = min(innovation**2 / variance, NOISE_CLIP * self.noise_variance)
            self.noise_variance += NOISE_RATE * (square / NOISE_KEPT - self.noise_variance)
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
        if step <= REFRESH_STEP:
            self.equations = -1
            return
        self.refresh = Refresh.TAKES
        if step > REFRESH_STRIDE or not self.settled:  # the whitening restarts with the new C
            self.pending = 1

    def _take_c(self) -> None:
        self.equations = -1
        if _stable(self._contracted):
            self.whitener.c = self._contracted
            self.whitener.rows = [(self._contracted, 1.0) for _ in range(max(self.config.na, 1))]
            self.refreshes += 1

    # ---- changes

    @property
    def _ceiling(self) -> float:
        return self.config.statistic_ceiling or 0.0

    def _watch(self, innovation: float, readings: tuple[float, float] | None, variance: float) -> bool:
        if self.quiet_n:
            self.quiet_n -= 1
            return False
        trigger = self.config.trigger
        if trigger == "none":
            return False
        if trigger == "cusum":
            return self._watch_cusum(innovation, readings, variance)
        self.statistic = abs(innovation)
        if trigger == "mean-between-faults":  # thesis 4.4.3
            self.mean_n += 1
            self.mean += ((abs(innovation) if self.config.absolute else innovation) - self.mean) / self.mean_n
            self.statistic = abs(self.mean)
        return self.statistic >= self._ceiling

    def _watch_cusum(self, innovation: float, readings: tuple[float, float] | None, variance: float) -> bool:
        self.statistic = cusum(self.statistic, innovation, variance)
        if readings is None:
            return self.statistic >= self._ceiling
        self.rivals = [cusum(g, e, variance) for g, e in zip(self.rivals, readings, strict=True)]
        if self.statistic < self._ceiling:
            return False
        if min(self.rivals) >= self._ceiling:
            return True
        if self.doubt is not None and self.doubt.age_n >= DOUBT_N:
            self._slip(self.doubt.theta)
            self._forget()
        return False

    def _slip(self, before: Vector) -> None:
        """Shift the b's of the estimate ``before`` the edges by one place, since the edges moved by one sample."""
        config = self.config
        first, last = config.na, config.na + config.nb
        b = before[first:last]
        moved = [0.0, *b[:-1]] if self.rivals[1] < self.rivals[0] else [*b[1:], 0.0]
        self.slipped = [*before[:first], *moved, *before[last:]]
        self.covariance.inflate(SLIP_DOUBT)
        self.statistic = min(self.rivals)
        self.slips += 1

    def _alarm(self) -> None:
        if self.config.reset == "all":
            self.theta = [0.0] * len(self.theta)
        self.covariance.reset()
        self.equations, self.refresh = 0, Refresh.WAITS
        self.statistic, self.mean, self.mean_n = 0.0, 0.0, 0
        self.quiet_n = self.config.hold_off_n
        self._forget()


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _stable(c: Sequence[float]) -> bool:
    """True if all zeros of 1 + c[0] z^-1 + ... are inside the unit circle (Schur and Cohn)."""
    a = list(c)
    while a:
        k = a.pop()
        if abs(k) >= 0.9999:
            return False
        a = [(x - k * y) / (1.0 - k * k) for x, y in zip(a, reversed(a), strict=True)]
    return True
