"""From a circuit to its piecewise-linear state space, by modified nodal analysis.

    dx/dt = A x + B u + c + G phi(w),   w = C x + D u + e,   v = L x + M u + n

x: the voltage of every capacitor, then the voltage behind the output resistance of every op-amp that has a pole
(netlist order each).
u: the voltage sources that are inputs. v: every node voltage. phi: one Kink per element of w: for each op-amp its slew
limit, then its clamp.

How: with x and u held, the circuit is resistive. Capacitors become voltage sources x, op-amp poles voltage sources x
behind their output resistance. Kirchhoff's current law at every node, and one equation per branch whose current is
unknown, give one linear system with right-hand side columns [x | u | 1]; its solution is [L M n] and the branch
currents, and the rest is read off it: a capacitor's dx/dt is its current over its capacitance, an op-amp's is its law
(opamp.py). Only elementwise arithmetic and engine_solve are used, no BLAS, so a circuit has the same bits on every
machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import library
from .circuit import GROUND, Capacitor, Circuit, OpAmp, Pot, Resistor, VoltageSource
from .errors import CircuitError
from .opamp import CLAMP_RATE
from .pot import checked_dial, legs_ohm

__all__ = ["Kink", "Nodal", "PiecewiseLinear", "piecewise_linear"]

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Kink:
    """A continuous function of three linear pieces, with slopes below lower, between, and above upper.

    Between, phi(w) = slopes[1] w.
    """

    lower: float
    upper: float
    slopes: tuple[float, float, float]

    @classmethod
    def clip(cls, limit: float) -> Kink:
        """clip(w, -limit, +limit)."""
        return cls(-limit, limit, (0.0, 1.0, 0.0))

    @classmethod
    def deadzone(cls, lower: float, upper: float) -> Kink:
        """What of w is beyond lower..upper, and 0 within."""
        return cls(lower, upper, (1.0, 0.0, 1.0))

    @property
    def intercepts(self) -> tuple[float, float, float]:
        """Constant terms of the pieces, such that they meet; 0 for a piece that an infinite bound removes."""
        below, between, above = self.slopes
        at_lower = (between - below) * self.lower if np.isfinite(self.lower) else 0.0
        at_upper = (between - above) * self.upper if np.isfinite(self.upper) else 0.0
        return at_lower, 0.0, at_upper


@dataclass(frozen=True)
class PiecewiseLinear:
    """The state space of a circuit, in the form of the module's docstring.

    Columns of abc, cde and lmn: states, inputs, constant.

    abc: (n, n+m+1) in 1/s and V/s; g: (n, q); cde: (q, n+m+1); lmn: (nodes, n+m+1), dimensionless but for its last
    column in V.
    states, inputs, nodes: names; ground is not among the nodes.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    nodes: tuple[str, ...]
    kinks: tuple[Kink, ...]
    abc: Matrix
    g: Matrix
    cde: Matrix
    lmn: Matrix

    def readings(self, nodes: Sequence[str]) -> Matrix:
        """The rows of lmn for these nodes, in this order. Raises CircuitError for a node that is not there."""
        try:
            return self.lmn[[self.nodes.index(node) for node in nodes]]
        except ValueError:
            missing = next(node for node in nodes if node not in self.nodes)
            raise CircuitError(f"no node is called {missing!r}; there are {', '.join(self.nodes)}") from None


def piecewise_linear(circuit: Circuit) -> PiecewiseLinear:
    """The state space of a circuit, its pots as they are set.

    Raises CircuitError naming the node where the circuit is singular.
    """
    return Nodal(circuit).at({})


class Nodal:
    """The equations of one circuit, with everything but the pots already entered: turning a pot costs little.

    Raises CircuitError when the circuit exceeds what the engine takes.
    """

    def __init__(self, circuit: Circuit) -> None:
        self._pots = circuit.of(Pot)
        self._capacitors = circuit.of(Capacitor)
        self._inputs = tuple(source for source in circuit.of(VoltageSource) if source.dc_v is None)
        self._poles = tuple(amp for amp in circuit.of(OpAmp) if amp.model.has_state)
        branches = [element.name for element in self._capacitors] + [
            source.name for source in circuit.of(VoltageSource)
        ]
        branches += [amp.name for amp in circuit.of(OpAmp) if not (amp.model.has_state and amp.model.rout_ohm > 0)]

        self._nodes = circuit.nodes
        self._unknowns = [f"node {node}" for node in self._nodes] + [f"current of {name}" for name in branches]
        # Ground has the last row and column, which are left out of the solution.
        self._row = {node: i for i, node in enumerate(self._nodes)} | {GROUND: len(self._unknowns)}
        self._branch = {name: len(self._nodes) + i for i, name in enumerate(branches)}
        holders: list[Capacitor | OpAmp] = [*self._capacitors, *self._poles]
        self._state = {element.name: i for i, element in enumerate(holders)}
        self._columns = len(self._state) + len(self._inputs) + 1
        self._check_size()

        size = len(self._unknowns) + 1
        self._left = np.zeros((size, size))
        self._right = np.zeros((size, self._columns))
        self._enter(circuit)
        self._kinks = tuple(kink for amp in self._poles for kink in _kinks(amp))

    def at(self, dials: Mapping[str, float]) -> PiecewiseLinear:
        """The state space with the pots named in dials set so, and the others as in the netlist.

        Raises PotError for a dial off its track, CircuitError for a singular circuit.
        """
        left = self._left.copy()
        for pot in self._pots:
            self._enter_pot(left, pot, checked_dial(dials.get(pot.name, pot.dial), pot.name))
        solution = self._solve(left)
        abc, g, cde = self._flow(solution)
        return PiecewiseLinear(
            states=tuple(self._state),
            inputs=tuple(source.name for source in self._inputs),
            nodes=self._nodes,
            kinks=self._kinks,
            abc=abc,
            g=g,
            cde=cde,
            lmn=solution[: len(self._nodes)],
        )

    # ---- entering the elements

    def _check_size(self) -> None:
        sizes = (
            ("states", len(self._state), library.MAX_STATES),
            ("inputs", len(self._inputs), library.MAX_INPUTS),
            ("nodes and branches", len(self._unknowns), library.MAX_UNKNOWNS),
        )
        for what, count, limit in sizes:
            if count > limit:
                raise CircuitError(f"the circuit has {count} {what}; the engine takes at most {limit}")

    def _enter(self, circuit: Circuit) -> None:
        for resistor in circuit.of(Resistor):
            self._conductance(self._left, resistor.a, resistor.b, 1.0 / resistor.ohm)
        for capacitor in self._capacitors:
            row = self._voltage_branch(capacitor.name, capacitor.a, capacitor.b)
            self._right[row, self._state[capacitor.name]] = 1.0
        for source in circuit.of(VoltageSource):
            row = self._voltage_branch(source.name, source.plus, source.minus)
            if source.dc_v is None:
                self._right[row, len(self._state) + self._inputs.index(source)] = 1.0
            else:
                self._right[row, -1] = source.dc_v
        for amp in circuit.of(OpAmp):
            self._enter_opamp(amp)

    def _conductance(self, left: Matrix, a: str, b: str, siemens: float) -> None:
        i, j = self._row[a], self._row[b]
        left[i, i] += siemens
        left[j, j] += siemens
        left[i, j] -= siemens
        left[j, i] -= siemens

    def _enter_pot(self, left: Matrix, pot: Pot, dial: float) -> None:
        upper_ohm, lower_ohm = legs_ohm(dial, pot.track_ohm)
        self._conductance(left, pot.top, pot.wiper, 1.0 / upper_ohm)
        self._conductance(left, pot.wiper, pot.bottom, 1.0 / lower_ohm)

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
            self._right[row, -1] = model.vos_v
        elif model.rout_ohm > 0:
            self._conductance(self._left, amp.out, GROUND, 1.0 / model.rout_ohm)
            self._right[out, self._state[amp.name]] += 1.0 / model.rout_ohm
        else:
            row = self._voltage_branch(amp.name, amp.out, GROUND)
            self._right[row, self._state[amp.name]] = 1.0

    # ---- reading the solution

    def _solve(self, left: Matrix) -> Matrix:
        """Every unknown as a function of [x | u | 1]: (unknowns + 1, columns), the last row being ground's zeros."""
        size = len(self._unknowns)
        matrix = np.ascontiguousarray(left[:size, :size])
        solution = np.zeros((size + 1, self._columns))
        solution[:size] = self._right[:size]
        failed = library.load().engine_solve(size, self._columns, matrix.ctypes.data, solution.ctypes.data)
        if failed >= 0:
            raise CircuitError(f"the circuit is singular: nothing determines the {self._unknowns[failed]}")
        return solution

    def _flow(self, solution: Matrix) -> tuple[Matrix, Matrix, Matrix]:
        abc = np.zeros((len(self._state), self._columns))
        g = np.zeros((len(self._state), len(self._kinks)))
        cde = np.zeros((len(self._kinks), self._columns))
        for capacitor in self._capacitors:
            abc[self._state[capacitor.name]] = solution[self._branch[capacitor.name]] / capacitor.farad
        kink = 0
        for amp in self._poles:
            state = self._state[amp.name]
            demand = self._demand(amp, solution)
            if amp.model.slews:
                cde[kink] = demand
                g[state, kink] = 1.0
                kink += 1
            else:
                abc[state] = demand
            if amp.model.clamps:
                cde[kink, state] = 1.0
                g[state, kink] = -CLAMP_RATE
                kink += 1
        return abc, g, cde

    def _demand(self, amp: OpAmp, solution: Matrix) -> Matrix:
        """The slope in V/s that the inputs ask of the op-amp, before any limit, as a row over [x | u | 1]."""
        difference: Matrix = solution[self._row[amp.plus]] - solution[self._row[amp.minus]]
        difference[-1] += amp.model.vos_v
        demand: Matrix = amp.model.gain_rate * difference
        demand[self._state[amp.name]] -= amp.model.leak_rate
        return demand


def _kinks(amp: OpAmp) -> list[Kink]:
    """In the order in which Nodal._flow enters them."""
    kinks = []
    if amp.model.slews:
        kinks.append(Kink.clip(amp.model.slew_v_per_s))
    if amp.model.clamps:
        kinks.append(Kink.deadzone(*amp.model.swing_v))
    return kinks
