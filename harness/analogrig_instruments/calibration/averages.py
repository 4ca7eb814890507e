"""Recordings of a rig: square waves, each with its own pots, levels and frequency; their averages and their noise.

Programs other than front and shock are recorded under random steps.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Program, Rig, RigError, Run, Scenario
from analogrig.recordings import unanswered
from analogrig.rigs import Block, Performance
from analogrig.run import INPUT, OUTPUT, Channel
from analogrig_emulator import Excitation
from analogrig_emulator.machine.patched_program import MACHINE_V

Vector = NDArray[np.float64]
_Scalar = TypeVar("_Scalar", bound=np.generic)
ProgramName = Literal["front", "shock"]

SAMPLES = 1400
_LEFT_OUT_N = 400
"""Samples left out at the start of each recording of a rig, whose state before it is unknown."""

RATE_HZ = 20e3
"""Sample rate of the card. The periods below are whole numbers of its samples."""

_PROGRAM_SAMPLES = 4000
_LEAST_BITS_HZ, _MOST_BITS_HZ, _BITS_PER_PERIOD = 1e3, 5e3, 18
"""Random steps: a half period of the trial play holds as many bits as the longest run of equal ones."""
_FIRST_BITS = (0, 300)
_MARGIN = 0.1
"""Distance from the levels of the trial play: random steps drive a resonance further than a square wave."""

FORCE, DISPLACEMENT = range(2)
"""Columns of a recording: input and output of the program."""

_THIRD_DIFFERENCE = (1.0, -3.0, 3.0, -1.0)
_NORMAL_MAD = 1.482602
"""Standard deviation over median absolute deviation of normal noise."""
_KEPT_SIGMAS, _KEPT_VARIANCE = 3.0, 0.973337
"""Largest deviation that counts as noise, and the variance of a standard normal number within it."""

_COLUMNS = [INPUT, OUTPUT]
_GRID = ("low_v", "lsb_v")

_Plant = tuple[float, float, float]
_PLAYS: tuple[tuple[_Plant, _Plant, tuple[float, float, int]], ...] = (
    ((115.0, 3021.0, 24500.0), (2.0, 900.0, 12250.0), (0.1, 9.9, 50)),
    ((115.0, 3021.0, 24500.0), (2.0, 900.0, 12250.0), (0.6, 9.5, 10)),
    ((115.0, 3021.0, 18000.0), (2.0, 900.0, 9000.0), (0.2, 8.0, 25)),
    ((115.0, 2123.0, 20000.0), (2.0, 632.0, 10000.0), (1.0, 9.0, 20)),
    ((60.0, 3021.0, 24500.0), (1.6, 900.0, 12250.0), (0.3, 9.7, 8)),
    ((60.0, 4000.0, 28000.0), (1.6, 1200.0, 14000.0), (0.4, 9.2, 16)),
    ((35.0, 2600.0, 19000.0), (2.6, 780.0, 9500.0), (0.7, 7.5, 20)),
    ((230.0, 4200.0, 15000.0), (5.5, 1250.0, 7500.0), (0.5, 6.0, 32)),
    ((160.0, 1600.0, 28000.0), (3.5, 600.0, 14000.0), (3.0, 9.0, 40)),
    ((31.0, 2500.0, 26500.0), (1.55, 750.0, 13250.0), (0.8, 8.8, 5)),
    ((80.0, 3600.0, 21500.0), (2.3, 1070.0, 10750.0), (0.1, 8.5, 10)),
    ((45.0, 2800.0, 16500.0), (4.0, 835.0, 8250.0), (1.2, 6.9, 25)),
    ((95.0, 2700.0, 22500.0), (1.8, 980.0, 11000.0), (2.0, 8.2, 64)),
)
"""M (kg), B (N s/m), K (N/m) of front and shock, which cover the ranges of the pots; low, high level (V), half period
(samples). No amplifier is overloaded, and the displacement stays within -1..9 V. The last play is the check."""


def scenarios(program: ProgramName) -> tuple[Scenario, ...]:
    """Scenarios that the twin is fitted to."""
    return tuple(_scenario(program, play, f"calibration-{play + 1}") for play in range(len(_PLAYS) - 1))


def check_scenario(program: ProgramName) -> Scenario:
    """Scenario to validate the twin; its pots, levels and frequency differ from all ``scenarios``."""
    return _scenario(program, -1, "calibration-check")


def _scenario(program: ProgramName, play: int, name: str) -> Scenario:
    front, shock, (low_v, high_v, half_n) = _PLAYS[play]
    wired = Program.load(program)
    values = dict(zip(wired.parameters, front if program == "front" else shock, strict=True))
    excitation = Excitation(low_v=low_v, high_v=high_v, frequency_hz=RATE_HZ / (2 * half_n))
    return Scenario(samples=SAMPLES, excitation=excitation, program=wired, set=values, name=name)


@dataclass(frozen=True, eq=False)
class SquareWaveRecording:
    """n samples of one scenario on a rig: a square wave, no pot changes."""

    scenario: Scenario
    sample_period_s: float
    channels: Mapping[str, Channel]
    codes: Vector  # (n, 2): force, displacement; not rounded where the rig gives the volts that it measured
    clipped: NDArray[np.bool_]  # (n, 2)

    @property
    def period_n(self) -> int:
        """Samples per period of the force.

        :raises ConfigurationError: half a period is no whole number of samples.
        """
        period_n = 1.0 / (self.scenario.excitation.frequency_hz * self.sample_period_s)
        if abs(period_n - round(period_n)) > 1e-6 * period_n or round(period_n) % 2:
            rate_hz = 1.0 / self.sample_period_s
            raise ConfigurationError(
                f"scenario {self.scenario.name}: half a period is no whole number of samples at {rate_hz:g} Hz;"
                f" calibration needs {RATE_HZ:g} Hz"
            )
        return round(period_n)

    def split_periods(self, values: NDArray[_Scalar]) -> NDArray[_Scalar]:
        """(periods, samples of a period): the settled part of ``values`` (n,)."""
        period_n = self.period_n
        first = -(-_LEFT_OUT_N // period_n) * period_n
        last = first + (len(values) - first) // period_n * period_n
        return values[first:last].reshape(-1, period_n)

    def periods(self, channel: int) -> tuple[Vector, NDArray[np.intp]]:
        """Codes (periods, samples of a period) of a channel, and the phases, in samples, without a clipped sample."""
        clipped = self.split_periods(self.clipped[:, channel]).any(axis=0)
        return self.split_periods(self.codes[:, channel]), np.flatnonzero(~clipped)


def record(rig: Rig, scenario: Scenario, seed: int) -> SquareWaveRecording:
    """Play the scenario on the rig and return its samples, with the values at which the rig's pots stood.

    :raises ConfigurationError: the rig cannot play it.
    :raises RigError: the rig failed, has caveats or gaps, or an amplifier was overloaded.
    """
    performance, blocks, standing = _play(rig, scenario, seed)
    channels = {name: performance.channels[name] for name in scenario.program.measured}
    codes = np.concatenate([block.codes[:, _COLUMNS] for block in blocks]).astype(np.float64)
    if not rig.computes_circuit:  # the volts of a computed circuit are before the noise of its card
        low_v, lsb_v = (np.array([getattr(channel, name) for channel in channels.values()]) for name in _GRID)
        codes = (np.concatenate([block.volts[:, _COLUMNS] for block in blocks]) - low_v) / lsb_v
    return SquareWaveRecording(
        dataclasses.replace(scenario, set={**scenario.set, **standing}),
        performance.sample_period_s,
        channels,
        codes,
        np.concatenate([block.clipped[:, _COLUMNS] for block in blocks]),
    )


def record_program(rig: Rig, program: Program, part: int, seed: int) -> Run:
    """Play a program on the rig under random steps, and return its samples as a recording without a device.

    :param part: 0 or 1; the steps of one differ from those of the other.
    :raises ConfigurationError, RigError: as for ``record``.
    """
    (driven, quantity), *_ = program.equations.inputs.items()
    full = program.circuit.scales.full(driven)
    low_v, high_v = (MACHINE_V * level / full for level in quantity.trial)
    margin_v = _MARGIN * (high_v - low_v)
    bits_hz = _BITS_PER_PERIOD * program.equations.speed / program.equations.period_s
    excitation = Excitation(
        shape="prbs",
        low_v=low_v + margin_v,
        high_v=high_v - margin_v,
        frequency_hz=min(max(bits_hz, _LEAST_BITS_HZ), _MOST_BITS_HZ),
        seed=_FIRST_BITS[part],
    )
    scenario = Scenario(samples=_PROGRAM_SAMPLES, excitation=excitation, program=program, name="calibration")
    performance, blocks, standing = _play(rig, scenario, seed)
    codes, clipped = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("codes", "clipped"))
    played = dataclasses.replace(scenario, set=dict(standing))
    rates = performance.sample_period_s, performance.time_scale
    return unanswered(codes, clipped, performance.channels, *rates, rig.description(), played, played.segments())


def _play(rig: Rig, scenario: Scenario, seed: int) -> tuple[Performance, list[Block], Mapping[str, float]]:
    """Play a scenario whose samples can be fitted, and return the values at which the pots stood too.

    :raises RigError: the rig failed, has caveats or gaps, or an amplifier was overloaded.
    """
    performance = rig.perform(scenario, seed)
    blocks = list(performance.blocks)
    hindsight = performance.hindsight()
    obstacles = list(hindsight.caveats[:1])
    if hindsight.lamps:
        obstacles.append(f"overload lamps of {', '.join(hindsight.lamps)} are lit")
    if len({block.record for block in blocks}) != 1:
        obstacles.append("the samples have a gap")
    if obstacles:
        raise RigError(f"scenario {scenario.name}: {obstacles[0]}: nothing can be fitted")
    return performance, blocks, hindsight.standing


class Averages(NamedTuple):
    """Means of one channel of a recording over all samples of the same phase."""

    phases: NDArray[np.intp]
    """Phases, in samples, without a clipped sample."""
    means: Vector
    """(phases,): mean codes."""
    variance: float
    """Variance of each mean, LSB^2: that of noise and of rounding, which averaging does not remove."""


def average_phases(recording: SquareWaveRecording, channel: int, noise_lsb: float) -> Averages:
    """Averages of a channel."""
    codes, phases = recording.periods(channel)
    left = rounding_variance(noise_lsb)
    variance = (noise_lsb**2 + 1.0 / 12.0 - left) / len(codes) + left
    return Averages(phases, codes.mean(axis=0)[phases], variance)


def rounding_variance(noise_lsb: float) -> float:
    """Variance, LSB^2, of the mean of rounded samples of a level at an unknown place between two codes.

    Widrow and Kollar, Quantization Noise, chapter 4: the error of the mean is a Fourier series in the level.
    """
    k = np.arange(1, 1000)
    return float((np.exp(-((2.0 * math.pi * k * noise_lsb) ** 2)) / (2.0 * (math.pi * k) ** 2)).sum())


def estimate_noise(recordings: Sequence[SquareWaveRecording], channel: int) -> tuple[float, float]:
    """Noise of a channel before rounding and its standard error, LSB rms, from samples a period apart.

    :raises RigError: every sample is clipped.
    """
    squares, levels = [], 0
    for recording in recordings:
        codes, phases = recording.periods(channel)
        squares.append((np.diff(codes[:, phases], axis=0) ** 2).ravel() / 2.0)
        levels += 2 if channel == FORCE else len(phases)
    every = np.concatenate(squares)
    if not len(every):
        name = recordings[0].scenario.program.measured[channel]
        raise RigError(f"{name}: every sample is clipped")
    variance = float(every.mean())
    noise_lsb = _remove_rounding(variance)
    # Each sample enters two differences, and at few levels the variance of rounding deviates from its mean.
    swing = (math.pi**-2 + 4.0 * noise_lsb**2) * math.exp(-2.0 * (math.pi * noise_lsb) ** 2)
    spread = math.hypot(variance * math.sqrt(3.0 / len(every)), swing / math.sqrt(2.0 * levels))
    return noise_lsb, spread / (2.0 * noise_lsb) if noise_lsb > 0.0 else math.sqrt(spread)


def _remove_rounding(variance: float) -> float:
    """Noise, LSB rms, whose rounded samples have ``variance`` about levels at any place between two codes."""
    from scipy.optimize import brentq

    def excess(noise_lsb: float) -> float:
        return noise_lsb**2 + 1.0 / 12.0 - rounding_variance(noise_lsb) - variance

    return float(brentq(excess, 0.0, 1.0 + math.sqrt(variance))) if excess(0.0) < 0.0 else 0.0


def noise_variance(values: NDArray[np.float64]) -> float:
    """Variance of white noise on a smooth signal: a 20th of that of its third differences, without outliers."""
    third = np.convolve(values, _THIRD_DIFFERENCE, mode="valid")
    sigma = _NORMAL_MAD * float(np.median(np.abs(third)))
    kept = third[np.abs(third) <= _KEPT_SIGMAS * sigma]
    return float(np.mean(np.square(kept))) / _KEPT_VARIANCE / float(np.square(_THIRD_DIFFERENCE).sum())
