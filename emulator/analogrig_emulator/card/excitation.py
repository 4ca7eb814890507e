"""Signal generator: two-level waveforms with exact edge instants, in ticks of the engine from sample 0; smooth ones.

The level of a smooth waveform moves all the time; the engine follows it between the samples as well.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.smooth import MOST_HARMONIC, MOST_V, multisine, sine, sweep_turns
from analogrig_emulator.engine import binding
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Drive, EdgeRows, Edges
from analogrig_emulator.exceptions import ExcitationError

_MOST_TICKS = 2.0**53
"""Whole numbers of ticks up to here are exact in float64."""

STEPPED_SHAPES = ("square", "pulse", "prbs")
SMOOTH_SHAPES = ("sine", "sweep", "multisine", "recorded")
SHAPES = (*STEPPED_SHAPES, *SMOOTH_SHAPES)
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


_OWN = {"sweep": ("end_hz", "sweep_s"), "multisine": ("harmonics",), "recorded": ("samples_v",)}
"""Fields that one shape needs and no other takes."""

_MOST_RECORDED = 1_000_000
_MOST_TURNS_PER_SAMPLE = 0.25


@dataclass(frozen=True)
class Excitation:
    """Generator whose level stays between low_v and high_v, and that is switched on at tick 0.

    shape: "square" and "pulse" are high for the first `duty` of each period (a square has duty 0.5); "prbs" takes a
    level for each period from a maximal-length sequence of register_length bits that starts at seed; "sine"; "sweep" is
    a sine whose frequency moves evenly from frequency_hz to end_hz in sweep_s, and back in as much, over and over;
    "multisine" is the sum of `harmonics` of frequency_hz with one amplitude and Schroeder's phases; "recorded" plays
    samples_v, in V, one at each sample instant, band-limited between them, and holds the last one.
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
    end_hz: float | None = None
    sweep_s: float | None = None
    harmonics: tuple[int, ...] | None = None
    samples_v: tuple[float, ...] | None = None

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
        for shape, names in _OWN.items():
            for name in names:
                is_given = getattr(self, name) is not None
                self._require("shape", is_given or self.shape != shape, f"needs {name}")
                self._require(name, self.shape == shape or not is_given, f"is for the shape {shape}")
        self._check_own()

    def _check_own(self) -> None:
        """Check the fields of one smooth shape."""
        if self.end_hz is not None and self.sweep_s is not None:
            self._require("end_hz", 0 <= self.end_hz <= 1e12, "must be 0 to 1e12")
            self._require("sweep_s", 0 < self.sweep_s < math.inf, "must be positive and finite")
        if self.harmonics is not None:
            is_apart = len({*self.harmonics}) == len(self.harmonics) <= MOST_HARMONIC
            within = all(1 <= each <= MOST_HARMONIC for each in self.harmonics)
            what = f"must be different whole numbers, 1 to {MOST_HARMONIC}"
            self._require("harmonics", self.harmonics and is_apart and within, what)
        if self.samples_v is not None:
            if not 1 <= len(self.samples_v) <= _MOST_RECORDED:
                raise ExcitationError(
                    f"excitation: samples_v must hold 1 to {_MOST_RECORDED} samples, not {len(self.samples_v)}"
                )
            for i, volts in enumerate(self.samples_v):
                if not abs(volts) <= MOST_V:
                    raise ExcitationError(f"excitation: samples_v[{i}] {volts!r} must be within +-{MOST_V:g} V")
            for name in ("low_v", "high_v", "frequency_hz", "phase", "clock"):
                is_default = getattr(self, name) == type(self).__dataclass_fields__[name].default
                self._require(name, is_default, "is not for the shape recorded")

    @property
    def is_smooth(self) -> bool:
        """True if the level moves all the time: drive() gives it, and there are no edges."""
        return self.shape in SMOOTH_SHAPES

    @property
    def range_v(self) -> tuple[float, float]:
        """Levels between which the generator stays at the samples."""
        return (self.low_v, self.high_v) if self.samples_v is None else (min(self.samples_v), max(self.samples_v))

    @property
    def true_frequency_hz(self) -> float:
        """Frequency with the drift of the generator's clock."""
        return self.frequency_hz * (1.0 + 1e-6 * self.drift_ppm)

    def period_ticks(self, sample_rate_hz: float) -> float:
        """Ticks per period (bit, for prbs). Raises ExcitationError like edges()."""
        if self.is_smooth:
            raise ExcitationError(f"excitation: the shape {self.shape} has no edges")
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

    def check_rate(self, sample_rate_hz: float) -> None:
        """Raise ExcitationError if the waveform is too fast or too slow for a sample rate."""
        if not self.is_smooth:
            self.period_ticks(sample_rate_hz)
            return
        most = max(self.harmonics or (1,))
        for name, hz in (("frequency_hz", most * self.frequency_hz), ("end_hz", self.end_hz or 0.0)):
            if self.samples_v is None and hz > _MOST_TURNS_PER_SAMPLE * sample_rate_hz:
                times = f" times harmonic {most}" if most > 1 else ""
                raise ExcitationError(
                    f"excitation: {name} {getattr(self, name)!r}{times} exceeds a quarter of the sample rate of"
                    f" {sample_rate_hz!r} Hz"
                )

    def drive(self, start_tick: int, stop_tick: int, sample_rate_hz: float) -> Drive:
        """Signal of a smooth shape for the ticks start_tick <= t < stop_tick, t >= 0.

        A range cut into parts gives the same signal. Raises ExcitationError for a frequency above a quarter of the
        sample rate. At a tenth of it a sine is exact to 1e-5 of its amplitude.
        """
        self.check_rate(sample_rate_hz)
        return Drive.sampled(functools.partial(self.smooth_v, sample_rate_hz=sample_rate_hz), start_tick, stop_tick)

    def smooth_v(self, at: NDArray[np.float64], sample_rate_hz: float) -> NDArray[np.float64]:
        """Level of a smooth shape at instants in sample periods, from 0 on, in V."""
        if self.samples_v is not None:
            return self._recorded.volts(np.minimum(at, len(self.samples_v) - 1.0))
        time_s = at * ((1.0 + 1e-6 * self.drift_ppm) / sample_rate_hz)
        turns = self.frequency_hz * time_s
        if self.end_hz is not None and self.sweep_s is not None:
            turns = sweep_turns(time_s, self.frequency_hz, self.end_hz, self.sweep_s)
        turns += self.phase
        wave = sine(turns) if self.harmonics is None else multisine(turns, self.harmonics)
        return np.asarray(0.5 * (self.low_v + self.high_v) + 0.5 * (self.high_v - self.low_v) * wave)

    @functools.cached_property
    def _recorded(self) -> Drive:
        return Drive.band_limited(np.array(self.samples_v))

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
            periods = starts
            bits = _sequence(self.register_length)
            of_bits_v = np.where(bits[(index + self.seed) % bits.size], self.high_v, self.low_v)
            levels_v = np.tile(of_bits_v, (len(phases), 1))
        else:
            periods, levels_v = np.empty((2, len(phases), 2 * index.size))
            periods[:, 0::2], periods[:, 1::2] = starts, starts + self.duty
            levels_v[:, 0::2], levels_v[:, 1::2] = self.high_v, self.low_v
        periods *= period
        ticks, counts = np.empty(periods.shape, np.int64), np.empty(len(phases), np.int64)
        grid = TICKS_PER_SAMPLE if self.clock == "card" else 1
        addresses = [array.ctypes.data for array in (periods, levels_v, ticks, counts)]
        binding.load().engine_edges(*periods.shape, grid, max(start_tick, 0), stop_tick, *addresses)
        return EdgeRows(counts, ticks, levels_v)

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
