"""Excitations of the emulated computer beside those of its generator."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from analogrig_emulator import TICKS_PER_SAMPLE, Edges, Excitation

from .emulated import Draw
from .played import HALF_PERIOD_N, HIGH_V, LOW_V, Array


@dataclass(frozen=True)
class Waveform(Excitation):
    """Excitation with given edges, in ticks of a machine at the card's rate."""

    given: Edges = field(default_factory=Edges.none)

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Edges:
        del sample_rate_hz
        return self.given.within(start_tick, stop_tick)


def square(frequency_hz: float = 200.0, part_of_range: float = 1.0, ppm: float | None = None) -> Draw:
    """Square wave of random phase; with ``ppm`` on a clock of its own that runs so much fast."""
    clock, drift_ppm = ("card", 0.0) if ppm is None else ("free", ppm)

    def draw(rng: np.random.Generator, samples: int) -> Excitation:
        del samples
        return Excitation(
            low_v=LOW_V,
            high_v=LOW_V + part_of_range * (HIGH_V - LOW_V),
            frequency_hz=frequency_hz,
            phase=float(rng.uniform()),
            clock=clock,
            drift_ppm=drift_ppm,
        )

    return draw


def pulse(rng: np.random.Generator, samples: int) -> Excitation:
    """Pulses of 200 Hz that are high for a fifth of the period."""
    del samples
    phase = float(rng.uniform())
    return Excitation(shape="pulse", duty=0.2, low_v=LOW_V, high_v=HIGH_V, frequency_hz=200.0, phase=phase)


def random_bits(rng: np.random.Generator, samples: int) -> Excitation:
    """Pseudorandom binary sequence with bits of 25 samples."""
    del samples
    seed = int(rng.integers(511))
    return Excitation(shape="prbs", low_v=LOW_V, high_v=HIGH_V, frequency_hz=800.0, seed=seed)


def random_instants(rng: np.random.Generator, samples: int) -> Excitation:
    """Edges at any instants, whose distances are exponentially distributed."""
    gaps = rng.exponential(HALF_PERIOD_N * TICKS_PER_SAMPLE, 2 * samples // HALF_PERIOD_N + 50)
    ticks = np.unique(np.cumsum(gaps).astype(np.int64))
    levels_v = np.where(np.arange(len(ticks) + 1) % 2, LOW_V, HIGH_V)
    return Waveform(given=Edges(np.append(0, ticks), levels_v))


def continuous(wave: Callable[[Array, np.random.Generator], Array], steps: int = 4, levels: int = 0) -> Draw:
    """Waveform with values within +-1 at instants in samples, held for 1/``steps`` of a sample.

    :param levels: number of levels of the generator's converter; 0: any.
    """

    def draw(rng: np.random.Generator, samples: int) -> Excitation:
        instants = np.arange((samples + 2) * steps) / steps
        shape = 0.5 + 0.5 * wave(instants + 0.5 / steps, rng)
        if levels:
            shape = np.rint(shape * (levels - 1)) / (levels - 1)
        ticks = np.rint(instants * TICKS_PER_SAMPLE).astype(np.int64)
        return Waveform(given=Edges(ticks, LOW_V + shape * (HIGH_V - LOW_V)))

    return draw


def sine(instants_n: Array, rng: np.random.Generator) -> Array:
    """Sine of 200 Hz."""
    return np.sin(math.pi * (instants_n / HALF_PERIOD_N + 2.0 * rng.uniform()))


def sweep(instants_n: Array, rng: np.random.Generator) -> Array:
    """Linear sweep from 20 to 1,000 Hz within 4,000 samples, repeated."""
    at = (instants_n / 4000.0 + rng.uniform()) % 1.0
    return np.sin(2.0 * math.pi * 4000.0 / 20e3 * (20.0 * at + 0.5 * 980.0 * at**2))


def multisine(instants_n: Array, rng: np.random.Generator) -> Array:
    """Sum of the odd harmonics of 50 Hz up to 950 Hz with random phases, scaled to its peak."""
    phases = rng.uniform(0.0, 2.0 * math.pi, 10)
    harmonics = 2.0 * math.pi * 50.0 / 20e3 * np.arange(1, 20, 2)
    period = np.arange(400.0)[:, None] * harmonics + phases
    peak = np.abs(np.sin(period).sum(axis=1)).max()
    total = np.zeros_like(instants_n)
    for harmonic, phase in zip(harmonics, phases, strict=True):
        total += np.sin(instants_n * harmonic + phase)
    return np.asarray(np.clip(total / peak, -1.0, 1.0))
