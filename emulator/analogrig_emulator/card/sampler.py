"""Data-acquisition card: voltages of simultaneous or multiplexed channels to codes.

Steps from voltage to code; a fault left at its default changes nothing:

    instant    k / rate + skew of the channel + aperture delay + jitter          (acquisition.py)
    hold       acquired to within exp(-acquisition) of the step from the sample before; droop while conversions wait
    amplifier  u = ((1 + gain error) held - low) / LSB + offset + noise, in LSB
    converter  successive approximation on levels_lsb; stuck bits
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine import binding
from analogrig_emulator.engine.system import is_integer
from analogrig_emulator.exceptions import SamplerError

_MAX_BITS = 16

RANGES_V: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"0..10": (0.0, 10.0), "+-10": (-10.0, 10.0), "0..5": (0.0, 5.0), "+-5": (-5.0, 5.0)}
)
"""The unipolar and bipolar ranges that cards of the DT2821 class can be set to."""


@dataclass(frozen=True)
class Card:
    """Description of a card. Defaults: 12 bits at 20 kHz, +-10 V on each of four channels, no faults.

    A field of one number per channel may be left empty for zeros.

    ranges_v: (low, high) of each channel in V; code 0 is low, and high is one LSB above the last code.
    noise_lsb: rms of the white Gaussian noise of each channel, added before quantisation.
    throughput_hz: conversions per second of the converter that all channels share.
    skew_s: delay of each channel after the nominal instant. clock_drift_ppm: excess of its clock rate.
    aperture_delay_s, aperture_jitter_s: delay of every sample-and-hold, and rms of its jitter.
    acquisition: acquisition time in time constants of the sample-and-hold; droop_v_per_s: rate at which a held voltage
    falls while earlier channels are converted, 1 / throughput_hz each.
    gain_error: fraction, by channel; offset_lsb: by channel.
    levels_lsb: transition from code c - 1 to code c, for c = 1 .. 2^bits - 1 (ideal: c - 1/2), in LSB; empty: ideal.
    missing_codes: codes that never occur. stuck_high, stuck_low: masks of bits that always read 1 or 0.
    Raises SamplerError naming the field.
    """

    bits: int = 12
    rate_hz: float = 20e3
    ranges_v: tuple[tuple[float, float], ...] = ((-10.0, 10.0),) * 4
    noise_lsb: tuple[float, ...] = (0.0,) * 4
    throughput_hz: float = math.inf
    skew_s: tuple[float, ...] = ()
    clock_drift_ppm: float = 0.0
    aperture_delay_s: float = 0.0
    aperture_jitter_s: float = 0.0
    acquisition: float = math.inf
    droop_v_per_s: float = 0.0
    gain_error: tuple[float, ...] = ()
    offset_lsb: tuple[float, ...] = ()
    levels_lsb: tuple[float, ...] = ()
    missing_codes: tuple[int, ...] = ()
    stuck_high: int = 0
    stuck_low: int = 0

    def __post_init__(self) -> None:
        self._require(
            "bits",
            is_integer(self.bits) and 1 <= self.bits <= _MAX_BITS,
            f"must be a whole number, 1 to {_MAX_BITS}",
        )
        self._require("rate_hz", math.isfinite(self.rate_hz) and self.rate_hz > 0, "must be positive and finite")
        for channel, (low, high) in enumerate(self.ranges_v):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise SamplerError(f"card: ranges_v of channel {channel} must be (low, high), got {(low, high)!r}")
        if len(self.noise_lsb) != len(self.ranges_v):
            raise SamplerError(f"card: noise_lsb has {len(self.noise_lsb)} channels, ranges_v has {len(self.ranges_v)}")
        self._check_channels()
        self._check_timing()
        self._check_converter()

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.ranges_v)

    @functools.cached_property
    def lsb_v(self) -> NDArray[np.float64]:
        """Volts per code of each channel: (channels,), read-only."""
        low, high = np.array(self.ranges_v).T
        lsb_v = np.asarray((high - low) / (1 << self.bits))
        lsb_v.setflags(write=False)
        return lsb_v

    @functools.cached_property
    def low_v(self) -> NDArray[np.float64]:
        """Voltage of code 0 of each channel: (channels,), read-only."""
        low_v = np.array(self.ranges_v)[:, 0]
        low_v.setflags(write=False)
        return low_v

    @property
    def true_rate_hz(self) -> float:
        """Samples per second of true time; rate_hz is by the card's own clock."""
        return self.rate_hz * (1.0 + 1e-6 * self.clock_drift_ppm)

    def per_channel(self, field: str) -> NDArray[np.float64]:
        """Values of a field by channel, zeros if it is empty: (channels,)."""
        return np.array(getattr(self, field) or (0.0,) * self.channels)

    def volts(self, codes: NDArray[np.uint16]) -> NDArray[np.float64]:
        """The voltages at the centres of the codes: (n, channels)."""
        return np.asarray(self.low_v + codes * self.lsb_v)

    @functools.cached_property
    def analogue(self) -> NDArray[np.float64]:
        """Gain, droop in V, low end in V, LSB in V, noise in LSB and offset in LSB: (6, channels)."""
        droop_v = self.droop_v_per_s / self.throughput_hz * np.arange(self.channels)
        gain, offset_lsb = 1.0 + self.per_channel("gain_error"), self.per_channel("offset_lsb")
        return np.stack((gain, droop_v, self.low_v, self.lsb_v, np.array(self.noise_lsb), offset_lsb))

    @functools.cached_property
    def levels(self) -> NDArray[np.float64] | None:
        """Transition levels from level 0 on, missing codes of zero width: (2^bits,); None for an ideal converter."""
        if not self.levels_lsb and not self.missing_codes:
            return None
        levels: NDArray[np.float64] = np.arange(1 << self.bits, dtype=np.float64) - 0.5
        if self.levels_lsb:
            levels[1:] = self.levels_lsb
        for code in sorted(self.missing_codes, reverse=True):
            levels[code] = levels[code + 1]
        return levels

    def _check_channels(self) -> None:
        for field, least in (("noise_lsb", 0.0), ("skew_s", 0.0), ("gain_error", -0.5), ("offset_lsb", -math.inf)):
            numbers = getattr(self, field)
            self._require(field, len(numbers) in (0, self.channels), f"must have {self.channels} channels or none")
            for channel, number in enumerate(numbers):
                if not (math.isfinite(number) and number >= least):
                    what = "not negative" if least == 0 else f"at least {least:g}"
                    raise SamplerError(f"card: {field} of channel {channel} must be finite and {what}, got {number!r}")

    def _check_timing(self) -> None:
        self._require("throughput_hz", self.throughput_hz > 0, "must be positive")
        if self.channels * self.rate_hz > self.throughput_hz:
            raise SamplerError(
                f"card: throughput_hz {self.throughput_hz:g} does not carry {self.channels} channels at "
                f"{self.rate_hz:g} Hz ({self.channels * self.rate_hz:g} conversions/s)"
            )
        self._require("clock_drift_ppm", abs(self.clock_drift_ppm) <= 10_000, "must be within +-10000 ppm")
        for field in ("aperture_delay_s", "aperture_jitter_s"):
            self._require(field, 0 <= getattr(self, field) <= 1e-6, "must be 0 to 1 us")
        latest_s = max(self.skew_s, default=0.0) + self.aperture_delay_s
        self._require("skew_s", latest_s <= 0.9 / self.rate_hz, "with the aperture delay exceeds 0.9 sample periods")
        self._require("acquisition", self.acquisition > 0, "must be positive")
        self._require("droop_v_per_s", math.isfinite(self.droop_v_per_s), "must be finite")
        if self.droop_v_per_s and not math.isfinite(self.throughput_hz):
            raise SamplerError("card: droop_v_per_s needs a finite throughput_hz: nothing waits otherwise")

    def _check_converter(self) -> None:
        codes = 1 << self.bits
        count = len(self.levels_lsb)
        if count not in (0, codes - 1) or not all(map(math.isfinite, self.levels_lsb)):
            raise SamplerError(f"card: levels_lsb must be {codes - 1} finite numbers or none, got {count}")
        given = all(is_integer(code) and 0 < code < codes - 1 for code in self.missing_codes)
        self._require("missing_codes", given, f"must be whole numbers, 1 to {codes - 2}")
        for field in ("stuck_high", "stuck_low"):
            mask = getattr(self, field)
            self._require(field, is_integer(mask) and 0 <= mask < codes, f"must be a mask of {self.bits} bits")
        self._require("stuck_high", not self.stuck_high & self.stuck_low, "has a bit that stuck_low has too")

    def _require(self, field: str, holds: object, what: str) -> None:
        if not holds:
            raise SamplerError(f"card: {field} {what}, got {getattr(self, field)!r}")


class NormalSource(Protocol):
    """Generator of the noise, such as a NormalStream or a np.random.Generator."""

    def standard_normal(self, size: tuple[int, ...], /) -> NDArray[np.float64]:
        """Standard normal numbers of this shape."""


class Sampler:
    """Converter of voltages to codes, with the state of one card.

    rng: generator of the noise. It gives one number per sample and channel whatever the settings, so neither block size
    nor another channel's noise changes a channel.
    """

    def __init__(self, card: Card, rng: NormalSource) -> None:
        self.card = card
        self._rng = rng
        self._held_v: NDArray[np.float64] | None = None

    def sample(
        self, volts: NDArray[np.float64], normals: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
        """Codes, uint16 (n, channels), and clipping flags, bool (n, channels), of volts (n, channels).

        Ideally code = floor((v - low) / LSB + noise + 1/2), limited to 0 .. 2^bits - 1. A sample is
        clipped if the converter's input, noise and errors included, is half an LSB or more beyond the end codes.
        normals: standard normal numbers (n, channels) for the noise, instead of those of rng.
        Raises SamplerError for a voltage that is not finite, or another shape.
        """
        return self.convert(self.seen_lsb(volts, normals))

    def seen_lsb(self, volts: NDArray[np.float64], normals: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Converter input of the next samples, noise and errors included: (n, channels), LSB above low.

        Raises SamplerError for a voltage that is not finite, or another shape.
        """
        if volts.ndim != 2:
            raise SamplerError(f"the card has {self.card.channels} channels, got volts of shape {volts.shape}")
        normals = self._rng.standard_normal(volts.shape) if normals is None else normals
        seen_lsb, self._held_v = _see(self.card, volts[None], normals, self._held_v)
        return seen_lsb.reshape(volts.shape)

    def convert(self, seen_lsb: NDArray[np.float64]) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
        """Codes and clipping flags, as from sample(), of converter inputs (n, channels) in LSB."""
        return _convert(self.card, seen_lsb)


def sample_plays(
    card: Card, volts: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Codes and clipping flags (plays, n, channels), as from the Sampler.sample() of a new card for each play.

    volts, normals: likewise. Raises SamplerError.
    """
    return _convert(card, _see(card, volts, normals, None)[0])


def _see(
    card: Card, volts: NDArray[np.float64], normals: NDArray[np.float64], held_v: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Converter inputs (plays, n, channels), and the voltages held afterwards (plays, channels).

    held_v: those held before; None at the start. Where each step is whole, the card holds none.
    """
    volts, normals = np.ascontiguousarray(volts, np.float64), np.ascontiguousarray(normals, np.float64)
    if volts.shape[-1] != card.channels:
        raise SamplerError(f"the card has {card.channels} channels, got volts of shape {volts.shape[1:]}")
    residual = math.exp(-card.acquisition)
    if residual != 0.0 and volts.shape[1]:
        held_v = (volts[:, 0] if held_v is None else held_v).copy()
    seen_lsb, held = np.empty_like(volts), None if held_v is None else held_v.ctypes.data
    converted = (card.analogue.ctypes.data, residual, volts.ctypes.data, normals.ctypes.data, held)
    if not binding.load().engine_see(*volts.shape, *converted, seen_lsb.ctypes.data):
        at = tuple(np.argwhere(~np.isfinite(volts))[0])
        raise SamplerError(f"sample {at[1]} of the block, channel {at[2]}: the voltage must be finite, got {volts[at]}")
    return seen_lsb, held_v


def _convert(card: Card, seen_lsb: NDArray[np.float64]) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Codes and clipping flags of converter inputs of any shape."""
    seen_lsb = np.ascontiguousarray(seen_lsb, np.float64)
    codes, clipped = np.empty(seen_lsb.shape, np.uint16), np.empty(seen_lsb.shape, np.bool_)
    levels = None if card.levels is None else card.levels.ctypes.data
    converter = (card.bits, levels, card.stuck_high, card.stuck_low)
    addresses = [array.ctypes.data for array in (seen_lsb, codes, clipped)]
    binding.load().engine_convert(seen_lsb.size, *converter, *addresses)
    return codes, clipped


def drawn_levels(bits: int, rng: np.random.Generator, inl_lsb: float, *, monotonic: bool = True) -> tuple[float, ...]:
    """Card.levels_lsb of a converter with random bit weights and largest INL inl_lsb.

    The error of bit b is normal and proportional to 2^(b/2), as for 2^b equal elements. INL is measured from the
    straight line through the ends. With monotonic, a major carry that would step back holds the level.
    """
    weights_lsb = rng.standard_normal(bits) * 2.0 ** (0.5 * np.arange(bits))
    codes = np.arange(1 << bits)
    errors = ((codes[:, None] >> np.arange(bits)) & 1).astype(np.float64) @ weights_lsb
    line = errors[1] + (errors[-1] - errors[1]) * (codes - 1) / max(codes[-1] - 1, 1)
    inl = (errors - line)[1:]
    largest = float(np.abs(inl).max())
    levels = codes[1:] - 0.5 + (inl * (inl_lsb / largest) if largest > 0 else 0.0)
    return tuple(np.maximum.accumulate(levels).tolist() if monotonic else levels.tolist())


_DT2821 = Card(
    throughput_hz=100e3,
    noise_lsb=(0.3,) * 4,
    aperture_delay_s=50e-9,
    aperture_jitter_s=1e-9,
    acquisition=12.0,
    droop_v_per_s=0.5,
    gain_error=(2e-4, -1e-4, 1e-4, -2e-4),
    offset_lsb=(0.3, -0.4, 0.2, -0.2),
    levels_lsb=drawn_levels(12, np.random.default_rng(2821), inl_lsb=0.5),
)

CARDS: Mapping[str, Card] = MappingProxyType(
    {
        "ideal": Card(),
        "dt2821": _DT2821,
        "skewed": Card(throughput_hz=100e3, skew_s=(0.0, 10e-6, 20e-6, 30e-6)),
    }
)
"""Cards by name. dt2821: class of the thesis's card, four simultaneous sample-and-holds on one 100 kHz converter;
skewed: the same converter without them, so each channel is one conversion later than the one before."""
