"""The card: four channels, sampled at the same instant, to codes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import SamplerError

__all__ = ["Card", "Sampler"]

_MAX_BITS = 16


@dataclass(frozen=True)
class Card:
    """An analogue-to-digital card; the defaults are 12 bits at 20 kHz, +-10 V on each of four channels, without noise.

    ranges_v: (low, high) of each channel in V; code 0 is low, and high is one LSB above the last code.
    noise_lsb: rms of the white Gaussian noise of each channel, added before quantisation.
    Raises SamplerError naming the field.
    """

    bits: int = 12
    rate_hz: float = 20e3
    ranges_v: tuple[tuple[float, float], ...] = ((-10.0, 10.0),) * 4
    noise_lsb: tuple[float, ...] = (0.0,) * 4

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= _MAX_BITS:
            raise SamplerError(f"card: bits must be 1 to {_MAX_BITS}, got {self.bits!r}")
        if not (math.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise SamplerError(f"card: rate_hz must be positive and finite, got {self.rate_hz!r}")
        for channel, (low, high) in enumerate(self.ranges_v):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise SamplerError(f"card: ranges_v of channel {channel} must be (low, high), got {(low, high)!r}")
        if len(self.noise_lsb) != len(self.ranges_v):
            raise SamplerError(f"card: noise_lsb has {len(self.noise_lsb)} channels, ranges_v has {len(self.ranges_v)}")
        for channel, noise in enumerate(self.noise_lsb):
            if not (math.isfinite(noise) and noise >= 0):
                raise SamplerError(
                    f"card: noise_lsb of channel {channel} must be finite and not negative, got {noise!r}"
                )

    @property
    def channels(self) -> int:
        """How many channels there are."""
        return len(self.ranges_v)

    @property
    def lsb_v(self) -> NDArray[np.float64]:
        """Volts per code of each channel, (channels,)."""
        low, high = np.array(self.ranges_v).T
        return np.asarray((high - low) / (1 << self.bits))

    def volts(self, codes: NDArray[np.uint16]) -> NDArray[np.float64]:
        """The voltages at the centres of the codes: (n, channels)."""
        low = np.array(self.ranges_v)[:, 0]
        return np.asarray(low + codes * self.lsb_v)


class Sampler:
    """A card at work.

    rng gives the noise: one number per sample and channel whatever the settings, so that neither the size of the blocks
    nor another channel's noise changes what a channel sees.
    """

    def __init__(self, card: Card, rng: np.random.Generator) -> None:
        self.card = card
        self._rng = rng
        self._low_v = np.array(card.ranges_v)[:, 0]
        self._lsb_v = card.lsb_v
        self._noise_lsb = np.array(card.noise_lsb)

    def sample(self, volts: NDArray[np.float64]) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
        """Volts (n, channels) to codes, uint16 (n, channels), and whether each was clipped, bool (n, channels).

        code = floor((v - low) / LSB + noise + 1/2), limited to 0 .. 2^bits - 1; clipped says that the limit was needed.
        Raises SamplerError for a voltage that is not a number, or another shape.
        """
        if volts.ndim != 2 or volts.shape[1] != self.card.channels:
            raise SamplerError(f"the card has {self.card.channels} channels, got volts of shape {volts.shape}")
        if np.isnan(volts).any():
            sample, channel = np.argwhere(np.isnan(volts))[0]
            raise SamplerError(f"sample {sample} of the block, channel {channel}: the voltage is not a number")
        noise = self._rng.standard_normal(volts.shape) * self._noise_lsb
        unlimited = np.floor((volts - self._low_v) / self._lsb_v + noise + 0.5)
        limited = np.clip(unlimited, 0, (1 << self.card.bits) - 1)
        return limited.astype(np.uint16), limited != unlimited
