"""The two inputs of an instrument: from what its leads show to the codes of a record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.sampler import Card, Sampler

BITS = 14
RANGES_V = {"LV": 1.0, "HV": 20.0}
"""By the position of an input's switch: it takes plus and minus this."""
LOOKS_PER_SAMPLE = 8
"""So often the leads are looked at while the instrument averages over one of its samples."""

MOST_SKEW_S = 1e-3
MOST_INPUT_V = 100.0
MOST_GAIN_ERROR = 0.5
CHANNELS_N = 2

Volts = NDArray[np.float64]
Codes = NDArray[np.int16]


@dataclass(frozen=True)
class InputFaults:
    """What inputs are known for; none by default."""

    noise_v: tuple[float, float] = (0.0, 0.0)
    """rms, on IN1 and IN2, before quantisation."""
    gain_error: tuple[float, float] = (0.0, 0.0)
    """A fraction."""
    offset_v: tuple[float, float] = (0.0, 0.0)
    skew_s: float = 0.0
    """By so much IN2 is taken later than IN1; earlier, if it is negative."""

    def __post_init__(self) -> None:
        for noise_v in self.noise_v:
            if not 0.0 <= noise_v <= MOST_INPUT_V:
                raise ValueError(f"noise_v must be 0 to {MOST_INPUT_V:g}, not {noise_v:g}")
        for gain_error in self.gain_error:
            if not abs(gain_error) <= MOST_GAIN_ERROR:
                raise ValueError(f"gain_error must be within +-{MOST_GAIN_ERROR:g}, not {gain_error:g}")
        for offset_v in self.offset_v:
            if not abs(offset_v) <= MOST_INPUT_V:
                raise ValueError(f"offset_v must be within +-{MOST_INPUT_V:g}, not {offset_v:g}")
        if not abs(self.skew_s) <= MOST_SKEW_S:
            raise ValueError(f"skew_s must be within +-{MOST_SKEW_S:g}, not {self.skew_s:g}")


class Inputs:
    """Samplers and converters of both channels."""

    def __init__(self, faults: InputFaults, rng: np.random.Generator) -> None:
        """``rng`` gives the noise."""
        self._faults = faults
        self._rng = rng
        self._before: Volts = np.empty((0, CHANNELS_N))

    def forget(self) -> None:
        """What was seen before has nothing to do with what comes."""
        self._before = self._before[:0]

    def samples(self, looks: Volts, rate_hz: float, *, averages: bool) -> Volts:
        """Consecutive looks, ``rate_hz`` of them a second and (8 n, 2), to samples: (n, 2).

        A sample is the mean of its looks, or the first of them. A skew that is no multiple of a look's period is taken
        on the chord between two looks.
        """
        if not len(looks):
            return looks
        by_sample = self._skewed(looks, rate_hz).reshape(-1, LOOKS_PER_SAMPLE, CHANNELS_N)
        return np.asarray(by_sample.mean(axis=1) if averages else by_sample[:, 0])

    def _skewed(self, looks: Volts, rate_hz: float) -> Volts:
        skew = self._faults.skew_s * rate_hz
        channel, late = (1, skew) if skew > 0.0 else (0, -skew)
        kept = math.ceil(late)
        before = self._before if len(self._before) == kept else np.repeat(looks[:1], kept, axis=0)
        seen = np.concatenate((before, looks))
        self._before = seen[len(seen) - kept :]
        skewed = looks.copy()
        skewed[:, channel] = np.interp(np.arange(len(looks)) + kept - late, np.arange(len(seen)), seen[:, channel])
        return skewed

    def codes(self, volts: Volts, switches: Sequence[str]) -> Codes:
        """What the converters make of samples: (n, 2), 0 for 0 V. ``switches``: the range of each channel."""
        lsbs_v = np.array([lsb_v(switch) for switch in switches])
        card = Card(
            bits=BITS,
            ranges_v=tuple((-RANGES_V[switch], RANGES_V[switch]) for switch in switches),
            noise_lsb=tuple((self._faults.noise_v / lsbs_v).tolist()),
            gain_error=self._faults.gain_error,
            offset_lsb=tuple((self._faults.offset_v / lsbs_v).tolist()),
        )
        codes, _ = Sampler(card, self._rng).sample(volts)
        return (codes.astype(np.int32) - (1 << (BITS - 1))).astype(np.int16)


def lsb_v(switch: str) -> float:
    """Volts per code in a range."""
    return 2.0 * RANGES_V[switch] / (1 << BITS)
