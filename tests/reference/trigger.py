"""Triggers of the reference estimator: statistic of the innovations, and the decision that a plant has changed."""

from __future__ import annotations

from enum import Enum

from analogrig.estimator_config import EstimatorConfig
from tests.reference.correlation import DRIFT, GAIN, cusum
from tests.reference.scale import HIGH_LIMIT, ReferenceScale

NEAR = 0.003
"""Distance from the ceiling at which rounding may decide, relative to the ceiling and 1."""

RIVAL_NEAR = 3e-4
"""The same of the distance between two readings of an edge, which share most of their rounding."""

LONE_LEAST, LONE_RATIO, LONE_EXPLAINED = 6.0, 30.0, 0.5
"""Smallest term of a lone outlier, in ceilings without the inflation, and its smallest ratio to the sum before it; part
of the ceiling below which the sum of another reading explains it."""


class Meaning(Enum):
    """Meaning of an innovation."""

    QUIET = 0
    ALARM = 1
    SLIP = 2
    """The edges of the force have moved by one sample; the plant has not changed."""
    UNDECIDED = 3
    """The statistic has reached the ceiling, that of another reading of the edges has not."""


class ReferenceTrigger:
    """Trigger of one estimator, with the scale of its innovations."""

    def __init__(self, config: EstimatorConfig) -> None:
        self._config = config
        self._ceiling = config.statistic_ceiling or 0.0
        self.scale = ReferenceScale(config)
        self.rivals = [0.0, 0.0]
        """Statistics under the readings that recent edges came one sample early, and late."""
        self.is_doubtful = False
        """True if rounding may have decided whether a statistic has reached the ceiling, or another reading leads."""
        self.restart(config.warm_up_n)

    def restart(self, quiet_n: int) -> None:
        """Begin anew; the statistic is zero for ``quiet_n`` innovations."""
        self.statistic, self.quiet_n = 0.0, quiet_n
        self._mean, self._mean_n = 0.0, 0

    @property
    def noise_variance(self) -> float:
        """Noise variance, configured or followed."""
        return self.scale.noise_variance

    @property
    def excess(self) -> float:
        """Statistic over half the ceiling; 0 without a ceiling."""
        return 2.0 * self.statistic / self._ceiling if self._ceiling else 0.0

    @property
    def has_rival(self) -> bool:
        """True if another reading of the edges explains the innovations better than the recorded one."""
        ahead = self.statistic - min(self.rivals)
        self.is_doubtful |= 0.0 < abs(ahead) < RIVAL_NEAR * (1.0 + self.statistic)
        return ahead > 0.0

    @property
    def comes_late(self) -> bool:
        """True if the better of the other readings has late edges."""
        return self.rivals[1] < self.rivals[0]

    def begin_doubt(self) -> None:
        """Start the other readings from the present statistic."""
        self.rivals = [self.statistic, self.statistic]

    def end_doubt(self) -> Meaning:
        """End a doubt at a gap: a slip if nothing but another reading has prevented an alarm."""
        if self.statistic >= self._ceiling:
            return Meaning.SLIP
        self.statistic = min(self.statistic, *self.rivals)
        return Meaning.QUIET

    def settle(self) -> None:
        """Continue with the better of the other readings, after a slip."""
        self.statistic = min(self.rivals)

    def is_lone_outlier(self, innovation: float, variance: float, *, in_doubt: bool) -> bool:
        """True if this innovation alone lifted the statistic over the ceiling, and no other reading explains all.

        :param variance: of the innovation, in noise variances.
        :param in_doubt: edges are in doubt.
        """
        term = GAIN * innovation * innovation / (variance * self.scale.expected)
        before = self.statistic + max(self.scale.correlation.lead, 0.0) - term + DRIFT
        threshold = max(LONE_RATIO * before, LONE_LEAST * self._ceiling / self.scale.inflation)
        margin = min(self.rivals) - LONE_EXPLAINED * self._ceiling
        self.is_doubtful |= abs(term - threshold) < NEAR * threshold
        self.is_doubtful |= in_doubt and abs(margin) < NEAR * (1.0 + self._ceiling)
        return term > threshold and not (in_doubt and margin < 0.0)

    def set_aside(self) -> None:
        """Restart the statistic after a lone outlier."""
        self.statistic = 0.0
        if self.scale.is_open:
            self.scale.correlation.restart_products()
        self.scale.correlation.forget()

    def find_hidden_change(self, *, is_doubted: bool) -> None:
        """Let the next innovation raise an alarm if the blocks of late were high. A doubt comes first."""
        if self.quiet_n or self._config.trigger != "cusum" or not self._config.noise_estimated:
            self.scale.high_n = 0
        elif self.scale.high_n >= HIGH_LIMIT and not is_doubted:
            self.scale.high_n = 0
            self.statistic = 2.0 * self._ceiling
        if self._config.trigger == "cusum":
            self.scale.correlation.restart()

    def enter(
        self, innovation: float, variance: float, readings: tuple[float, float] | None, *, expires: bool
    ) -> Meaning:
        """Enter an innovation with its variance in noise variances.

        :param readings: innovations under the other readings of the edges in doubt; None without doubt.
        :param expires: the doubt ends with this sample.
        """
        trigger, held = self._config.trigger, self.quiet_n > 0
        if trigger == "cusum":
            self._enter_cusum(innovation, variance, readings, held=held)
        if held:
            self.quiet_n -= 1
            return Meaning.QUIET
        if trigger == "none":
            return Meaning.QUIET
        if trigger == "cusum":
            self._note_doubt()
            return self._decide(is_doubted=readings is not None, expires=expires)
        self.statistic = abs(innovation)
        if trigger == "mean-between-faults":  # thesis 4.4.3
            self._mean_n += 1
            self._mean += ((abs(innovation) if self._config.absolute else innovation) - self._mean) / self._mean_n
            self.statistic = abs(self._mean)
        self._note_doubt()
        return Meaning.ALARM if self.statistic >= self._ceiling else Meaning.QUIET

    def _note_doubt(self) -> None:
        self.is_doubtful |= abs(self.statistic - self._ceiling) < NEAR * (1.0 + self._ceiling)

    def _enter_cusum(
        self, innovation: float, variance: float, readings: tuple[float, float] | None, *, held: bool
    ) -> None:
        scale = self.scale
        self.statistic = scale.correlation.enter(
            innovation, self.statistic, variance, scale.expected, counts=scale.is_open, held=held
        )
        if readings is not None and not held:
            expected = variance * scale.expected
            self.rivals = [cusum(g, e, expected) for g, e in zip(self.rivals, readings, strict=True)]

    def _decide(self, *, is_doubted: bool, expires: bool) -> Meaning:
        if self.statistic < self._ceiling:
            return Meaning.QUIET
        if not is_doubted or min(self.rivals) >= self._ceiling:
            return Meaning.ALARM
        return Meaning.SLIP if expires else Meaning.UNDECIDED
