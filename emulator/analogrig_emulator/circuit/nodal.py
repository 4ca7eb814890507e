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

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np

from analogrig_emulator.circuit.circuit import Circuit, element_error
from analogrig_emulator.circuit.elements import (
    GROUND,
    CurrentSource,
    OpAmp,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
)
from analogrig_emulator.circuit.laws import LawParts, Laws, LinearLayout, kink_records, law_records
from analogrig_emulator.circuit.nonlinear import Multiplier
from analogrig_emulator.circuit.pot import check_dial, legs_ohm
from analogrig_emulator.engine import binding
from analogrig_emulator.engine.system import Matrix, PiecewiseLinear, solve_in_place
from analogrig_emulator.exceptions import CircuitError


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

    _parts: LawParts
    _laws: Laws

    def __init__(self, circuit: Circuit, untrimmed: Nodal | None = None) -> None:
        if untrimmed is None:
            self._build(circuit)
        else:
            vars(self).update(vars(untrimmed))
            poles = circuit.of(OpAmp)
            self._parts = self._parts._replace(poles=poles)
            self._laws = self._laws.with_offsets([amp.model.vos_v for amp in poles])
        self._circuit = circuit
        self._untrimmed = untrimmed
        self._kept: dict[_Place, PiecewiseLinear] = {}
        self._trims: dict[_Place, Trim] = {}

    def _build(self, circuit: Circuit) -> None:
        self._circuit = circuit
        self._pots = circuit.of(Pot)
        self._switches = circuit.of(Switch)
        self._inputs = circuit.inputs
        self._parts = parts = LawParts.of(circuit)
        self._nodes, amps = circuit.nodes, circuit.of(OpAmp)
        branches = [part.name for part in (*parts.capacitors, *circuit.of(VoltageSource))]
        outputs: tuple[OpAmp | Multiplier, ...] = (*amps, *parts.multipliers)
        branches += [part.name for part in outputs if not (part.model.has_state and part.model.rout_ohm > 0)]
        branches += [function.name for function in parts.functions]
        self._branch = {name: i for i, name in enumerate(branches, len(self._nodes))}
        self._unknowns = len(self._nodes) + len(branches)
        # Ground has the last row and column, which are left out of the solution.
        self._row = {node: i for i, node in enumerate(self._nodes)} | {GROUND: self._unknowns}
        self._state = {element.name: i for i, element in enumerate(parts.held)}
        first_product = len(self._state) + len(self._inputs)
        self._columns = first_product + len(parts.multipliers) + 1
        layout = LinearLayout(self._row, self._branch, first_product, self._columns)
        kinks = kink_records(parts, layout)
        self._kinks = tuple(each.kink for each in kinks)
        last_source = len(kinks) - 2 * len(parts.multipliers)
        self._sources = slice(last_source - parts.sources, last_source)
        self._check_size()

        size = self._unknowns + 1
        self._left = np.zeros((size, size))
        self._right = np.zeros((size, self._columns + parts.sources))
        legs = _Stamps(size)
        for part in (*self._switches, *self._pots):
            for a, b in part.bonds:
                legs.join(self._row[a], self._row[b], 1.0)
        self._leg_places = np.array(legs.places, np.intp)
        self._laws = Laws.of(law_records(parts, layout), kinks, parts)
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
        return len(self._parts.poles) == len(self._circuit.of(OpAmp))

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
            products=tuple(part.product for part in self._parts.multipliers),
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
        slew_kinks = dict(zip(laws.slewing.others.tolist(), laws.slewing.kinks.tolist(), strict=True))
        return Trim(
            amps=tuple(amp.name for amp in self._parts.poles),
            apart_v=laws.apart(solution)[laws.poles, self._columns - 1],
            gain_rate=laws.rates[: len(self._parts.poles), 0],
            rows=tuple((pole, slew_kinks.get(pole)) for pole in range(laws.poles.start, laws.poles.stop)),
        )

    def disturbances(self, dials: Mapping[str, float]) -> dict[str, Matrix]:
        """Contribution of unit sources to dx/dt while no limit acts, each (n,), with pots at `dials`.

        Key node: 1 A into it; key op-amp: 1 V in series with its + input; key multiplier with a bandwidth: 1 V added to
        its product; ground: zeros. Raises like at().
        """
        size = self._unknowns
        slopes = self._laws.slopes(self._solve(self._set(dials, {}), np.eye(size + 1)))
        columns = {node: slopes[:, row] if node != GROUND else np.zeros(len(slopes)) for node, row in self._row.items()}
        own = np.eye(len(self._state))
        poles = {part.name: own[self._state[part.name]] * part.model.gain_rate for part in self._parts.limited}
        amps = {amp.name for amp in self._parts.poles}
        return columns | {name: slopes[:, row] for name, row in self._branch.items() if name not in amps} | poles

    # ---- entering the elements

    def _check_size(self) -> None:
        sizes = (
            ("states", len(self._state), binding.MAX_STATES),
            ("multipliers", len(self._parts.multipliers), binding.MAX_PRODUCTS),
            ("inputs and multipliers", len(self._inputs) + len(self._parts.multipliers), binding.MAX_INPUTS),
            ("limits, diode limiters, bends and inputs of multipliers", len(self._kinks), binding.MAX_KINKS),
            ("nodes and branches", self._unknowns, binding.MAX_UNKNOWNS),
        )
        for what, count, limit in sizes:
            if count > limit:
                raise CircuitError(f"the circuit has {count} {what}; the engine takes at most {limit}")

    def _enter(self, circuit: Circuit) -> None:
        row, states = self._row, len(self._state)
        left, right = _Stamps(self._unknowns + 1), self._right
        for resistor in circuit.of(Resistor):
            left.join(row[resistor.a], row[resistor.b], 1.0 / resistor.ohm)
        for i, capacitor in enumerate(self._parts.capacitors):
            right[self._enter_branch(left, capacitor.name, capacitor.a, capacitor.b), i] = 1.0
        self._enter_sources(left, circuit)
        for amp in circuit.of(OpAmp):
            self._enter_opamp(left, amp)
        for i, limiter in enumerate(self._parts.limiters, self._columns):
            left.join(row[limiter.a], row[limiter.b], 1.0 / limiter.off_ohm)
            right[row[limiter.a], i] -= limiter.excess_siemens
            right[row[limiter.b], i] += limiter.excess_siemens
        for i, part in enumerate(self._parts.multipliers, states + len(self._inputs)):
            self._enter_multiplier(left, part, i)
        bend = self._columns + len(self._parts.limiters)
        for function in self._parts.functions:
            slope, volts = function.line
            branch = self._enter_branch(left, function.name, function.out, GROUND)
            left.add(branch, row[function.x], -slope)
            right[branch, self._columns - 1] = volts
            right[branch, bend : bend + len(function.kinks)] = 1.0
            bend += len(function.kinks)
        for amp in self._parts.recovering:
            right[:, bend] = -right[:, self._state[amp.name]]
            bend += 1
        np.add.at(self._left.reshape(-1), np.array(left.places, np.intp), left.values)

    def _enter_sources(self, left: _Stamps, circuit: Circuit) -> None:
        row, right = self._row, self._right
        for source in circuit.of(VoltageSource):
            column, volts = self._drive(source)
            right[self._enter_branch(left, source.name, source.plus, source.minus), column] = volts
        for drive in circuit.of(CurrentSource):
            column, amperes = self._drive(drive)
            right[row[drive.plus], column] -= amperes
            right[row[drive.minus], column] += amperes

    def _drive(self, source: VoltageSource | CurrentSource) -> tuple[int, float]:
        """Column of the right-hand side that drives a source, and its factor."""
        level = source.constant
        if level is None:
            return len(self._state) + self._inputs.index(source), 1.0
        return self._columns - 1, level

    def _set(self, dials: Mapping[str, float], closed: Mapping[str, bool]) -> Matrix:
        """The left-hand side with pots and switches entered."""
        left = self._left.copy()
        ohms = [switch.ohm(closed=closed.get(switch.name, switch.closed)) for switch in self._switches]
        for pot in self._pots:
            ohms += legs_ohm(check_dial(dials.get(pot.name, pot.dial), pot.name), pot.track_ohm)
        values: list[float] = []
        for ohm in ohms:
            siemens = 1.0 / ohm
            values += (siemens, siemens, -siemens, -siemens)
        np.add.at(left.reshape(-1), self._leg_places, values)
        return left

    def _enter_branch(self, left: _Stamps, name: str, plus: str, minus: str) -> int:
        """Enters a branch whose current flows from node plus through it to node minus.

        Returns the row of its equation, v(plus) - v(minus) = right-hand side.
        """
        row = self._branch[name]
        left.branch(row, self._row[plus], self._row[minus])
        return row

    def _enter_opamp(self, left: _Stamps, amp: OpAmp) -> None:
        model = amp.model
        if model.has_state:
            self._enter_output(left, amp)
            return
        # (v(out) - Rout i) / Avol - (v+ - v-) = Vos, with the current i leaving the node; for infinite Avol this is
        # v+ = v-.
        out, row = self._row[amp.out], self._branch[amp.name]
        plus, minus = self._row[amp.plus], self._row[amp.minus]
        left.add(out, row, 1.0)
        left.add(row, out, 1.0 / model.avol)
        left.add(row, row, -model.rout_ohm / model.avol)
        left.add(row, plus, -1.0)
        left.add(row, minus, 1.0)
        self._right[row, self._columns - 1] = model.vos_v
        for node in (plus, minus):
            left.add(row, node, -0.5 / model.cmrr)

    def _enter_output(self, left: _Stamps, part: OpAmp | Multiplier) -> None:
        """Enter the state of an element behind its output resistance."""
        state = self._state[part.name]
        if part.model.rout_ohm > 0:
            siemens, out = 1.0 / part.model.rout_ohm, self._row[part.out]
            left.join(out, self._row[GROUND], siemens)
            self._right[out, state] += siemens
        else:
            self._right[self._enter_branch(left, part.name, part.out, GROUND), state] = 1.0

    def _enter_multiplier(self, left: _Stamps, part: Multiplier, product: int) -> None:
        if part.model.has_state:
            self._enter_output(left, part)
            return
        row = self._enter_branch(left, part.name, part.out, GROUND)
        if part.model.rout_ohm > 0:
            left.add(row, row, -part.model.rout_ohm)
        self._right[row, product] = 1.0
        self._right[row, self._columns - 1] = part.model.z_offset_v

    # ---- reading the solution

    def _solution(self, dials: Mapping[str, float], closed: Mapping[str, bool]) -> Matrix:
        return self._solve(self._set(dials, closed), self._right)

    def _solve(self, left: Matrix, right: Matrix) -> Matrix:
        """Solution for the columns of `right`: a row per unknown, and a last row of zeros for ground."""
        size = self._unknowns
        solution = np.zeros((size + 1, right.shape[1]))
        solution[:size] = right[:size]
        failed = solve_in_place(left[:size, :size], solution)
        if failed >= 0:
            raise self._singular(failed)
        return solution

    def _singular(self, unknown: int) -> CircuitError:
        """CircuitError that names the undetermined node, with the first element at it, or the current."""
        is_node = unknown < len(self._nodes)
        what = "node" if is_node else "current of"
        name = (*self._nodes, *self._branch)[unknown]
        element = next(part for part in self._circuit.elements if name in (part.nodes if is_node else (part.name,)))
        return element_error(element, f"the circuit is singular: nothing determines the {what} {name}")

    def _flow(self, solution: Matrix) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """[A B c], G, [C D e] and P."""
        laws, states = self._laws, len(self._state)
        drives = laws.drives(solution, self._columns - 1)
        w = drives.take(laws.law_of_kink, 0)
        w[laws.held.kinks] = 0.0
        w[laws.held.kinks, laws.held.others] = 1.0
        if laws.loaded.kinks.size:
            w[laws.loaded.kinks] -= solution[laws.loaded.others]
            w[laws.missing.kinks, laws.missing.others] -= 1.0
        slopes = drives[:states]
        slopes[laws.slewing.others] = 0.0
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


class _Stamps:
    """Numbers to be added to the left-hand side, in order, with their indices in the flattened matrix."""

    def __init__(self, size: int) -> None:
        self._size = size
        self.places: list[int] = []
        self.values: list[float] = []

    def add(self, row: int, column: int, value: float) -> None:
        """Add a number in one place."""
        self.places.append(row * self._size + column)
        self.values.append(value)

    def join(self, i: int, j: int, siemens: float) -> None:
        """Add a conductance between two nodes."""
        size = self._size
        self.places += (i * size + i, j * size + j, i * size + j, j * size + i)
        self.values += (siemens, siemens, -siemens, -siemens)

    def branch(self, row: int, i: int, j: int) -> None:
        """Add a branch with the voltage between two nodes; row: its equation, and the column of its current."""
        size = self._size
        self.places += (i * size + row, j * size + row, row * size + i, row * size + j)
        self.values += (1.0, -1.0, 1.0, -1.0)
