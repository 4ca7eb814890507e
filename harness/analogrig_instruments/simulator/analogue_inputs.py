"""Inputs of the simulated instrument: from the voltages at its connectors to the codes of a record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.config import check_range
from analogrig_emulator import Card, Sampler
from analogrig_instruments.simulator.computer import WiredComputer

BITS = 14
RANGES_V = {"LV": 1.0, "HV": 20.0}
"""Full scale, plus and minus, by the position of an input's switch."""
LEAST_OVERSAMPLING, MOST_OVERSAMPLING = 8, 40
"""Points in time within a sample, over which the instrument averages."""
_ON_POINT = 1e-3
"""Distance from a point, in points, below which an instant counts as that of the point."""

MOST_SKEW_S = 1e-3
MOST_INPUT_V = 100.0
MOST_GAIN_ERROR = 0.5
CHANNELS_N = 2

Volts = NDArray[np.float64]
Codes = NDArray[np.int16]


@dataclass(frozen=True)
class InputFaults:
    """Known faults of inputs, each for IN1 and IN2; none by default."""

    noise_v: tuple[float, float] = (0.0, 0.0)
    """rms before quantisation."""
    gain_error: tuple[float, float] = (0.0, 0.0)
    """Relative gain error."""
    offset_v: tuple[float, float] = (0.0, 0.0)
    reach: tuple[float, float] = (0.0, 0.0)
    """Relative excess of the converter's range over that of the switch. The volts are right, so that the ends of the
    converter are not those of the range."""
    skew_s: float = 0.0
    """Delay of the samples of IN2 after those of IN1."""

    def __post_init__(self) -> None:
        check_range(self, "noise_v", 0.0, MOST_INPUT_V)
        check_range(self, "gain_error", -MOST_GAIN_ERROR, MOST_GAIN_ERROR)
        check_range(self, "offset_v", -MOST_INPUT_V, MOST_INPUT_V)
        check_range(self, "reach", -MOST_GAIN_ERROR, MOST_GAIN_ERROR)
        check_range(self, "skew_s", -MOST_SKEW_S, MOST_SKEW_S)


class Inputs:
    """Samplers and converters of both channels of a computer."""

    def __init__(self, computer: WiredComputer, faults: InputFaults, rng: np.random.Generator) -> None:
        """``rng`` draws the noise."""
        self._computer = computer
        self._faults = faults
        self._rng = rng
        self._oversampling = LEAST_OVERSAMPLING
        self._delay_n = 0.0
        self._ahead: Volts = np.empty((0, CHANNELS_N))
        """Points of the next samples that are already taken: the later channel needs them early."""

    def set_rate(self, sample_rate_hz: float) -> None:
        """Set the samples per second; the computer restarts from rest.

        :raises EmulatorError: the generator is too fast for the rate; then nothing changes.
        """
        oversampling = _choose_oversampling(self._faults, sample_rate_hz)
        self._computer.set_rate(oversampling * sample_rate_hz)
        self._oversampling = oversampling
        self._delay_n = abs(self._faults.skew_s) * sample_rate_hz * oversampling
        self.forget()

    def samples_to_period(self) -> int | None:
        """Number of whole samples until the generator begins a period; None if it is silent."""
        points = self._computer.points_to_period()
        return None if points is None else (points + len(self._ahead)) // self._oversampling

    def pause(self, duration_s: float) -> None:
        """Let machine time pass without a sample."""
        self._computer.run(round(duration_s * self._computer.rate_hz))
        self.forget()

    def forget(self) -> None:
        """Discard points that were taken ahead."""
        self._ahead = self._ahead[:0]

    def sample(self, count: int, *, averages: bool) -> Volts:
        """The next samples, (count, 2): each is the mean of its points, or the first of them.

        The later channel is interpolated between two points.
        """
        own = count * self._oversampling
        missing = own + math.ceil(self._delay_n) - len(self._ahead)
        taken = np.concatenate((self._ahead, self._computer.run(missing))) if count else self._ahead
        points, self._ahead = taken[:own].copy(), taken[own:]
        if self._delay_n and count:
            later = 1 if self._faults.skew_s > 0.0 else 0
            points[:, later] = np.interp(np.arange(own) + self._delay_n, np.arange(len(taken)), taken[:, later])
        by_sample = points.reshape(count, self._oversampling, CHANNELS_N)
        return np.asarray(by_sample.mean(axis=1) if averages else by_sample[:, 0])

    def codes(self, volts: Volts, switches: Sequence[str]) -> Codes:
        """Codes of samples, (n, 2), 0 for 0 V. ``switches``: the range of each channel."""
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


def _choose_oversampling(faults: InputFaults, sample_rate_hz: float) -> int:
    """Number of points in a sample at which the later channel's instant is that of a point, or else close to one."""
    part = abs(faults.skew_s) * sample_rate_hz
    counts = range(LEAST_OVERSAMPLING, MOST_OVERSAMPLING + 1)
    return next((n for n in counts if abs(part * n - round(part * n)) < _ON_POINT), MOST_OVERSAMPLING)
