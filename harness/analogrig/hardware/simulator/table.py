"""What stands on the table of a served emulator: generator, analogue computer, pots, and two leads to look at it.

    generator -> stage -> force input of the computer        force, displacement -> stages -> IN1, IN2 of the instrument

Time is the machine's own. It goes on when the instrument says so, and no clock on the wall has a part in it: a client
that is slow, or far away, gets the same records.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from analogrig.run import MEASURED
from analogrig_emulator import CHANNELS, SOURCE, TICKS_PER_SAMPLE, Edges, Excitation, Mode, SuspensionComputer

SEEN = tuple(CHANNELS.index(name) for name in MEASURED)

FIRST_RATE_HZ = 160e3
AT_A_TIME_N = 1 << 16
"""Looks: the machine gives four channels, of which two are kept."""
MOST_GAIN, MOST_STAGE_V = 1e3, 1e3
_JUST_STARTED = 1e-9
"""Periods: so soon after an edge the generator still stands at it."""


@dataclass(frozen=True)
class Amplifier:
    """An amplifier between instrument and computer: out = gain in + offset_v, within limits_v."""

    gain: float = 1.0
    """Below 0: its polarity is inverted."""
    offset_v: float = 0.0
    limits_v: tuple[float, float] = (-MOST_STAGE_V, MOST_STAGE_V)

    def __post_init__(self) -> None:
        if not abs(self.gain) <= MOST_GAIN:
            raise ValueError(f"gain must be within +-{MOST_GAIN:g}, not {self.gain:g}")
        if not abs(self.offset_v) <= MOST_STAGE_V:
            raise ValueError(f"offset_v must be within +-{MOST_STAGE_V:g}, not {self.offset_v:g}")
        low_v, high_v = self.limits_v
        if not -MOST_STAGE_V <= low_v < high_v <= MOST_STAGE_V:
            raise ValueError(f"limits_v must be (low, high) within +-{MOST_STAGE_V:g}, not ({low_v:g}, {high_v:g})")

    def passed(self, volts: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.clip(self.gain * volts + self.offset_v, *self.limits_v)


@dataclass(frozen=True)
class Booster(Amplifier):
    """The stage behind the generator, whose +-1 V are to become the computer's +-10 V."""

    gain: float = 10.0


@dataclass(frozen=True)
class Wiring:
    """The ``[instrument.wiring]`` table: how instrument and computer are connected."""

    generator: Booster = field(default_factory=Booster)
    """To the force input."""
    force: Amplifier = field(default_factory=Amplifier)
    """To IN1."""
    displacement: Amplifier = field(default_factory=Amplifier)
    """To IN2."""
    swapped: bool = False
    """The force comes to IN2, and the displacement to IN1."""


@dataclass(frozen=True)
class DueTurn:
    """A pot that is to be turned, so long from now."""

    delay_s: float
    pot: str
    dial: float


class Table:
    """The computer in operation, from rest; ``rate_hz`` is how often its channels are looked at."""

    def __init__(
        self, computer: Callable[[float], SuspensionComputer], wiring: Wiring, rate_hz: float = FIRST_RATE_HZ
    ) -> None:
        """``computer`` makes the machine for a rate, its pots as they are set.

        :raises EmulatorError: it cannot be made.
        """
        self._make = computer
        self._wiring = wiring
        self._computer = _switched_on(computer(rate_hz))
        self._waveform: Excitation | None = None
        self._started_tick = 0
        self._due: list[tuple[int, DueTurn]] = []
        self.rate_hz = rate_hz

    def look_at(self, rate_hz: float) -> None:
        """Another rate: the computer begins anew, from rest. Pots, generator and scheduled turns stay as they are.

        :raises EmulatorError: the generator is too fast for it; then nothing changes.
        """
        waveform = None if self._waveform is None else replace(self._waveform, phase=self._periods % 1.0)
        _check(waveform, rate_hz)
        if rate_hz == self.rate_hz:
            return
        left = [replace(turn, delay_s=(tick - self._now_tick) * self._tick_s) for tick, turn in self._due]
        computer = self._make(rate_hz)
        computer.machine.turn(self.dials)
        self._computer = _switched_on(computer)
        self.rate_hz = rate_hz
        self._waveform, self._started_tick = waveform, 0
        self.schedule(left)

    # ---- pots

    @property
    def dials(self) -> dict[str, float]:
        return self._computer.dials

    def turn(self, pot: str, dial: float) -> None:
        """At once.

        :raises EmulatorError: it cannot be turned there.
        """
        self._computer.machine.turn({pot: dial})

    def schedule(self, turns: Iterable[DueTurn]) -> None:
        """These and no others, from this instant on."""
        ticks = [(self._now_tick + round(turn.delay_s / self._tick_s), turn) for turn in turns]
        self._due = sorted(ticks, key=lambda due: due[0])

    # ---- generator

    def generate(self, waveform: Excitation) -> None:
        """From this instant on the generator gives ``waveform``: volts at its own output.

        :raises EmulatorError: it is too fast to be looked at; then it goes on as it was.
        """
        _check(waveform, self.rate_hz)
        self._waveform, self._started_tick = waveform, self._now_tick

    def silence(self) -> None:
        """From this instant on the generator gives 0 V."""
        self._waveform = None

    @property
    def generates(self) -> bool:
        return self._waveform is not None

    def until_edge_n(self) -> int | None:
        """Looks until the generator begins a period, 0 if it is just doing so; None if it is silent."""
        if self._waveform is None:
            return None
        periods = self._periods
        left_s = (math.ceil(periods - _JUST_STARTED) - periods) / _true_frequency_hz(self._waveform)
        return max(round(left_s * self.rate_hz), 0)

    @property
    def _periods(self) -> float:
        """Of the generator, since the beginning of that in which it was started."""
        if self._waveform is None:
            return 0.0
        since_s = (self._now_tick - self._started_tick) * self._tick_s
        return since_s * _true_frequency_hz(self._waveform) + self._waveform.phase

    # ---- time

    def look(self, count: int) -> NDArray[np.float64]:
        """The next ``count`` looks at the instrument's inputs, V: (count, 2).

        :raises EmulatorError: the machine cannot be played.
        """
        stop, parts = self._recorded + count, [np.empty((0, len(SEEN)))]
        while self._recorded < stop:
            until = min(stop, self._recorded + AT_A_TIME_N)
            until = min(until, self._due[0][0] // TICKS_PER_SAMPLE + 1) if self._due else until
            if until > self._recorded:
                parts.append(self._play(until - self._recorded))
            while self._due and self._due[0][0] < self._now_tick:
                turn = self._due.pop(0)[1]
                self.turn(turn.pot, turn.dial)
        force_v, displacement_v = np.concatenate(parts).T
        leads = [self._wiring.force.passed(force_v), self._wiring.displacement.passed(displacement_v)]
        return np.stack(leads[::-1] if self._wiring.swapped else leads, axis=1)

    @property
    def _recorded(self) -> int:
        return self._computer.machine.recorded

    @property
    def _now_tick(self) -> int:
        """The instant of the next look: nothing happens before it."""
        return self._recorded * TICKS_PER_SAMPLE

    @property
    def _tick_s(self) -> float:
        return 1.0 / (self.rate_hz * TICKS_PER_SAMPLE)

    def _play(self, count: int) -> NDArray[np.float64]:
        edges = {SOURCE: self._edges(*self._computer.machine.window(count))}
        volts = self._computer.machine.run(count, edges) * self._computer.program.channel_signs
        return np.asarray(volts[:, SEEN])

    def _edges(self, start: int, stop: int) -> Edges:
        """Of the force input; a level that differs from the last one begins with the first tick."""
        if self._waveform is None:
            ticks, levels_v = np.array([start]), np.zeros(1)
        else:
            own = self._waveform.edges(
                max(start - self._started_tick, 0), max(stop - self._started_tick, 0), self.rate_hz
            )
            ticks, levels_v = own.ticks + self._started_tick, own.levels_v
        return Edges(ticks, self._wiring.generator.passed(levels_v))


def _switched_on(computer: SuspensionComputer) -> SuspensionComputer:
    computer.machine.restart(Mode.OPERATE)
    return computer


def _check(waveform: Excitation | None, rate_hz: float) -> None:
    """:raises EmulatorError: it cannot be looked at so rarely."""
    if waveform is not None:
        waveform.edges(0, 1, rate_hz)


def _true_frequency_hz(waveform: Excitation) -> float:
    return waveform.frequency_hz * (1.0 + 1e-6 * waveform.drift_ppm)
