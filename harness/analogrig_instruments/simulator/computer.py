"""Analogue computer of the simulator, with its generator, pots, and two leads to the instrument.

    generator -> stage -> input of the computer        its input and output -> stages -> IN1, IN2 of the instrument

Time is machine time, which passes only when the instrument runs the computer. A slow client gets the same records.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from analogrig.config import check_range
from analogrig.run import INPUT, OUTPUT
from analogrig_emulator import SOURCE, TICKS_PER_SAMPLE, Edges, Excitation, Mode, SuspensionComputer
from analogrig_instruments.instrument import DialChange

MEASURED_AT = (INPUT, OUTPUT)

FIRST_RATE_HZ = 160e3
CHUNK_N = 1 << 16
"""Points that are run at a time: the machine returns four channels, of which two are kept."""
MOST_GAIN, MOST_STAGE_V = 1e3, 1e3
_JUST_STARTED = 1e-9
"""Periods after an edge in which the generator still counts as being at it."""


@dataclass(frozen=True)
class Amplifier:
    """Amplifier between instrument and computer: out = gain in + offset_v, within limits_v."""

    gain: float = 1.0
    """Negative: the polarity is inverted."""
    offset_v: float = 0.0
    limits_v: tuple[float, float] = (-MOST_STAGE_V, MOST_STAGE_V)

    def __post_init__(self) -> None:
        check_range(self, "gain", -MOST_GAIN, MOST_GAIN)
        check_range(self, "offset_v", -MOST_STAGE_V, MOST_STAGE_V)
        check_range(self, "limits_v", -MOST_STAGE_V, MOST_STAGE_V)
        if self.limits_v[0] >= self.limits_v[1]:
            raise ValueError(f"limits_v must be (low, high), not ({self.limits_v[0]:g}, {self.limits_v[1]:g})")

    def output_v(self, input_v: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.clip(self.gain * input_v + self.offset_v, *self.limits_v)


@dataclass(frozen=True)
class Booster(Amplifier):
    """Stage behind the generator, which raises its +-1 V to the computer's +-10 V."""

    gain: float = 10.0


@dataclass(frozen=True)
class Wiring:
    """Table ``[instrument.wiring]``: the leads between instrument and computer."""

    generator: Booster = field(default_factory=Booster)
    """Stage to the input of the computer."""
    force: Amplifier = field(default_factory=Amplifier)
    """Stage to IN1."""
    displacement: Amplifier = field(default_factory=Amplifier)
    """Stage to IN2."""
    swapped: bool = False
    """True: the force goes to IN2, the displacement to IN1."""


class WiredComputer:
    """Computer in operation, from rest; its channels are observed at ``rate_hz`` points per second."""

    def __init__(
        self, make: Callable[[float], SuspensionComputer], wiring: Wiring, rate_hz: float = FIRST_RATE_HZ
    ) -> None:
        """``make`` returns the machine for a rate, with its pots set.

        :raises EmulatorError: it fails.
        """
        self._make = make
        self._wiring = wiring
        self._computer = _start(make(rate_hz))
        self._waveform: Excitation | None = None
        self._started_tick = 0
        self._due: list[tuple[int, DialChange]] = []
        self.rate_hz = rate_hz

    def set_rate(self, rate_hz: float) -> None:
        """Restart the computer from rest at another rate; pots, generator and schedule continue.

        :raises EmulatorError: the generator is too fast for the rate; then nothing changes.
        """
        waveform = None if self._waveform is None else replace(self._waveform, phase=self._periods % 1.0)
        _check(waveform, rate_hz)
        if rate_hz == self.rate_hz:
            return
        left = [change._replace(delay_s=(tick - self._now_tick) * self._tick_s) for tick, change in self._due]
        computer = self._make(rate_hz)
        computer.machine.turn(self.dials)
        self._computer = _start(computer)
        self.rate_hz = rate_hz
        self._waveform, self._started_tick = waveform, 0
        self.schedule(left)

    # ---- pots

    @property
    def dials(self) -> dict[str, float]:
        return self._computer.dials

    def turn(self, pot: str, dial: float) -> None:
        """Set a pot at once.

        :raises EmulatorError: the pot does not exist, or cannot stand there.
        """
        self._computer.machine.turn({pot: dial})

    def schedule(self, changes: Iterable[DialChange]) -> None:
        """Replace the scheduled changes; their delays count from now."""
        ticks = [(self._now_tick + round(change.delay_s / self._tick_s), change) for change in changes]
        self._due = sorted(ticks, key=lambda due: due[0])

    # ---- generator

    def generate(self, waveform: Excitation) -> None:
        """Start a waveform, in volts at the generator's output.

        :raises EmulatorError: it is too fast for the rate; then the generator continues as before.
        """
        _check(waveform, self.rate_hz)
        self._waveform, self._started_tick = waveform, self._now_tick

    def silence(self) -> None:
        """Set the generator to 0 V."""
        self._waveform = None

    @property
    def generates(self) -> bool:
        return self._waveform is not None

    def points_to_period(self) -> int | None:
        """Points until the generator begins a period, 0 if it is at one; None if it is silent."""
        if self._waveform is None:
            return None
        periods = self._periods
        left_s = (math.ceil(periods - _JUST_STARTED) - periods) / self._waveform.true_frequency_hz
        return max(round(left_s * self.rate_hz), 0)

    @property
    def _periods(self) -> float:
        """Phase of the generator in periods, counted from the period in which it was started."""
        if self._waveform is None:
            return 0.0
        since_s = (self._now_tick - self._started_tick) * self._tick_s
        return since_s * self._waveform.true_frequency_hz + self._waveform.phase

    # ---- time

    def run(self, count: int) -> NDArray[np.float64]:
        """Run for ``count`` points. Return the volts at the instrument's inputs, (count, 2).

        :raises EmulatorError: the machine cannot be played.
        """
        stop, parts = self._recorded + count, [np.empty((0, len(MEASURED_AT)))]
        while self._recorded < stop:
            until = min(stop, self._recorded + CHUNK_N)
            until = min(until, self._due[0][0] // TICKS_PER_SAMPLE + 1) if self._due else until
            if until > self._recorded:
                parts.append(self._play(until - self._recorded))
            while self._due and self._due[0][0] < self._now_tick:
                change = self._due.pop(0)[1]
                self.turn(change.pot, change.dial)
        force_v, displacement_v = np.concatenate(parts).T
        leads = [self._wiring.force.output_v(force_v), self._wiring.displacement.output_v(displacement_v)]
        return np.stack(leads[::-1] if self._wiring.swapped else leads, axis=1)

    @property
    def _recorded(self) -> int:
        return self._computer.machine.recorded

    @property
    def _now_tick(self) -> int:
        """Instant of the next point: nothing happens before it."""
        return self._recorded * TICKS_PER_SAMPLE

    @property
    def _tick_s(self) -> float:
        return 1.0 / (self.rate_hz * TICKS_PER_SAMPLE)

    def _play(self, count: int) -> NDArray[np.float64]:
        edges = {SOURCE: self._edges(*self._computer.machine.window(count))}
        volts = self._computer.machine.run(count, edges) * self._computer.program.channel_signs
        return np.asarray(volts[:, MEASURED_AT])

    def _edges(self, start: int, stop: int) -> Edges:
        """Edges at the force input between two ticks; a level that differs from the last one begins at ``start``."""
        if self._waveform is None:
            ticks, levels_v = np.array([start]), np.zeros(1)
        else:
            since, until = (max(tick - self._started_tick, 0) for tick in (start, stop))
            own = self._waveform.edges(since, until, self.rate_hz)
            ticks, levels_v = own.ticks + self._started_tick, own.levels_v
        return Edges(ticks, self._wiring.generator.output_v(levels_v))


def _start(computer: SuspensionComputer) -> SuspensionComputer:
    """Switch a computer to operation, from rest. Return it."""
    computer.machine.restart(Mode.OPERATE)
    return computer


def _check(waveform: Excitation | None, rate_hz: float) -> None:
    """:raises EmulatorError: the waveform is too fast for the rate."""
    if waveform is not None:
        waveform.edges(0, 1, rate_hz)
