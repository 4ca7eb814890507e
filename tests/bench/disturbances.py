"""Disturbances of the samples of an emulated run."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator import PROGRAMS, PotTurn

from .emulated import Disturbance, Validity, Wander
from .played import DISPLACEMENT, Array


def hum(amplitude_lsb: float, frequency_hz: float = 50.0, channels: Sequence[int] = (DISPLACEMENT,)) -> Disturbance:
    """Sine of this amplitude and of random phase, at 20,000 samples/s."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        phase = 2.0 * math.pi * (np.arange(len(lsb)) * frequency_hz / 20e3 + rng.uniform())
        lsb[:, channels] += amplitude_lsb * np.sin(phase)[:, None]
        return lsb

    return disturb


def drift(codes_per_sample: float) -> Disturbance:
    """Displacement that rises with every sample."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        del rng
        lsb[:, DISPLACEMENT] += codes_per_sample * np.arange(len(lsb))
        return lsb

    return disturb


def impulses(share: float, amplitude_lsb: float) -> Disturbance:
    """Impulses of either sign on single samples of the displacement."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        hit = rng.uniform(size=len(lsb)) < share
        lsb[:, DISPLACEMENT] += np.where(hit, amplitude_lsb * rng.choice([-1.0, 1.0], len(lsb)), 0.0)
        return lsb

    return disturb


def heavy_tails(degrees: float, deviation_lsb: float) -> Disturbance:
    """White noise on the displacement, beside the card's, of Student's t distribution with this standard deviation."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        lsb[:, DISPLACEMENT] += deviation_lsb * math.sqrt(1.0 - 2.0 / degrees) * rng.standard_t(degrees, len(lsb))
        return lsb

    return disturb


def popcorn(amplitude_lsb: float, dwell_n: float) -> Disturbance:
    """Displacement that jumps between two levels, this much either side, after ``dwell_n`` samples on average."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        jumps = rng.uniform(size=len(lsb)) < 1.0 / dwell_n
        lsb[:, DISPLACEMENT] += amplitude_lsb * (-1.0) ** np.cumsum(jumps)
        return lsb

    return disturb


def backlash(width_lsb: float) -> Disturbance:
    """Play of the displacement sensor: it follows the motion at half this width on either side."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        del rng
        at, half = lsb[0, DISPLACEMENT], 0.5 * width_lsb
        for k, moved in enumerate(lsb[:, DISPLACEMENT].tolist()):
            at = min(max(at, moved - half), moved + half)
            lsb[k, DISPLACEMENT] = at
        return lsb

    return disturb


def rising_noise(lsb_before: float, lsb_after: float) -> Disturbance:
    """White noise on the displacement, beside the card's, that rises linearly along the run."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        lsb[:, DISPLACEMENT] += rng.standard_normal(len(lsb)) * np.linspace(lsb_before, lsb_after, len(lsb))
        return lsb

    return disturb


def proportional_noise(part: float) -> Disturbance:
    """White noise on the displacement, beside the card's, in proportion to its code."""

    def disturb(lsb: Array, rng: np.random.Generator) -> Array:
        lsb[:, DISPLACEMENT] *= 1.0 + part * rng.standard_normal(len(lsb))
        return lsb

    return disturb


def missing(share: float, together_n: int = 1) -> Validity:
    """Loss of this share of the samples at random, ``together_n`` consecutive ones at a time."""

    def arrives(samples: int, rng: np.random.Generator) -> NDArray[np.bool_]:
        blocks = rng.uniform(size=-(-samples // together_n)) >= share
        return np.repeat(blocks, together_n)[:samples]

    return arrives


def warming(part: float, within_n: int = 10_000, step_n: int = 100) -> Wander:
    """Stiffness that turns by this part of it within so many samples, in small steps, as with a warming machine."""

    def wander(samples: int) -> Sequence[PotTurn]:
        stiffness = PROGRAMS["front"].values["K"]
        return [PotTurn(k, {"K": stiffness * (1.0 + part * k / within_n)}) for k in range(0, samples, step_n)]

    return wander
