"""Noise-free courses of one channel of a machine, from any sample on and with its parameters at any values.

A judge compares such courses with and without a change. Pots stand between windings here. A coefficient beyond 1 is
taken into an input of ten times the gain, because rivals of a plant may exceed its pots.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.card.acquisition import on_card_clock, probe_of_channel, probes_per_sample
from analogrig_emulator.card.excitation import Excitation
from analogrig_emulator.card.sampler import Card
from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.elements import Resistor
from analogrig_emulator.circuit.nodal import analyse
from analogrig_emulator.circuit.opamp import OpAmpModel
from analogrig_emulator.engine.engine import CircuitSchedule, Engine
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Edges, PiecewiseLinear
from analogrig_emulator.exceptions import CircuitError, PotError
from analogrig_emulator.machine.program_circuit import SOURCE, PotRow, ProgramCircuit, Scales
from analogrig_emulator.machine.suspension import SuspensionComputer

Matrix = NDArray[np.float64]

_WIDE_GAIN = 10.0

_MOST_STEPS = 256
"""Steps in which pots turn during a ramp; a step is at least a sample long, and shows its middle."""


class LinearMode(NamedTuple):
    """State space from one input of a circuit to a node: dx/dt = flow x + driven u, v = reading x + direct u."""

    flow: Matrix  # (n, n) 1/s
    driven: Matrix  # (n,) 1/s
    reading: Matrix  # (n,)
    direct: float


def linear_mode(circuit: PiecewiseLinear, source: str, node: str, sign: float) -> LinearMode:
    """State space of the circuit with every kink in its middle piece; sign: of the node in the output.

    Raises CircuitError for a circuit with multipliers.
    """
    if circuit.products:
        raise CircuitError("a circuit with multipliers has no linear mode")
    n, (row,) = len(circuit.states), circuit.rows([node])
    slopes = np.array([kink.slopes[1] for kink in circuit.kinks])
    phi = slopes[:, None] * np.linalg.solve(np.eye(len(slopes)) - circuit.w_phi * slopes, circuit.cde)
    flow = circuit.abc + circuit.g @ phi
    reading = sign * (circuit.lmn[row] + circuit.v_phi[row] @ phi)
    at = n + circuit.inputs.index(source)
    return LinearMode(flow[:, :n], flow[:, at], reading[:n], float(reading[at]))


class Wired(NamedTuple):
    """Machine to play, and the one whose pots show the dials: a nominal one where pots are digital."""

    machine: SuspensionComputer
    dials: SuspensionComputer


class Moment(NamedTuple):
    """Voltages of a machine's states at a sample."""

    sample: int
    state: Matrix


class Course:
    """Course of the channel from the sample after a moment on."""

    def __init__(
        self, courses: Courses, start: Moment, turns: Sequence[tuple[int, PiecewiseLinear]], probe: int
    ) -> None:
        """turns: circuits and the probes after which they begin, the first at once. Samples are taken at a probe."""
        self._courses, self._start, self._turns, self._probe = courses, start, turns, probe
        self._edges = courses.edges_from(start.sample)
        self._engine = courses.engine(turns[0][1], start.sample)
        self._engine.state = start.state
        self._coming = list(turns[1:])

    def advance(self, samples: int) -> Matrix:
        """Voltages of the next samples, (samples,). Raises EngineError."""
        probes = self._courses.probes
        first = 0 if self._engine.recorded else 1 + self._probe
        count = first + samples * probes
        now = [turn for turn in self._coming if turn[0] < self._engine.recorded + count]
        del self._coming[: len(now)]
        edges = {} if self._edges is None else {SOURCE: self._edges.within(*self._engine.window(count))}
        volts = self._engine.run_changing(count, now, edges) if now else self._engine.run(count, edges)
        return self._courses.sign * volts[first + probes - 1 :: probes, 0]

    def moment(self) -> Moment:
        """Moment of the last sample; there must be one. Raises EngineError."""
        samples = (self._engine.recorded - 1) // self._courses.probes
        if not self._probe:
            return Moment(self._start.sample + samples, self._engine.state)
        course = Course(self._courses, self._start, self._turns, 0)
        course.advance(samples)
        return course.moment()


class Courses:
    """Courses of one channel of a machine under one excitation.

    wire: machines whose pots feed inputs of a gain, to be called with 1, and with 10 where a coefficient exceeds 1.
    samples: length of the run; channel: index of the card's channel. Raises ExcitationError, SamplerError.
    """

    def __init__(
        self, wire: Callable[[float], Wired], card: Card, excitation: Excitation, samples: int, channel: int
    ) -> None:
        self._wire = functools.cache(wire)
        self._machine = self._wire(1.0).machine
        self.probes, self._probe = probes_per_sample(card), probe_of_channel(card, channel)
        program = self._machine.program
        self._nodes = (program.channel_nodes[channel],)
        self.sign = float(program.channel_signs[channel])
        generator, until = on_card_clock(card, excitation), (0, self._tick(samples), self._machine.sample_rate_hz)
        self._drive = generator.drive(*until) if generator.is_smooth else None
        self._edges = None if generator.is_smooth else generator.edges(*until)
        self._later: dict[int, Edges] = {}

    @property
    def parameters(self) -> Mapping[str, float]:
        """Parameters that pots show, with their values in the program."""
        return self._machine.program.values

    def at_rest(self, values: Mapping[str, float]) -> Moment:
        """Moment of sample 0, after a start from rest."""
        ((_, circuit),) = self._turns(values, values, 0)
        return Moment(0, np.zeros(len(circuit.states)))

    def linear_mode(self, values: Mapping[str, float]) -> LinearMode:
        """State space from the source to the channel, with these values.

        Raises CircuitError for a circuit with multipliers.
        """
        ((_, circuit),) = self._turns(values, values, 0)
        return linear_mode(circuit, SOURCE, self._nodes[0], self.sign)

    def course(self, start: Moment, before: Mapping[str, float], after: Mapping[str, float], ramp_n: int = 0) -> Course:
        """Course from a moment on, with pots that turn there from one set of values to another.

        Raises PotError for values beyond pots and gains, and EngineError.
        """
        return Course(self, start, self._turns(before, after, ramp_n), self._probe)

    def engine(self, circuit: PiecewiseLinear, sample: int) -> Engine:
        """Engine of the machine, at rest before a sample, which it counts as its first."""
        drives = {} if self._drive is None else {SOURCE: self._drive.after(sample * self.probes)}
        return Engine(circuit, self._nodes, self._machine.sample_rate_hz, drives=drives)

    def edges_from(self, sample: int) -> Edges | None:
        """Edges after a sample, counted from there, with the level at the sample first; None for a smooth level."""
        if self._edges is None:
            return None
        if sample not in self._later:
            tick = self._tick(sample)
            level_v = self._edges.levels_v[np.searchsorted(self._edges.ticks, tick, "right") - 1]
            later = self._edges.after(tick).shifted(-tick)
            self._later = {sample: Edges(np.append(0, later.ticks), np.append(level_v, later.levels_v))}
        return self._later[sample]

    def _turns(
        self, before: Mapping[str, float], after: Mapping[str, float], ramp_n: int
    ) -> list[tuple[int, PiecewiseLinear]]:
        """Circuits and the probes after which they begin. During a ramp the dials turn in even steps."""
        try:
            return self._turns_at_gain(1.0, before, after, ramp_n)
        except PotError:
            return self._turns_at_gain(_WIDE_GAIN, before, after, ramp_n)

    def _turns_at_gain(
        self, gain: float, before: Mapping[str, float], after: Mapping[str, float], ramp_n: int
    ) -> list[tuple[int, PiecewiseLinear]]:
        machine, shown = self._wire(gain)
        goal = shown.dials_between(after)
        last = (ramp_n * self.probes, machine.machine.operating(goal))
        if not ramp_n:
            return [last]
        start, step_n = shown.dials_between(before), -(-ramp_n // _MOST_STEPS)
        places = [(first, min(first + step_n, ramp_n)) for first in range(0, ramp_n, step_n)]
        turns = []
        for first, end in places:
            part = (first + end) / (2 * ramp_n)
            between = {pot: start[pot] + part * (dial - start[pot]) for pot, dial in goal.items()}
            turns.append((first * self.probes, machine.machine.operating(between)))
        return [*turns, last]

    def _tick(self, sample: int) -> int:
        return sample * self.probes * TICKS_PER_SAMPLE


class RepeatedCourses:
    """Courses of machines that differ in op-amp offsets, each with its phase of the excitation: Courses to the bit.

    wired: machine that is_repeatable(), taken at every sample of the card; phases: (plays,); offsets_v: (plays,
    amplifiers) V from U1 on; samples, channel: as for Courses. Raises ExcitationError and CircuitError.
    """

    def __init__(
        self,
        wired: Wired,
        excitation: Excitation,
        phases: Matrix,
        offsets_v: Matrix,
        samples: int,
        channel: int,
    ) -> None:
        self._wired, self._offsets_v = wired, offsets_v
        machine = wired.machine
        self._nodal = analyse(machine.circuit)
        self.at_rest = Moment(0, np.zeros(len(self._nodal.at(machine.dials).states)))
        self._nodes = (machine.program.channel_nodes[channel],)
        self._sign = float(machine.program.channel_signs[channel])
        self._edges = excitation.edges_at(phases, 0, samples * TICKS_PER_SAMPLE, machine.sample_rate_hz)

    def play(
        self, values: Mapping[str, float], start: int, samples: int, states_v: Matrix | None
    ) -> tuple[Matrix, Matrix]:
        """Voltages (plays, samples) after the sample `start`, and states (plays, n) at the last one.

        values: of the parameters; states_v: (plays, n) V at `start`, None: at rest. Raises PotError and EngineError.
        """
        dials = {**self._wired.machine.dials, **self._wired.dials.dials_between(values)}
        system, trim = self._nodal.with_trim(dials)
        schedule = CircuitSchedule([system], self._nodes, [samples], TICKS_PER_SAMPLE, trim.rows)
        numbers = [int(name.removeprefix("U")) - 1 for name in trim.amps]
        constants = (trim.apart_v + self._offsets_v[:, None, numbers]) * trim.gain_rate
        edges = self._edges.between(start * TICKS_PER_SAMPLE, (start + samples) * TICKS_PER_SAMPLE)
        engine = Engine(system, self._nodes, self._wired.machine.sample_rate_hz)
        plays = engine.play_all(schedule, constants, {SOURCE: edges}, states_v)
        return self._sign * plays.volts[:, 1:, 0], plays.states_v


@dataclass(frozen=True)
class WideProgram(ProgramCircuit):
    """Program whose pots feed inputs of so many times the gain, with as much smaller coefficients."""

    program: ProgramCircuit
    gain: float

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.program.name

    @property
    def scales(self) -> Scales:
        return self.program.scales

    @property
    def amplifiers(self) -> int:
        return self.program.amplifiers

    @property
    def integrators(self) -> tuple[str, ...]:
        return self.program.integrators

    @property
    def channels(self) -> tuple[str, ...]:
        return self.program.channels

    @property
    def values(self) -> dict[str, float]:
        return self.program.values

    @property
    def pots(self) -> Mapping[str, PotRow]:
        return self.program.pots

    def netlist(self, models: Sequence[OpAmpModel]) -> list[Element]:
        loads = {row.load for row in self.pots.values()}
        return [
            replace(each, ohm=each.ohm / self.gain) if isinstance(each, Resistor) and each.name in loads else each
            for each in self.program.netlist(models)
        ]

    def pot_coefficient(self, pot: str, values: Mapping[str, float]) -> float:
        return self.program.pot_coefficient(pot, values) / self.gain
