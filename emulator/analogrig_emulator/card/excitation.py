"""Signal generator: a two-level waveform with exact edge instants, in ticks of the engine from sample 0."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine import library
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, EdgeRows, Edges
from analogrig_emulator.errors import ExcitationError

_MOST_TICKS = 2.0**53
"""Whole numbers of ticks up to here are exact in float64."""

SHAPES = ("square", "pulse", "prbs")
CLOCKS = ("card", "free")

_TAPS = {
    2: (2, 1),
    3: (3, 2),
    4: (4, 3),
    5: (5, 3),
    6: (6, 5),
    7: (7, 6),
    8: (8, 6, 5, 4),
    9: (9, 5),
    10: (10, 7),
    11: (11, 9),
    12: (12, 6, 4, 1),
    13: (13, 4, 3, 1),
    14: (14, 5, 3, 1),
    15: (15, 14),
    16: (16, 15, 13, 4),
    17: (17, 14),
    18: (18, 11),
    19: (19, 6, 2, 1),
    20: (20, 17),
}
"""Feedback taps of maximal-length shift registers (Xilinx XAPP 052, table 3)."""


@dataclass(frozen=True)
class Excitation:
    """Generator that switches between low_v and high_v, and is switched on at tick 0.

    shape: "square" and "pulse" are high for the first `duty` of each period (a square has duty 0.5); "prbs" takes a
    level for each period from a maximal-length sequence of register_length bits that starts at seed.
    frequency_hz: periods (bits, for prbs) per second of machine time.
    phase: position within the period at tick 0, in periods, 0 <= phase < 1.
    clock: "card": the generator runs on the card's clock, and an edge comes at the first sample instant at or after its
    ideal instant; "free": it has a clock of its own, edges come at any instant, and it runs drift_ppm fast (slow when
    negative).

    Raises ExcitationError naming the field.
    """

    shape: str = "square"
    low_v: float = 0.0
    high_v: float = 10.0
    frequency_hz: float = 200.0
    phase: float = 0.0
    duty: float = 0.5
    clock: str = "card"
    drift_ppm: float = 0.0
    register_length: int = 9
    seed: int = 0

    def __post_init__(self) -> None:
        self._require("shape", self.shape in SHAPES, f"must be one of {', '.join(SHAPES)}")
        self._require("clock", self.clock in CLOCKS, f"must be one of {', '.join(CLOCKS)}")
        self._require("low_v", math.isfinite(self.low_v), "must be finite")
        self._require(
            "high_v", math.isfinite(self.high_v) and self.high_v >= self.low_v, "must be finite and not below low_v"
        )
        self._require("frequency_hz", 1e-6 <= self.frequency_hz <= 1e12, "must be 1e-6 to 1e12")
        self._require("phase", 0 <= self.phase < 1, "must be at least 0 and less than 1 period")
        self._require("duty", 0 < self.duty < 1, "must be between 0 and 1, exclusive")
        self._require("duty", self.shape == "pulse" or self.duty == 0.5, "is for the shape pulse")
        self._require("drift_ppm", abs(self.drift_ppm) <= 10_000, "must be within +-10000 ppm")
        self._require(
            "drift_ppm",
            self.clock == "free" or self.drift_ppm == 0,
            "is for the clock free: the card's clock is the reference",
        )
        self._require("register_length", self.register_length in _TAPS, f"must be {min(_TAPS)} to {max(_TAPS)}")
        self._require("seed", isinstance(self.seed, int), "must be an integer")
        self._require("seed", 0 <= self.seed < 2**63, "must be 0 to 2^63 - 1")

    @property
    def true_frequency_hz(self) -> float:
        """Frequency with the drift of the generator's clock."""
        return self.frequency_hz * (1.0 + 1e-6 * self.drift_ppm)

    def period_ticks(self, sample_rate_hz: float) -> float:
        """Ticks per period (bit, for prbs). Raises ExcitationError like edges()."""
        if self.frequency_hz > 0.5 * sample_rate_hz:
            raise ExcitationError(
                f"excitation: frequency_hz {self.frequency_hz!r} exceeds half the sample rate of {sample_rate_hz!r} Hz"
            )
        period = TICKS_PER_SAMPLE * sample_rate_hz / self.true_frequency_hz
        if not period <= _MOST_TICKS:
            raise ExcitationError(
                f"excitation: frequency_hz {self.frequency_hz!r} is too low at {sample_rate_hz!r} samples/s: "
                "a period has more than 2^53 ticks"
            )
        return period

    def edges(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Edges:
        """Edges at ticks start_tick <= t < stop_tick, t >= 0. The edge at tick 0 switches the generator on.

        A range cut into parts gives the same edges. Instants are exact to the tick up to tick 2^53 (29
        hours at 20 kHz).
        Raises ExcitationError for a frequency above half the sample rate, or so low that a period has more ticks.
        """
        found = self.edges_at(np.array([self.phase]), start_tick, stop_tick, sample_rate_hz)
        part = slice(int(found.counts[0]))
        return Edges(found.ticks[0, part], found.levels_v[0, part])

    def edges_at(self, phases: NDArray[np.float64], start_tick: int, stop_tick: int, sample_rate_hz: float) -> EdgeRows:
        """Edges of edges() for each of these phases (plays,). Raises ExcitationError likewise."""
        period = self.period_ticks(sample_rate_hz)
        # An edge on the card's clock may be up to a sample later than its ideal instant: begin a period early.
        first = math.floor(start_tick / period) - 1
        last = math.ceil(stop_tick / period) + 1
        if start_tick <= 0:
            first = -2
        index = np.arange(first, last + 1)
        starts = index - phases[:, None]
        if self.shape == "prbs":
            periods, levels_v = starts, self._bit_levels_v(index)
        else:
            periods = np.stack((starts, starts + self.duty), axis=-1).reshape(len(phases), -1)
            levels_v = np.tile((self.high_v, self.low_v), index.size)
        periods *= period
        levels_v = np.tile(levels_v, (len(phases), 1))
        ticks, counts = np.empty(periods.shape, np.int64), np.empty(len(phases), np.int64)
        grid = TICKS_PER_SAMPLE if self.clock == "card" else 1
        addresses = [array.ctypes.data for array in (periods, levels_v, ticks, counts)]
        library.load().engine_edges(*periods.shape, grid, max(start_tick, 0), stop_tick, *addresses)
        return EdgeRows(counts, ticks, levels_v)

    def _bit_levels_v(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """Levels of these bits."""
        bits = _sequence(self.register_length)
        return np.where(bits[(index + self.seed) % bits.size], self.high_v, self.low_v)

    def _require(self, field: str, holds: object, what: str) -> None:
        if not holds:
            raise ExcitationError(f"excitation: {field} {getattr(self, field)!r} {what}")


@functools.lru_cache(maxsize=4)
def _sequence(length: int) -> NDArray[np.bool_]:
    """One period of the maximal-length sequence from a register of ones: 2^length - 1 bits."""
    register = [1] * length
    taps = [tap - 1 for tap in _TAPS[length]]
    bits = np.empty((1 << length) - 1, np.bool_)
    for i in range(bits.size):
        bits[i] = register[-1]
        register = [sum(register[tap] for tap in taps) % 2, *register[:-1]]
    bits.setflags(write=False)
    return bits
