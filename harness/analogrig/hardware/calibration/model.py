"""Emulator as a function of the unknowns of a rig: mean codes of the displacement, and their derivatives.

Force and displacement do not identify every component. They identify:

    x'' = k_M (g_F F - g_B k_B x' - g_K k_K x)        three gains, as deviations of RF, C1 and C2; other parts nominal
    at rest: x = F / K + c + (a1 + a2 / k_M + a4 k_B) / k_K        offsets of U1, U2, U4, and c of the card
    bandwidths, and the slew rate of U1        weakly; the datasheet's spread is their prior
    the skew of the displacement

Each pot misses its setting a little, differently at each, since the wiper rests on a winding. So each setting has one
more unknown, whose prior is the resolution of the pots.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from analogrig.errors import RigError
from analogrig.hardware.calibration.recordings import (
    DISPLACEMENT,
    SquareWaveRecording,
    Vector,
    average_phases,
    split_periods,
)
from analogrig.rigs.emulator import (
    CardDescription,
    ComputerDescription,
    EmulatorDescription,
    EmulatorRig,
    MeasuredValues,
)
from analogrig.run import CHANNELS
from analogrig.scenario import PlantChoice
from analogrig_emulator import OP_AMP_GRADES, TICKS_PER_SAMPLE, Edges, Excitation, SuspensionComputer

POT_RESOLUTION = 1.0 / 5000.0
"""Resolution of a ten-turn pot, as part of its track; a wiper rests up to half of it from its setting."""


@dataclass(frozen=True)
class Unknown:
    """Parameter of the fit."""

    name: str
    unit: str
    step: float
    """Step of its difference quotient."""
    stands_for: str
    table: str = ""
    """Field of MeasuredValues that it belongs to, if any."""
    element: str = ""
    known_to: float = math.inf
    """Prior standard deviation about 0."""


_TRACKS_KNOWN_TO = 0.05 / math.sqrt(3.0)

_GAINS = ("RF", "C1", "C2")
"""First unknowns: g_F = 1 / (RF C1 C2), g_B = 1 / C1, g_K = 1 / (C1 C2) of their nominal values."""

_POWERS = np.array([[0.0, -1.0, 0.0], [0.0, -1.0, 1.0], [1.0, 0.0, -1.0]])
"""Row of a pot (M, B, K): powers of its coefficient that act as factors of RF, C1, C2."""

SKEW, OFFSET = "skew", "displacement offset"


def _unknowns(computer: ComputerDescription) -> Iterator[Unknown]:
    """Unknowns of a kind of machine, but for those of the pots' settings."""
    yield Unknown("RF", "", 1e-4, "RF R5 / (RK R5FB), over the gain of the displacement's channel", "deviation", "RF")
    yield Unknown("C1", "", 1e-4, "R1 C1 RB R4 / (RFB R4FB)", "deviation", "C1")
    yield Unknown("C2", "", 1e-4, "R2 C2 RK R4FB / (RB R4)", "deviation", "C2")
    for name, what in (("U1", "its offset"), ("U2", "its offset"), ("U4", "its offset less half that of U3")):
        yield Unknown(f"{name} offset", "V", 1e-3, what, "offset_v", name)
    grade = OP_AMP_GRADES.get(computer.op_amp)
    if grade is not None and grade.bandwidth:
        bandwidth, slew = (spread / math.sqrt(3.0) for spread in (grade.bandwidth, grade.slew))
        for name in ("U1", "U2", "U3", "U4"):
            yield Unknown(f"{name} bandwidth", "", 0.02, "its bandwidth", "bandwidth", name, bandwidth)
        yield Unknown("U1 slew", "", 0.02, "its slew rate", "slew", "U1", slew)
    if computer.pots == "dial":
        for pot in "MBK":
            yield Unknown(f"{pot} track", "", 1e-3, "its track over its load", "deviation", pot, _TRACKS_KNOWN_TO)
    yield Unknown(SKEW, "s", 2e-7, "displacement after force, less the delay of U5")
    yield Unknown(OFFSET, "LSB", 1.0, "offset of the displacement's channel, and of U5")


@dataclass(frozen=True)
class _Setting:
    """Setting of one pot, whose coefficient has an unknown relative error."""

    parameter: int  # M, B, K: 0, 1, 2
    value: float
    known_to: float


@dataclass(frozen=True)
class _LateExcitation(Excitation):
    """Excitation whose edges are ``ticks`` later."""

    ticks: int = 0

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Edges:
        early = super().edges(start_tick - self.ticks, stop_tick - self.ticks, sample_rate_hz)
        return Edges(early.ticks + self.ticks, early.levels_v)


class EmulatorModel:
    """Averages of the displacement that the emulator predicts for given unknowns x (unknowns,)."""

    def __init__(
        self, recordings: Sequence[SquareWaveRecording], computer: ComputerDescription, noise_lsb: float
    ) -> None:
        self.unknowns = tuple(_unknowns(computer))
        self.nominal = computer
        self._pairs = [(each, average_phases(each, DISPLACEMENT, noise_lsb)) for each in recordings]
        self._settings = tuple(dict.fromkeys(setting for each in recordings for setting in _settings_of(each)))
        self.known_to = np.array(
            [*(each.known_to for each in self.unknowns), *(each.known_to for each in self._settings)]
        )

    def residuals(self, x: Vector, doubt_lsb: float = 0.0) -> Vector:
        """(m,) residuals of the averages and of the priors, in standard deviations.

        :param doubt_lsb: added in quadrature to the standard deviation of each average.
        """
        known = np.isfinite(self.known_to)
        return np.concatenate([self.misses(x) / self._deviations(doubt_lsb), -x[known] / self.known_to[known]])

    def misses(self, x: Vector) -> Vector:
        """Averages of the recordings less those of the emulator, LSB."""
        return np.concatenate([average.means - self.codes(x, each)[average.phases] for each, average in self._pairs])

    def jacobian(self, x: Vector, doubt_lsb: float = 0.0) -> Vector:
        """(m, unknowns) derivative of ``residuals``."""
        slopes = np.concatenate([self._slopes(x, each)[average.phases] for each, average in self._pairs])
        known = np.isfinite(self.known_to)
        return np.concatenate([-slopes / self._deviations(doubt_lsb)[:, None], -np.diag(1.0 / self.known_to)[known]])

    def _deviations(self, doubt_lsb: float) -> Vector:
        variances = [np.full(len(average.phases), average.variance) for _, average in self._pairs]
        return np.sqrt(np.concatenate(variances) + doubt_lsb**2)

    def codes(self, x: Vector, recording: SquareWaveRecording) -> Vector:
        """(phases,) mean code of each phase of the period, not rounded."""
        values = self.by_name(x)
        channel = recording.channels["displacement"]
        factors = np.ones(len(_GAINS))
        for column, setting in self._columns_of(recording):
            factors *= (1.0 + x[column]) ** _POWERS[setting.parameter]
        rig = EmulatorRig(
            EmulatorDescription(
                card=CardDescription(dict.fromkeys(CHANNELS, (-10.0, 10.0)), rate_hz=1.0 / recording.sample_period_s),
                computer=self.computer(values, dict(zip(_GAINS, factors.tolist(), strict=True))),
            )
        )
        computer, wave, _ = rig.set_up(recording.scenario, 0)
        volts = _late_displacement(computer, wave, len(recording.codes), values[SKEW] / recording.sample_period_s)
        return np.asarray(
            (split_periods(recording, volts).mean(axis=0) - channel.low_v) / channel.lsb_v + values[OFFSET]
        )

    def by_name(self, x: Vector) -> dict[str, float]:
        """Values of the unknowns, but for those of the settings."""
        return {unknown.name: float(value) for unknown, value in zip(self.unknowns, x, strict=False)}

    def computer(self, values: Mapping[str, float], factors: Mapping[str, float] | None = None) -> ComputerDescription:
        """Machine with these values of the unknowns.

        :param factors: of RF, C1, C2, for pots that miss their settings.
        :raises RigError: no machine has such values.
        """
        tables: dict[str, dict[str, float]] = {"deviation": {}, "offset_v": {}, "bandwidth": {}, "slew": {}}
        for unknown in self.unknowns:
            if unknown.table:
                tables[unknown.table][unknown.element] = values[unknown.name]
        for gain, factor in (factors or {}).items():
            tables["deviation"][gain] = (1.0 + tables["deviation"][gain]) * factor - 1.0
        try:
            return dataclasses.replace(self.nominal, values=MeasuredValues(**tables))
        except ValueError as error:
            raise RigError(f"no emulator fits the recordings: {error}") from error

    def _slopes(self, x: Vector, recording: SquareWaveRecording) -> Vector:
        """(phases, unknowns) derivative of ``codes``."""
        here = self.codes(x, recording)
        slopes = np.zeros((len(here), len(x)))
        for column, unknown in enumerate(self.unknowns):
            if unknown.name == OFFSET:
                slopes[:, column] = 1.0
                continue
            moved = x.copy()
            moved[column] += unknown.step
            slopes[:, column] = (self.codes(moved, recording) - here) / unknown.step
        gains = slice(len(_GAINS))
        for column, setting in self._columns_of(recording):
            slopes[:, column] = slopes[:, gains] @ ((1.0 + x[gains]) * _POWERS[setting.parameter])
        return slopes

    def _columns_of(self, recording: SquareWaveRecording) -> list[tuple[int, _Setting]]:
        first = len(self.unknowns)
        return [(first + self._settings.index(setting), setting) for setting in _settings_of(recording)]


def _settings_of(recording: SquareWaveRecording) -> list[_Setting]:
    choice = recording.scenario.plant
    values = zip(choice.plant().parameters().values(), _pot_errors(choice), strict=True)
    return [_Setting(i, value, error) for i, (value, error) in enumerate(values)]


@functools.cache
def _pot_errors(plant: PlantChoice) -> tuple[float, ...]:
    """Relative errors of the coefficients of pots M, B, K, rms, for dial errors uniform within half a step."""
    computer = SuspensionComputer(plant.set, opamp="ideal")
    program = computer.program
    computer.set(**dict(zip(program.values, plant.plant().parameters().values(), strict=False)))
    dials, coefficients = computer.dials, computer.coefficients
    computer.set(**{f"{pot}_dial": dial - POT_RESOLUTION for pot, dial in dials.items()})
    missed = computer.coefficients
    return tuple((coefficients[pot] - missed[pot]) / (math.sqrt(12.0) * coefficients[pot]) for pot in dials)


def _late_displacement(computer: SuspensionComputer, wave: Excitation, samples: int, late_n: float) -> Vector:
    """(samples,) displacement ``late_n`` samples after each sample, V.

    The force moves instead of the samples, by one sample less ``late_n``: the emulator then needs no finer grid.
    """
    late = _LateExcitation(**dataclasses.asdict(wave), ticks=round((1.0 - late_n) * TICKS_PER_SAMPLE))
    volts = np.concatenate(list(computer.play(late, samples + 1)))
    return np.asarray(volts[1:, CHANNELS.index("displacement")])
