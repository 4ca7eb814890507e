"""The analogue computer as it is operated: its modes, its pots, and its overload lamps.

    POT SET            integrators as in INITIAL CONDITION, and every amplifier's inputs lifted off its junction onto
                       ground, so that pots keep their loads; a pot's top is put on the reference to read it
    INITIAL CONDITION  integrators charge to their initial voltages
    HOLD               integrators' inputs lie on ground and not on the junction: the capacitors keep what they have
    OPERATE            the circuit as patched

A mode is the circuit with its relays in another position, solved by nodal analysis like any other; capacitors and
op-amps have the same states in all of them and carry them over. Relays switch at any tick, in no time and without
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

from analogrig_emulator.circuit.circuit import (
    GROUND,
    Capacitor,
    Circuit,
    Element,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
    label,
)
from analogrig_emulator.circuit.components import NOMINAL, Components, contact_of, is_part_of
from analogrig_emulator.circuit.nodal import Nodal
from analogrig_emulator.circuit.pot import END_FRACTION, checked_dial, checked_ramp
from analogrig_emulator.engine.engine import Engine
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Edges, Kink, PiecewiseLinear
from analogrig_emulator.errors import CircuitError, EmulatorError, EngineError, ModeError, PotError
from analogrig_emulator.machine.patching import Patch, patches

REFERENCE_V = 10.0
"""The machine's reference, on which a pot's top lies while its coefficient is read."""

LAMP_DELAY_S = 10e-6
"""How long an amplifier must have lost its virtual ground before its lamp lights."""

_AT_ONCE_OHM = 10e3
_BISECTIONS = 53

_SLOW_PER_SAMPLE = 5e-5
"""A dial that turns by so much a sample may stand still from one sample to the next."""

_MOST_PIECES = 64

_READING_TOLERANCE = 2 * END_FRACTION
"""The end stops leave so much of the track."""


class Mode(enum.Enum):
    """In which position the relays are."""

    POT_SET = "POT SET"
    INITIAL_CONDITION = "INITIAL CONDITION"
    HOLD = "HOLD"
    OPERATE = "OPERATE"


RelaySwitch = tuple[int, Mode]
"""(tick, mode): the relays switch at that tick, after whatever sample or edge falls on it."""

_FOLLOWERS: Mapping[Mode, frozenset[Mode]] = MappingProxyType(
    {
        Mode.POT_SET: frozenset({Mode.INITIAL_CONDITION}),
        Mode.INITIAL_CONDITION: frozenset({Mode.POT_SET, Mode.HOLD, Mode.OPERATE}),
        Mode.HOLD: frozenset({Mode.POT_SET, Mode.INITIAL_CONDITION, Mode.OPERATE}),
        Mode.OPERATE: frozenset({Mode.INITIAL_CONDITION, Mode.HOLD}),
    }
)


class AnalogComputer:
    """A machine with a circuit patched on it.

    readings: the nodes that run() records. initial_v: which amplifiers are integrators, each with the output voltage
    to which INITIAL CONDITION charges it. ic_ohm: the resistors through which it does, one from the reference and one
    across the capacitor, with the time constant ic_ohm C; None charges at once: on entering INITIAL CONDITION all
    that would settle has settled. The machine begins in INITIAL CONDITION, its capacitors empty (or, with None,
    charged), before sample 0.

    An amplifier's overload lamp lights when its output has been unable to follow, at its swing or at its slew rate,
    for lamp_delay_s without a break: then its junction is off virtual ground, by more than slew / (2 pi GBW) (0.7 V
    for a TL07x). Amplifiers without such limits have a lamp that stays dark.

    components: with which the circuit was fitted; they say where wipers come to rest, and how they sound on the way.

    Raises CircuitError for errors of patching, a reading that is no node and an integrator that is none, EngineError
    for a rate or a delay that cannot be.
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
        # First, for it refuses a circuit that is too large at once.
        self._nodals = {Mode.OPERATE: Nodal(circuit)}
        if missing := [node for node in readings if node not in circuit.nodes]:
            raise CircuitError(f"readings: no node is called {missing[0]!r}; there are {', '.join(circuit.nodes)}")
        self._patched = circuit
        self._readings = tuple(readings)
        self._patches = patches(circuit)
        self._initial_v = dict(initial_v or {})
        self._ic_ohm = ic_ohm
        self._sample_rate_hz = sample_rate_hz
        self._lamp_delay_ticks = round(lamp_delay_s * sample_rate_hz * TICKS_PER_SAMPLE)
        self._wipers = _Wipers(circuit, components)
        self._dials = {pot.name: pot.dial for pot in circuit.of(Pot)}
        self._turns: dict[str, _Ramp] = {}
        self._closed = {switch.name: switch.closed for switch in circuit.of(Switch)}
        self._check_integrators(self._initial_v)
        self.restart()

    # ---- what it shows

    @property
    def mode(self) -> Mode:
        """The present mode."""
        return self._mode

    @property
    def circuit(self) -> Circuit:
        """The circuit as patched, its pots and switches as they are set now."""
        return self._as_set(self._patched)

    @property
    def wiring(self) -> Circuit:
        """The circuit with the relays, pots and switches as they stand now; to_spice writes it as any other."""
        return self._as_set(self._wired(self._mode))

    def _as_set(self, circuit: Circuit) -> Circuit:
        circuit = circuit.with_dials(self._dials)
        return circuit.with_switches(self._closed) if self._closed else circuit

    @property
    def dials(self) -> dict[str, float]:
        """Where the pots stand, 0..1."""
        return {pot: self._dials[pot] for pot in self._wipers.pots}

    @property
    def recorded(self) -> int:
        """Samples recorded since the last restart."""
        return self._engine.recorded

    @property
    def lamps(self) -> dict[str, int | None]:
        """For each amplifier the first sample that was taken with its overload lamp lit, None while it is dark."""
        amplifiers = [amp.name for amp in self._patched.of(OpAmp)]
        return lit(amplifiers, self._system.kinks, self._engine.overdue_ticks)

    @property
    def lamp_delay_ticks(self) -> int:
        """lamp_delay_s in ticks."""
        return self._lamp_delay_ticks

    def clear_lamps(self) -> None:
        """Puts the lamps out. One whose amplifier is still overloaded lights again after its delay."""
        self._engine.watch(self._lamp_delay_ticks)

    def read(self) -> dict[str, float]:
        """The voltage of every node of the circuit at the present instant, in any mode."""
        nodes = self._patched.nodes
        probe = Engine(self._system, nodes, self._sample_rate_hz)
        probe.state = self._engine.state
        volts = probe.run(1, {name: Edges(np.zeros(1, np.int64), np.array([v])) for name, v in self._levels_v.items()})
        return dict(zip(nodes, volts[0].tolist(), strict=True))

    # ---- pots

    def turn(self, dials: Mapping[str, float], ramp_n: int = 0) -> None:
        """Turns pots to these dials, in any mode; a running machine keeps its voltages.

        With ramp_n they turn evenly while run() plays on, and arrive ramp_n samples after the last one taken (sample 0
        when there is none yet). Wipers rest on the nearest winding, on the way too. A pot that is turned again goes on
        from where it is.
        Raises PotError for a dial off its track, a pot that is not there or a ramp of no whole number of samples, and
        EngineError for a circuit that the engine refuses (a machine that has not been played yet: run() does); nothing
        is turned then.
        """
        goals = self.resting(dials)
        checked_ramp(ramp_n, dials)
        with self._changing():
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
        """Where the wipers come to rest when pots are turned to these dials. Raises PotError, as turn does."""
        for pot, dial in dials.items():
            self._check_pot(pot)
            checked_dial(dial, pot)
        return {pot: self._wipers.resting(pot, dial) for pot, dial in dials.items()}

    def _check_pot(self, pot: str) -> None:
        if pot not in self._wipers.pots:
            raise PotError(f"no pot is called {pot!r}; there are {', '.join(sorted(self._wipers.pots)) or 'none'}")

    def throw(self, closed: Mapping[str, bool]) -> None:
        """Throws switches of the circuit, in any mode.

        Raises CircuitError for one that is not there, EngineError as turn() does; nothing is thrown then.
        """
        self._patched.with_switches(closed)
        with self._changing():
            self._closed |= closed

    def coefficient(self, pot: str) -> float:
        """Reads a pot in POT SET: the voltage of its wiper, under load, with its top on the reference, per reference.

        Raises ModeError in another mode, PotError for a pot that is not there.
        """
        return self._reading(self._pot_on_reference(pot), pot, self._dials[pot])

    def set_coefficient(self, pot: str, coefficient: float) -> None:
        """Turns a pot in POT SET until coefficient() reads so, to the nearest winding.

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

    def restart(self, mode: Mode = Mode.INITIAL_CONDITION) -> None:
        """Power off and on: empty capacitors, inputs at 0 V, dark lamps, the clock before sample 0; in that mode.

        The pots and the initial voltages stay as they are set; a pot on its way stays where it is.
        """
        self._mode = mode
        self._dials |= self._wipers.contacts_at_rest(self._turns)
        self._turns = {}
        self._levels_v = {source.name: 0.0 for source in self._patched.inputs}
        self._powered: Engine | None = None
        self._solved: PiecewiseLinear | None = None

    def set_initial(self, initial_v: Mapping[str, float]) -> None:
        """Sets the output voltages to which INITIAL CONDITION charges integrators.

        Raises CircuitError and, as turn() does, EngineError; nothing is set then.
        """
        wanted = self._initial_v | dict(initial_v)
        if wanted.keys() != self._initial_v.keys():
            strangers = ", ".join(sorted(wanted.keys() - self._initial_v.keys()))
            raise CircuitError(f"{strangers}: no such integrator; there are {', '.join(self._initial_v) or 'none'}")
        self._check_integrators(wanted)
        with self._changing(charged=self._powered):
            self._initial_v = wanted
            self._nodals = {mode: nodal for mode, nodal in self._nodals.items() if mode in (Mode.HOLD, Mode.OPERATE)}

    def switch(self, mode: Mode) -> None:
        """Switches at the present instant. The present mode again changes nothing.

        Raises ModeError, and EngineError or CircuitError for a circuit that cannot be in that mode; the machine stays
        in its mode then.
        """
        self._check_switches([mode])
        self._enter(mode)

    def window(self, samples: int) -> tuple[int, int]:
        """The ticks (start, stop) of the edges and switches that run(samples) takes next: start <= tick < stop."""
        return self._engine.window(samples)

    def run(
        self, samples: int, edges: Mapping[str, Edges] | None = None, switches: Sequence[RelaySwitch] = ()
    ) -> NDArray[np.float64]:
        """Records the next samples: float64 (samples, readings), V.

        edges: by input, within window(samples). switches: in order of time, from the present instant to the last of
        the run; one at the instant of a sample comes right after that sample. There are none while a pot is turning.
        Raises ModeError and EngineError, the former before anything is played.
        """
        edges = edges or {}
        self._check_switches([mode for _, mode in switches])
        if switches and self._turns:
            raise ModeError(
                f"relays cannot switch within a run while {', '.join(self._turns)} are being turned: "
                "switch() between two runs"
            )
        self._check_instants(samples, [tick for tick, _ in switches])
        volts = []
        stop = self.recorded + samples
        for (tick, mode), taken in zip(switches, _portions(edges, [tick for tick, _ in switches]), strict=False):
            volts.append(self._play_to(tick, taken))
            self._enter(mode)
        rest = _after(edges, switches[-1][0]) if switches else edges
        volts.append(self._play(stop - self.recorded, rest))
        return volts[0] if len(volts) == 1 else np.concatenate(volts)

    def repeat(
        self, cycles: int, initial_ticks: int, operate_ticks: int, edges: Mapping[str, Edges] | None = None
    ) -> NDArray[np.float64]:
        """Repetitive operation: INITIAL CONDITION and OPERATE by turns; float64 (cycles, samples, readings), V.

        A cycle begins right after a sample (sample 0 is taken first when there is none yet) and must last a whole
        number of samples; edges: by input, at ticks counted from the beginning of each cycle. With ic_ohm None, and
        inputs that begin each cycle at the same level, all cycles are equal bit for bit.
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
        """Made when it is first needed after a restart: most machines have their pots set before they are played."""
        if self._powered is None:
            self._powered = Engine(self._system, self._readings, self._sample_rate_hz)
            self._powered.watch(self._lamp_delay_ticks)
            self._charge_at_once(self._powered)
        return self._powered

    @property
    def _system(self) -> PiecewiseLinear:
        """The state space of the present mode, the pots as they are set now."""
        if self._solved is None:
            self._solved = self._nodal.at(self._dials, self._closed)
        return self._solved

    @property
    def _nodal(self) -> Nodal:
        """Of the present mode, at any setting of the pots."""
        nodal = self._nodals.get(self._mode)
        if nodal is None:
            nodal = self._nodals[self._mode] = Nodal(self._wired(self._mode))
        return nodal

    def _play_to(self, tick: int, edges: Mapping[str, Edges]) -> NDArray[np.float64]:
        """Records what samples there are up to a tick, and goes there."""
        samples = max(tick // TICKS_PER_SAMPLE + 1 - self.recorded, 0)
        if not samples:
            volts, later = np.empty((0, len(self._readings))), edges
        else:
            at_last = (self.recorded + samples - 1) * TICKS_PER_SAMPLE
            volts, later = self._play(samples, _until(edges, at_last)), _after(edges, at_last)
        self._engine.advance(tick, later)
        self._note_levels(later)
        return volts

    def _play(self, samples: int, edges: Mapping[str, Edges]) -> NDArray[np.float64]:
        if not (self._turns and samples):
            volts = self._engine.run(samples, edges)
        else:
            volts = np.concatenate(list(self._turned(self.recorded + samples, edges)))
        self._note_levels(edges)
        return volts

    def _turned(self, stop: int, edges: Mapping[str, Edges]) -> Iterator[NDArray[np.float64]]:
        """Records samples up to stop, in stretches in which the same pots are being turned."""
        while self._turns and self.recorded < stop:
            last = min(stop - 1, *(turn.last for turn in self._turns.values()))
            pieces = max(turn.pieces for turn in self._turns.values())
            until = last * TICKS_PER_SAMPLE
            yield self._engine.run_turning(last + 1 - self.recorded, self._while_turning, _until(edges, until), pieces)
            edges = _after(edges, until)
            self._dials |= self._dials_at(last)
            self._turns = {pot: turn for pot, turn in self._turns.items() if turn.last > last}
            self._changed()
        yield self._engine.run(stop - self.recorded, edges)

    def _while_turning(self, sample: float) -> PiecewiseLinear:
        return self._nodal.at(self._dials | self._dials_at(sample), self._closed)

    def _dials_at(self, sample: float) -> dict[str, float]:
        """The pots on their way, and the contacts of their wipers."""
        dials: dict[str, float] = {}
        for pot, turn in self._turns.items():
            dials[pot] = self._wipers.resting(pot, turn.at(sample))
            moves = turn.first < sample < turn.last
            dials |= self._wipers.contacts_moving(pot, dials[pot]) if moves else self._wipers.contacts_at_rest([pot])
        return dials

    def _note_levels(self, edges: Mapping[str, Edges]) -> None:
        self._levels_v |= {name: float(train.levels_v[-1]) for name, train in edges.items() if train.ticks.size}

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
            with self._changing(charged=self._engine):
                self._mode = mode

    @contextlib.contextmanager
    def _changing(self, charged: Engine | None = None) -> Iterator[None]:
        """Relays, pots, switches or initial voltages get another position within; all or, when it is refused, none."""
        before = self._position
        try:
            yield
            self._changed()
            if charged is not None:
                self._charge_at_once(charged)
        except EmulatorError:
            self._position = before
            self._changed()
            raise

    def _changed(self) -> None:
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
            levels_v = [self._levels_v[name] for name in self._system.inputs]
            engine.state = self._system.rest(np.array(levels_v)).state

    def _wired(self, mode: Mode) -> Circuit:
        """The circuit with the relays in the position of a mode."""
        if mode is Mode.OPERATE:
            return self._patched
        lifted = self._patches if mode is Mode.POT_SET else self._initial_v
        elements = list(self._patched.elements)
        for amplifier in lifted:
            elements = [_lifted(element, self._patches[amplifier]) for element in elements]
        if mode is not Mode.HOLD:
            elements += [part for name in self._initial_v for part in self._charging(self._patches[name])]
        return Circuit(elements)

    def _charging(self, patch: Patch) -> list[Element]:
        """The relays' charging circuit of one integrator: an inverter of gain 1 with the capacitor across it."""
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
        self._check_forgotten(initial_v)

    def _check_forgotten(self, initial_v: Mapping[str, float]) -> None:
        """An amplifier that only a capacitor feeds back drifts into its limit unless INITIAL CONDITION charges it."""
        ends = [frozenset(part.nodes) for part in self._patched.elements if not isinstance(part, Capacitor | OpAmp)]
        for amp in self._patched.of(OpAmp):
            patch = self._patches[amp.name]
            fed_back = any({patch.junction, patch.out} <= nodes for nodes in ends)
            if patch.capacitors and not fed_back and amp.name not in initial_v:
                raise CircuitError(f"{label(amp)}: an integrator needs an initial voltage, if only {amp.name}: 0.0")

    # ---- reading pots

    def _pot_on_reference(self, pot: str) -> Nodal:
        if self._mode is not Mode.POT_SET:
            raise ModeError(f"coefficients are read and set in POT SET, and this is {self._mode.value}")
        self._check_pot(pot)
        pot_top = self._terminal(pot, "top")
        elements = [
            _moved(element, pot_top, "reference") if element.name == pot or is_part_of(element, pot) else element
            for element in self._wired(Mode.POT_SET).elements
        ]
        return Nodal(Circuit([*elements, VoltageSource("reference", "reference", dc_v=REFERENCE_V)]))

    def _terminal(self, pot: str, end: str) -> str:
        """The node at which that end of a pot is patched: where what fitted() put there meets anything else."""
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


def lit(amplifiers: Iterable[str], kinks: Iterable[Kink], overdue_ticks: NDArray[np.int64]) -> dict[str, int | None]:
    """AnalogComputer.lamps, from what the engine saw of each kink."""
    lamps: dict[str, int | None] = dict.fromkeys(amplifiers)
    for kink, tick in zip(kinks, overdue_ticks.tolist(), strict=True):
        if tick >= 0 and kink.element in lamps:
            sample, before = -(-tick // TICKS_PER_SAMPLE), lamps[kink.element]
            lamps[kink.element] = sample if before is None else min(sample, before)
    return lamps


@dataclass(frozen=True)
class _Ramp:
    """A pot on its way, evenly, from one dial at sample `first` to another at sample `last`."""

    start: float
    goal: float
    first: int
    last: int

    def at(self, sample: float) -> float:
        """The dial."""
        if sample >= self.last:
            return self.goal
        return self.start + (self.goal - self.start) * max(sample - self.first, 0.0) / (self.last - self.first)

    @property
    def pieces(self) -> int:
        """Into how many pieces of standing dials a sample is cut: the error goes with speed / pieces^2."""
        speed_per_sample = abs(self.goal - self.start) / (self.last - self.first)
        return min(max(math.ceil(math.sqrt(speed_per_sample / _SLOW_PER_SAMPLE)), 1), _MOST_PIECES)


class _Position(NamedTuple):
    """All that decides which circuit the machine is."""

    mode: Mode
    nodals: dict[Mode, Nodal]
    initial_v: dict[str, float]
    dials: dict[str, float]
    turns: dict[str, _Ramp]
    closed: dict[str, bool]


class _Wipers:
    """What the wipers of a circuit's pots do: where they rest, and what their contacts do on the way."""

    def __init__(self, circuit: Circuit, components: Components) -> None:
        names = [pot.name for pot in circuit.of(Pot)]
        contacts = {contact_of(name) for name in names}
        self.pots = {
            pot.name: components.pots.model(pot.track_ohm) for pot in circuit.of(Pot) if pot.name not in contacts
        }
        self._contacts = {pot.name: components.contact(pot) for pot in circuit.of(Pot) if contact_of(pot.name) in names}

    def resting(self, pot: str, dial: float) -> float:
        """On the nearest winding."""
        return self.pots[pot].resting(dial)

    def contacts_at_rest(self, pots: Iterable[str]) -> dict[str, float]:
        """The dials of the contacts of these pots while their wipers stand: no resistance."""
        return {contact_of(pot): 1.0 for pot in pots if pot in self._contacts}

    def contacts_moving(self, pot: str, dial: float) -> dict[str, float]:
        """The dial of the contact while the wiper passes there."""
        if pot not in self._contacts:
            return {}
        places = self._contacts[pot]
        return {contact_of(pot): 1.0 - float(places[round(dial * (len(places) - 1))])}


def _lifted(element: Element, patch: Patch) -> Element:
    """An input of an amplifier with its end at the junction put on ground."""
    return _moved(element, patch.junction, GROUND) if element.name in patch.inputs else element


def _moved(element: Element, node: str, to: str) -> Element:
    """The element with its ends at one node moved to another."""
    ends: dict[str, Any] = {
        field.name: to for field in fields(element) if field.name != "name" and getattr(element, field.name) == node
    }
    return replace(element, **ends)


def _portions(edges: Mapping[str, Edges], ticks: Sequence[int]) -> Iterator[Mapping[str, Edges]]:
    """The edges up to the first of the ticks, from there up to the second, and so on."""
    for tick in ticks:
        yield _until(edges, tick)
        edges = _after(edges, tick)


def _until(edges: Mapping[str, Edges], tick: int) -> dict[str, Edges]:
    return {name: train.until(tick) for name, train in edges.items()}


def _after(edges: Mapping[str, Edges], tick: int) -> dict[str, Edges]:
    return {name: train.after(tick) for name, train in edges.items()}
