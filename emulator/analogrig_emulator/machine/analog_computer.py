"""Operation of the analogue computer: modes, pots and overload lamps.

    POT SET            integrators as in INITIAL CONDITION; every amplifier's inputs on ground instead of the junction,
                       so that pots keep their loads; a pot is read with its top on the reference
    INITIAL CONDITION  integrators charge to their initial voltages
    HOLD               integrators' inputs on ground instead of the junction: capacitors keep their voltages
    OPERATE            the circuit as patched

A mode is the circuit with its relays in another position, solved by nodal analysis like any other. Capacitors and
op-amps keep their states across modes. Relays switch at any tick, in no time and without
bounce.
"""

from __future__ import annotations

import contextlib
import enum
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import Circuit, Element, label
from analogrig_emulator.circuit.components import NOMINAL, Components, contact_of, is_part_of
from analogrig_emulator.circuit.elements import GROUND, Capacitor, OpAmp, Pot, Resistor, Switch, VoltageSource
from analogrig_emulator.circuit.nodal import Nodal, analyse
from analogrig_emulator.circuit.nonlinear import Multiplier
from analogrig_emulator.circuit.pot import END_FRACTION, check_dial, check_ramp
from analogrig_emulator.engine.engine import Engine
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Drive, Edges, Kink, Law, PiecewiseLinear
from analogrig_emulator.exceptions import CircuitError, EmulatorError, EngineError, ModeError, PotError
from analogrig_emulator.machine.patch_panel import Patch, patches

REFERENCE_V = 10.0
"""Reference voltage at a pot's top while its coefficient is read."""

LAMP_DELAY_S = 10e-6
"""Time without virtual ground after which an amplifier's lamp lights, in s."""

_AT_ONCE_OHM = 10e3
_BISECTIONS = 53

_SLOW_PER_SAMPLE = 5e-5
"""Dial speed per sample below which one piece per sample suffices."""

_MOST_PIECES = 64

_READING_TOLERANCE = 2 * END_FRACTION
"""Largest error of a coefficient, from the track left at the end stops."""


class Mode(enum.Enum):
    """Position of the relays."""

    POT_SET = "POT SET"
    INITIAL_CONDITION = "INITIAL CONDITION"
    HOLD = "HOLD"
    OPERATE = "OPERATE"


RelaySwitch = tuple[int, Mode]
"""(tick, mode): the relays switch at that tick, after its sample and edges."""

_FOLLOWERS: Mapping[Mode, frozenset[Mode]] = MappingProxyType(
    {
        Mode.POT_SET: frozenset({Mode.INITIAL_CONDITION}),
        Mode.INITIAL_CONDITION: frozenset({Mode.POT_SET, Mode.HOLD, Mode.OPERATE}),
        Mode.HOLD: frozenset({Mode.POT_SET, Mode.INITIAL_CONDITION, Mode.OPERATE}),
        Mode.OPERATE: frozenset({Mode.INITIAL_CONDITION, Mode.HOLD}),
    }
)


class AnalogComputer:
    """Machine with a circuit patched on it. It begins in INITIAL CONDITION, before sample 0.

    readings: nodes that run() records. initial_v: output voltage of each integrator (an amplifier) to which INITIAL
    CONDITION charges it. ic_ohm: charging resistors, one from the reference and one across the capacitor, with time
    constant ic_ohm C and empty capacitors at the start; None charges at once.

    An amplifier's overload lamp lights when its output has been unable to follow, at its swing or at its slew rate,
    for lamp_delay_s without a break: then its junction is off virtual ground, by more than slew / (2 pi GBW) (0.7 V
    for a TL07x). Amplifiers without such limits have a lamp that stays dark.

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
        if not 0 <= lamp_delay_s < math.inf:
            raise EngineError(f"lamp_delay_s must be finite and not negative, got {lamp_delay_s!r}")
        # First: it rejects a circuit that is too large at once.
        self._nodals = {Mode.OPERATE: analyse(circuit)}
        self._patched = circuit
        self.read_nodes(readings)
        self._patches = patches(circuit)
        self._initial_v = dict(initial_v or {})
        self._ic_ohm = ic_ohm
        self._sample_rate_hz = sample_rate_hz
        self._ahead_ticks = 0
        self._lamp_delay_ticks = round(lamp_delay_s * sample_rate_hz * TICKS_PER_SAMPLE)
        self._wipers = _Wipers(circuit, components)
        self._dials = {pot.name: pot.dial for pot in circuit.of(Pot)}
        self._turns: dict[str, _Ramp] = {}
        self._closed = {switch.name: switch.closed for switch in circuit.of(Switch)}
        self._check_integrators(self._initial_v)
        self.restart()

    # ---- state

    @property
    def mode(self) -> Mode:
        """Present mode."""
        return self._mode

    @property
    def circuit(self) -> Circuit:
        """Circuit as patched, with the present pots and switches."""
        return self._with_settings(self._patched)

    @property
    def wiring(self) -> Circuit:
        """Circuit with the present relays, pots and switches, for to_spice for instance."""
        return self._with_settings(self._circuit_in(self._mode))

    def _with_settings(self, circuit: Circuit) -> Circuit:
        circuit = circuit.with_dials(self._dials)
        return circuit.with_switches(self._closed) if self._closed else circuit

    @property
    def dials(self) -> dict[str, float]:
        """Dials of the pots, 0..1."""
        return {pot: self._dials[pot] for pot in self._wipers.pots}

    @property
    def is_turning(self) -> bool:
        """True while a pot turns."""
        return bool(self._turns)

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
        with self._all_or_nothing():
            for pot in goals:
                self._turns.pop(pot, None)
            if ramp_n:
                first = max(self.recorded - 1, 0)
                self._turns |= {
                    pot: _Ramp(self._dials[pot], dial, first, first + ramp_n)
                    for pot, dial in goals.items()
                    if dial != self._dials[pot]
                }
            else:
                self._dials |= goals
            self._dials |= self._wipers.contacts_at_rest(goals)

    def resting(self, dials: Mapping[str, float]) -> dict[str, float]:
        """Dials at which wipers rest when pots are turned to these dials. Raises PotError like turn()."""
        for pot, dial in dials.items():
            self._check_pot(pot)
            check_dial(dial, pot)
        return {pot: self._wipers.resting(pot, dial) for pot, dial in dials.items()}

    def _check_pot(self, pot: str) -> None:
        if pot not in self._wipers.pots:
            raise PotError(f"no pot is called {pot!r}; there are {', '.join(sorted(self._wipers.pots)) or 'none'}")

    def operating(self, dials: Mapping[str, float]) -> PiecewiseLinear:
        """State space of OPERATE with pots at these dials, windings left out; the others as they stand.

        The machine does not change. Raises PotError and CircuitError.
        """
        settled = self._dials | dict(dials) | self._wipers.contacts_at_rest(dials)
        return self._nodals[Mode.OPERATE].at(settled, self._closed)

    def throw(self, closed: Mapping[str, bool]) -> None:
        """Throw switches of the circuit, in any mode.

        Raises CircuitError for an unknown switch, EngineError like turn(). No switch is thrown then.
        """
        self._patched.with_switches(closed)
        with self._all_or_nothing():
            self._closed |= closed

    def coefficient(self, pot: str) -> float:
        """Coefficient of a pot in POT SET: wiper voltage under load with the top on the reference, per reference.

        Raises ModeError in another mode, PotError for an unknown pot.
        """
        return self._reading(self._pot_on_reference(pot), pot, self._dials[pot])

    def set_coefficient(self, pot: str, coefficient: float) -> None:
        """Turn a pot in POT SET until coefficient() reads the value, to the nearest winding.

        Raises ModeError, and PotError beyond the track.
        """
        nodal = self._pot_on_reference(pot)
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._reading(nodal, pot, middle) < coefficient else (low, middle)
        reached = self._reading(nodal, pot, high)
        if not abs(reached - coefficient) <= _READING_TOLERANCE:
            raise PotError(f"pot {pot}: coefficient {coefficient:.6g} is beyond the track, which ends at {reached:.6g}")
        self.turn({pot: high})

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
        self._mode, self._ahead_ticks, self._drives = mode, ahead_ticks, dict(drives)
        self._dials |= self._wipers.contacts_at_rest(self._turns)
        self._turns = {}
        self._levels_v = {source.name: 0.0 for source in self._patched.inputs}
        self._powered: Engine | None = None
        self._solved: PiecewiseLinear | None = None

    def set_initial(self, initial_v: Mapping[str, float]) -> None:
        """Set the output voltages to which INITIAL CONDITION charges integrators.

        Raises CircuitError and, like turn(), EngineError. No voltage is set then.
        """
        wanted = self._initial_v | dict(initial_v)
        if wanted.keys() != self._initial_v.keys():
            strangers = ", ".join(sorted(wanted.keys() - self._initial_v.keys()))
            raise CircuitError(f"{strangers}: no such integrator; there are {', '.join(self._initial_v) or 'none'}")
        self._check_integrators(wanted)
        with self._all_or_nothing(charged=self._powered):
            self._initial_v = wanted
            self._nodals = {mode: nodal for mode, nodal in self._nodals.items() if mode in (Mode.HOLD, Mode.OPERATE)}

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
        self._check_switches([mode])
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
        self._check_switches([mode for _, mode in switches])
        if self._turns:
            raise ModeError(
                f"relays cannot switch within a run while {', '.join(self._turns)} are being turned: "
                "switch() between two runs"
            )
        self._check_instants(samples, [tick for tick, _ in switches])
        volts = []
        stop = self.recorded + samples
        for (tick, mode), taken in zip(switches, _split_at(edges, [tick for tick, _ in switches]), strict=False):
            volts.append(self._play_to(tick, taken))
            self._enter(mode)
        volts.append(self._play(stop - self.recorded, _edges_after(edges, switches[-1][0])))
        return np.concatenate(volts)

    def run_jumping(
        self, samples: int, jumps: Sequence[tuple[int, Mapping[str, float]]], edges: Mapping[str, Edges]
    ) -> NDArray[np.float64]:
        """Record the next samples like run(), and after each sample k of `jumps` turn pots to resting dials at once.

        No pot may be turning. Equals alternating run() and turn(), at a fraction of the cost. Raises PotError,
        CircuitError for a circuit without a solution before anything is played, and EngineError.
        """
        dials, changes = dict(self._dials), []
        for sample, goals in jumps:
            dials |= self.resting(goals)
            dials |= self._wipers.contacts_at_rest(goals)
            changes.append((sample, self._nodal.at(dials, self._closed)))
        volts = self._engine.run_changing(samples, changes, edges)
        self._dials, self._solved = dials, None
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
            self._solved = self._nodal.at(self._dials, self._closed)
        return self._solved

    @property
    def _nodal(self) -> Nodal:
        """Nodal analysis of the present mode."""
        nodal = self._nodals.get(self._mode)
        if nodal is None:
            nodal = self._nodals[self._mode] = Nodal(self._circuit_in(self._mode))
        return nodal

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
        if not (self._turns and samples):
            volts = self._engine.run(samples, edges)
        else:
            volts = np.concatenate(list(self._run_ramps(self.recorded + samples, edges)))
        self._note_levels(edges)
        return volts

    def _run_ramps(self, stop: int, edges: Mapping[str, Edges]) -> Iterator[NDArray[np.float64]]:
        """Record samples up to stop, in stretches with the same pots turning."""
        while self._turns and self.recorded < stop:
            last = min(stop - 1, *(turn.last for turn in self._turns.values()))
            pieces = max(turn.pieces for turn in self._turns.values())
            until = last * TICKS_PER_SAMPLE
            yield self._engine.run_turning(
                last + 1 - self.recorded, self._system_during_ramps, _edges_until(edges, until), pieces
            )
            edges = _edges_after(edges, until)
            self._dials |= self._dials_at(last)
            self._turns = {pot: turn for pot, turn in self._turns.items() if turn.last > last}
            self._update_system()
        yield self._engine.run(stop - self.recorded, edges)

    def _system_during_ramps(self, sample: float) -> PiecewiseLinear:
        return self._nodal.at(self._dials | self._dials_at(sample), self._closed)

    def _dials_at(self, sample: float) -> dict[str, float]:
        """Dials of the turning pots and of their contacts."""
        dials: dict[str, float] = {}
        for pot, turn in self._turns.items():
            dials[pot] = self._wipers.resting(pot, turn.at(sample))
            moves = turn.first < sample < turn.last
            dials |= self._wipers.contacts_moving(pot, dials[pot]) if moves else self._wipers.contacts_at_rest([pot])
        return dials

    def _note_levels(self, edges: Mapping[str, Edges]) -> None:
        self._levels_v |= {name: float(train.levels_v[-1]) for name, train in edges.items() if train.ticks.size}

    def _levels_at(self, tick: int) -> dict[str, float]:
        """Levels of all inputs at the present tick, in V."""
        return self._levels_v | {name: drive.at(tick) for name, drive in self._drives.items()}

    def _check_instants(self, samples: int, ticks: Sequence[int]) -> None:
        _, stop = self.window(samples)
        allowed = [max(self._engine.now_tick, 0), *ticks, stop - 1]
        if ticks and any(later < earlier for earlier, later in itertools.pairwise(allowed)):
            raise ModeError(f"switches at ticks {list(ticks)}: not in order, or not within {allowed[0]} to {stop - 1}")

    # ---- relays

    def _check_switches(self, modes: Sequence[Mode]) -> None:
        for before, after in itertools.pairwise([self._mode, *modes]):
            if after is not before and after not in _FOLLOWERS[before]:
                ways = ", ".join(sorted(mode.value for mode in _FOLLOWERS[before]))
                raise ModeError(f"{before.value} cannot be followed by {after.value}, only by {ways}")

    def _enter(self, mode: Mode) -> None:
        if mode is not self._mode:
            with self._all_or_nothing(charged=self._engine):
                self._mode = mode

    @contextlib.contextmanager
    def _all_or_nothing(self, charged: Engine | None = None) -> Iterator[None]:
        """Apply the changes made in the body to the engine, or undo them if they raise EmulatorError."""
        before = self._position
        try:
            yield
            self._update_system()
            if charged is not None:
                self._charge_at_once(charged)
        except EmulatorError:
            self._position = before
            self._update_system()
            raise

    def _update_system(self) -> None:
        self._solved = None
        if self._powered is not None:
            self._powered.set_system(self._system)

    @property
    def _position(self) -> _Position:
        mode, nodals = self._mode, dict(self._nodals)
        return _Position(mode, nodals, self._initial_v, dict(self._dials), dict(self._turns), dict(self._closed))

    @_position.setter
    def _position(self, position: _Position) -> None:
        self._mode, self._nodals, self._initial_v, self._dials, self._turns, self._closed = position

    def _charge_at_once(self, engine: Engine) -> None:
        if self._ic_ohm is None and self._mode in (Mode.INITIAL_CONDITION, Mode.POT_SET):
            levels = self._levels_at(max(engine.now_tick, 0))
            levels_v = [levels[name] for name in self._system.inputs]
            engine.state = self._system.rest(np.array(levels_v)).state

    def _circuit_in(self, mode: Mode) -> Circuit:
        """Circuit with the relays in the position of a mode."""
        if mode is Mode.OPERATE:
            return self._patched
        lifted = self._patches if mode is Mode.POT_SET else self._initial_v
        elements = list(self._patched.elements)
        for amplifier in lifted:
            elements = [_lift_inputs(element, self._patches[amplifier]) for element in elements]
        if mode is Mode.POT_SET:  # every input is at ground, and 0 / 0 has no value: dividers stand idle as multipliers
            elements = [replace(each, law=Law.PRODUCT) if isinstance(each, Multiplier) else each for each in elements]
        if mode is not Mode.HOLD:
            elements += [part for name in self._initial_v for part in self._charging_circuit(self._patches[name])]
        return Circuit(elements)

    def _charging_circuit(self, patch: Patch) -> list[Element]:
        """Charging circuit of one integrator: an inverter of gain 1 with the capacitor across it."""
        name, node, ohm = f"IC_{patch.amplifier}", f"ic_{patch.amplifier}", self._ic_ohm or _AT_ONCE_OHM
        return [
            VoltageSource(name, node, dc_v=-self._initial_v[patch.amplifier]),
            Resistor(f"{name}_in", node, patch.junction, ohm),
            Resistor(f"{name}_fb", patch.junction, patch.out, ohm),
        ]

    def _check_integrators(self, initial_v: Mapping[str, float]) -> None:
        for name, volts in initial_v.items():
            patch = self._patches.get(name)
            if patch is None:
                raise CircuitError(f"no amplifier is called {name!r}; there are {', '.join(self._patches) or 'none'}")
            if not patch.capacitors:
                amp = next(amp for amp in self._patched.of(OpAmp) if amp.name == name)
                raise CircuitError(
                    f"{label(amp)}: an integrator without a capacitor between nodes {patch.junction} and {patch.out}"
                )
            if not math.isfinite(volts):
                raise CircuitError(f"integrator {name}: initial voltage {volts!r} is not finite")
            if abs(volts) > REFERENCE_V:
                raise CircuitError(
                    f"integrator {name}: initial voltage {volts:g} V is beyond the reference of {REFERENCE_V:g} V"
                )
        self._check_uncharged(initial_v)

    def _check_uncharged(self, initial_v: Mapping[str, float]) -> None:
        """Raise CircuitError for an integrator without initial voltage: it would drift into its limit."""
        for amp in self._patched.of(OpAmp):
            patch = self._patches[amp.name]
            if not patch.capacitors or amp.name in initial_v:
                continue
            parts = (part for part in self._patched.elements if not isinstance(part, Capacitor | OpAmp))
            if not any({patch.junction, patch.out} <= set(part.nodes) for part in parts):
                raise CircuitError(f"{label(amp)}: an integrator needs an initial voltage, if only {amp.name}: 0.0")

    # ---- reading pots

    def _pot_on_reference(self, pot: str) -> Nodal:
        if self._mode is not Mode.POT_SET:
            raise ModeError(f"coefficients are read and set in POT SET, and this is {self._mode.value}")
        self._check_pot(pot)
        pot_top = self._terminal(pot, "top")
        elements = [
            _move_ends(element, pot_top, "reference") if element.name == pot or is_part_of(element, pot) else element
            for element in self._circuit_in(Mode.POT_SET).elements
        ]
        return Nodal(Circuit([*elements, VoltageSource("reference", "reference", dc_v=REFERENCE_V)]))

    def _terminal(self, pot: str, end: str) -> str:
        """Node at which an end of a pot is patched: where the parts added by fit() meet other elements."""
        own = [element for element in self._patched.elements if element.name == pot or is_part_of(element, pot)]
        parts = [bond for element in own if element.name != pot for bond in element.bonds]
        patched = {
            GROUND,
            *(node for element in self._patched.elements if element not in own for node in element.nodes),
        }
        reached: list[str] = [next(getattr(element, end) for element in own if element.name == pot)]
        for node in reached:
            fresh = {other for bond in parts if node in bond for other in bond}
            reached += sorted(fresh.difference(reached, {GROUND}))
        return next(node for node in reached if node in patched)

    def _reading(self, nodal: Nodal, pot: str, dial: float) -> float:
        system = nodal.at(self._dials | {pot: dial}, self._closed)
        levels_v = np.array([self._levels_v[name] for name in system.inputs])
        return system.rest(levels_v).volts[self._terminal(pot, "wiper")] / REFERENCE_V


def lamp_samples(
    amplifiers: Iterable[str], kinks: Iterable[Kink], overdue_ticks: NDArray[np.int64]
) -> dict[str, int | None]:
    """Value of AnalogComputer.lamps, from the overdue ticks of each kink."""
    lamps: dict[str, int | None] = dict.fromkeys(amplifiers)
    for kink, tick in zip(kinks, overdue_ticks.tolist(), strict=True):
        if tick >= 0 and kink.element in lamps:
            sample, before = -(-tick // TICKS_PER_SAMPLE), lamps[kink.element]
            lamps[kink.element] = sample if before is None else min(sample, before)
    return lamps


@dataclass(frozen=True)
class _Ramp:
    """Even motion of a pot from one dial at sample `first` to another at sample `last`."""

    start: float
    goal: float
    first: int
    last: int

    def at(self, sample: float) -> float:
        """Dial at a sample, which may be a fraction."""
        if sample >= self.last:
            return self.goal
        return self.start + (self.goal - self.start) * max(sample - self.first, 0.0) / (self.last - self.first)

    @property
    def pieces(self) -> int:
        """Number of pieces with constant dials per sample; the error goes with speed / pieces^2."""
        speed_per_sample = abs(self.goal - self.start) / (self.last - self.first)
        return min(max(math.ceil(math.sqrt(speed_per_sample / _SLOW_PER_SAMPLE)), 1), _MOST_PIECES)


class _Position(NamedTuple):
    """State that determines the circuit of the machine."""

    mode: Mode
    nodals: dict[Mode, Nodal]
    initial_v: dict[str, float]
    dials: dict[str, float]
    turns: dict[str, _Ramp]
    closed: dict[str, bool]


class _Wipers:
    """Wipers of a circuit's pots: resting places, and noise of the contacts."""

    def __init__(self, circuit: Circuit, components: Components) -> None:
        pots = {pot.name: pot for pot in circuit.of(Pot)}
        contacts = {contact_of(name): name for name in pots if contact_of(name) in pots}
        self.pots = {name: components.pots.model(pot.track_ohm) for name, pot in pots.items() if name not in contacts}
        self._contacts = {name: components.contact(pots[name]) for name in contacts.values()}

    def resting(self, pot: str, dial: float) -> float:
        """Dial of the nearest winding."""
        return self.pots[pot].resting(dial)

    def contacts_at_rest(self, pots: Iterable[str]) -> dict[str, float]:
        """Dials of the contacts of resting wipers: no resistance."""
        return {contact_of(pot): 1.0 for pot in pots if pot in self._contacts}

    def contacts_moving(self, pot: str, dial: float) -> dict[str, float]:
        """Dial of the contact while the wiper passes a dial."""
        if pot not in self._contacts:
            return {}
        places = self._contacts[pot]
        return {contact_of(pot): 1.0 - float(places[round(dial * (len(places) - 1))])}


def _lift_inputs(element: Element, patch: Patch) -> Element:
    """Element with its end at the junction moved to ground, if it is an input of the patch."""
    return _move_ends(element, patch.junction, GROUND) if element.name in patch.inputs else element


def _move_ends(element: Element, node: str, to: str) -> Element:
    """Element with its ends at one node moved to another."""
    ends: dict[str, Any] = {
        field.name: to for field in fields(element) if field.name != "name" and getattr(element, field.name) == node
    }
    return replace(element, **ends)


def _split_at(edges: Mapping[str, Edges], ticks: Sequence[int]) -> Iterator[Mapping[str, Edges]]:
    """Edges up to the first tick, from there up to the second, and so on."""
    for tick in ticks:
        yield _edges_until(edges, tick)
        edges = _edges_after(edges, tick)


def _edges_until(edges: Mapping[str, Edges], tick: int) -> dict[str, Edges]:
    return {name: train.until(tick) for name, train in edges.items()}


def _edges_after(edges: Mapping[str, Edges], tick: int) -> dict[str, Edges]:
    return {name: train.after(tick) for name, train in edges.items()}
