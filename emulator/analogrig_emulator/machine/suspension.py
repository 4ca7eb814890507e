"""Analogue computer wired with a program: pots set by physical values, plays from rest."""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.card.smooth import RecordedExcitation
from analogrig_emulator.circuit.circuit import Circuit
from analogrig_emulator.circuit.components import NOMINAL, Components
from analogrig_emulator.circuit.nonlinear import MULTIPLIERS, Multiplier, MultiplierModel
from analogrig_emulator.circuit.opamp import OpAmpModel, preset
from analogrig_emulator.circuit.pot import PotModel, PotTurn, check_dial, check_ramp
from analogrig_emulator.engine.system import Edges, Law, is_integer
from analogrig_emulator.exceptions import CircuitError, EngineError, PotError
from analogrig_emulator.machine.analog_computer import AnalogComputer
from analogrig_emulator.machine.program_circuit import SOURCE, ProgramCircuit, Scales
from analogrig_emulator.machine.quarter_car import FRONT, SHOCK
from analogrig_emulator.machine.relays import Mode

PROGRAMS: Mapping[str, ProgramCircuit] = MappingProxyType({program.name: program for program in (FRONT, SHOCK)})
"""Circuits wired by hand, by the name of their program. Others are compiled from files."""

BLOCK_SAMPLES = 32768
"""Default block, 1 MB: in smaller blocks the calls cost more than a quiet stretch."""


class SuspensionComputer:
    """Machine wired with a program.

    program: a name in PROGRAMS or a ProgramCircuit. opamp: the name of a preset ("tl07x", "741", "ideal") or a model.
    multiplier: model of every multiplier. components: real components for the program's diagram;
    Components(given=...) sets single deviations.
    Pots are set to the program's values, with the real load connected.
    rng, offset_v: with an rng, each op-amp has an offset uniform within +-offset_v, drawn from U1 on.
    machine: the AnalogComputer, for operation by hand. The program's integrators (front: U2 and U3, at +velocity and
    -displacement) begin at 0 V. Its lamps are those of the last play.
    Raises CircuitError, PotError.
    """

    def __init__(
        self,
        program: str | ProgramCircuit = "front",
        *,
        opamp: str | OpAmpModel = "tl07x",
        multiplier: MultiplierModel = MULTIPLIERS["ideal"],
        components: Components = NOMINAL,
        rng: np.random.Generator | None = None,
        offset_v: float = 3e-3,
        sample_rate_hz: float = 20e3,
    ) -> None:
        self.program = _program(program)
        self.sample_rate_hz = sample_rate_hz
        if not 0 <= offset_v < math.inf:
            raise CircuitError(f"offset_v must be finite and not negative, got {offset_v!r}")
        model, count = preset(opamp) if isinstance(opamp, str) else opamp, self.program.amplifiers
        offsets_v = None if rng is None else drawn_offsets_v(model, rng.random(count), offset_v).tolist()
        if components.is_perfect and isinstance(self.program, Hashable):
            circuit, self._pots = _nominal(self.program, model, multiplier)
            if offsets_v is not None:
                circuit = circuit.with_offsets({f"U{i}": vos_v for i, vos_v in enumerate(offsets_v, 1)})
        else:
            models = [replace(model, vos_v=vos_v) for vos_v in offsets_v or [model.vos_v] * count]
            circuit, self._pots = _wired(self.program, models, multiplier, components)
        self.machine = AnalogComputer(
            circuit,
            self.program.channel_nodes,
            initial_v=dict.fromkeys(self.program.integrators, 0.0),
            sample_rate_hz=sample_rate_hz,
            components=components,
        )
        self._values = dict(self.program.values)
        self.machine.turn({pot: self._dial(pot, self._values) for pot in self._pots})
        self._plays = 0
        self.probed: NDArray[np.float64] = np.empty((0, 0))
        """Volts of the probed nodes in the last block of play_in_steps(): (samples, probes)."""

    @property
    def circuit(self) -> Circuit:
        """Netlist with the present pots."""
        return self.machine.circuit

    @property
    def scales(self) -> Scales:
        """Scales of the program."""
        return self.program.scales

    @property
    def dials(self) -> dict[str, float]:
        """Dials by pot, 0..1 (front: M, B and K)."""
        return self.machine.dials

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients by pot, under load."""
        return {pot: self._pots[pot].coefficient(dial) for pot, dial in self.dials.items()}

    def set(self, ramp_n: int = 0, /, **settings: float) -> None:
        """Set pots by value (front: M, B, K) or by dial (M_dial, B_dial, K_dial, 0..1).

        Values set the coefficient under load, as in pot-set mode. A running machine keeps its voltages. With ramp_n
        the pots arrive so many samples after the last one taken.
        Raises PotError naming the pot; no pot is turned then.
        """
        values = dict(self._values)
        self.machine.turn(self._resolve(settings, values), ramp_n)
        self._values = values

    def dials_for(self, **settings: float) -> dict[str, float]:
        """Dials to which set(**settings) turns the pots."""
        return self.machine.resting(self._resolve(settings, dict(self._values)))

    def dials_between(self, settings: Mapping[str, float]) -> dict[str, float]:
        """Dials for settings on continuous tracks, between windings. Raises PotError."""
        return self._resolve(settings, dict(self._values))

    def plan(self, changes: Sequence[PotTurn], samples: int) -> list[PotTurn]:
        """Dials by pot that play(..., samples, changes) sets, in order of time. Raises PotError."""
        planned, values = [], dict(self._values)
        for sample, settings, ramp_n in sorted(changes, key=lambda change: change.sample):
            if not (is_integer(sample) and 0 <= sample < samples):
                raise PotError(
                    f"change of {', '.join(settings)} at sample {sample!r}: the run has samples 0 to {samples - 1}"
                )
            dials = self.machine.resting(self._resolve(settings, values))
            planned.append(PotTurn(sample, dials, check_ramp(ramp_n, settings)))
        return planned

    def play(
        self,
        excitation: Excitation | RecordedExcitation,
        samples: int,
        changes: Sequence[PotTurn] = (),
        block_samples: int = BLOCK_SAMPLES,
        ahead_ticks: int = 0,
    ) -> Iterator[NDArray[np.float64]]:
        """Play from rest; yield the volts of the channels in blocks: float64 (block_samples or, last, fewer; channels).

        If ahead_ticks is not 0, a row has twice as many volts: those of the sample, and those so many ticks later, as
        for Engine.

        The excitation's first level or sample applies at sample 0. A change takes effect right after its sample is
        taken; a ramp begins there. Pots stay where the changes leave them. set() between two blocks acts likewise.
        Raises PotError, ExcitationError and EngineError; for invalid arguments before anything is played.
        """
        return self.play_planned(excitation, samples, self.plan(changes, samples), block_samples, ahead_ticks)

    def play_planned(
        self,
        excitation: Excitation | RecordedExcitation,
        samples: int,
        turns: Sequence[PotTurn],
        block_samples: int = BLOCK_SAMPLES,
        ahead_ticks: int = 0,
    ) -> Iterator[NDArray[np.float64]]:
        """Play like play(), with turns from plan()."""
        if samples < 0 or block_samples < 1:
            raise EngineError(f"cannot play {samples} samples in blocks of {block_samples}")
        lengths = (min(block_samples, samples - start) for start in range(0, samples, block_samples))
        return self._begin(excitation, lengths, list(turns), ahead_ticks)

    def play_in_steps(
        self, excitation: Excitation, lengths: Iterable[int], probes: Sequence[str] = (), ahead_ticks: int = 0
    ) -> Iterator[NDArray[np.float64]]:
        """Play from rest like play(), in blocks of these lengths, each drawn when its block is requested.

        Between two blocks set() turns the pots and machine.switch() the relays. probes: nodes to read as well, into
        `probed`. The volts are those of play() to the bit. Raises ExcitationError, EngineError and CircuitError.
        """
        return self._begin(excitation, lengths, [], ahead_ticks, probes)

    # ---- playing

    def _begin(
        self,
        excitation: Excitation | RecordedExcitation,
        lengths: Iterable[int],
        turns: list[PotTurn],
        ahead_ticks: int,
        probes: Sequence[str] = (),
    ) -> Iterator[NDArray[np.float64]]:
        if isinstance(excitation, Excitation):
            excitation.check_rate(self.sample_rate_hz)
        drives = {SOURCE: excitation.drive(0, 1, self.sample_rate_hz)} if excitation.is_smooth else {}
        self.machine.read_nodes((*self.program.channel_nodes, *probes))
        self.machine.restart(Mode.OPERATE, ahead_ticks, drives)
        self._plays += 1
        return self._blocks(self._plays, excitation, lengths, turns)

    def _blocks(
        self,
        play: int,
        excitation: Excitation | RecordedExcitation,
        lengths: Iterable[int],
        turns: list[PotTurn],
    ) -> Iterator[NDArray[np.float64]]:
        stop = 0
        for length in lengths:
            stop += length
            parts = []
            window = self.machine.window(length)
            edges = self._excite(excitation, window)
            while play == self._plays and self.machine.recorded < stop:
                now = [turn for turn in turns if turn.sample < stop]
                if not self.machine.is_turning and not any(turn.ramp_n for turn in now):
                    parts.append(self._advance(edges, stop - self.machine.recorded, now))
                    del turns[: len(now)]
                    continue
                until = min(stop, turns[0].sample + 1) if turns else stop
                parts.append(self._advance(edges, until - self.machine.recorded))
                while turns and turns[0].sample + 1 == self.machine.recorded:
                    turn = turns.pop(0)
                    self.machine.turn(turn.values, turn.ramp_n)
            if play != self._plays:
                raise EngineError("this play was ended by a newer one on the same machine")
            yield parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _excite(self, excitation: Excitation | RecordedExcitation, window: tuple[int, int]) -> Edges:
        """Edges of a window; the machine follows a level that moves all the time instead."""
        if not excitation.is_smooth:
            return excitation.edges(*window, self.sample_rate_hz)
        self.machine.follow({SOURCE: excitation.drive(*window, self.sample_rate_hz)})
        return Edges.none()

    def _advance(self, edges: Edges, samples: int, turns: Sequence[PotTurn] = ()) -> NDArray[np.float64]:
        """Volts of the next samples, with these turns, all at once: (samples, channels)."""
        trains = {SOURCE: edges.within(*self.machine.window(samples))} if edges.ticks.size else {}
        jumps = [(turn.sample, turn.values) for turn in turns]
        volts = self.machine.run_jumping(samples, jumps, trains) if jumps else self.machine.run(samples, trains)
        channels = len(self.program.channels)
        readings = self.machine.readings
        by_instant = volts.reshape(samples, volts.shape[1] // readings, readings)
        self.program.orient(by_instant[..., :channels])
        if readings == channels:
            return volts
        self.probed = by_instant[:, 0, channels:]
        return by_instant[..., :channels].reshape(samples, -1)

    # ---- pots

    def _resolve(self, settings: Mapping[str, float], values: dict[str, float]) -> dict[str, float]:
        """Dials for settings, which are entered into the values of the parameters."""
        dials: dict[str, float] = {}
        for key, value in settings.items():
            if key in self.program.values:
                values[key] = value
                continue
            pot = key.removesuffix("_dial")
            if pot == key or pot not in self._pots:
                known = (*self.program.values, *(f"{name}_dial" for name in self._pots))
                raise PotError(f"unknown setting {key!r}; there are {', '.join(known)}")
            dials[pot] = check_dial(value, pot)
        for pot, row in self.program.pots.items():
            if any(name in settings for name in row.settings):
                if pot in dials:
                    raise PotError(f"pot {pot}: set twice at the same time")
                dials[pot] = self._dial(pot, values, settings)
        return dials

    def _dial(self, pot: str, values: Mapping[str, float], settings: Mapping[str, float] | None = None) -> float:
        """Dial of a pot for values of the parameters; settings: those to name in an error, all by default."""
        try:
            return self._pots[pot].dial(self.program.pot_coefficient(pot, values))
        except PotError as cause:
            named = self.program.pots[pot].settings
            texts = [f"{name} = {values[name]:g}" for name in named if settings is None or name in settings]
            limit = self._limit(pot, values) if len(named) == 1 else ""
            raise PotError(
                f"{', '.join(texts)} cannot be set on program {self.program.name}{limit}: {cause}"
            ) from cause

    def _limit(self, pot: str, values: Mapping[str, float]) -> str:
        """Limit of the one parameter that turns a pot, in words; empty if it follows no power law."""
        (name,) = self.program.pots[pot].settings
        value = values[name]
        if not 0.0 < value < math.inf:
            return ""
        here, doubled = (self.program.pot_coefficient(pot, dict(values) | {name: each}) for each in (value, 2 * value))
        power = math.log2(doubled / here)
        if not power or abs(power - round(power)) > _EXACT:
            return ""
        low, high = (self._pots[pot].coefficient(dial) for dial in (0.0, 1.0))
        end, is_most = (high, power > 0) if here > low else (low, power < 0)
        if not end:
            return ""
        limit = value * (end / here) ** (1.0 / power)
        digit = 10.0 ** (math.floor(math.log10(limit)) - 3)
        within = math.floor(limit / digit + _EXACT) if is_most else math.ceil(limit / digit - _EXACT)
        return f", whose {name} is at {'most' if is_most else 'least'} {within * digit:.4g}"


_EXACT = 1e-9


class _LoadedPot(NamedTuple):
    """Pot with its load to a virtual ground."""

    model: PotModel
    name: str
    load_ohm: float

    def coefficient(self, dial: float) -> float:
        return self.model.coefficient(dial, self.load_ohm)

    def dial(self, coefficient: float) -> float:
        return self.model.dial(coefficient, self.load_ohm, self.name)


_LoadedPots: TypeAlias = dict[str, _LoadedPot]


def _wired(
    program: ProgramCircuit, models: Sequence[OpAmpModel], multiplier: MultiplierModel, components: Components
) -> tuple[Circuit, _LoadedPots]:
    """Circuit of a program with these op-amps, multipliers and components, and its pots."""
    netlist = program.netlist(models)
    fitted = [
        replace(each, model=multiplier) if isinstance(each, Multiplier) and each.law is Law.PRODUCT else each
        for each in netlist
    ]
    circuit = Circuit(components.fit(fitted))
    return circuit, _pots(program, circuit, components)


@functools.lru_cache(maxsize=8)
def _nominal(program: ProgramCircuit, model: OpAmpModel, multiplier: MultiplierModel) -> tuple[Circuit, _LoadedPots]:
    """The same with perfect components. Equal machines share their circuit, and with it its equations."""
    return _wired(program, [model] * program.amplifiers, multiplier, NOMINAL)


def _pots(program: ProgramCircuit, circuit: Circuit, components: Components) -> _LoadedPots:
    return {
        pot: _LoadedPot(components.pots.model(track_ohm), pot, load_ohm)
        for pot, (track_ohm, load_ohm) in program.pot_ohms(circuit.elements).items()
    }


def _program(program: str | ProgramCircuit) -> ProgramCircuit:
    if isinstance(program, ProgramCircuit):
        return program
    if program not in PROGRAMS:
        raise CircuitError(f"unknown program {program!r}; there are {', '.join(PROGRAMS)}, or load_patch(file)")
    return PROGRAMS[program]


def drawn_offsets_v(model: OpAmpModel, uniforms: NDArray[np.float64], offset_v: float) -> NDArray[np.float64]:
    """Input offsets of op-amps, in V, from uniform numbers from 0 to 1: the model's plus one within +-offset_v."""
    return np.asarray(model.vos_v + (-offset_v + 2.0 * offset_v * uniforms))
