"""The fit: recordings in, a description of the emulator and its covariance out.

The weighted squares of the differences between the averages of the recordings and those of the emulator are minimised
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
    averaged,
    noise_of,
    rounding,
)
from analogrig.rigs.emulator import CardDescription, ComputerDescription, EmulatorDescription
from analogrig.run import CHANNELS

Stock = Literal["nominal", "polyester", "polypropylene"]
Pots = Literal["coefficient", "dial"]

STOCKS: tuple[Stock, ...] = ("polypropylene", "polyester", "nominal")
POTS: tuple[Pots, ...] = ("coefficient", "dial")

_UNMEASURED_RANGE_V = (-12.5, 12.5)

_ALIKE, _UNSEEN = 0.95, 0.8

_MOST_DEVIATIONS = 5.0
"""Of a chi-square that is left to chance, in its standard deviations."""

_FINE_SKEW = 1e-3
"""Of a sample period: closer than this the twin's skew need not be."""


@dataclass(frozen=True)
class FittedValue:
    """A fitted value with its standard error."""

    name: str
    value: float
    standard_error: float
    unit: str
    stands_for: str
    """What acts in the same way and cannot be told from it."""
    known_to: float = math.inf
    """Its standard error before anything was recorded."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A rig's twin, and how well it is known."""

    twin: EmulatorDescription
    estimates: tuple[FittedValue, ...]
    covariance: Vector
    """Of those of the estimates that were fitted to the displacement together, which come first."""
    residual_lsb: float
    """rms between the averages of the recordings and of the twin."""
    chi_squares: Mapping[tuple[Stock, Pots], float]
    """Of the kinds of machine that can be fitted at all, of those that were tried."""
    freedom: int
    """Its expectation."""

    def estimate(self, name: str) -> FittedValue:
        """:raises KeyError: none is called so."""
        return {each.name: each for each in self.estimates}[name]

    @property
    def chi_square(self) -> float:
        """Of the kind that the twin is of."""
        return self.chi_squares[self.twin.computer.components, self.twin.computer.pots]

    @property
    def is_least(self) -> bool:
        """Whether no other kind has a smaller chi-square; see ``_likeliest``."""
        return self.chi_square <= min(self.chi_squares.values())

    @property
    def explains_all(self) -> bool:
        """Whether what is left of the recordings is no more than their noise."""
        return self.chi_square <= self.freedom + _MOST_DEVIATIONS * math.sqrt(2.0 * self.freedom)

    @property
    def alike(self) -> list[tuple[str, str, float]]:
        """Pairs that the recordings hardly tell apart, with their correlation."""
        errors = np.sqrt(np.diag(self.covariance))
        correlation = self.covariance / np.outer(errors, errors)
        pairs = zip(*np.nonzero(np.triu(np.abs(correlation) > _ALIKE, 1)), strict=True)
        return [(self.estimates[i].name, self.estimates[j].name, float(correlation[i, j])) for i, j in pairs]

    @property
    def unseen(self) -> list[str]:
        """Those of which the recordings say little beyond the datasheet."""
        return [each.name for each in self.estimates if each.standard_error > _UNSEEN * each.known_to]


def calibrate(
    recordings: Sequence[SquareWaveRecording],
    *,
    op_amp: str = "tl07x",
    stocks: Sequence[Stock] = STOCKS,
    pots: Sequence[Pots] = POTS,
    progress: Callable[[int, int], None] | None = None,
) -> Calibration:
    """The twin of the rig that made the recordings, of the kind that explains them best.

    :param recordings: those of ``plan.scenarios`` of one program.
    :param op_amp: what the rig's amplifiers are.
    :param stocks: what its other components may be; one or more.
    :param pots: what its pots may be set by; one or both.
    :param progress: told how many kinds of machine have been tried, and of how many.
    :raises RigError: no emulator is like it: the fit does not settle, or the displacement comes before the force.
    :raises ConfigurationError: half a period is no whole number of samples.
    """
    noise_lsb, noise_error = noise_of(recordings, DISPLACEMENT)
    kinds = [[ComputerDescription(op_amp=op_amp, components=stock, pots=set_by) for stock in stocks] for set_by in pots]
    fits = _fits([[EmulatorModel(recordings, machine, noise_lsb) for machine in alike] for alike in kinds], progress)
    best = _likeliest(fits)
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


def _fits(
    models: Sequence[Sequence[EmulatorModel]], progress: Callable[[int, int], None] | None
) -> dict[tuple[Stock, Pots], _EmulatorFit]:
    """Of every kind that can be fitted at all; those that have the same unknowns are in one row.

    :raises RigError: none can; that of the first.
    """
    fits: dict[tuple[Stock, Pots], _EmulatorFit] = {}
    problems: list[RigError] = []
    for alike in models:
        start: Vector | None = None
        for model in alike:
            try:
                fit = _fitted(model, start)
            except RigError as error:
                problems.append(error)
            else:
                fits[model.nominal.components, model.nominal.pots], start = fit, fit.x
            if progress is not None:
                progress(len(fits) + len(problems), sum(map(len, models)))
    if not fits:
        raise problems[0]
    return fits


def _likeliest(fits: Mapping[tuple[Stock, Pots], _EmulatorFit]) -> _EmulatorFit:
    """The one with the least chi-square; but pots are set by coefficients unless that is out of the question, for
    tracks that are unknowns too explain a bit more of anything."""
    kinds = sorted(fits, key=lambda kind: fits[kind].chi_square)
    least = fits[kinds[0]]
    simple = next((fits[kind] for kind in kinds if kind[1] == "coefficient"), least)
    excess = (simple.chi_square - least.chi_square) / max(1.0, least.chi_square / least.freedom)
    return least if excess > OUT_OF_THE_QUESTION else simple


OUT_OF_THE_QUESTION = 30.0
"""Three unknowns more gain this by chance with a probability of 1e-6."""


# ---- Gauss-Newton

_DOUBTS_LSB = (30.0, 3.0)
"""Added to the standard deviations at first, when the model is not yet linear: until then what is known holds."""

_MOST_STEPS = 20

_SETTLED, _FAR = 0.02, 10.0
"""In standard errors: a step that is the last, and one after which the slopes are others."""


@dataclass(frozen=True, eq=False)
class _EmulatorFit:
    """Where the squares are least."""

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
        """Of the unknowns but for the pots' settings; wider where more is left than the noise explains."""
        n = len(self.model.unknowns)
        return self.covariance_of_all[:n, :n] * max(1.0, self.chi_square / self.freedom)

    def estimates(self) -> list[FittedValue]:
        errors = np.sqrt(np.diag(self.covariance)).tolist()
        return [
            FittedValue(unknown.name, value, error, unknown.unit, unknown.stands_for, unknown.known_to)
            for unknown, value, error in zip(self.model.unknowns, self.x.tolist(), errors, strict=False)
        ]


def _fitted(model: EmulatorModel, x: Vector | None) -> _EmulatorFit:
    """From x, or from nominal. The last slopes are kept while steps are short.

    :raises RigError: it does not settle.
    """
    x = _approached(model) if x is None else x
    slopes, covariance = _linear(model, x)
    for _ in range(_MOST_STEPS):
        residuals = model.residuals(x)
        step = covariance @ slopes.T @ residuals
        length = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        if length <= _SETTLED:
            return _EmulatorFit(model, x, residuals, covariance)
        x = x - step
        if length > _FAR:
            slopes, covariance = _linear(model, x)
    raise RigError("the emulator does not become like the recordings: the fit does not settle")


def _approached(model: EmulatorModel) -> Vector:
    x = np.zeros(len(model.known_to))
    for doubt_lsb in _DOUBTS_LSB:
        slopes, covariance = _linear(model, x, doubt_lsb)
        x = x - covariance @ slopes.T @ model.residuals(x, doubt_lsb)
    return x


def _linear(model: EmulatorModel, x: Vector, doubt_lsb: float = 0.0) -> tuple[Vector, Vector]:
    """The slopes of the residuals, and the covariance that they give."""
    slopes = model.jacobian(x, doubt_lsb)
    return slopes, _inverse(slopes.T @ slopes)


def _inverse(normal: Vector) -> Vector:
    """Of a symmetric matrix whose rows are in units of their own.

    :raises RigError: there is none.
    """
    own, untold = np.diag(normal), "the recordings do not tell what is to be fitted: are there enough, and of a signal?"
    if not (own > 0.0).all():
        raise RigError(untold)
    units = np.sqrt(np.outer(own, own))
    try:
        inverse = np.linalg.inv(normal / units) / units
    except np.linalg.LinAlgError as error:
        raise RigError(untold) from error
    if not (np.diag(inverse) > 0.0).all():
        raise RigError(untold)
    return np.asarray(inverse)


# ---- the card


def _force_channel(recordings: Sequence[SquareWaveRecording]) -> list[FittedValue]:
    """Offset, gain error and noise of the channel of the force, whose levels are known: a weighted line."""
    noise_lsb, noise_error = noise_of(recordings, FORCE)
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
    """Of both levels of the force: the level and by how much its mean code is off, both in LSB, and the variance."""
    average = averaged(recording, FORCE, noise_lsb)
    channel, wave, half_n = recording.channels["force"], recording.scenario.excitation, recording.period_n // 2
    left, levels = rounding(noise_lsb), []
    for level_v, first in ((wave.high_v, 0), (wave.low_v, half_n)):
        # The sample at the edge itself may show either level.
        here = (average.phases > first) & (average.phases < first + half_n)
        if here.any():
            off_lsb = float(average.means[here].mean()) - (level_v - channel.low_v) / channel.lsb_v
            variance = (average.variance - left) / int(here.sum()) + left
            levels.append((level_v / channel.lsb_v, off_lsb, variance))
    return levels


def _card(recordings: Sequence[SquareWaveRecording], estimates: Sequence[FittedValue]) -> CardDescription:
    by_name = {each.name: each for each in estimates}
    value = {name: each.value for name, each in by_name.items()}
    period_s, skew = recordings[0].sample_period_s, by_name[SKEW]
    if skew.value < -3.0 * skew.standard_error - _FINE_SKEW * period_s:
        raise RigError(
            f"the displacement is taken {-1e6 * skew.value:.2f} us before the edges of the force, as no card does:"
            " do these come later than at the samples at which the scenario has them?"
        )
    return CardDescription(
        range_v=_ranges(recordings),
        bits=_bits(recordings),
        rate_hz=1.0 / period_s,
        noise_lsb={**dict.fromkeys(CHANNELS, value["displacement noise"]), "force": value["force noise"]},
        faults={
            "skew_s": (0.0, _coarse(max(skew.value, 0.0) / period_s) * period_s, 0.0, 0.0),
            "gain_error": (value["force gain"], 0.0, 0.0, 0.0),
            "offset_lsb": (value["force offset"], value[OFFSET], 0.0, 0.0),
        },
    )


def _coarse(late_n: float) -> float:
    """The fraction of least denominator that is near enough: the emulator is the faster, the coarser the grid."""
    return next(
        round(late_n * parts) / parts
        for parts in range(1, 1001)
        if abs(round(late_n * parts) / parts - late_n) <= _FINE_SKEW
    )


def _bits(recordings: Sequence[SquareWaveRecording]) -> int:
    """The least even number of bits, from 12 on, that has the code of 0 V and all that came."""
    zeros = [channel.zero for recording in recordings for channel in recording.channels.values()]
    most = max([*zeros, *(float(recording.codes.max()) for recording in recordings)])
    return next(bits for bits in (12, 14, 16) if most < 1 << bits or bits == 16)


def _ranges(recordings: Sequence[SquareWaveRecording]) -> dict[str, tuple[float, float]]:
    channels, codes = recordings[0].channels, 1 << _bits(recordings)
    measured = {name: (channel.low_v, channel.low_v + codes * channel.lsb_v) for name, channel in channels.items()}
    return {name: measured.get(name, _UNMEASURED_RANGE_V) for name in CHANNELS}
