"""Recordings of square waves on a rig, their averages phase by phase, their noise, and their distance from a twin."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError, RigError
from analogrig.hardware.calibration.plan import RATE_HZ
from analogrig.rigs.emulator import EmulatorDescription, EmulatorRig
from analogrig.rigs.rig import Rig
from analogrig.run import CHANNELS, MEASURED, Channel
from analogrig.scenario import Scenario
from analogrig_emulator import Sampler

Vector = NDArray[np.float64]

SETTLING_N = 400
"""Samples left out at the start of each recording: the state before it is unknown."""

FORCE, DISPLACEMENT = range(2)
"""Columns of a recording, as in MEASURED."""

_COLUMNS = [CHANNELS.index(name) for name in MEASURED]


@dataclass(frozen=True, eq=False)
class SquareWaveRecording:
    """n samples of one scenario on a rig: a square wave, no pot changes."""

    scenario: Scenario
    sample_period_s: float
    channels: Mapping[str, Channel]
    codes: NDArray[np.uint16]  # (n, 2): force, displacement
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


def record(rig: Rig, scenario: Scenario, seed: int) -> SquareWaveRecording:
    """Play the scenario on the rig and return its samples.

    :raises ConfigurationError: the rig cannot play it.
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
    return SquareWaveRecording(
        scenario,
        performance.sample_period_s,
        {name: performance.channels[name] for name in MEASURED},
        np.concatenate([block.codes[:, _COLUMNS] for block in blocks]),
        np.concatenate([block.clipped[:, _COLUMNS] for block in blocks]),
    )


@dataclass(frozen=True, eq=False)
class Averages:
    """Means of one channel of a recording over all samples of the same phase."""

    phases: NDArray[np.intp]
    """Phases, in samples, without a clipped sample."""
    means: Vector
    """(phases,): mean codes."""
    variance: float
    """Variance of each mean, LSB^2."""


def split_periods(recording: SquareWaveRecording, values: NDArray[np.generic]) -> NDArray[np.generic]:
    """(periods, samples of a period): the settled part of ``values`` (n,)."""
    period_n = recording.period_n
    first = -(-SETTLING_N // period_n) * period_n
    last = first + (len(values) - first) // period_n * period_n
    return values[first:last].reshape(-1, period_n)


def average_phases(recording: SquareWaveRecording, channel: int, noise_lsb: float) -> Averages:
    """Averages of a channel; their variance is that of noise and of rounding, which averaging does not remove."""
    codes = split_periods(recording, recording.codes[:, channel]).astype(np.float64)
    clipped = split_periods(recording, recording.clipped[:, channel]).any(axis=0)
    (phases,) = np.nonzero(~clipped)
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
        codes = split_periods(recording, recording.codes[:, channel]).astype(np.float64)
        kept = ~split_periods(recording, recording.clipped[:, channel]).any(axis=0)
        squares.append((np.diff(codes[:, kept], axis=0) ** 2).ravel() / 2.0)
        levels += 2 if channel == FORCE else int(kept.sum())
    every = np.concatenate(squares)
    if not len(every):
        raise RigError(f"{MEASURED[channel]}: every sample is clipped")
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


def noise_free_lsb(description: EmulatorDescription, scenario: Scenario, seed: int) -> Vector:
    """(n, 2) force and displacement at an emulated card without noise, before rounding, LSB.

    :raises ConfigurationError: the emulator cannot play the scenario.
    :raises RigError: the emulator failed.
    """
    card = description.card.card()
    silent = dataclasses.replace(card, noise_lsb=(0.0,) * card.channels)
    volts = np.concatenate([block.volts for block in EmulatorRig(description).perform(scenario, seed).blocks])
    return Sampler(silent, np.random.default_rng(0)).seen_lsb(volts)[:, _COLUMNS]


def difference_lsb(recording: SquareWaveRecording, twin: EmulatorDescription, noise_lsb: float) -> float:
    """Upper bound (two standard errors) of the rms difference between the displacements of rig and twin, LSB.

    Compares averages; subtracts the contribution of noise and rounding to the mean square.

    :param noise_lsb: noise of the rig's displacement.
    :raises ConfigurationError, RigError: as for ``noise_free_lsb``.
    """
    average = average_phases(recording, DISPLACEMENT, noise_lsb)
    there = split_periods(recording, noise_free_lsb(twin, recording.scenario, 0)[:, DISPLACEMENT]).mean(axis=0)
    mean_square = float(np.mean((average.means - there[average.phases]) ** 2))
    uncertain = average.variance * math.sqrt(2.0 / len(average.means))
    return math.sqrt(max(0.0, mean_square - average.variance) + 2.0 * uncertain)
