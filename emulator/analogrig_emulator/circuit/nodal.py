"""Piecewise-linear state space of a circuit (engine/system.py), by modified nodal analysis.

x: the voltage of every capacitor, then the voltage behind the output resistance of every op-amp that has a pole, then
that of every multiplier with a bandwidth (netlist order each).
u: the voltage sources that are inputs, then the product of every multiplier. v: every node voltage. phi: one Kink per
element of w: for each op-amp and multiplier its slew limit, then its clamp, then the limit of its current; for each
diode limiter the voltage beyond its threshold; for each function generator the bends of its input; for each op-amp that
recovers from overloads the voltage beyond its swing; last the two arguments of every product.

With x and u held, the circuit is resistive. Capacitors become voltage sources x, op-amp poles voltage sources x
behind their output resistance. Kirchhoff's current law at every node, and one equation per branch whose current is
unknown, give one linear system with right-hand side columns [x | u | 1 | phi of limiters and bends]; its solution is
[L M n R] and the branch currents, and A, B, c, G follow from it: a capacitor's dx/dt is its current over its
capacitance, an op-amp's is its law (opamp.py). Only elementwise arithmetic and engine_solve are used, no BLAS,
so a circuit has the same bits on every machine.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import (
    Capacitor,
    Circuit,
    CurrentSource,
    DiodeLimiter,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
    element_error,
)
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.circuit.opamp import CLAMP_RATE, OpAmpModel
from analogrig_emulator.circuit.part import GROUND
from analogrig_emulator.circuit.pot import check_dial, legs_ohm
from analogrig_emulator.engine import library
from analogrig_emulator.engine.system import Kink, Matrix, PiecewiseLinear, solve_in_place
from analogrig_emulator.errors import CircuitError


def piecewise_linear(circuit: Circuit) -> PiecewiseLinear:
    """State space of a circuit with its pots at their dials.

    Raises CircuitError naming the node where the circuit is singular.
    """
    return analyse(circuit).at({})


def analyse(circuit: Circuit) -> Nodal:
    """Nodal analysis of a circuit, made once. Circuits that differ in offsets alone share all that allows it.

    Raises CircuitError for a circuit that exceeds the limits of the engine.
    """
    return circuit.derive(Nodal if circuit.untrimmed is circuit else _trimmed)


def _trimmed(circuit: Circuit) -> Nodal:
    untrimmed = analyse(circuit.untrimmed)
    return Nodal(circuit, untrimmed if untrimmed.can_be_trimmed else None)


_KEPT_SYSTEMS = 256

_Place: TypeAlias = tuple[tuple[float, ...], tuple[bool, ...]]
"""Dials of all pots and positions of all switches."""

_T = TypeVar("_T")


def _keep(kept: dict[_Place, _T], place: _Place, value: _T) -> _T:
    """Store a value in the place of the oldest if there are _KEPT_SYSTEMS. Return it."""
    if len(kept) >= _KEPT_SYSTEMS:
        del kept[next(iter(kept))]
    kept[place] = value
    return value


class Nodal:
    """Equations of one circuit with all but pots and switches entered, so that turning a pot is cheap.

    The last state spaces are kept: returning to earlier dials costs nothing.
    untrimmed: analysis of a circuit that differs in offsets alone, with can_be_trimmed.
    Raises CircuitError for a circuit that exceeds the limits of the engine.
    """

    _laws: _Laws

    def __init__(self, circuit: Circuit, untrimmed: Nodal | None = None) -> None:
        if untrimmed is None:
            self._build(circuit)
        else:
            vars(self).update(vars(untrimmed))
            self._poles = circuit.of(OpAmp)
            offset = self._laws.offset.copy()
            offset[self._laws.poles] = [amp.model.vos_v for amp in self._poles]
            self._laws = replace(self._laws, offset=offset)
        self._circuit = circuit
        self._untrimmed = untrimmed
        self._kept: dict[_Place, PiecewiseLinear] = {}
        self._trims: dict[_Place, Trim] = {}

    def _build(self, circuit: Circuit) -> None:
        self._circuit = circuit
        self._pots = circuit.of(Pot)
        self._switches = circuit.of(Switch)
        self._limiters = circuit.of(DiodeLimiter)
        self._capacitors = circuit.of(Capacitor)
        self._inputs = circuit.inputs
        amps = circuit.of(OpAmp)
        self._poles = tuple(amp for amp in amps if amp.model.has_state)
        self._multipliers = circuit.of(Multiplier)
        self._functions = circuit.of(Function)
        followers = tuple(part for part in self._multipliers if part.model.has_state)
        branches = [element.name for element in self._capacitors] + [
            source.name for source in circuit.of(VoltageSource)
        ]
        outputs: tuple[OpAmp | Multiplier, ...] = (*amps, *self._multipliers)
        branches += [part.name for part in outputs if not (part.model.has_state and part.model.rout_ohm > 0)]
        branches += [function.name for function in self._functions]

        self._nodes = circuit.nodes
        self._unknowns = [("node", node) for node in self._nodes] + [("current of", name) for name in branches]
        # Ground has the last row and column, which are left out of the solution.
        self._row = {node: i for i, node in enumerate(self._nodes)} | {GROUND: len(self._unknowns)}
        self._branch = {name: len(self._nodes) + i for i, name in enumerate(branches)}
        holders: list[Capacitor | OpAmp | Multiplier] = [*self._capacitors, *self._poles, *followers]
        self._state = {element.name: i for i, element in enumerate(holders)}
        self._columns = len(self._state) + len(self._inputs) + len(self._multipliers) + 1
        limited: tuple[OpAmp | Multiplier, ...] = (*self._poles, *followers)
        limits = [_limits(part) for part in limited]
        self._kinks = tuple(kink for kinks in limits for kink in kinks.values())
        first_source = len(self._kinks)
        self._kinks += tuple(Kink.deadzone(-math.inf, limiter.threshold_v, limiter.name) for limiter in self._limiters)
        self._kinks += tuple(kink for function in self._functions for kink in function.kinks)
        self._recovering = tuple(amp for amp in self._poles if amp.model.recovers)
        self._kinks += tuple(Kink.deadzone(*amp.model.swing_v, amp.name) for amp in self._recovering)
        self._sources = slice(first_source, len(self._kinks))
        self._kinks += tuple(Kink.none(part.name) for part in self._multipliers for _ in "xy")
        self._check_size()

        size = len(self._unknowns) + 1
        self._left = np.zeros((size, size))
        self._right = np.zeros((size, self._columns + self._sources.stop - first_source))
        ends = [(switch.a, switch.b) for switch in self._switches]
        self._leg_places = self._places(ends + [bond for pot in self._pots for bond in pot.bonds])
        parts = _Parts(self._capacitors, self._poles, self._multipliers, self._limiters, self._functions, limits)
        self._laws = _Laws.of(self._row, self._branch, parts, len(self._state) + len(self._inputs))
        self._enter(circuit)

    def at(self, dials: Mapping[str, float], closed: Mapping[str, bool] | None = None) -> PiecewiseLinear:
        """State space with pots at `dials` and switches at `closed`; the others are as in the netlist.

        Raises PotError for a dial off its track, CircuitError for a singular circuit.
        """
        closed = closed or {}
        place = self._place(dials, closed)
        if place in self._kept:
            return self._kept[place]
        if self._untrimmed is None:
            return _keep(self._kept, place, self._system(self._solution(dials, closed)))
        system, trim = self._untrimmed.with_trim(dials, closed)
        return _keep(self._kept, place, trim.apply(system, self._laws.offset[self._laws.poles]))

    @property
    def can_be_trimmed(self) -> bool:
        """True if offsets enter nothing but the drives of their own op-amps."""
        return len(self._poles) == len(self._circuit.of(OpAmp))

    def _place(self, dials: Mapping[str, float], closed: Mapping[str, bool]) -> _Place:
        return (
            tuple([dials.get(pot.name, pot.dial) for pot in self._pots]),
            tuple([closed.get(switch.name, switch.closed) for switch in self._switches]),
        )

    def _system(self, solution: Matrix) -> PiecewiseLinear:
        abc, g, cde, w_phi = self._flow(solution)
        voltages = solution[: len(self._nodes)]
        return PiecewiseLinear(
            states=tuple(self._state),
            inputs=tuple(source.name for source in self._inputs),
            nodes=self._nodes,
            kinks=self._kinks,
            abc=abc,
            g=g,
            cde=cde,
            w_phi=w_phi,
            lmn=voltages[:, : self._columns],
            v_phi=self._spread(voltages),
            products=tuple(part.product for part in self._multipliers),
        )

    def with_trim(
        self, dials: Mapping[str, float], closed: Mapping[str, bool] | None = None
    ) -> tuple[PiecewiseLinear, Trim]:
        """State space of at(), and the trim by which op-amp offsets enter it.

        Raises like at(), and CircuitError for an op-amp without a pole.
        """
        if not self.can_be_trimmed:
            raise CircuitError("the offset of an op-amp without a pole enters every node: it cannot be trimmed")
        closed = closed or {}
        place = self._place(dials, closed)
        if place not in self._trims or place not in self._kept:
            solution = self._solution(dials, closed)
            if place not in self._kept:
                _keep(self._kept, place, self._system(solution))
            _keep(self._trims, place, self._trim(solution))
        return self._kept[place], self._trims[place]

    def _trim(self, solution: Matrix) -> Trim:
        laws = self._laws
        apart_v = laws.apart(solution)[laws.poles, self._columns - 1]
        slew_kinks = dict(zip(laws.drive_of_kink[laws.slews].tolist(), laws.slews.tolist(), strict=True))
        return Trim(
            amps=tuple(amp.name for amp in self._poles),
            apart_v=apart_v,
            gain_rate=laws.gain[laws.poles, 0],
            rows=tuple((pole, slew_kinks.get(pole)) for pole in laws.poles.tolist()),
        )

    def disturbances(self, dials: Mapping[str, float]) -> dict[str, Matrix]:
        """Contribution of unit sources to dx/dt while no limit acts, each (n,), with pots at `dials`.

        Key node: 1 A into it; key op-amp: 1 V in series with its + input; key multiplier with a bandwidth: 1 V added to
        its product; ground: zeros. Raises like at().
        """
        size = len(self._unknowns)
        slopes = self._laws.slopes(self._solve(self._set(dials, {}), np.eye(size + 1)))[: len(self._state)]
        columns = {node: slopes[:, row] if node != GROUND else np.zeros(len(slopes)) for node, row in self._row.items()}
        amps = {amp.name: amp for amp in self._poles}
        own = np.eye(len(self._state))
        followers = {part.name: part for part in self._multipliers if part.model.has_state}
        held: dict[str, OpAmp | Multiplier] = {**amps, **followers}
        poles = {name: own[self._state[name]] * part.model.gain_rate for name, part in held.items()}
        return columns | {name: slopes[:, row] for name, row in self._branch.items() if name not in amps} | poles

    # ---- entering the elements

    def _check_size(self) -> None:
        sizes = (
            ("states", len(self._state), library.MAX_STATES),
            ("multipliers", len(self._multipliers), library.MAX_PRODUCTS),
            ("inputs and multipliers", len(self._inputs) + len(self._multipliers), library.MAX_INPUTS),
            ("limits, diode limiters, bends and inputs of multipliers", len(self._kinks), library.MAX_KINKS),
            ("nodes and branches", len(self._unknowns), library.MAX_UNKNOWNS),
        )
        for what, count, limit in sizes:
            if count > limit:
                raise CircuitError(f"the circuit has {count} {what}; the engine takes at most {limit}")

    def _enter(self, circuit: Circuit) -> None:
        places = self._places([(resistor.a, resistor.b) for resistor in circuit.of(Resistor)])
        siemens = [1.0 / resistor.ohm for resistor in circuit.of(Resistor)]
        np.add.at(self._left.reshape(-1), places, np.outer(siemens, _STAMP).ravel())
        for capacitor in self._capacitors:
            row = self._voltage_branch(capacitor.name, capacitor.a, capacitor.b)
            self._right[row, self._state[capacitor.name]] = 1.0
        for source in circuit.of(VoltageSource):
            row = self._voltage_branch(source.name, source.plus, source.minus)
            column, volts = self._drive(source)
            self._right[row, column] = volts
        for drive in circuit.of(CurrentSource):
            column, amperes = self._drive(drive)
            self._right[self._row[drive.plus], column] -= amperes
            self._right[self._row[drive.minus], column] += amperes
        for amp in circuit.of(OpAmp):
            self._enter_opamp(amp)
        for i, limiter in enumerate(self._limiters):
            self._conductance(self._left, limiter.a, limiter.b, 1.0 / limiter.off_ohm)
            self._right[self._row[limiter.a], self._columns + i] -= limiter.excess_siemens
            self._right[self._row[limiter.b], self._columns + i] += limiter.excess_siemens
        for i, part in enumerate(self._multipliers):
            self._enter_multiplier(part, len(self._state) + len(self._inputs) + i)
        bend = self._columns + len(self._limiters)
        for function in self._functions:
            slope, volts = function.line
            row = self._voltage_branch(function.name, function.out, GROUND)
            self._left[row, self._row[function.x]] -= slope
            self._right[row, self._columns - 1] = volts
            self._right[row, bend : bend + len(function.kinks)] = 1.0
            bend += len(function.kinks)
        for amp in self._recovering:
            self._right[:, bend] = -self._right[:, self._state[amp.name]]
            bend += 1

    def _drive(self, source: VoltageSource | CurrentSource) -> tuple[int, float]:
        """Column of the right-hand side that drives a source, and its factor."""
        level = source.constant
        if level is None:
            return len(self._state) + self._inputs.index(source), 1.0
        return self._columns - 1, level

    def _conductance(self, left: Matrix, a: str, b: str, siemens: float) -> None:
        i, j = self._row[a], self._row[b]
        left[i, i] += siemens
        left[j, j] += siemens
        left[i, j] -= siemens
        left[j, i] -= siemens

    def _set(self, dials: Mapping[str, float], closed: Mapping[str, bool]) -> Matrix:
        """The left-hand side with pots and switches entered."""
        left = self._left.copy()
        np.add.at(left.reshape(-1), self._leg_places, np.outer(self._leg_siemens(dials, closed), _STAMP).ravel())
        return left

    def _leg_siemens(self, dials: Mapping[str, float], closed: Mapping[str, bool]) -> list[float]:
        """Conductances of the switches, then of both legs of every pot."""
        ohms = [switch.ohm(closed=closed.get(switch.name, switch.closed)) for switch in self._switches]
        for pot in self._pots:
            ohms += legs_ohm(check_dial(dials.get(pot.name, pot.dial), pot.name), pot.track_ohm)
        return [1.0 / ohm for ohm in ohms]

    def _places(self, ends: Sequence[tuple[str, str]]) -> NDArray[np.intp]:
        """Indices at which conductances between these nodes enter the flattened matrix, four each."""
        size = len(self._unknowns) + 1
        rows = [(self._row[a], self._row[b]) for a, b in ends]
        return np.array([(i * size + i, j * size + j, i * size + j, j * size + i) for i, j in rows], np.intp).ravel()

    def _voltage_branch(self, name: str, plus: str, minus: str) -> int:
        """Enters a branch whose current flows from node plus through it to node minus.

        Returns the row of its equation, v(plus) - v(minus) = right-hand side.
        """
        row, i, j = self._branch[name], self._row[plus], self._row[minus]
        self._left[i, row] += 1.0
        self._left[j, row] -= 1.0
        self._left[row, i] += 1.0
        self._left[row, j] -= 1.0
        return row

    def _enter_opamp(self, amp: OpAmp) -> None:
        model, out = amp.model, self._row[amp.out]
        if not model.has_state:
            # (v(out) - Rout i) / Avol - (v+ - v-) = Vos, with the current i leaving the node; for infinite Avol this is
            # v+ = v-.
            row = self._branch[amp.name]
            self._left[out, row] += 1.0
            self._left[row, out] += 1.0 / model.avol
            self._left[row, row] -= model.rout_ohm / model.avol
            self._left[row, self._row[amp.plus]] -= 1.0
            self._left[row, self._row[amp.minus]] += 1.0
            self._right[row, self._columns - 1] = model.vos_v
            for node in (amp.plus, amp.minus):
                self._left[row, self._row[node]] -= 0.5 / model.cmrr
        else:
            self._enter_output(amp)

    def _enter_output(self, part: OpAmp | Multiplier) -> None:
        """Enter the state of an element behind its output resistance."""
        if part.model.rout_ohm > 0:
            self._conductance(self._left, part.out, GROUND, 1.0 / part.model.rout_ohm)
            self._right[self._row[part.out], self._state[part.name]] += 1.0 / part.model.rout_ohm
        else:
            row = self._voltage_branch(part.name, part.out, GROUND)
            self._right[row, self._state[part.name]] = 1.0

    def _enter_multiplier(self, part: Multiplier, product: int) -> None:
        if part.model.has_state:
            self._enter_output(part)
        else:
            row = self._voltage_branch(part.name, part.out, GROUND)
            if part.model.rout_ohm > 0:
                self._left[row, row] -= part.model.rout_ohm
            self._right[row, product] = 1.0
            self._right[row, self._columns - 1] = part.model.z_offset_v

    # ---- reading the solution

    def _solution(self, dials: Mapping[str, float], closed: Mapping[str, bool]) -> Matrix:
        return self._solve(self._set(dials, closed), self._right)

    def _solve(self, left: Matrix, right: Matrix) -> Matrix:
        """Solution for the columns of `right`: a row per unknown, and a last row of zeros for ground."""
        size = len(self._unknowns)
        solution = np.zeros((size + 1, right.shape[1]))
        solution[:size] = right[:size]
        failed = solve_in_place(left[:size, :size], solution)
        if failed >= 0:
            raise self._singular(failed)
        return solution

    def _singular(self, unknown: int) -> CircuitError:
        """CircuitError that names the undetermined node, with the first element at it, or the current."""
        what, name = self._unknowns[unknown]
        element = next(
            part for part in self._circuit.elements if name in (part.nodes if what == "node" else (part.name,))
        )
        return element_error(element, f"the circuit is singular: nothing determines the {what} {name}")

    def _flow(self, solution: Matrix) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """[A B c], G, [C D e] and P."""
        laws, states = self._laws, len(self._state)
        drives = laws.drives(solution, self._columns - 1)
        w = drives[laws.drive_of_kink]
        w[laws.of_state] = 0.0
        w[laws.of_state, laws.state] = 1.0
        w[laws.currents] -= solution[laws.loaded]
        for kink, column in laws.saturations:
            w[kink, column] -= 1.0
        slopes = drives[:states]
        slopes[laws.drive_of_kink[laws.slews]] = 0.0
        g = laws.g.copy()
        g[:, self._sources] = slopes[:, self._columns :]
        return slopes[:, : self._columns], g, w[:, : self._columns], self._spread(w)

    def _spread(self, solution: Matrix) -> Matrix:
        """The columns of phi of limiters and bends at the places of their kinks: (rows, kinks)."""
        spread = np.zeros((solution.shape[0], len(self._kinks)))
        spread[:, self._sources] = solution[:, self._columns :]
        return spread


@dataclass(frozen=True)
class Trim:
    """Entry of op-amp offsets into a state space: the constant of each drive is (apart_v + offset) gain_rate.

    apart_v: (amps,) V between the inputs at x = 0, u = 0; gain_rate: (amps,) 1/s. rows: for each op-amp the row of abc,
    and that of cde which holds the drive instead if the amplifier has a slew limit.
    """

    amps: tuple[str, ...]
    apart_v: Matrix
    gain_rate: Matrix
    rows: tuple[tuple[int, int | None], ...]

    def apply(self, system: PiecewiseLinear, offsets_v: Matrix) -> PiecewiseLinear:
        """The state space of the trim, with the op-amps' offsets offsets_v, (amps,) V."""
        abc, cde = system.abc.copy(), system.cde.copy()
        for rate, (row, kink) in zip((self.apart_v + offsets_v) * self.gain_rate, self.rows, strict=True):
            if kink is None:
                abc[row, -1] = rate
            else:
                cde[kink, -1] = rate
        return system.with_drives(abc, cde)


_STAMP = np.array((1.0, 1.0, -1.0, -1.0))
"""Signs of a conductance at its four places: both diagonal ones, then both off-diagonal ones."""


class _Parts(NamedTuple):
    """Elements with laws."""

    capacitors: Sequence[Capacitor]
    poles: Sequence[OpAmp]
    multipliers: Sequence[Multiplier]
    limiters: Sequence[DiodeLimiter]
    functions: Sequence[Function]
    limits: Sequence[Mapping[_Limit, Kink]]
    """Those of each op-amp and multiplier with a pole."""


@dataclass(frozen=True)
class _Laws:
    """Laws of capacitors (by current), and of op-amps, multipliers, limiters and bends (by voltages), as arrays.

    A drive is (solution[plus] - solution[minus] + offset) gain / capacity, less the leak. The drives of multipliers
    hold their products besides: fed gives their rows, products the columns. drive_of_kink: drive of each kink, in the
    order of the kinks; slews: indices of the kinks of that kind. of_state: kinks whose argument is a state, and state:
    it. currents: those from which the voltage of the node in loaded is taken. saturations: (kink, column of the
    solution) at which the output of a recovering op-amp lacks its excess. common: for each op-amp, 1 / (2 CMRR). g: G
    without limiters and bends. holders: rows with a leak; poles: those of the op-amps.
    """

    plus: NDArray[np.intp]
    minus: NDArray[np.intp]
    offset: Matrix
    gain: Matrix
    capacity: Matrix
    poles: NDArray[np.intp]
    holders: NDArray[np.intp]
    fed: NDArray[np.intp]
    products: NDArray[np.intp]
    leak: Matrix
    drive_of_kink: NDArray[np.intp]
    slews: NDArray[np.intp]
    of_state: NDArray[np.intp]
    state: NDArray[np.intp]
    currents: NDArray[np.intp]
    loaded: NDArray[np.intp]
    saturations: tuple[tuple[int, int], ...]
    common: Matrix
    g: Matrix

    @classmethod
    def of(cls, row: Mapping[str, int], branch: Mapping[str, int], parts: _Parts, first_product: int) -> _Laws:
        """Laws of a circuit with numbered nodes (row) and branches."""
        capacitors, poles, multipliers, limiters, functions, limits = parts
        followers = [part for part in multipliers if part.model.has_state]
        bent = [function for function in functions for _ in function.kinks]
        ends = [(branch[capacitor.name], row[GROUND]) for capacitor in capacitors]
        ends += [(row[amp.plus], row[amp.minus]) for amp in poles]
        ends += [(row[GROUND], row[GROUND])] * len(followers)
        ends += [(row[limiter.a], row[limiter.b]) for limiter in limiters]
        ends += [(row[function.x], row[GROUND]) for function in bent]
        recovering = [(i, amp) for i, amp in enumerate(poles, len(capacitors)) if amp.model.recovers]
        ends += [(row[GROUND], row[GROUND])] * len(recovering)
        ends += [(row[node], row[GROUND]) for part in multipliers for node in (part.x, part.y)]
        plus, minus = np.array(ends, np.intp).reshape(-1, 2).T
        limited: tuple[OpAmp | Multiplier, ...] = (*poles, *followers)
        first, states = len(capacitors), len(capacitors) + len(limited)
        parts_limits = enumerate(zip(limited, limits, strict=True), first)
        kinds = [(i, part, limit) for i, (part, kinks) in parts_limits for limit in kinks]
        held = [(kink, i) for kink, (i, _, limit) in enumerate(kinds) if limit is not _Limit.SLEW]
        fed_back = [(kink, part) for kink, (_, part, limit) in enumerate(kinds) if limit is _Limit.CURRENT]
        last_source = len(kinds) + len(limiters) + len(bent) + len(recovering)
        held += [(last_source - len(recovering) + k, i) for k, (i, _) in enumerate(recovering)]
        # The columns of sources follow those of the last product and the constant.
        excess = {
            amp.name: first_product + len(multipliers) + 1 + len(limiters) + len(bent) + k
            for k, (_, amp) in enumerate(recovering)
        }
        ones, zeros = np.ones(len(capacitors)), np.zeros(len(capacitors))
        tail = np.ones(len(ends) - states)
        offsets_v = np.zeros(tail.size)
        offsets_v[tail.size - 2 * len(multipliers) :] = [
            volts for part in multipliers for volts in (part.model.x_offset_v, part.model.y_offset_v)
        ]
        rates = [part.model.gain_rate for part in limited]
        z_offsets_v = [part.model.z_offset_v for part in followers]
        laws = cls(
            plus=plus,
            minus=minus,
            offset=np.concatenate((zeros, [amp.model.vos_v for amp in poles], z_offsets_v, offsets_v)),
            gain=np.concatenate((ones, rates, tail)).reshape(-1, 1),
            capacity=np.concatenate(([c.farad for c in capacitors], np.ones(len(limited)), tail)).reshape(-1, 1),
            poles=np.arange(first, first + len(poles)),
            holders=np.arange(first, states),
            fed=np.arange(first + len(poles), states),
            products=first_product + np.array([i for i, p in enumerate(multipliers) if p.model.has_state], np.intp),
            leak=np.array([part.model.leak_rate for part in limited]),
            drive_of_kink=np.array([*(i for i, _, _ in kinds), *range(states, len(ends))], np.intp),
            slews=np.array([kink for kink, (_, _, limit) in enumerate(kinds) if limit is _Limit.SLEW], np.intp),
            of_state=np.array([kink for kink, _ in held], np.intp),
            state=np.array([i for _, i in held], np.intp),
            currents=np.array([kink for kink, _ in fed_back], np.intp),
            loaded=np.array([row[part.out] for _, part in fed_back], np.intp),
            saturations=tuple((kink, excess[part.name]) for kink, part in fed_back if part.name in excess),
            common=np.array([0.5 / amp.model.cmrr for amp in poles]).reshape(-1, 1),
            g=np.zeros((states, len(kinds) + tail.size)),
        )
        laws.g[laws.drive_of_kink[laws.slews], laws.slews] = 1.0
        for kink, i in held[: len(held) - len(recovering)]:
            laws.g[i, kink] = -CLAMP_RATE
        return laws

    def apart(self, solution: Matrix) -> Matrix:
        """Voltage between the ends of each law, with what an op-amp passes of its common mode."""
        apart: Matrix = solution[self.plus] - solution[self.minus]
        if self.common.any():
            apart[self.poles] += (solution[self.plus[self.poles]] + solution[self.minus[self.poles]]) * self.common
        return apart

    def drives(self, solution: Matrix, constant: int) -> Matrix:
        """A row for each capacitor (V/s), op-amp and multiplier with a pole (V/s, before any limit), and w (V)."""
        drives = self.apart(solution)
        drives[:, constant] += self.offset
        drives[self.fed, self.products] += 1.0
        drives *= self.gain
        drives /= self.capacity
        drives[self.holders, self.holders] -= self.leak
        return drives

    def slopes(self, solution: Matrix) -> Matrix:
        """Rows of drives() without offsets and leaks."""
        return np.asarray(self.apart(solution) * self.gain / self.capacity)


class _Limit(enum.Enum):
    """Limits of an output."""

    SLEW = enum.auto()
    SWING = enum.auto()
    CURRENT = enum.auto()


def _limits(part: OpAmp | Multiplier) -> dict[_Limit, Kink]:
    """Limits of an output with a pole, in the order of their kinks."""
    model, limits = part.model, {}
    if model.slews:
        limits[_Limit.SLEW] = Kink.clip(model.slew_v_per_s, part.name)
    if model.clamps:
        limits[_Limit.SWING] = Kink.deadzone(*model.bounds_v, part.name)
    if isinstance(model, OpAmpModel) and model.limits_current:
        drop_v = model.rout_ohm * model.current_limit_a
        limits[_Limit.CURRENT] = Kink.deadzone(-drop_v, drop_v, part.name)
    return limits
