"""Recordings of square waves, averaged phase by phase of their period; how sure the averages are, and the noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError, RigError
from analogrig.hardware.calibration.plan import RATE_HZ
from analogrig.rigs.rig import Rig
from analogrig.run import CHANNELS, MEASURED, Channel
from analogrig.scenario import Scenario

Vector = NDArray[np.float64]

SETTLING_N = 400
"""Left out at the start of each recording: what came before it is not known."""

FORCE, DISPLACEMENT = range(2)
"""Columns of a recording: MEASURED."""


@dataclass(frozen=True, eq=False)
class SquareWaveRecording:
    """What a rig gave for one scenario: square wave, pots at rest."""

    scenario: Scenario
    sample_period_s: float
    channels: Mapping[str, Channel]
    codes: NDArray[np.uint16]
    """(n, 2): force, displacement."""
    clipped: NDArray[np.bool_]
    """(n, 2)"""

    @property
    def period_n(self) -> int:
        """Samples of a period of the force.

        :raises ConfigurationError: it is no whole number.
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
    """Plays the scenario on the rig.

    :raises ConfigurationError: the rig cannot play it.
    :raises RigError: the rig failed, is not well, or an amplifier was overloaded.
    """
    performance = rig.perform(scenario, seed)
    blocks = list(performance.blocks)
    hindsight = performance.hindsight()
    if hindsight.caveats:
        raise RigError(f"scenario {scenario.name}: {hindsight.caveats[0]}: nothing can be fitted")
    if lamps := hindsight.lamps:
        raise RigError(f"scenario {scenario.name}: overload lamps of {', '.join(lamps)} are lit: nothing can be fitted")
    if len({block.record for block in blocks}) != 1:
        raise RigError(f"scenario {scenario.name}: was not recorded without a gap: nothing can be fitted")
    columns = [CHANNELS.index(name) for name in MEASURED]
    return SquareWaveRecording(
        scenario,
        performance.sample_period_s,
        {name: performance.channels[name] for name in MEASURED},
        np.concatenate([block.codes[:, columns] for block in blocks]),
        np.concatenate([block.clipped[:, columns] for block in blocks]),
    )


@dataclass(frozen=True, eq=False)
class Averages:
    """One channel of a recording, phase by phase of its period."""

    phases: NDArray[np.intp]
    """Those of which no sample was clipped."""
    means: Vector
    """Of the codes: (phases,)."""
    variance: float
    """Of each mean, LSB^2."""


def periods(recording: SquareWaveRecording, values: NDArray[np.generic]) -> NDArray[np.generic]:
    """The settled part of (n,) as (periods, samples of a period)."""
    period_n = recording.period_n
    first = -(-SETTLING_N // period_n) * period_n
    last = first + (len(values) - first) // period_n * period_n
    return values[first:last].reshape(-1, period_n)


def averaged(recording: SquareWaveRecording, channel: int, noise_lsb: float) -> Averages:
    """The variance is that of the noise and that of rounding, which averaging does not remove."""
    codes = periods(recording, recording.codes[:, channel]).astype(np.float64)
    clipped = periods(recording, recording.clipped[:, channel]).any(axis=0)
    (phases,) = np.nonzero(~clipped)
    left = rounding(noise_lsb)
    variance = (noise_lsb**2 + 1.0 / 12.0 - left) / len(codes) + left
    return Averages(phases, codes.mean(axis=0)[phases], variance)


def rounding(noise_lsb: float) -> float:
    """Variance in LSB^2 of the mean of rounded samples of a level that may lie anywhere between two codes.

    Widrow and Kollar, Quantization Noise, chapter 4: the error of the mean is a Fourier series in the level.
    """
    k = np.arange(1, 1000)
    return float((np.exp(-((2.0 * math.pi * k * noise_lsb) ** 2)) / (2.0 * (math.pi * k) ** 2)).sum())


def noise_of(recordings: Sequence[SquareWaveRecording], channel: int) -> tuple[float, float]:
    """The noise of a channel before rounding and its standard error, LSB rms, from samples a period apart.

    :raises RigError: every sample is clipped.
    """
    squares, levels = [], 0
    for recording in recordings:
        codes = periods(recording, recording.codes[:, channel]).astype(np.float64)
        kept = ~periods(recording, recording.clipped[:, channel]).any(axis=0)
        squares.append((np.diff(codes[:, kept], axis=0) ** 2).ravel() / 2.0)
        levels += 2 if channel == FORCE else int(kept.sum())
    every = np.concatenate(squares)
    if not len(every):
        raise RigError(f"{MEASURED[channel]}: every sample is clipped")
    variance = float(every.mean())
    noise_lsb = _before_rounding(variance)
    # Samples a period apart are used in two differences each; and at a few levels rounding spreads more or less.
    swing = (math.pi**-2 + 4.0 * noise_lsb**2) * math.exp(-2.0 * (math.pi * noise_lsb) ** 2)
    spread = math.hypot(variance * math.sqrt(3.0 / len(every)), swing / math.sqrt(2.0 * levels))
    return noise_lsb, spread / (2.0 * noise_lsb) if noise_lsb > 0.0 else math.sqrt(spread)


def _before_rounding(variance: float) -> float:
    """The noise whose rounded samples have that variance at levels anywhere between two codes, LSB rms."""
    from scipy.optimize import brentq

    def beyond(noise_lsb: float) -> float:
        return noise_lsb**2 + 1.0 / 12.0 - rounding(noise_lsb) - variance

    return float(brentq(beyond, 0.0, 1.0 + math.sqrt(variance))) if beyond(0.0) < 0.0 else 0.0
