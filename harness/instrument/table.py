"""What stands on the bench of a served emulator: generator, analogue computer, pots, and two channels to look at it.

    generator -> stage -> force input of the computer        force, displacement -> stages -> the instrument's two inputs

Time is the machine's own. It goes on when the instrument says so, and no clock on the wall has a part in it: a client
that is slow, or far away, gets the same records.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from emulator.excitation import TICKS_PER_SAMPLE, Edges, Excitation
from emulator.machine import Mode
from emulator.program import CHANNELS, SOURCE
from emulator.suspension import SuspensionComputer

INPUTS = tuple(CHANNELS.index(name) for name in ("force", "displacement"))


@dataclass(frozen=True)
class Stage:
    """What is between instrument and computer: out = gain in + offset_v."""

    gain: float = 1.0
    offset_v: float = 0.0


@dataclass(frozen=True)
class Wiring:
    """How instrument and computer are connected."""

    generator: Stage = field(default_factory=lambda: Stage(gain=10.0))
    """From the generator's output to the force input."""
    inputs: tuple[Stage, Stage] = (Stage(), Stage())
    """From force and displacement to IN1 and IN2."""


@dataclass(frozen=True)
class Turn:
    """A pot that is to be turned so long after the generator was triggered."""

    delay_s: float
    pot: str
    dial: float


class Table:
    """The computer in operation, from rest; ``rate_hz`` is how often its channels are looked at."""

    def __init__(self, computer: Callable[[float], SuspensionComputer], wiring: Wiring, rate_hz: float) -> None:
        """``computer`` makes the machine for a rate, its pots as they are set."""
        self._make = computer
        self._wiring = wiring
        self._levels: Excitation | None = None
        self._started_tick = 0
        self._due: list[tuple[int, Turn]] = []
        self.look_at(rate_hz)

    def look_at(self, rate_hz: float) -> None:
        """Another rate: the machine begins anew, from rest, its pots as they stand and the generator off."""
        dials = self._computer.dials if hasattr(self, "_computer") else {}
        self._computer = self._make(rate_hz)
        self._computer.machine.turn(dials)
        self._computer.machine.restart(Mode.OPERATE)
        self._levels, self._due = None, []
        self._level_v = 0.0
        self.rate_hz = rate_hz

    # ---- pots

    @property
    def dials(self) -> dict[str, float]:
        return self._computer.dials

    def turn(self, pot: str, dial: float) -> None:
        """At once."""
        self._computer.machine.turn({pot: dial})

    # ---- generator

    def generate(self, waveform: Excitation, turns: list[Turn]) -> None:
        """From this instant on the generator gives ``waveform`` (volts at its own output); the turns count from here."""
        self._levels = waveform
        self._started_tick = self._now_tick
        self._due = sorted(
            ((self._now_tick + round(turn.delay_s * self.rate_hz * TICKS_PER_SAMPLE), turn) for turn in turns),
            key=lambda due: due[0],
        )

    def silence(self) -> None:
        """From this instant on the generator gives 0 V."""
        self._levels = None

    @property
    def generates(self) -> bool:
        return self._levels is not None

    def until_edge_n(self) -> int:
        """Looks until the next rising edge of the generator; 0 if it has just been started."""
        if self._levels is None:
            return 0
        since_s = (self._now_tick - self._started_tick) / TICKS_PER_SAMPLE / self.rate_hz
        periods = since_s * self._levels.frequency_hz + self._levels.phase
        left_s = (math.ceil(periods - 1e-9) - periods) / self._levels.frequency_hz
        return round(left_s * self.rate_hz)

    # ---- time

    def look(self, count: int) -> NDArray[np.float64]:
        """The next ``count`` looks at IN1 and IN2: (count, 2) volts at the instrument."""
        parts = []
        while count:
            until = self._due[0][0] // TICKS_PER_SAMPLE + 1 - self._recorded if self._due else count
            now = max(0, min(count, until))
            if now:
                parts.append(self._play(now))
                count -= now
            while self._due and self._due[0][0] < self._recorded * TICKS_PER_SAMPLE:
                turn = self._due.pop(0)[1]
                self.turn(turn.pot, turn.dial)
        volts = np.concatenate(parts)[:, INPUTS] if parts else np.empty((0, len(INPUTS)))
        gains = [stage.gain for stage in self._wiring.inputs]
        offsets_v = [stage.offset_v for stage in self._wiring.inputs]
        return np.asarray(volts * gains + offsets_v)

    @property
    def _recorded(self) -> int:
        return self._computer.machine.recorded

    @property
    def _now_tick(self) -> int:
        """Nothing happens before the next look."""
        return self._recorded * TICKS_PER_SAMPLE

    def _play(self, count: int) -> NDArray[np.float64]:
        start, stop = self._computer.machine.window(count)
        volts = self._computer.machine.run(count, {SOURCE: self._edges(start, stop)})
        return np.asarray(volts * self._computer.program.channel_signs)

    def _edges(self, start: int, stop: int) -> Edges:
        """Of the force input; a level that differs from the last one begins with the first tick."""
        stage = self._wiring.generator
        if self._levels is None:
            ticks, levels_v = np.array([start]), np.zeros(1)
        else:
            own = self._levels.edges(max(start - self._started_tick, 0), stop - self._started_tick, self.rate_hz)
            ticks, levels_v = own.ticks + self._started_tick, own.levels_v
        levels_v = stage.gain * levels_v + stage.offset_v
        return Edges(ticks, levels_v)
