"""The two inputs of an instrument: from what its leads show to the codes of a record."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator import Card, Sampler

BITS = 14
RANGES_V = {"LV": 1.0, "HV": 20.0}
"""By the position of an input's switch: it takes plus and minus this."""
LEAST_LOOKS, MOST_LOOKS = 8, 40
"""So often the leads are looked at while the instrument averages over one of its samples."""
_AT_A_LOOK = 1e-3
"""Looks: so close to one an instant is taken for its own."""

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
    reach: tuple[float, float] = (0.0, 0.0)
    """By which fraction a converter takes more than its switch says. The volts that it says are right, so that its ends
    are not at those of the range."""
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
        for reach in self.reach:
            if not abs(reach) <= MOST_GAIN_ERROR:
                raise ValueError(f"reach must be within +-{MOST_GAIN_ERROR:g}, not {reach:g}")
        if not abs(self.skew_s) <= MOST_SKEW_S:
            raise ValueError(f"skew_s must be within +-{MOST_SKEW_S:g}, not {self.skew_s:g}")


class Inputs:
    """Samplers and converters of both channels."""

    def __init__(self, faults: InputFaults, rng: np.random.Generator) -> None:
        """``rng`` gives the noise."""
        self._faults = faults
        self._rng = rng
        self._looks_n = LEAST_LOOKS
        self._late = 0.0
        self._ahead: Volts = np.empty((0, CHANNELS_N))

    def tune(self, looks_n: int, sample_rate_hz: float) -> None:
        """A sample is made of so many looks, and there are so many samples a second."""
        self._looks_n = looks_n
        self._late = abs(self._faults.skew_s) * sample_rate_hz * looks_n
        self.forget()

    def until(self, looks_n: int) -> int:
        """Samples until so many looks from now, whole ones."""
        return (looks_n + self.ahead_n) // self._looks_n

    @property
    def ahead_n(self) -> int:
        """Looks that have been taken and are of the samples that come: the later channel needs them before its time."""
        return len(self._ahead)

    def forget(self) -> None:
        """What has been seen has nothing to do with what comes."""
        self._ahead = self._ahead[:0]

    def samples(self, look: Callable[[int], Volts], count: int, *, averages: bool) -> Volts:
        """The next samples, (count, 2), from consecutive looks: ``look(n)`` is (n, 2).

        A sample is the mean of its looks, or the first of them. The later channel is taken on the chord between two.
        """
        own = count * self._looks_n
        lacking = own + math.ceil(self._late) - self.ahead_n
        seen = np.concatenate((self._ahead, look(lacking))) if count else self._ahead
        looks, self._ahead = seen[:own].copy(), seen[own:]
        if self._late and count:
            later = 1 if self._faults.skew_s > 0.0 else 0
            looks[:, later] = np.interp(np.arange(own) + self._late, np.arange(len(seen)), seen[:, later])
        by_sample = looks.reshape(count, self._looks_n, CHANNELS_N)
        return np.asarray(by_sample.mean(axis=1) if averages else by_sample[:, 0])

    def codes(self, volts: Volts, switches: Sequence[str]) -> Codes:
        """What the converters make of samples: (n, 2), 0 for 0 V. ``switches``: the range of each channel."""
        lsbs_v = np.array(self.lsb_v(switches))
        most_v = lsbs_v * (1 << (BITS - 1))
        card = Card(
            bits=BITS,
            ranges_v=tuple((-each_v, each_v) for each_v in most_v.tolist()),
            noise_lsb=tuple((self._faults.noise_v / lsbs_v).tolist()),
            gain_error=self._faults.gain_error,
            offset_lsb=tuple((self._faults.offset_v / lsbs_v).tolist()),
        )
        codes, _ = Sampler(card, self._rng).sample(volts)
        return (codes.astype(np.int32) - (1 << (BITS - 1))).astype(np.int16)

    def lsb_v(self, switches: Sequence[str]) -> tuple[float, float]:
        """Volts per code of each channel."""
        nominal_v = [2.0 * RANGES_V[switch] / (1 << BITS) for switch in switches]
        first_v, second_v = (each_v * (1.0 + more) for each_v, more in zip(nominal_v, self._faults.reach, strict=True))
        return first_v, second_v


def looks_per_sample(faults: InputFaults, sample_rate_hz: float) -> int:
    """So many that the later channel's instant is that of a look, if that can be; else it is close to one."""
    part = abs(faults.skew_s) * sample_rate_hz
    counts = range(LEAST_LOOKS, MOST_LOOKS + 1)
    return next((n for n in counts if abs(part * n - round(part * n)) < _AT_A_LOOK), MOST_LOOKS)
