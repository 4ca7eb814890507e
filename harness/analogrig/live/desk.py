"""Desk: the rig of a live session, as a hand operates it.

An emulated computer is played in steps: between two blocks pots turn, relays switch and faults come and go. Any other
rig plays one record after another, and what the hand does takes effect in the next one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError
from analogrig.live.commands import Fault, Mode
from analogrig.live.faults import LABELS, ChannelFaults
from analogrig.live.knobs import Knob, knobs_of, settings_names
from analogrig.rigs.emulator import EmulatorRig, emulator_errors, is_emulated
from analogrig.rigs.rig import Performance, Rig
from analogrig.scenario import Scenario
from analogrig_emulator import Mode as Relays
from analogrig_emulator import SuspensionComputer, probes_per_sample
from analogrig_emulator.machine.patching import patches

RECORD_N = 4000
"""Samples of a record of a rig that plays records."""
CHANGE_N = 2000
"""Sample of a record after which the pots turn, if the hand has turned them."""

Lengths = Callable[[], Iterator[int]]
"""Function that yields the length of each next block when it is due."""


class Desk(Rig):
    """Rig of a session. The defaults are those of a rig that plays records."""

    is_stepped = False
    """True if pots turn between two blocks, and not between two records."""
    faults: Mapping[Fault, str] = {}
    """Faults that can be injected, with their labels."""
    amplifiers: tuple[str, ...] = ()
    """Amplifiers whose outputs are read."""
    nodes: tuple[str, ...] = ()
    """Nodes of their outputs."""

    def __init__(self, rig: Rig, scenario: Scenario, seed: int) -> None:
        """Find the limits of the rig's pots.

        :raises ConfigurationError: the rig cannot play the scenario.
        """
        self._rig = rig
        self._seed = seed
        self.performance: Performance | None = None
        """Play under way; None before the first."""
        self.scenario = dataclasses.replace(scenario, samples=RECORD_N, tweaks=(), random_phase=False)
        self.capabilities = rig.capabilities
        with emulator_errors(f"scenario {scenario.name}: "):
            self.computer = SuspensionComputer(scenario.plant.set)
        self.check(self.scenario)
        self.knobs: Mapping[str, Knob] = knobs_of(self.computer.program, self._check_settings)

    def _check_settings(self, settings: Mapping[str, float]) -> None:
        """:raises ConfigurationError, EmulatorError: the rig does not accept these settings of pots."""
        names = {setting: name for name, setting in settings_names(self.computer.program).items()}
        values: dict[str, Any] = {names[key]: value for key, value in settings.items()}
        plant = dataclasses.replace(self.scenario.plant, **values)
        self.check(dataclasses.replace(self.scenario, plant=plant))

    def check(self, scenario: Scenario) -> None:
        """:raises ConfigurationError: the rig cannot play this scenario; nothing moves."""
        self._rig.perform(scenario, self._seed)

    def description(self) -> Mapping[str, Any]:
        return self._rig.description()

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        self.performance = self._rig.perform(scenario, seed)
        return self.performance

    def probed(self, samples: int) -> NDArray[np.float64]:
        """Volts of the amplifiers in the last block, (samples, amplifiers)."""
        return np.empty((samples, 0))

    @property
    def mode(self) -> Mode:
        """Mode of the computer."""
        return "OPERATE"

    @property
    def lamps(self) -> Sequence[str]:
        """Amplifiers with a lit overload lamp."""
        return ()


class SteppedDesk(Desk):
    """Emulated computer that is operated between two blocks."""

    is_stepped = True
    faults = LABELS

    def __init__(self, rig: EmulatorRig, scenario: Scenario, seed: int, lengths: Lengths) -> None:
        """:raises ConfigurationError: the rig cannot play the scenario."""
        self._emulated = rig
        self._lengths = lengths
        self._faults: ChannelFaults | None = None
        self._probes_per_sample = probes_per_sample(rig.card)
        super().__init__(rig, scenario, seed)
        found = patches(self.computer.circuit)
        self.amplifiers = tuple(found)
        self.nodes = tuple(patch.out for patch in found.values())

    def _check_settings(self, settings: Mapping[str, float]) -> None:
        self.computer.dials_for(**settings)

    def check(self, scenario: Scenario) -> None:
        set_up = self._emulated.set_up(scenario, self._seed)
        with emulator_errors():
            set_up.excitation.period_ticks(self._emulated.card.rate_hz)

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        set_up = self._emulated.set_up(scenario, seed)
        on = set() if self._faults is None else self._faults.on
        self.computer = set_up.computer
        card = self._emulated.card
        self._faults = ChannelFaults(float(card.lsb_v[1]), card.rate_hz, np.random.default_rng(seed))
        for fault in on:
            self._faults.switch(fault, on=True)
        alter = self._faults.alter
        self.performance = self._emulated.perform_in_steps(set_up, seed, self._lengths(), self.nodes, alter)
        return self.performance

    def probed(self, samples: int) -> NDArray[np.float64]:
        return self.computer.probed[:: self._probes_per_sample][:samples]

    def turn(self, settings: Mapping[str, float], ramp_n: int) -> None:
        """Turn pots after the last sample taken.

        :raises ConfigurationError: a pot cannot show a setting; none is turned then.
        """
        with emulator_errors():
            self.computer.set(ramp_n * self._probes_per_sample, **settings)

    @property
    def is_turning(self) -> bool:
        """True while a pot turns."""
        return self.computer.machine.is_turning

    def inject(self, fault: Fault, *, on: bool) -> None:
        """Switch a fault on or off, from the next sample on."""
        if self._faults is not None:
            self._faults.switch(fault, on=on)

    @property
    def injected(self) -> set[Fault]:
        """Faults in force."""
        return set() if self._faults is None else self._faults.on

    @property
    def mode(self) -> Mode:
        return self.computer.machine.mode.value

    def switch(self, mode: Mode) -> None:
        """Switch the relays, through the modes between.

        :raises ConfigurationError: the circuit has no solution in that mode.
        """
        machine, goal = self.computer.machine, Relays(mode)
        if goal is machine.mode:
            return
        is_far = {goal, machine.mode} in ({Relays.OPERATE, Relays.POT_SET}, {Relays.HOLD, Relays.POT_SET})
        with emulator_errors():
            if is_far:
                machine.switch(Relays.INITIAL_CONDITION)
            machine.switch(goal)

    @property
    def lamps(self) -> Sequence[str]:
        return [name for name, sample in self.computer.machine.lamps.items() if sample is not None]

    def clear_lamps(self) -> None:
        """Put the overload lamps out."""
        self.computer.machine.clear_lamps()


def open_desk(rig: Rig, scenario: Scenario, seed: int, lengths: Lengths) -> Desk:
    """Desk of a rig.

    :raises ConfigurationError: the rig plays its own scenario only, or cannot play this one.
    """
    if rig.recorded is not None:
        raise ConfigurationError("a recording has no pots to turn: name an emulated or a real rig")
    return SteppedDesk(rig, scenario, seed, lengths) if is_emulated(rig) else Desk(rig, scenario, seed)
