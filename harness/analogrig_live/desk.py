"""Desk: the rig of a live session, as a hand operates it.

An emulated computer is played in steps: between two blocks pots turn, relays switch and faults come and go. Any other
rig plays one record after another, and what the hand does takes effect in the next one.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, PotChange, Rig, Scenario
from analogrig.judging import Machine
from analogrig.rigs import Block, EmulatorRig, Performance, emulator_errors, is_emulated
from analogrig.run import OUTPUT
from analogrig_emulator import Mode as Relays
from analogrig_emulator import Moment, SuspensionComputer, probes_per_sample
from analogrig_emulator.machine.patch_panel import patches
from analogrig_live.commands import Fault, Mode
from analogrig_live.faults import ChannelFaults, labels
from analogrig_live.knobs import Knob, knobs_of
from analogrig_live.stepped_play import perform_in_steps
from analogrig_live.take import MOST_KEPT_CHANGES

RECORD_N = 4000
"""Samples of a record of a rig that plays records."""
CHANGE_N = 2000
"""Sample of a record after which the pots turn, if the hand has turned them."""

Lengths = Callable[[], Iterator[int]]
"""Function that yields the length of each next block when it is due; 0: the device answers all blocks before."""


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
    moments: Mapping[int, Moment] = {}
    """State of the machine at the last turns of pots, by sample."""
    performance: Performance
    """Play under way; before the first, one that is not taken."""

    def __init__(self, rig: Rig, scenario: Scenario, seed: int) -> None:
        self._rig = rig
        self._seed = seed
        self.scenario = dataclasses.replace(scenario, samples=RECORD_N, changes=(), random_phase=False)
        self.capabilities = rig.capabilities
        self.program = scenario.program
        self.knobs: Mapping[str, Knob] = knobs_of(self.scenario.plant)

    def check(self, scenario: Scenario) -> None:
        """:raises ConfigurationError: the rig cannot play this scenario; nothing moves."""
        self._rig.perform(scenario, self._seed)

    def check_turn(self, values: Mapping[str, float], turned: Mapping[str, float]) -> None:
        """Check a turn of pots from some values.

        :raises ConfigurationError: the rig's pots cannot turn so, or cannot show these values.
        """
        scenario = self.scenario.with_plant(self.scenario.plant.changed(values))
        self.check(dataclasses.replace(scenario, changes=(PotChange(CHANGE_N, turned),)))

    def description(self) -> Mapping[str, Any]:
        return self._rig.description()

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        self.performance = self._rig.perform(scenario, seed)
        return self.performance

    def probed(self, samples: int) -> NDArray[np.float64]:
        """Volts of the amplifiers in the next answered block, (samples, amplifiers); to be called once for each."""
        return np.empty((samples, 0))

    @property
    def mode(self) -> Mode:
        """Mode of the computer."""
        return "OPERATE"

    @property
    def lamps(self) -> Sequence[str]:
        """Amplifiers with a lit overload lamp."""
        return ()

    @property
    def is_turning(self) -> bool:
        """True while a pot turns."""
        return False

    @property
    def injected(self) -> set[Fault]:
        """Faults in force."""
        return set()

    @property
    def computer(self) -> SuspensionComputer | None:
        """Emulated computer; None: a rig that plays records."""
        return None

    def machine(self, samples: int, lsb_v: float) -> Machine | None:  # noqa: ARG002
        """Machine of the play as a model of its plant, for so many samples; None: unknown.

        :raises ConfigurationError: it cannot be.
        """
        return None

    def turn(self, values: Mapping[str, float], names: Iterable[str], sample: int, ramp_n: int) -> None:
        """Turn pots of a stepped rig after the last sample taken, to values of which these parameters have changed.

        :raises ConfigurationError: a pot cannot show a value; none is turned then.
        """
        raise NotImplementedError

    def inject(self, fault: Fault, *, on: bool) -> None:
        """Switch one of ``faults`` on or off, from the next sample on."""
        raise NotImplementedError

    def switch(self, mode: Mode) -> None:
        """Switch the relays of a stepped rig, through the modes between.

        :raises ConfigurationError: the circuit has no solution in that mode.
        """
        raise NotImplementedError

    def clear_lamps(self) -> None:
        """Put the overload lamps out."""


class SteppedDesk(Desk):
    """Emulated computer that is operated between two blocks."""

    is_stepped = True

    def __init__(self, rig: EmulatorRig, scenario: Scenario, seed: int, lengths: Lengths) -> None:
        """:raises ConfigurationError: the rig cannot be set up for the scenario."""
        self._emulated = rig
        self._lengths = lengths
        self._faults: ChannelFaults | None = None
        self._card = rig.card(scenario.program)
        super().__init__(rig, scenario, seed)
        self._probes_per_sample = probes_per_sample(self._card)
        self._playing = self.scenario
        self._probed: deque[NDArray[np.float64]] = deque()
        """Volts of the amplifiers in each block that is not answered."""
        self._length = 0
        """Length of the block that is due."""
        self.moments: dict[int, Moment] = {}
        self.faults = labels(scenario.program.channels[OUTPUT].replace("_", " "))
        self._computer = rig.set_up(self.scenario, seed).computer
        found = patches(self._computer.circuit)
        self.amplifiers = tuple(found)
        self.nodes = tuple(patch.out for patch in found.values())

    def check(self, scenario: Scenario) -> None:
        set_up = self._emulated.set_up(scenario, self._seed)
        with emulator_errors():
            set_up.excitation.check_rate(self._card.rate_hz)

    def check_turn(self, values: Mapping[str, float], turned: Mapping[str, float]) -> None:
        plant = self.scenario.plant.changed({**values, **turned})
        with emulator_errors():
            self._computer.dials_for(**self._emulated.pot_settings(plant, plant.parameters()))

    def perform(self, scenario: Scenario, seed: int) -> Performance:
        set_up = self._emulated.set_up(scenario, seed)
        on = self.injected
        self._playing, self._computer, self.moments = scenario, set_up.computer, {}
        self._faults = ChannelFaults(float(self._card.lsb_v[OUTPUT]), self._card.rate_hz, np.random.default_rng(seed))
        for fault in on:
            self._faults.switch(fault, on=True)
        performance = perform_in_steps(
            self._emulated, set_up, self.program, seed, iter(lambda: self._length, 0), self.nodes, self._faults.alter
        )
        self._probed.clear()
        self.performance = dataclasses.replace(performance, blocks=self._play(performance.blocks))
        return self.performance

    @property
    def computer(self) -> SuspensionComputer:
        return self._computer

    def machine(self, samples: int, lsb_v: float) -> Machine:
        with emulator_errors():
            return Machine(self._emulated.courses(self._playing, self._seed, samples), lsb_v)

    def probed(self, samples: int) -> NDArray[np.float64]:
        return self._probed.popleft()[:samples]

    def _play(self, blocks: Iterator[Block]) -> Iterator[Block]:
        """Play blocks as they are due, and keep the volts of the amplifiers until each is answered."""
        end, nothing = 0, np.empty((0, len(self.program.channels)))
        for length in self._lengths():
            if length:
                self._length = length
                for block in islice(blocks, 1):
                    self._probed.append(self._computer.probed[:: self._probes_per_sample].copy())
                    end = block.first + len(block.codes)
                    yield block
            else:
                yield Block(end, nothing, nothing.astype(np.uint16), nothing.astype(np.bool_))

    def turn(self, values: Mapping[str, float], names: Iterable[str], sample: int, ramp_n: int) -> None:
        with emulator_errors():
            settings = self._emulated.pot_settings(self.scenario.plant.changed(values), names)
            self._computer.set(ramp_n * self._probes_per_sample, **settings)
        if self.mode == "OPERATE":
            self.moments[sample] = Moment(sample, self._computer.machine.state)
        if len(self.moments) > MOST_KEPT_CHANGES:
            del self.moments[min(self.moments)]

    @property
    def is_turning(self) -> bool:
        return self._computer.machine.is_turning

    def inject(self, fault: Fault, *, on: bool) -> None:
        if self._faults is not None:
            self._faults.switch(fault, on=on)

    @property
    def injected(self) -> set[Fault]:
        return set() if self._faults is None else self._faults.on

    @property
    def mode(self) -> Mode:
        return self._computer.machine.mode.value

    def switch(self, mode: Mode) -> None:
        machine, goal = self._computer.machine, Relays(mode)
        if goal is machine.mode:
            return
        self.moments.clear()  # no course passes through another mode
        is_far = {goal, machine.mode} in ({Relays.OPERATE, Relays.POT_SET}, {Relays.HOLD, Relays.POT_SET})
        with emulator_errors():
            if is_far:
                machine.switch(Relays.INITIAL_CONDITION)
            machine.switch(goal)

    @property
    def lamps(self) -> Sequence[str]:
        return [name for name, sample in self._computer.machine.lamps.items() if sample is not None]

    def clear_lamps(self) -> None:
        self._computer.machine.clear_lamps()


def open_desk(rig: Rig, scenario: Scenario, seed: int, lengths: Lengths) -> Desk:
    """Desk of a rig.

    :raises ConfigurationError: the rig plays its own scenario only, or cannot play this one.
    """
    if rig.recorded is not None:
        raise ConfigurationError("a recording has no pots to turn: name an emulated or a real rig")
    desk = SteppedDesk(rig, scenario, seed, lengths) if is_emulated(rig) else Desk(rig, scenario, seed)
    desk.perform(desk.scenario, seed)
    return desk
