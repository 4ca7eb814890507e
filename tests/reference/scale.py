"""Scale of the innovations of the reference estimator: their variance as the trigger expects it, and its inflation."""

from __future__ import annotations

from enum import Enum

from analogrig.estimator_config import EstimatorConfig
from tests.reference.correlation import ReferenceCorrelation
from tests.reference.regression import Vector

BLOCK_N = 32
"""Equations between two updates."""

SHARE_MIN, SHARE_WARM, WARM_N = 0.032, 0.25, 64
"""Smallest shares of a block in the noise variance, armed and before; equations before which it is armed."""

HIGH, HIGH_STEP, HIGH_LIMIT = 5.0, 3, 7
"""Mean square of a high block in noise variances that contain it, its step, and the count at which an alarm is due."""

MARGIN, GROWTH_MAX = 2.0, 9.0
INFLATION_STEP, INFLATION_DECAY, INFLATION_MAX = 4.0, 0.9998933, 1e6
TRIAL_BEGIN_N, TRIAL_LEAST_N, TRIAL_N, TRIAL_MAX_N = 16, 20, 56, 120
JUSTIFIED, CREDIT_N, CREDIT_MAX_N = 4.0, 157, 4 * 157
PLAIN = 64.0 * (TRIAL_N - TRIAL_BEGIN_N)
"""Squared errors of the old estimate, in expected variances, beyond which a justified alarm is plain."""
DISPERSED, DISPERSION_GAIN, DISPERSION_MAX = 1.15, 2.0, 10.0
"""Mean of the squared mean squares of blocks, in noise variances, beyond which the scale grows, factor, and largest
value of a block."""
NOISE_LEAST = 0.07
"""Smallest noise variance that is followed, in configured ones."""

NEAR = 0.003
"""Relative distance from a threshold at which rounding may decide."""


class BlockStage(Enum):
    """Stage of the update after a block, one an equation."""

    CORRELATION = 0
    NOISE = 1
    CHANGE = 2
    END = 3


class ReferenceScale:
    """Variance expected of the innovations: the followed noise variance times an inflation."""

    def __init__(self, config: EstimatorConfig) -> None:
        self.noise_variance = config.noise_variance
        self.inflation, self._credit_n = 1.0, CREDIT_MAX_N
        self._is_cusum = config.trigger == "cusum"
        self._share = 1.0 if config.noise_estimated else 0.0
        """Share of the next block in the noise variance; 0: it is not followed."""
        self._dispersion = 1.0
        self._trial_n, self._balance, self._energy = 0, 0.0, 0.0
        self.correlation = ReferenceCorrelation()
        self.high_n = 0
        """Steps of high blocks."""
        self._old: Vector = []
        self._least = NOISE_LEAST * config.noise_variance
        self.is_doubtful = False
        """True if rounding may have decided whether a block counts, or whether an alarm was justified."""
        self._restart()
        self._apply()

    @property
    def is_on_trial(self) -> bool:
        """True while the last alarm is on trial."""
        return self._trial_n > 0

    @property
    def old(self) -> Vector:
        """Estimate before the alarm on trial."""
        return self._old

    @property
    def factor(self) -> float:
        """Factor of the noise variance for what the model does not explain."""
        return self.inflation * (1.0 + DISPERSION_GAIN * max(self._dispersion - DISPERSED, 0.0))

    @property
    def is_open(self) -> bool:
        """True if the block is not complete."""
        return self._left_n > 0

    def _apply(self) -> None:
        self.expected = self.noise_variance * self.factor * (1.0 + MARGIN * self._share)
        """Variance that the trigger expects."""

    def _restart(self) -> None:
        self._squares, self._left_n, self._stage = 0.0, BLOCK_N, BlockStage.CORRELATION
        self.correlation.restart_products()

    def begin_trial(self, old: Vector) -> None:
        """Compare the estimate ``old`` with those that follow. An earlier trial ends."""
        self.end_trial()
        self._trial_n, self._left_n, self._balance, self._energy = 1, 0, 0.0, 0.0
        self._old = list(old)

    def end_trial(self) -> None:
        """Judge the alarm on trial, if one is."""
        if not self._trial_n:
            return
        excess = self._balance - PLAIN * self.expected
        self.is_doubtful |= min(abs(self._balance), abs(excess)) < NEAR * self._energy
        cost_n = 0 if excess > 0.0 else CREDIT_N
        if self._trial_n > TRIAL_LEAST_N and self._balance > 0.0 and self._credit_n >= cost_n:
            self._credit_n -= cost_n
        elif self.inflation < INFLATION_MAX:
            self.inflation *= INFLATION_STEP
        self._trial_n = 0
        self._restart()
        self._apply()

    def forgive(self) -> None:
        """Begin anew with another model of the edges."""
        self.inflation = self._dispersion = 1.0
        self._share = SHARE_WARM if self._share else 0.0
        self.is_doubtful |= self.correlation.is_doubtful
        self.correlation = ReferenceCorrelation()
        self._restart()
        self._apply()

    def enter(
        self, square: float, old_square: float, since_n: int, *, waits: bool, quiet_n: int, excess: float
    ) -> bool:
        """Enter one equation. Return true iff a hidden change is to be found with it.

        :param square: of its innovation, over the predicted variance in noise variances.
        :param old_square: of its innovation with the estimate on trial.
        :param since_n: samples since an edge.
        :param waits: the step has other work.
        :param quiet_n: innovations before the trigger is armed.
        :param excess: statistic over half the ceiling.
        """
        if self._left_n:
            self._left_n -= 1
            self._squares += square
        elif self._trial_n:
            self._try(square, old_square, since_n)
        elif not waits:
            return self._renew(quiet_n, excess)
        return False

    def _renew(self, quiet_n: int, excess: float) -> bool:
        """Do one stage of the update after a block. Return true iff it is that of a hidden change.

        A block whose sum is half way to an alarm is discarded.
        """
        stage = self._stage
        self._stage = BlockStage(min(stage.value + 1, BlockStage.END.value))
        if stage is BlockStage.CORRELATION:
            self.is_doubtful |= self._share > 0.0 and abs(excess - 1.0) < NEAR
            if self._share > 0.0 and excess < 1.0:
                self._follow_shape(quiet_n)
            else:
                self._stage = BlockStage.CHANGE
        elif stage is BlockStage.NOISE:
            self._follow(quiet_n)
        elif stage is BlockStage.CHANGE:
            self._count_high()
            return True
        elif stage is BlockStage.END:
            self._relax()
        return False

    def _try(self, square: float, old_square: float, since_n: int) -> None:
        self._trial_n += 1
        if self._trial_n > TRIAL_BEGIN_N:
            self._balance += old_square - JUSTIFIED * square
            self._energy += old_square + JUSTIFIED * square
        if self._trial_n >= TRIAL_MAX_N or (self._trial_n >= TRIAL_N and since_n < self._trial_n):
            self.end_trial()

    def _follow_shape(self, quiet_n: int) -> None:
        """Let correlation and dispersion of the innovations follow the complete block."""
        mean = self._squares / BLOCK_N
        if self._is_cusum:
            self.correlation.follow(mean, self.noise_variance, BLOCK_N, armed=quiet_n == 0)
        square = min((mean / self.noise_variance) ** 2, DISPERSION_MAX)
        self._dispersion += self._share * (square - self._dispersion)
        if quiet_n or self.correlation.is_smooth:  # theta settles, or the squares have no peaks
            self._dispersion = 1.0

    def _follow(self, quiet_n: int) -> None:
        """Let the noise variance follow the complete block."""
        mean = min(self._squares / BLOCK_N, GROWTH_MAX * self.noise_variance)
        self.noise_variance = max(self.noise_variance + self._share * (mean - self.noise_variance), self._least)
        least = SHARE_WARM if quiet_n >= WARM_N else SHARE_MIN
        self._share = max(self._share / (1.0 + self._share), least)

    def _count_high(self) -> None:
        height = self._squares / BLOCK_N / (HIGH * self.noise_variance)
        self.is_doubtful |= abs(height - 1.0) < NEAR
        if height < 1.0:
            self.high_n = max(self.high_n - 1, 0)
        elif self.high_n < HIGH_LIMIT:
            self.high_n += HIGH_STEP

    def _relax(self) -> None:
        """Let the inflation decrease, and the number of alarms that may be justified increase."""
        self.inflation = max(self.inflation * INFLATION_DECAY, 1.0)
        self._credit_n = min(self._credit_n + 1, CREDIT_MAX_N)
        self._restart()
        self._apply()
