"""Fit of the emulator to recordings of a rig, which makes it the twin of that rig.

Minimises the weighted squares of the differences between the averages of the recordings and those of the emulator
(Gauss-Newton; Bates and Watts, Nonlinear Regression Analysis, 2.2).

Force and displacement do not identify every component. They identify:

    x'' = k_M (g_F F - g_B k_B x' - g_K k_K x)        three gains, as deviations of RF, C1 and C2; other parts nominal
    at rest: x = F / K + c + (a1 + a2 / k_M + a4 k_B) / k_K        offsets of U1, U2, U4, and c of the card
    bandwidths, and the slew rate of U1        weakly; the datasheet's spread is their prior
    the skew of the displacement

Each pot misses its setting a little, differently at each, since the wiper rests on a winding. So each setting has one
more unknown, whose prior is the resolution of the pots.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from analogrig import Plant, RigError, Scenario
from analogrig.rigs import CardDescription, ComputerDescription, EmulatorDescription, EmulatorRig, MeasuredValues
from analogrig.run import INPUT, OUTPUT
from analogrig_emulator import CHANNELS, OP_AMP_GRADES, Excitation, Sampler, SuspensionComputer
from analogrig_instruments.calibration.averages import (
    DISPLACEMENT,
    FORCE,
    SquareWaveRecording,
    Vector,
    average_phases,
    estimate_noise,
    rounding_variance,
)

Stock = Literal["nominal", "polyester", "polypropylene"]
Pots = Literal["coefficient", "dial"]
Kind = tuple[Stock, Pots]

STOCKS: tuple[Stock, ...] = ("polypropylene", "polyester", "nominal")
POTS: tuple[Pots, ...] = ("coefficient", "dial")

LEAST_GAIN_OF_DIALS = 30.0
"""Least decrease in chi-square, per residual variance, for which dials are chosen: their three unknowns more gain this
by chance with a probability of 1e-6."""

POT_RESOLUTION = 1.0 / 5000.0
"""Resolution of a ten-turn pot, as part of its track; a wiper rests up to half of it from its setting."""

_TRACKS_KNOWN_TO = 0.05 / math.sqrt(3.0)
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

    :param recordings: those of ``averages.scenarios`` of one program.
    :param op_amp: type of the rig's amplifiers.
    :param stocks: candidate types of its other components; one or more.
    :param pots: candidate quantities that its pots are set by; one or both.
    :param progress: called with the number of kinds fitted, and of all kinds.
    :raises RigError: no fit converges, or the displacement precedes the force.
    :raises ConfigurationError: half a period is no whole number of samples.
    """
    noise_lsb, noise_error = estimate_noise(recordings, DISPLACEMENT)
    fits: dict[Kind, _Fit] = {}
    problems: list[RigError] = []
    for set_by in pots:
        start: Vector | None = None  # kinds of the same pots have the same unknowns
        for stock in stocks:
            machine = ComputerDescription(op_amp=op_amp, components=stock, pots=set_by)
            try:
                fit = fits[stock, set_by] = EmulatorModel(recordings, machine, noise_lsb).fit(start)
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
    return Calibration(
        EmulatorDescription(card=_card(recordings, estimates), computer=best.model.computer(best.x)),
        estimates,
        best.covariance,
        float(np.sqrt(np.mean(best.model.misses(best.x) ** 2))),
        {kind: fit.chi_square for kind, fit in fits.items()},
        best.freedom,
    )


def _choose(fits: Mapping[Kind, _Fit]) -> _Fit:
    """Fit with the least chi-square; pots set by coefficients are preferred unless dials gain much.

    With dials the tracks are unknowns too, and three unknowns more always explain a little more.
    """
    by_chi_square = sorted(fits.items(), key=lambda item: item[1].chi_square)
    least = by_chi_square[0][1]
    simple = next((fit for (_, pots), fit in by_chi_square if pots == "coefficient"), least)
    gain = (simple.chi_square - least.chi_square) / max(1.0, least.chi_square / least.freedom)
    return least if gain > LEAST_GAIN_OF_DIALS else simple


# ---- the emulator as a function of its unknowns

_GAINS = ("RF", "C1", "C2")
"""First unknowns: g_F = 1 / (RF C1 C2), g_B = 1 / C1, g_K = 1 / (C1 C2) of their nominal values."""

_POWERS = np.array([[0.0, -1.0, 0.0], [0.0, -1.0, 1.0], [1.0, 0.0, -1.0]])
"""Row of a pot (M, B, K): powers of its coefficient that act as factors of RF, C1, C2."""

SKEW, OFFSET = "skew", "displacement offset"


class Unknown(NamedTuple):
    """Parameter of the fit."""

    name: str
    unit: str
    step: float
    """Step of its difference quotient."""
    stands_for: str
    table: str = ""
    """Field of MeasuredValues that it belongs to, if any; its element is the first word of the name."""
    known_to: float = math.inf
    """Prior standard deviation about 0."""


def _unknowns(computer: ComputerDescription) -> tuple[Unknown, ...]:
    """Unknowns of a kind of machine, but for those of the pots' settings."""
    weak: list[Unknown] = []
    grade = OP_AMP_GRADES.get(computer.op_amp)
    if grade is not None and grade.bandwidth:
        bandwidth, slew = (spread / math.sqrt(3.0) for spread in (grade.bandwidth, grade.slew))
        weak += [Unknown(f"U{i} bandwidth", "", 0.02, "its bandwidth", "bandwidth", bandwidth) for i in range(1, 5)]
        weak += [Unknown("U1 slew", "", 0.02, "its slew rate", "slew", slew)]
    if computer.pots == "dial":
        about = 1e-3, "its track over its load", "deviation", _TRACKS_KNOWN_TO
        weak += [Unknown(f"{pot} track", "", *about) for pot in "MBK"]
    return (
        Unknown("RF", "", 1e-4, "RF R5 / (RK R5FB), over the gain of the displacement's channel", "deviation"),
        Unknown("C1", "", 1e-4, "R1 C1 RB R4 / (RFB R4FB)", "deviation"),
        Unknown("C2", "", 1e-4, "R2 C2 RK R4FB / (RB R4)", "deviation"),
        Unknown("U1 offset", "V", 1e-3, "its offset", "offset_v"),
        Unknown("U2 offset", "V", 1e-3, "its offset", "offset_v"),
        Unknown("U4 offset", "V", 1e-3, "its offset less half that of U3", "offset_v"),
        *weak,
        Unknown(SKEW, "s", 2e-7, "displacement after force, less the delay of U5"),
        Unknown(OFFSET, "LSB", 1.0, "offset of the displacement's channel, and of U5"),
    )


class EmulatorModel:
    """Averages of the displacement that the emulator predicts for given unknowns x (unknowns,)."""

    def __init__(
        self, recordings: Sequence[SquareWaveRecording], computer: ComputerDescription, noise_lsb: float
    ) -> None:
        self.unknowns = _unknowns(computer)
        self.nominal = computer
        self._pairs = [(each, average_phases(each, DISPLACEMENT, noise_lsb)) for each in recordings]
        # Column of each setting of a pot: pot (0, 1, 2 for M, B, K) and value, with the prior of its relative error.
        settings = {setting: error for each in recordings for setting, error in _settings(each.scenario.plant).items()}
        self._columns = {setting: len(self.unknowns) + i for i, setting in enumerate(settings)}
        self.known_to = np.array([*(each.known_to for each in self.unknowns), *settings.values()])

    def fit(self, x: Vector | None = None) -> _Fit:
        """Minimise the squares from ``x``, or from nominal values; derivatives are kept while steps are short.

        :raises RigError: the fit does not converge.
        """
        if x is None:
            x = np.zeros(len(self.known_to))
            for doubt_lsb in _DOUBTS_LSB:
                slopes, covariance = self._linearise(x, doubt_lsb)
                x = x - covariance @ slopes.T @ self._residuals(x, doubt_lsb)
        slopes, covariance = self._linearise(x)
        for _ in range(_MOST_STEPS):
            residuals = self._residuals(x)
            step = covariance @ slopes.T @ residuals
            length = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
            if length <= _CONVERGED:
                chi_square, n = float(residuals @ residuals), len(self.unknowns)
                freedom = len(residuals) - len(x) - int(np.isinf(self.known_to).sum())
                return _Fit(self, x, chi_square, freedom, covariance[:n, :n] * max(1.0, chi_square / freedom))
            x = x - step
            if length > _FAR:
                slopes, covariance = self._linearise(x)
        raise RigError("no emulator fits the recordings: the fit does not converge")

    def misses(self, x: Vector) -> Vector:
        """Averages of the recordings less those of the emulator, LSB."""
        return np.concatenate([average.means - self.codes(x, each)[average.phases] for each, average in self._pairs])

    def _residuals(self, x: Vector, doubt_lsb: float = 0.0) -> Vector:
        """(m,) residuals of the averages and of the priors, in standard deviations.

        :param doubt_lsb: added in quadrature to the standard deviation of each average.
        """
        return np.concatenate([self.misses(x) / self._deviations(doubt_lsb), -x / self.known_to])

    def _linearise(self, x: Vector, doubt_lsb: float = 0.0) -> tuple[Vector, Vector]:
        """(m, unknowns) derivative of ``_residuals``, and the covariance that it gives."""
        slopes = np.concatenate([self._slopes(x, each)[average.phases] for each, average in self._pairs])
        whole = np.concatenate([-slopes / self._deviations(doubt_lsb)[:, None], -np.diag(1.0 / self.known_to)])
        return whole, _inverse(whole.T @ whole)

    def _deviations(self, doubt_lsb: float) -> Vector:
        variances = [np.full(len(average.phases), average.variance) for _, average in self._pairs]
        return np.sqrt(np.concatenate(variances) + doubt_lsb**2)

    def codes(self, x: Vector, recording: SquareWaveRecording) -> Vector:
        """(phases,) mean code of each phase of the period, not rounded.

        :raises RigError: no machine has such values.
        """
        values = self._by_name(x)
        channel, period_s = recording.channels["displacement"], recording.sample_period_s
        factors = np.ones(len(_GAINS))
        for pot, column in self._columns_of(recording):
            factors *= (1.0 + x[column]) ** _POWERS[pot]
        card = CardDescription(dict.fromkeys(CHANNELS, (-10.0, 10.0)), rate_hz=1.0 / period_s)
        rig = EmulatorRig(EmulatorDescription(card=card, computer=self.computer(x, factors)))
        computer, wave, _ = rig.set_up(recording.scenario, 0)
        volts = _late_displacement(computer, wave, len(recording.codes), values[SKEW] / period_s)
        means = recording.split_periods(volts).mean(axis=0)
        return np.asarray((means - channel.low_v) / channel.lsb_v + values[OFFSET])

    def computer(self, x: Vector, factors: Vector | None = None) -> ComputerDescription:
        """Machine with these values of the unknowns.

        :param factors: (3,) of RF, C1, C2, for pots that miss their settings.
        :raises RigError: no machine has such values.
        """
        values = self._by_name(x)
        tables: dict[str, dict[str, float]] = {"deviation": {}, "offset_v": {}, "bandwidth": {}, "slew": {}}
        for unknown in self.unknowns:
            if unknown.table:
                tables[unknown.table][unknown.name.split()[0]] = values[unknown.name]
        for gain, factor in zip(_GAINS, () if factors is None else factors.tolist(), strict=False):
            tables["deviation"][gain] = (1.0 + tables["deviation"][gain]) * factor - 1.0
        try:
            return dataclasses.replace(self.nominal, values=MeasuredValues(**tables))
        except ValueError as error:
            raise RigError(f"no emulator fits the recordings: {error}") from error

    def _by_name(self, x: Vector) -> dict[str, float]:
        return {unknown.name: float(value) for unknown, value in zip(self.unknowns, x, strict=False)}

    def _slopes(self, x: Vector, recording: SquareWaveRecording) -> Vector:
        """(phases, unknowns) derivative of ``codes``."""
        here = self.codes(x, recording)
        slopes = np.zeros((len(here), len(x)))
        for column, unknown in enumerate(self.unknowns):
            moved = x.copy()
            moved[column] += unknown.step
            slopes[:, column] = (self.codes(moved, recording) - here) / unknown.step
        gains = slice(len(_GAINS))
        for pot, column in self._columns_of(recording):
            slopes[:, column] = slopes[:, gains] @ ((1.0 + x[gains]) * _POWERS[pot])
        return slopes

    def _columns_of(self, recording: SquareWaveRecording) -> list[tuple[int, int]]:
        """Each pot and the column of its setting."""
        return [(setting[0], self._columns[setting]) for setting in _settings(recording.scenario.plant)]


@functools.cache
def _settings(plant: Plant) -> Mapping[tuple[int, float], float]:
    """Relative error of each pot's coefficient, rms, by pot and value; dial errors are uniform within half a step."""
    computer = SuspensionComputer(plant.program.circuit, opamp="ideal")
    computer.set(**plant.parameters())
    dials, coefficients = computer.dials, computer.coefficients
    computer.set(**{f"{pot}_dial": dial - POT_RESOLUTION for pot, dial in dials.items()})
    missed = computer.coefficients
    return {
        (i, value): (coefficients[pot] - missed[pot]) / (math.sqrt(12.0) * coefficients[pot])
        for i, (pot, value) in enumerate(zip(dials, plant.values, strict=True))
    }


def _late_displacement(computer: SuspensionComputer, wave: Excitation, samples: int, late_n: float) -> Vector:
    """(samples,) displacement ``late_n`` samples after each sample, V.

    The force moves instead of the samples, by one sample less ``late_n``: the emulator then needs no finer grid.
    """
    by = (1.0 - late_n) * wave.frequency_hz / computer.sample_rate_hz
    later = dataclasses.replace(wave, clock="free", phase=(wave.phase - by) % 1.0)
    volts = np.concatenate(list(computer.play(later, samples + 1)))
    return np.asarray(volts[1:, OUTPUT])


class _Fit(NamedTuple):
    """Minimum of the squares."""

    model: EmulatorModel
    x: Vector
    chi_square: float
    freedom: int
    covariance: Vector
    """Covariance of the unknowns but for the pots' settings, scaled up if noise does not explain the residuals."""

    def estimates(self) -> list[FittedValue]:
        errors = np.sqrt(np.diag(self.covariance)).tolist()
        return [
            FittedValue(unknown.name, value, error, unknown.unit, unknown.stands_for, unknown.known_to)
            for unknown, value, error in zip(self.model.unknowns, self.x.tolist(), errors, strict=False)
        ]


def _inverse(normal: Vector) -> Vector:
    """Inverse of a symmetric matrix whose rows have different units.

    :raises RigError: it is singular.
    """
    own = np.sqrt(np.diag(normal))
    units = np.outer(own, own)
    inverse = None
    if (own > 0.0).all():
        with contextlib.suppress(np.linalg.LinAlgError):
            inverse = np.linalg.inv(normal / units) / units
    if inverse is None or not (np.diag(inverse) > 0.0).all():
        raise RigError("the recordings do not determine the values to fit: check their number and their signals")
    return np.asarray(inverse)


# ---- the card


def _force_channel(recordings: Sequence[SquareWaveRecording]) -> list[FittedValue]:
    """Offset, gain error and noise of the force's channel: a weighted line through its known levels."""
    noise_lsb, noise_error = estimate_noise(recordings, FORCE)
    levels, errors_lsb, variances = np.array(
        [level for recording in recordings for level in _levels(recording, noise_lsb)]
    ).T
    (gain, offset), covariance = np.polyfit(levels, errors_lsb, 1, w=1.0 / np.sqrt(variances), cov="unscaled")
    gain_error, offset_error = np.sqrt(np.diag(covariance)).tolist()
    return [
        FittedValue("force offset", float(offset), offset_error, "LSB", "offset of the force's channel"),
        FittedValue("force gain", float(gain), gain_error, "", "gain of the force's channel, and of the generator"),
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
    value = {each.name: each.value for each in estimates}
    period_s, channels = recordings[0].sample_period_s, recordings[0].channels
    (skew,) = (each for each in estimates if each.name == SKEW)
    if skew.value < -3.0 * skew.standard_error - _FINE_SKEW * period_s:
        raise RigError(
            f"the displacement is taken {-1e6 * skew.value:.2f} us before the edges of the force, which no card does:"
            " check that the edges are at the samples that the scenario sets"
        )
    # The fraction of least denominator is taken for the skew: on a coarser grid the emulator is faster.
    late_n = max(skew.value, 0.0) / period_s
    near = (round(late_n * parts) / parts for parts in range(1, 1001))
    late_n = next(each for each in near if abs(each - late_n) <= _FINE_SKEW)
    zeros = [channel.zero for recording in recordings for channel in recording.channels.values()]
    most = max([*zeros, *(float(recording.codes.max()) for recording in recordings)])
    bits = next(bits for bits in (12, 14, 16) if most < 1 << bits or bits == 16)
    measured = {name: (each.low_v, each.low_v + (1 << bits) * each.lsb_v) for name, each in channels.items()}
    return CardDescription(
        range_v={name: measured.get(name, _UNMEASURED_RANGE_V) for name in CHANNELS},
        bits=bits,
        rate_hz=1.0 / period_s,
        noise_lsb={**dict.fromkeys(CHANNELS, value["displacement noise"]), "force": value["force noise"]},
        faults={
            "skew_s": (0.0, late_n * period_s, 0.0, 0.0),
            "gain_error": (value["force gain"], 0.0, 0.0, 0.0),
            "offset_lsb": (value["force offset"], value[OFFSET], 0.0, 0.0),
        },
    )


# ---- the distance between rig and twin


def noise_free_lsb(description: EmulatorDescription, scenario: Scenario, seed: int) -> Vector:
    """(n, 2) force and displacement at an emulated card without noise, before rounding, LSB.

    :raises ConfigurationError: the emulator cannot play the scenario.
    :raises RigError: the emulator failed.
    """
    card = description.card.card(scenario.program.channels)
    silent = dataclasses.replace(card, noise_lsb=(0.0,) * card.channels)
    volts = np.concatenate([block.volts for block in EmulatorRig(description).perform(scenario, seed).blocks])
    lsb = Sampler(silent, np.random.default_rng(0)).seen_lsb(volts)
    return np.asarray(lsb[:, [INPUT, OUTPUT]])


def difference_lsb(recording: SquareWaveRecording, twin: EmulatorDescription, noise_lsb: float) -> float:
    """Upper bound (two standard errors) of the rms difference between the displacements of rig and twin, LSB.

    Compares averages; subtracts the contribution of noise and rounding to the mean square.

    :param noise_lsb: noise of the rig's displacement.
    :raises ConfigurationError, RigError: as for ``noise_free_lsb``.
    """
    average = average_phases(recording, DISPLACEMENT, noise_lsb)
    there = recording.split_periods(noise_free_lsb(twin, recording.scenario, 0)[:, DISPLACEMENT]).mean(axis=0)
    mean_square = float(np.mean((average.means - there[average.phases]) ** 2))
    uncertain = average.variance * math.sqrt(2.0 / len(average.means))
    return math.sqrt(max(0.0, mean_square - average.variance) + 2.0 * uncertain)
