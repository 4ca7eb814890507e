"""Fit of the emulator to recordings: returns a description of the twin and the covariance of what was fitted.

Minimises the weighted squares of the differences between the averages of the recordings and those of the emulator
(Gauss-Newton; Bates and Watts, Nonlinear Regression Analysis, 2.2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from analogrig.errors import RigError
from analogrig.hardware.calibration.model import OFFSET, SKEW, EmulatorModel
from analogrig.hardware.calibration.recordings import (
    DISPLACEMENT,
    FORCE,
    SquareWaveRecording,
    Vector,
    average_phases,
    estimate_noise,
    rounding_variance,
)
from analogrig.rigs.emulator import CardDescription, ComputerDescription, EmulatorDescription
from analogrig.run import CHANNELS

Stock = Literal["nominal", "polyester", "polypropylene"]
Pots = Literal["coefficient", "dial"]
Kind = tuple[Stock, Pots]

STOCKS: tuple[Stock, ...] = ("polypropylene", "polyester", "nominal")
POTS: tuple[Pots, ...] = ("coefficient", "dial")

LEAST_GAIN_OF_DIALS = 30.0
"""Least decrease in chi-square, per residual variance, for which dials are chosen: their three unknowns more gain this
by chance with a probability of 1e-6."""

_UNMEASURED_RANGE_V = (-12.5, 12.5)

_ALIKE = 0.95
"""Least correlation of two values that the recordings hardly separate."""
_UNSEEN = 0.8
"""Least standard error, in prior standard deviations, of a value that the recordings hardly show."""
_MOST_DEVIATIONS = 5.0
"""Largest excess of a chi-square over its expectation that is chance, in its standard deviations."""
_FINE_SKEW = 1e-3
"""Accuracy of the twin's skew, in sample periods."""

_DOUBTS_LSB = (30.0, 3.0)
"""Added to the standard deviations of the first steps, while the model is not linear, so that the priors dominate."""
_MOST_STEPS = 20
_CONVERGED, _FAR = 0.02, 10.0
"""Step lengths in standard errors: of the last step, and beyond which derivatives are computed anew."""


@dataclass(frozen=True)
class FittedValue:
    """Fitted value with its standard error."""

    name: str
    value: float
    standard_error: float
    unit: str
    stands_for: str
    """Quantities with the same effect, which the value includes."""
    known_to: float = math.inf
    """Prior standard deviation."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Twin of a rig with its uncertainty."""

    twin: EmulatorDescription
    estimates: tuple[FittedValue, ...]
    covariance: Vector
    """Covariance of the first estimates, which were fitted to the displacement jointly."""
    residual_lsb: float
    """rms between the averages of the recordings and of the twin."""
    chi_squares: Mapping[Kind, float]
    """Chi-square of each kind of machine whose fit converged."""
    freedom: int
    """Degrees of freedom: the expectation of the chi-square."""

    def estimate(self, name: str) -> FittedValue:
        """Return the estimate of this name.

        :raises KeyError: there is none.
        """
        return {each.name: each for each in self.estimates}[name]

    @property
    def chi_square(self) -> float:
        """Chi-square of the twin's kind."""
        return self.chi_squares[self.twin.computer.components, self.twin.computer.pots]

    @property
    def is_least(self) -> bool:
        """True if no other kind has a smaller chi-square; see ``_choose``."""
        return self.chi_square <= min(self.chi_squares.values())

    @property
    def explains_all(self) -> bool:
        """True if noise alone explains the residuals."""
        return self.chi_square <= self.freedom + _MOST_DEVIATIONS * math.sqrt(2.0 * self.freedom)

    @property
    def alike(self) -> list[tuple[str, str, float]]:
        """Pairs of values that the recordings hardly separate, with their correlation."""
        errors = np.sqrt(np.diag(self.covariance))
        correlation = self.covariance / np.outer(errors, errors)
        pairs = zip(*np.nonzero(np.triu(np.abs(correlation) > _ALIKE, 1)), strict=True)
        return [(self.estimates[i].name, self.estimates[j].name, float(correlation[i, j])) for i, j in pairs]

    @property
    def unseen(self) -> list[str]:
        """Names of values that are known little better than by the datasheet."""
        return [each.name for each in self.estimates if each.standard_error > _UNSEEN * each.known_to]


def calibrate(
    recordings: Sequence[SquareWaveRecording],
    *,
    op_amp: str = "tl07x",
    stocks: Sequence[Stock] = STOCKS,
    pots: Sequence[Pots] = POTS,
    progress: Callable[[int, int], None] | None = None,
) -> Calibration:
    """Fit the twin of the rig that made the recordings, of the kind that explains them best.

    :param recordings: those of ``plan.scenarios`` of one program.
    :param op_amp: type of the rig's amplifiers.
    :param stocks: candidate types of its other components; one or more.
    :param pots: candidate quantities that its pots are set by; one or both.
    :param progress: called with the number of kinds fitted, and of all kinds.
    :raises RigError: no fit converges, or the displacement precedes the force.
    :raises ConfigurationError: half a period is no whole number of samples.
    """
    noise_lsb, noise_error = estimate_noise(recordings, DISPLACEMENT)
    fits: dict[Kind, _EmulatorFit] = {}
    problems: list[RigError] = []
    for set_by in pots:
        start: Vector | None = None  # kinds of the same pots have the same unknowns
        for stock in stocks:
            machine = ComputerDescription(op_amp=op_amp, components=stock, pots=set_by)
            try:
                fit = fits[stock, set_by] = _minimise(EmulatorModel(recordings, machine, noise_lsb), start)
                start = fit.x
            except RigError as error:
                problems.append(error)
            if progress is not None:
                progress(len(fits) + len(problems), len(pots) * len(stocks))
    if not fits:
        raise problems[0]
    best = _choose(fits)
    noise = FittedValue("displacement noise", noise_lsb, noise_error, "LSB", "white, rms, before rounding")
    estimates = (*best.estimates(), noise, *_force_channel(recordings))
    computer = best.model.computer(best.model.by_name(best.x))
    return Calibration(
        EmulatorDescription(card=_card(recordings, estimates), computer=computer),
        estimates,
        best.covariance,
        float(np.sqrt(np.mean(best.model.misses(best.x) ** 2))),
        {kind: fit.chi_square for kind, fit in fits.items()},
        best.freedom,
    )


def _choose(fits: Mapping[Kind, _EmulatorFit]) -> _EmulatorFit:
    """Fit with the least chi-square; pots set by coefficients are preferred unless dials gain much.

    With dials the tracks are unknowns too, and three unknowns more always explain a little more.
    """
    kinds = sorted(fits, key=lambda kind: fits[kind].chi_square)
    least = fits[kinds[0]]
    simple = next((fits[kind] for kind in kinds if kind[1] == "coefficient"), least)
    gain = (simple.chi_square - least.chi_square) / max(1.0, least.chi_square / least.freedom)
    return least if gain > LEAST_GAIN_OF_DIALS else simple


# ---- Gauss-Newton


@dataclass(frozen=True, eq=False)
class _EmulatorFit:
    """Minimum of the squares."""

    model: EmulatorModel
    x: Vector
    residuals: Vector
    covariance_of_all: Vector

    @property
    def chi_square(self) -> float:
        return float(self.residuals @ self.residuals)

    @property
    def freedom(self) -> int:
        return len(self.residuals) - len(self.x)

    @property
    def covariance(self) -> Vector:
        """Covariance of the unknowns but for the pots' settings, scaled up if noise does not explain the residuals."""
        n = len(self.model.unknowns)
        return self.covariance_of_all[:n, :n] * max(1.0, self.chi_square / self.freedom)

    def estimates(self) -> list[FittedValue]:
        errors = np.sqrt(np.diag(self.covariance)).tolist()
        return [
            FittedValue(unknown.name, value, error, unknown.unit, unknown.stands_for, unknown.known_to)
            for unknown, value, error in zip(self.model.unknowns, self.x.tolist(), errors, strict=False)
        ]


def _minimise(model: EmulatorModel, x: Vector | None) -> _EmulatorFit:
    """Minimise from ``x``, or from nominal values; derivatives are kept while steps are short.

    :raises RigError: the fit does not converge.
    """
    if x is None:
        x = np.zeros(len(model.known_to))
        for doubt_lsb in _DOUBTS_LSB:
            slopes, covariance = _linearise(model, x, doubt_lsb)
            x = x - covariance @ slopes.T @ model.residuals(x, doubt_lsb)
    slopes, covariance = _linearise(model, x)
    for _ in range(_MOST_STEPS):
        residuals = model.residuals(x)
        step = covariance @ slopes.T @ residuals
        length = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        if length <= _CONVERGED:
            return _EmulatorFit(model, x, residuals, covariance)
        x = x - step
        if length > _FAR:
            slopes, covariance = _linearise(model, x)
    raise RigError("no emulator fits the recordings: the fit does not converge")


def _linearise(model: EmulatorModel, x: Vector, doubt_lsb: float = 0.0) -> tuple[Vector, Vector]:
    """Derivative of the residuals at ``x`` and the covariance that it gives."""
    slopes = model.jacobian(x, doubt_lsb)
    return slopes, _inverse(slopes.T @ slopes)


def _inverse(normal: Vector) -> Vector:
    """Inverse of a symmetric matrix whose rows have different units.

    :raises RigError: it is singular.
    """
    own = np.diag(normal)
    singular = RigError("the recordings do not determine the values to fit: check their number and their signals")
    if not (own > 0.0).all():
        raise singular
    units = np.sqrt(np.outer(own, own))
    try:
        inverse = np.linalg.inv(normal / units) / units
    except np.linalg.LinAlgError as error:
        raise singular from error
    if not (np.diag(inverse) > 0.0).all():
        raise singular
    return np.asarray(inverse)


# ---- the card


def _force_channel(recordings: Sequence[SquareWaveRecording]) -> list[FittedValue]:
    """Offset, gain error and noise of the force's channel: a weighted line through its known levels."""
    noise_lsb, noise_error = estimate_noise(recordings, FORCE)
    levels = [level for recording in recordings for level in _levels(recording, noise_lsb)]
    volts, errors_lsb, variances = np.array(levels).T
    design = np.stack([np.ones(len(volts)), volts], axis=1) / np.sqrt(variances)[:, None]
    covariance = _inverse(design.T @ design)
    offset, gain = (covariance @ design.T @ (errors_lsb / np.sqrt(variances))).tolist()
    offset_error, gain_error = np.sqrt(np.diag(covariance)).tolist()
    return [
        FittedValue("force offset", offset, offset_error, "LSB", "offset of the force's channel"),
        FittedValue("force gain", gain, gain_error, "", "gain of the force's channel, and of the generator"),
        FittedValue("force noise", noise_lsb, noise_error, "LSB", "white, rms, before rounding"),
    ]


def _levels(recording: SquareWaveRecording, noise_lsb: float) -> list[tuple[float, float, float]]:
    """Both levels of the force: level and error of its mean code, both in LSB, and the variance of the latter."""
    average = average_phases(recording, FORCE, noise_lsb)
    channel, wave, half_n = recording.channels["force"], recording.scenario.excitation, recording.period_n // 2
    left, levels = rounding_variance(noise_lsb), []
    for level_v, first in ((wave.high_v, 0), (wave.low_v, half_n)):
        # The sample at the edge itself may show either level.
        here = (average.phases > first) & (average.phases < first + half_n)
        if here.any():
            off_lsb = float(average.means[here].mean()) - (level_v - channel.low_v) / channel.lsb_v
            variance = (average.variance - left) / int(here.sum()) + left
            levels.append((level_v / channel.lsb_v, off_lsb, variance))
    return levels


def _card(recordings: Sequence[SquareWaveRecording], estimates: Sequence[FittedValue]) -> CardDescription:
    """Card of the twin.

    :raises RigError: the displacement precedes the force.
    """
    by_name = {each.name: each for each in estimates}
    value = {name: each.value for name, each in by_name.items()}
    period_s, skew = recordings[0].sample_period_s, by_name[SKEW]
    if skew.value < -3.0 * skew.standard_error - _FINE_SKEW * period_s:
        raise RigError(
            f"the displacement is taken {-1e6 * skew.value:.2f} us before the edges of the force, which no card does:"
            " check that the edges are at the samples that the scenario sets"
        )
    bits = _bits(recordings)
    channels = recordings[0].channels
    measured = {name: (each.low_v, each.low_v + (1 << bits) * each.lsb_v) for name, each in channels.items()}
    return CardDescription(
        range_v={name: measured.get(name, _UNMEASURED_RANGE_V) for name in CHANNELS},
        bits=bits,
        rate_hz=1.0 / period_s,
        noise_lsb={**dict.fromkeys(CHANNELS, value["displacement noise"]), "force": value["force noise"]},
        faults={
            "skew_s": (0.0, _round_skew(max(skew.value, 0.0) / period_s) * period_s, 0.0, 0.0),
            "gain_error": (value["force gain"], 0.0, 0.0, 0.0),
            "offset_lsb": (value["force offset"], value[OFFSET], 0.0, 0.0),
        },
    )


def _round_skew(late_n: float) -> float:
    """Fraction of least denominator close to ``late_n``: on a coarser grid the emulator is faster."""
    return next(
        round(late_n * parts) / parts
        for parts in range(1, 1001)
        if abs(round(late_n * parts) / parts - late_n) <= _FINE_SKEW
    )


def _bits(recordings: Sequence[SquareWaveRecording]) -> int:
    """Least of 12, 14, 16 bits that hold the code of 0 V and all codes recorded."""
    zeros = [channel.zero for recording in recordings for channel in recording.channels.values()]
    most = max([*zeros, *(float(recording.codes.max()) for recording in recordings)])
    return next(bits for bits in (12, 14, 16) if most < 1 << bits or bits == 16)
