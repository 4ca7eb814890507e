"""Repeated plays that differ in amplifier offsets and excitation.

Volts and lamps equal those of SuspensionComputer.play to the bit. State spaces are computed once: for some thousand
samples that takes longer than to play them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.circuit.elements import OpAmp
from analogrig_emulator.circuit.nodal import Nodal
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.circuit.pot import PotTurn
from analogrig_emulator.engine.engine import CircuitSchedule, Engine
from analogrig_emulator.machine.program_circuit import SOURCE
from analogrig_emulator.machine.readouts import lamp_samples
from analogrig_emulator.machine.suspension import SuspensionComputer


class Repeat(NamedTuple):
    """One play: volts of the program's channels, float64 (samples, channels), and AnalogComputer.lamps."""

    volts: NDArray[np.float64]
    lamps: Mapping[str, int | None]


def is_repeatable(computer: SuspensionComputer, changes: Sequence[PotTurn]) -> bool:
    """True if RepeatedPlay accepts it: no ramps, no products, op-amps whose offsets enter only their own drives."""
    has_ramps = any(change.ramp_n for change in changes)
    has_products = bool(computer.circuit.of(Multiplier) or computer.circuit.of(Function))
    return not (has_ramps or has_products) and all(amp.model.has_state for amp in computer.circuit.of(OpAmp))


class RepeatedPlay:
    """Play of `samples` (at least 1) from rest, with the computer's present pots and changes as for its play().

    The computer does not change. Raises PotError for impossible changes, CircuitError unless is_repeatable().
    """

    def __init__(self, computer: SuspensionComputer, samples: int, changes: Sequence[PotTurn] = ()) -> None:
        turns = computer.plan(changes, samples)
        nodal, dials = Nodal(computer.circuit), dict(computer.dials)
        solved = [nodal.with_trim(dials)]
        for turn in turns:
            dials |= turn.values
            solved.append(nodal.with_trim(dials))
        systems, trim = [system for system, _ in solved], solved[0][1]
        nodes = computer.program.channel_nodes
        last_samples = [*(turn.sample for turn in turns), samples - 1]
        patience_ticks = computer.machine.lamp_delay_ticks
        self._schedule = CircuitSchedule(systems, nodes, last_samples, patience_ticks, trim.rows)
        self._engine = Engine(systems[0], nodes, computer.sample_rate_hz)
        self._kinks = systems[0].kinks
        self._program = computer.program
        self._rate_hz = computer.sample_rate_hz
        self._amplifiers = trim.amps
        self._numbers = np.array([int(name.removeprefix("U")) - 1 for name in trim.amps])
        self._apart_v = np.stack([each.apart_v for _, each in solved])
        self._gain_rate = trim.gain_rate

    def play(self, excitation: Excitation, offsets_v: NDArray[np.float64]) -> Repeat:
        """Play with the input offsets offsets_v: (amplifiers,) V from U1 on, as from drawn_offsets_v.

        Raises ExcitationError and EngineError.
        """
        volts, (lamps,) = self.play_all(excitation, np.array([excitation.phase]), offsets_v[None])
        return Repeat(volts[0], lamps)

    def play_all(
        self, excitation: Excitation, phases: NDArray[np.float64], offsets_v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], list[Mapping[str, int | None]]]:
        """Volts (plays, samples, channels) and lamps for these phases, (plays,), and offsets, (plays, amplifiers).

        Raises ExcitationError and EngineError, whichever play fails.
        """
        constants = (self._apart_v + offsets_v[:, None, self._numbers]) * self._gain_rate
        edges = excitation.edges_at(phases, 0, int(self._schedule.until_ticks[-1]) + 1, self._rate_hz)
        plays = self._engine.play_all(self._schedule, constants, {SOURCE: edges})
        volts = plays.volts
        self._program.orient(volts)
        return volts, [lamp_samples(self._amplifiers, self._kinks, ticks) for ticks in plays.overdue_ticks]
