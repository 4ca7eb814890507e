"""The emulator with its unknowns: what it says the displacement is, and how that changes with each of them.

From force and displacement alone not every resistor can be told. What acts on them:

    x'' = k_M (g_F F - g_B k_B x' - g_K k_K x)        three gains, as deviations of RF, C1 and C2; other parts nominal
    at rest: x = F / K + c + (a1 + a2 / k_M + a4 k_B) / k_K        offsets of U1, U2, U4, and c of the card
    bandwidth and slew rate of U1        weakly seen: the datasheet's spread is one more measurement of them
    the skew of the displacement

Each pot misses its setting by a little, differently at each (it rests on a winding): for each setting there is one more
unknown, with the resolution of the pots as its spread.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from analogrig.errors import RigError
from analogrig.hardware.calibration.recordings import DISPLACEMENT, SquareWaveRecording, Vector, averaged, periods
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
"""Of a ten-turn pot, as part of its track: a wiper rests up to half of it beside its setting."""


@dataclass(frozen=True)
class Unknown:
    """A number that is fitted."""

    name: str
    unit: str
    step: float
    """For difference quotients: seen, and small enough to be linear."""
    stands_for: str
    table: str = ""
    """Of MeasuredValues, if it is an element's."""
    element: str = ""
    known_to: float = math.inf
    """Its standard deviation beforehand, around 0."""


_TRACKS_KNOWN_TO = 0.05 / math.sqrt(3.0)

_GAINS = ("RF", "C1", "C2")
"""The first unknowns: g_F = 1 / (RF C1 C2), g_B = 1 / C1, g_K = 1 / (C1 C2) of their nominal values."""

SKEW, OFFSET = "skew", "displacement offset"


def _unknowns(computer: ComputerDescription) -> tuple[Unknown, ...]:
    gains = {
        "RF": "RF R5 / (RK R5FB), over the gain of the displacement's channel",
        "C1": "R1 C1 RB R4 / (RFB R4FB)",
        "C2": "R2 C2 RK R4FB / (RB R4)",
    }
    offsets = {"U1": "its offset", "U2": "its offset", "U4": "its offset less half that of U3"}
    return (
        *(Unknown(name, "", 1e-4, what, "deviation", name) for name, what in gains.items()),
        *(Unknown(f"{name} offset", "V", 1e-3, what, "offset_v", name) for name, what in offsets.items()),
        *_rates(computer.op_amp),
        *_tracks(computer),
        Unknown(SKEW, "s", 2e-7, "displacement after force, less the delay of U5"),
        Unknown(OFFSET, "LSB", 1.0, "offset of the displacement's channel, and of U5"),
    )


def _rates(op_amp: str) -> list[Unknown]:
    """Bandwidths and the slew rate that is felt, of amplifiers that have them."""
    grade = OP_AMP_GRADES.get(op_amp)
    if grade is None or not grade.bandwidth:
        return []
    bandwidth, slew = (spread / math.sqrt(3.0) for spread in (grade.bandwidth, grade.slew))
    within = [
        Unknown(f"U{i} bandwidth", "", 0.02, "its bandwidth", "bandwidth", f"U{i}", bandwidth) for i in range(1, 5)
    ]
    return [*within, Unknown("U1 slew", "", 0.02, "its slew rate", "slew", "U1", slew)]


def _tracks(computer: ComputerDescription) -> list[Unknown]:
    """They matter where pots are set by their dials."""
    if computer.pots == "coefficient":
        return []
    what = "its track over its load"
    return [Unknown(f"{pot} track", "", 1e-3, what, "deviation", pot, _TRACKS_KNOWN_TO) for pot in "MBK"]


@dataclass(frozen=True)
class _Setting:
    """What the pot of a parameter (M, B, K: 0, 1, 2) was set to, and by which part of it its coefficient may be off."""

    parameter: int
    value: float
    known_to: float

    @property
    def powers(self) -> Vector:
        """With which power of the coefficient each of the gains' elements goes that acts as it does."""
        return np.asarray(_POWERS[self.parameter])


_POWERS = np.array([[0.0, -1.0, 0.0], [0.0, -1.0, 1.0], [1.0, 0.0, -1.0]])


@dataclass(frozen=True)
class _Late(Excitation):
    """An excitation whose edges come so many ticks later."""

    ticks: int = 0

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Edges:
        early = super().edges(start_tick - self.ticks, stop_tick - self.ticks, sample_rate_hz)
        return Edges(early.ticks + self.ticks, early.levels_v)


class EmulatorModel:
    """What the emulator says the averages of the displacement are, for any values of the unknowns."""

    def __init__(
        self, recordings: Sequence[SquareWaveRecording], computer: ComputerDescription, noise_lsb: float
    ) -> None:
        self.recordings = recordings
        self.unknowns = _unknowns(computer)
        self.nominal = computer
        self._averages = [averaged(recording, DISPLACEMENT, noise_lsb) for recording in recordings]
        self._settings = tuple(dict.fromkeys(setting for each in recordings for setting in self._settings_of(each)))
        self.known_to = np.array([each.known_to for each in self.unknowns] + [each.known_to for each in self._settings])

    def residuals(self, x: Vector, doubt_lsb: float = 0.0) -> Vector:
        """In standard deviations: those of the averages, with the doubt, and of what is known beforehand; (m,)."""
        known = np.isfinite(self.known_to)
        return np.concatenate([self.misses(x) / self._deviations(doubt_lsb), -x[known] / self.known_to[known]])

    def misses(self, x: Vector) -> Vector:
        """By how much the averages lie above the emulator's, LSB."""
        pairs = zip(self.recordings, self._averages, strict=True)
        return np.concatenate([average.means - self.codes(x, each)[average.phases] for each, average in pairs])

    def jacobian(self, x: Vector, doubt_lsb: float = 0.0) -> Vector:
        """Of ``residuals``: (m, unknowns)."""
        pairs = zip(self.recordings, self._averages, strict=True)
        slopes = np.concatenate([self._slopes(x, each)[average.phases] for each, average in pairs])
        known = np.isfinite(self.known_to)
        return np.concatenate([-slopes / self._deviations(doubt_lsb)[:, None], -np.diag(1.0 / self.known_to)[known]])

    def _deviations(self, doubt_lsb: float) -> Vector:
        each = [np.full(len(average.phases), average.variance) for average in self._averages]
        return np.sqrt(np.concatenate(each) + doubt_lsb**2)

    def codes(self, x: Vector, recording: SquareWaveRecording) -> Vector:
        """The mean code of each phase of the period, not rounded: (phases,)."""
        values = self.by_name(x)
        channel = recording.channels["displacement"]
        rig = EmulatorRig(
            EmulatorDescription(
                card=CardDescription(dict.fromkeys(CHANNELS, (-10.0, 10.0)), rate_hz=1.0 / recording.sample_period_s),
                computer=self.computer(values, self._missed(x, recording)),
            )
        )
        computer, wave, _ = rig.set_up(recording.scenario, 0)
        volts = _taken_late(computer, wave, len(recording.codes), values[SKEW] / recording.sample_period_s)
        return np.asarray((periods(recording, volts).mean(axis=0) - channel.low_v) / channel.lsb_v + values[OFFSET])

    def by_name(self, x: Vector) -> dict[str, float]:
        """The unknowns but for those of the settings."""
        return {unknown.name: float(value) for unknown, value in zip(self.unknowns, x, strict=False)}

    def computer(self, values: Mapping[str, float], missed: Mapping[str, float] | None = None) -> ComputerDescription:
        """With these values of the unknowns.

        :param missed: what pots that miss their setting are like: factors of the elements of the gains.
        :raises RigError: no machine has such values.
        """
        tables: dict[str, dict[str, float]] = {"deviation": {}, "offset_v": {}, "bandwidth": {}, "slew": {}}
        for unknown in self.unknowns:
            if unknown.table:
                tables[unknown.table][unknown.element] = values[unknown.name]
        for gain, factor in (missed or {}).items():
            tables["deviation"][gain] = (1.0 + tables["deviation"][gain]) * factor - 1.0
        try:
            return dataclasses.replace(self.nominal, values=MeasuredValues(**tables))
        except ValueError as error:
            raise RigError(f"the emulator does not become like the recordings: {error}") from error

    def _missed(self, x: Vector, recording: SquareWaveRecording) -> dict[str, float]:
        factors = np.ones(len(_GAINS))
        for column, setting in self._columns_of(recording):
            factors *= (1.0 + x[column]) ** setting.powers
        return dict(zip(_GAINS, factors.tolist(), strict=True))

    def _slopes(self, x: Vector, recording: SquareWaveRecording) -> Vector:
        """Of ``codes``: (phases, unknowns)."""
        here = self.codes(x, recording)
        slopes = np.zeros((len(here), len(x)))
        for column, unknown in enumerate(self.unknowns):
            if unknown.name == OFFSET:
                slopes[:, column] = 1.0
                continue
            beside = x.copy()
            beside[column] += unknown.step
            slopes[:, column] = (self.codes(beside, recording) - here) / unknown.step
        for column, setting in self._columns_of(recording):
            gains = slice(len(_GAINS))
            slopes[:, column] = slopes[:, gains] @ ((1.0 + x[gains]) * setting.powers)
        return slopes

    def _columns_of(self, recording: SquareWaveRecording) -> list[tuple[int, _Setting]]:
        first = len(self.unknowns)
        return [(first + self._settings.index(setting), setting) for setting in self._settings_of(recording)]

    def _settings_of(self, recording: SquareWaveRecording) -> list[_Setting]:
        plant = recording.scenario.plant.plant()
        errors = _pot_errors(recording.scenario.plant)
        values = zip(plant.parameters().values(), errors, strict=True)
        return [_Setting(i, value, error) for i, (value, error) in enumerate(values)]


@functools.cache
def _pot_errors(plant: PlantChoice) -> tuple[float, ...]:
    """By which part of their coefficients the pots M, B, K miss them, rms: a dial that is evenly off by half a step."""
    computer = SuspensionComputer(plant.set, opamp="ideal")
    program = computer.program
    computer.set(**dict(zip(program.values, plant.plant().parameters().values(), strict=False)))
    dials, coefficients = computer.dials, computer.coefficients
    computer.set(**{f"{pot}_dial": dial - POT_RESOLUTION for pot, dial in dials.items()})
    missed = computer.coefficients
    return tuple((coefficients[pot] - missed[pot]) / (math.sqrt(12.0) * coefficients[pot]) for pot in dials)


def _taken_late(computer: SuspensionComputer, wave: Excitation, samples: int, late_n: float) -> Vector:
    """The displacement at every sample and ``late_n`` samples after it, V: (samples,).

    Instead of the samples the force is moved, one sample less late_n later: at any instant, at no cost.
    """
    moved = _Late(**dataclasses.asdict(wave), ticks=round((1.0 - late_n) * TICKS_PER_SAMPLE))
    volts = np.concatenate(list(computer.play(moved, samples + 1)))
    return np.asarray(volts[1:, CHANNELS.index("displacement")])
