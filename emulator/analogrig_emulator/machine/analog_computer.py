"""Operation of the analogue computer: a circuit in its modes, with its pots, switches and overload lamps.

Modes are those of relays.py, pots and their ramps those of pot_panel.py, coefficients and lamps those of readouts.py.
Capacitors and op-amps keep their states across modes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import Circuit
from analogrig_emulator.circuit.components import NOMINAL, Components
from analogrig_emulator.circuit.elements import OpAmp, Switch
from analogrig_emulator.circuit.nodal import Nodal, analyse
from analogrig_emulator.circuit.pot import check_ramp
from analogrig_emulator.engine.engine import Engine
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Drive, Edges, PiecewiseLinear
from analogrig_emulator.exceptions import CircuitError, EmulatorError, EngineError, ModeError
from analogrig_emulator.machine.pot_panel import PotPanel
from analogrig_emulator.machine.readouts import (
    LAMP_DELAY_S,
    PotReading,
    lamp_delay_ticks,
    lamp_samples,
    on_reference,
    terminal,
)
from analogrig_emulator.machine.relays import Mode, Relays, RelaySwitch, check_modes


class _Setting(NamedTuple):
    """Setting of the machine by hand: it determines the circuit."""

    mode: Mode
    relays: Relays
    pots: PotPanel
    closed: Mapping[str, bool]

    @property
    def nodal(self) -> Nodal:
        """Nodal analysis of the mode."""
        return self.relays.nodal(self.mode)

    def system(self) -> PiecewiseLinear:
        """State space of the circuit."""
        return self.nodal.at(self.pots.dials, self.closed)

    def on(self, circuit: Circuit) -> Circuit:
        """Circuit with the pots and switches set."""
        circuit = circuit.with_dials(self.pots.dials)
        return circuit.with_switches(self.closed) if self.closed else circuit


class AnalogComputer:
    """Machine with a circuit patched on it. It begins in INITIAL CONDITION, before sample 0.

    readings: nodes that run() records. initial_v: output voltage of each integrator (an amplifier) to which INITIAL
    CONDITION charges it. ic_ohm: charging resistors, one from the reference and one across the capacitor, with time
    constant ic_ohm C and empty capacitors at the start; None charges at once.

    lamp_delay_s: time without virtual ground after which an amplifier's overload lamp lights.

    components: those fitted to the circuit; they determine resting places and noise of wipers.

    Raises CircuitError for errors of patching, an unknown reading or an amplifier that is no integrator, EngineError
    for a rate or delay out of range.
    """

    def __init__(
        self,
        circuit: Circuit,
        readings: Sequence[str],
        *,
        initial_v: Mapping[str, float] | None = None,
        ic_ohm: float | None = 10e3,
        sample_rate_hz: float = 20e3,
        lamp_delay_s: float = LAMP_DELAY_S,
        components: Components = NOMINAL,
    ) -> None:
        if ic_ohm is not None and not (math.isfinite(ic_ohm) and ic_ohm > 0):
            raise CircuitError(f"ic_ohm must be positive and finite, got {ic_ohm!r}")
        if not 0 < sample_rate_hz < math.inf:
            raise EngineError(f"sample_rate_hz must be positive and finite, got {sample_rate_hz!r}")
        self._lamp_delay_ticks = lamp_delay_ticks(lamp_delay_s, sample_rate_hz)
        # First: it rejects a circuit that is too large at once.
        operate = analyse(circuit)
        self._patched = circuit
        self.read_nodes(readings)
        relays = Relays(circuit, operate, initial_v or {}, ic_ohm)
        closed = {switch.name: switch.closed for switch in circuit.of(Switch)}
        self._setting = _Setting(Mode.INITIAL_CONDITION, relays, PotPanel.of(circuit, components), closed)
        self._charges_at_once = ic_ohm is None
        self._sample_rate_hz = sample_rate_hz
        self.restart()

    # ---- state

    @property
    def mode(self) -> Mode:
        """Present mode."""
        return self._setting.mode

    @property
    def circuit(self) -> Circuit:
        """Circuit as patched, with the present pots and switches."""
        return self._setting.on(self._patched)

    @property
    def wiring(self) -> Circuit:
        """Circuit with the present relays, pots and switches, for to_spice for instance."""
        return self._setting.on(self._setting.relays.circuit(self.mode))

    @property
    def dials(self) -> dict[str, float]:
        """Dials of the pots, 0..1."""
        pots = self._setting.pots
        return {pot: pots.dials[pot] for pot in pots.wipers.pots}

    @property
    def is_turning(self) -> bool:
        """True while a pot turns."""
        return bool(self._setting.pots.ramps)

    @property
    def recorded(self) -> int:
        """Number of samples recorded since the last restart."""
        return self._engine.recorded

    @property
    def state(self) -> NDArray[np.float64]:
        """Voltages of the states of the circuit at the last sample recorded."""
        return self._engine.state

    @property
    def lamps(self) -> dict[str, int | None]:
        """First sample by amplifier with its overload lamp lit, None while it is dark."""
        amplifiers = [amp.name for amp in self._patched.of(OpAmp)]
        return lamp_samples(amplifiers, self._system.kinks, self._engine.overdue_ticks)

    @property
    def lamp_delay_ticks(self) -> int:
        """lamp_delay_s in ticks."""
        return self._lamp_delay_ticks

    def clear_lamps(self) -> None:
        """Put the lamps out. The lamp of an amplifier still overloaded lights again after its delay."""
        self._engine.watch(self._lamp_delay_ticks)

    def read(self) -> dict[str, float]:
        """Voltage of every node at the present instant, in any mode."""
        nodes = self._patched.nodes
        probe = Engine(self._system, nodes, self._sample_rate_hz)
        probe.state = self._engine.state
        levels = self._levels_at(max(self._engine.now_tick, 0)).items()
        volts = probe.run(1, {name: Edges(np.zeros(1, np.int64), np.array([v])) for name, v in levels})
        return dict(zip(nodes, volts[0].tolist(), strict=True))

    # ---- pots

    def turn(self, dials: Mapping[str, float], ramp_n: int = 0) -> None:
        """Turn pots to these dials, in any mode; a running machine keeps its voltages.

        With ramp_n they turn evenly during run(), and arrive ramp_n samples after the last one taken, or sample 0.
        Wipers rest on the nearest winding, also during a ramp. A pot turned again starts from its present dial.
        Raises PotError for a dial off its track, an unknown pot or a ramp_n that is no integer, and EngineError for a
        circuit that the engine rejects (before the first run(), that raises instead). No pot is turned then.
        """
        goals = self.resting(dials)
        check_ramp(ramp_n, dials)
        pots = self._setting.pots
        turned = pots.ramped(goals, max(self.recorded - 1, 0), ramp_n) if ramp_n else pots.turned(goals)
        self._become(self._setting._replace(pots=turned))

    def resting(self, dials: Mapping[str, float]) -> dict[str, float]:
        """Dials at which wipers rest when pots are turned to these dials. Raises PotError like turn()."""
        return self._setting.pots.wipers.resting(dials)

    def operating(self, dials: Mapping[str, float]) -> PiecewiseLinear:
        """State space of OPERATE with pots at these dials, windings left out; the others as they stand.

        The machine does not change. Raises PotError and CircuitError.
        """
        return self._setting.relays.nodal(Mode.OPERATE).at(self._setting.pots.settled(dials), self._setting.closed)

    def throw(self, closed: Mapping[str, bool]) -> None:
        """Throw switches of the circuit, in any mode.

        Raises CircuitError for an unknown switch, EngineError like turn(). No switch is thrown then.
        """
        self._patched.with_switches(closed)
        self._become(self._setting._replace(closed={**self._setting.closed, **closed}))

    def coefficient(self, pot: str) -> float:
        """Coefficient of a pot in POT SET: wiper voltage under load with the top on the reference, per reference.

        Raises ModeError in another mode, PotError for an unknown pot.
        """
        return self._on_reference(pot).coefficient(self._setting.pots.dials[pot])

    def set_coefficient(self, pot: str, coefficient: float) -> None:
        """Turn a pot in POT SET until coefficient() reads the value, to the nearest winding.

        Raises ModeError, and PotError beyond the track.
        """
        self.turn({pot: self._on_reference(pot).dial_of(coefficient)})

    def _on_reference(self, pot: str) -> PotReading:
        setting = self._setting
        if setting.mode is not Mode.POT_SET:
            raise ModeError(f"coefficients are read and set in POT SET, and this is {setting.mode.value}")
        setting.pots.wipers.check(pot)
        top, wiper = terminal(self._patched, pot, "top"), terminal(self._patched, pot, "wiper")
        nodal = Nodal(on_reference(setting.relays.circuit(Mode.POT_SET), pot, top))
        return PotReading(pot, nodal, wiper, setting.pots.dials, setting.closed, self._levels_v)

    # ---- operation

    @property
    def readings(self) -> int:
        """Number of nodes that run() records."""
        return len(self._readings)

    def read_nodes(self, readings: Sequence[str]) -> None:
        """Set the nodes that run() records, from the next restart() on. Raises CircuitError for an unknown node."""
        if missing := [node for node in readings if node not in self._patched.nodes]:
            there = ", ".join(self._patched.nodes)
            raise CircuitError(f"readings: no node is called {missing[0]!r}; there are {there}")
        self._readings = tuple(readings)

    def restart(
        self,
        mode: Mode = Mode.INITIAL_CONDITION,
        ahead_ticks: int = 0,
        drives: Mapping[str, Drive] = MappingProxyType({}),
    ) -> None:
        """Restart in a mode: empty capacitors, inputs at 0 V, dark lamps, clock before sample 0.

        Pots and initial voltages stay; a ramp stops at its present dial. ahead_ticks, drives: as for Engine.
        """
        self._ahead_ticks, self._drives = ahead_ticks, dict(drives)
        _, relays, pots, closed = self._setting
        self._setting = _Setting(mode, relays, pots.stopped(), closed)
        self._levels_v = {source.name: 0.0 for source in self._patched.inputs}
        self._powered: Engine | None = None
        self._solved: PiecewiseLinear | None = None

    def set_initial(self, initial_v: Mapping[str, float]) -> None:
        """Set the output voltages to which INITIAL CONDITION charges integrators.

        Raises CircuitError and, like turn(), EngineError. No voltage is set then.
        """
        relays = self._setting.relays.with_initial(initial_v)
        self._become(self._setting._replace(relays=relays), charged=self._powered)

    def follow(self, drives: Mapping[str, Drive]) -> None:
        """Replace drives by those of the coming samples, as Engine.follow does."""
        self._drives |= drives
        if self._powered is not None:
            self._powered.follow(drives)

    def switch(self, mode: Mode) -> None:
        """Switch to a mode at the present instant. The present mode changes nothing.

        Raises ModeError, and EngineError or CircuitError for a circuit without a solution in that mode. The machine
        stays in its mode then.
        """
        check_modes([self.mode, mode])
        self._enter(mode)

    def window(self, samples: int) -> tuple[int, int]:
        """Range of ticks (start, stop) of edges and switches that run(samples) accepts: start <= tick < stop."""
        return self._engine.window(samples)

    def run(
        self, samples: int, edges: Mapping[str, Edges] | None = None, switches: Sequence[RelaySwitch] = ()
    ) -> NDArray[np.float64]:
        """Record the next samples: float64 (samples, readings), V.

        edges: by input, within window(samples). switches: in time order, from the present instant to the last of the
        run, none during a ramp; a switch at the instant of a sample comes right after that sample.
        Raises ModeError before anything is played, and EngineError.
        """
        edges = edges or {}
        if not switches:
            return self._play(samples, edges)
        check_modes([self.mode, *(mode for _, mode in switches)])
        if self.is_turning:
            raise ModeError(
                f"relays cannot switch within a run while {', '.join(self._setting.pots.ramps)} are being turned: "
                "switch() between two runs"
            )
        instants = [tick for tick, _ in switches]
        first, last = max(self._engine.now_tick, 0), self.window(samples)[1] - 1
        if any(later < earlier for earlier, later in itertools.pairwise([first, *instants, last])):
            raise ModeError(f"switches at ticks {instants}: not in order, or not within {first} to {last}")
        volts = []
        stop = self.recorded + samples
        for tick, mode in switches:
            volts.append(self._play_to(tick, _edges_until(edges, tick)))
            edges = _edges_after(edges, tick)
            self._enter(mode)
        volts.append(self._play(stop - self.recorded, edges))
        return np.concatenate(volts)

    def run_jumping(
        self, samples: int, jumps: Sequence[tuple[int, Mapping[str, float]]], edges: Mapping[str, Edges]
    ) -> NDArray[np.float64]:
        """Record the next samples like run(), and after each sample k of `jumps` turn pots to resting dials at once.

        No pot may be turning. Equals alternating run() and turn(), at a fraction of the cost. Raises PotError,
        CircuitError for a circuit without a solution before anything is played, and EngineError.
        """
        mode, relays, pots, closed = self._setting
        nodal, changes = relays.nodal(mode), []
        for sample, goals in jumps:
            pots = pots.turned(self.resting(goals))
            changes.append((sample, nodal.at(pots.dials, closed)))
        volts = self._engine.run_changing(samples, changes, edges)
        self._setting, self._solved = _Setting(mode, relays, pots, closed), None
        self._note_levels(edges)
        return volts

    def repeat(
        self, cycles: int, initial_ticks: int, operate_ticks: int, edges: Mapping[str, Edges] | None = None
    ) -> NDArray[np.float64]:
        """Alternate INITIAL CONDITION and OPERATE (repetitive operation): float64 (cycles, samples, readings), V.

        A cycle begins right after a sample, sample 0 if none is taken yet, and lasts a whole number of samples.
        edges: by input, at ticks from the beginning of each cycle. With ic_ohm None and inputs that begin each cycle at
        the same level, all cycles are equal to the bit.
        Raises ModeError and EngineError.
        """
        period = initial_ticks + operate_ticks
        if min(cycles, initial_ticks, operate_ticks) < 0 or period == 0 or period % TICKS_PER_SAMPLE:
            raise ModeError(f"a cycle of {initial_ticks} + {operate_ticks} ticks is no whole number of samples")
        samples = period // TICKS_PER_SAMPLE
        if not self.recorded:
            self.run(1)
        volts = np.empty((cycles, samples, len(self._readings)))
        for cycle in range(cycles):
            start = (self.recorded - 1) * TICKS_PER_SAMPLE
            switches = [(start, Mode.INITIAL_CONDITION), (start + initial_ticks, Mode.OPERATE)]
            shifted = {name: train.shifted(start) for name, train in (edges or {}).items()}
            volts[cycle] = self.run(samples, shifted, switches)
        return volts

    # ---- time

    @property
    def _engine(self) -> Engine:
        """Engine, made on first use after a restart: most machines have their pots set before they are played."""
        if self._powered is None:
            self._powered = Engine(
                self._system, self._readings, self._sample_rate_hz, ahead_ticks=self._ahead_ticks, drives=self._drives
            )
            self._powered.watch(self._lamp_delay_ticks)
            self._charge_at_once(self._powered)
        return self._powered

    @property
    def _system(self) -> PiecewiseLinear:
        """State space of the present mode and pots."""
        if self._solved is None:
            self._solved = self._setting.system()
        return self._solved

    def _play_to(self, tick: int, edges: Mapping[str, Edges]) -> NDArray[np.float64]:
        """Record the samples up to a tick and go there."""
        samples = max(tick // TICKS_PER_SAMPLE + 1 - self.recorded, 0)
        if not samples:
            volts, later = self._engine.run(0), edges
        else:
            at_last = (self.recorded + samples - 1) * TICKS_PER_SAMPLE
            volts, later = self._play(samples, _edges_until(edges, at_last)), _edges_after(edges, at_last)
        self._engine.advance(tick, later)
        self._note_levels(later)
        return volts

    def _play(self, samples: int, edges: Mapping[str, Edges]) -> NDArray[np.float64]:
        if not (self.is_turning and samples):
            volts = self._engine.run(samples, edges)
        else:
            volts = np.concatenate(list(self._run_ramps(self.recorded + samples, edges)))
        self._note_levels(edges)
        return volts

    def _run_ramps(self, stop: int, edges: Mapping[str, Edges]) -> Iterator[NDArray[np.float64]]:
        """Record samples up to stop, in stretches with the same pots turning."""

        def during(sample: float) -> PiecewiseLinear:
            return self._setting.nodal.at(self._setting.pots.during(sample), self._setting.closed)

        while self.is_turning and self.recorded < stop:
            pots = self._setting.pots
            last = min(stop - 1, pots.next_arrival)
            until = last * TICKS_PER_SAMPLE
            yield self._engine.run_turning(last + 1 - self.recorded, during, _edges_until(edges, until), pots.pieces)
            edges = _edges_after(edges, until)
            self._setting = self._setting._replace(pots=pots.at(last))
            self._update_system()
        yield self._engine.run(stop - self.recorded, edges)

    def _note_levels(self, edges: Mapping[str, Edges]) -> None:
        self._levels_v |= {name: float(train.levels_v[-1]) for name, train in edges.items() if train.ticks.size}

    def _levels_at(self, tick: int) -> dict[str, float]:
        """Levels of all inputs at the present tick, in V."""
        return self._levels_v | {name: drive.at(tick) for name, drive in self._drives.items()}

    # ---- relays

    def _enter(self, mode: Mode) -> None:
        if mode is not self.mode:
            self._become(self._setting._replace(mode=mode), charged=self._engine)

    def _become(self, setting: _Setting, charged: Engine | None = None) -> None:
        """Take another setting. EmulatorError leaves the machine as it was."""
        before, self._setting = self._setting, setting
        try:
            self._update_system()
            if charged is not None:
                self._charge_at_once(charged)
        except EmulatorError:
            self._setting = before
            self._update_system()
            raise

    def _update_system(self) -> None:
        self._solved = None
        if self._powered is not None:
            self._powered.set_system(self._system)

    def _charge_at_once(self, engine: Engine) -> None:
        if self._charges_at_once and self.mode.charges:
            levels = self._levels_at(max(engine.now_tick, 0))
            levels_v = [levels[name] for name in self._system.inputs]
            engine.state = self._system.rest(np.array(levels_v)).state


def _edges_until(edges: Mapping[str, Edges], tick: int) -> dict[str, Edges]:
    return {name: train.until(tick) for name, train in edges.items()}


def _edges_after(edges: Mapping[str, Edges], tick: int) -> dict[str, Edges]:
    return {name: train.after(tick) for name, train in edges.items()}
