"""Laws of a circuit: what drives its states and kinks, read from the solution of the resistive part.

Each state, limiter, bend and factor of a product has a LawRecord, each kink a KinkRecord. `Laws` holds both as arrays,
by which one solution becomes the matrices of a state space.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.circuit.circuit import Circuit
from analogrig_emulator.circuit.elements import GROUND, Capacitor, DiodeLimiter, OpAmp
from analogrig_emulator.circuit.nonlinear import Function, Multiplier
from analogrig_emulator.circuit.opamp import CLAMP_RATE, OpAmpModel
from analogrig_emulator.engine.system import Kink, Matrix


class LawParts(NamedTuple):
    """Elements with laws, in the order of the laws: states, then kinks."""

    capacitors: tuple[Capacitor, ...]
    poles: tuple[OpAmp, ...]
    """Op-amps with a pole."""
    followers: tuple[Multiplier, ...]
    """Multipliers with a bandwidth."""
    limiters: tuple[DiodeLimiter, ...]
    functions: tuple[Function, ...]
    recovering: tuple[OpAmp, ...]
    """Op-amps that recover from overloads."""
    multipliers: tuple[Multiplier, ...]

    @classmethod
    def of(cls, circuit: Circuit) -> LawParts:
        """Elements of a circuit."""
        poles = tuple(amp for amp in circuit.of(OpAmp) if amp.model.has_state)
        multipliers = circuit.of(Multiplier)
        return cls(
            capacitors=circuit.of(Capacitor),
            poles=poles,
            followers=tuple(part for part in multipliers if part.model.has_state),
            limiters=circuit.of(DiodeLimiter),
            functions=circuit.of(Function),
            recovering=tuple([amp for amp in poles if amp.model.recovers]),
            multipliers=multipliers,
        )

    @property
    def limited(self) -> tuple[OpAmp | Multiplier, ...]:
        """Elements with a pole."""
        return *self.poles, *self.followers

    @property
    def held(self) -> tuple[Capacitor | OpAmp | Multiplier, ...]:
        """Elements with a state."""
        return *self.capacitors, *self.limited

    @property
    def sources(self) -> int:
        """Number of kinks whose value drives the resistive part: limiters, bends and recoveries."""
        bends = sum(len(function.kinks) for function in self.functions)
        return len(self.limiters) + bends + len(self.recovering)


class LinearLayout(NamedTuple):
    """Rows and columns of the linear system.

    row: of each node, ground last, which is left out of the solution; branch: row of each unknown current;
    first_product, first_source: columns of the first multiplier and of the first of LawParts.sources.
    """

    row: Mapping[str, int]
    branch: Mapping[str, int]
    first_product: int
    first_source: int


class LawRecord(NamedTuple):
    """Drive solution[plus] - solution[minus] + offset_v of a state or of a kink.

    For a state, farad divides the drive of a capacitor, rate multiplies that of an op-amp or multiplier, and leak
    lessens it; common: share of the sum of both voltages that an op-amp adds; product: column of the product that a
    multiplier adds.
    """

    plus: int
    minus: int
    offset_v: float = 0.0
    farad: float = 0.0
    rate: float = 0.0
    leak: float = 0.0
    common: float = 0.0
    product: int | None = None


class KinkRecord(NamedTuple):
    """Kink and the law that is its argument.

    state: state that is the argument instead; slews: True if the value becomes the slope of the law's state; clamps:
    True if the value pulls the state back; loaded: row of the node whose voltage is taken from the argument; excess:
    column of the kink by which that node lacks.
    """

    kink: Kink
    law: int
    state: int | None = None
    slews: bool = False
    clamps: bool = False
    loaded: int | None = None
    excess: int | None = None


def law_records(parts: LawParts, layout: LinearLayout) -> list[LawRecord]:
    """Law of each state, limiter, bend, recovery and factor of a product, in this order."""
    row, ground = layout.row, layout.row[GROUND]
    products = {part.name: column for column, part in enumerate(parts.multipliers, layout.first_product)}
    laws = [LawRecord(layout.branch[part.name], ground, farad=part.farad) for part in parts.capacitors]
    for amp in parts.poles:
        model = amp.model
        ends, rates = (row[amp.plus], row[amp.minus]), (model.gain_rate, model.leak_rate)
        laws.append(LawRecord(*ends, model.vos_v, 0.0, *rates, common=0.5 / model.cmrr))
    for part in parts.followers:
        rates = (part.model.gain_rate, part.model.leak_rate)
        laws.append(LawRecord(ground, ground, part.model.z_offset_v, 0.0, *rates, product=products[part.name]))
    laws += [LawRecord(row[limiter.a], row[limiter.b]) for limiter in parts.limiters]
    laws += [LawRecord(row[part.x], ground) for part in parts.functions for _ in part.kinks]
    laws += [LawRecord(ground, ground) for _ in parts.recovering]
    for part in parts.multipliers:
        laws.append(LawRecord(row[part.x], ground, part.model.x_offset_v))
        laws.append(LawRecord(row[part.y], ground, part.model.y_offset_v))
    return laws


def kink_records(parts: LawParts, layout: LinearLayout) -> list[KinkRecord]:
    """Kinks: limits of op-amps and multipliers with a pole, then limiters, bends, recoveries, factors of products."""
    states = {part.name: state for state, part in enumerate(parts.held)}
    first_excess = layout.first_source + parts.sources - len(parts.recovering)
    excess = {amp.name: column for column, amp in enumerate(parts.recovering, first_excess)}
    kinks = [
        record
        for part in parts.limited
        for record in _limits(part, states[part.name], layout.row[part.out], excess.get(part.name))
    ]
    own = [Kink.deadzone(-math.inf, limiter.threshold_v, limiter.name) for limiter in parts.limiters]
    own += [kink for function in parts.functions for kink in function.kinks]
    kinks += [KinkRecord(kink, law) for law, kink in enumerate(own, len(states))]
    kinks += [
        KinkRecord(Kink.deadzone(*amp.model.swing_v, amp.name), law, states[amp.name])
        for law, amp in enumerate(parts.recovering, len(states) + len(own))
    ]
    first_factor = len(states) + len(own) + len(parts.recovering)
    factors = [part.name for part in parts.multipliers for _ in "xy"]
    return kinks + [KinkRecord(Kink.none(name), law) for law, name in enumerate(factors, first_factor)]


def _limits(part: OpAmp | Multiplier, state: int, out: int, excess: int | None) -> list[KinkRecord]:
    """Limits of an output with a pole: its slew rate, swing and current."""
    model, limits = part.model, []
    if model.slews:
        limits.append(KinkRecord(Kink.clip(model.slew_v_per_s, part.name), state, slews=True))
    if model.clamps:
        limits.append(KinkRecord(Kink.deadzone(*model.bounds_v, part.name), state, state, clamps=True))
    if isinstance(model, OpAmpModel) and model.limits_current:
        drop_v = model.rout_ohm * model.current_limit_a
        kink = Kink.deadzone(-drop_v, drop_v, part.name)
        limits.append(KinkRecord(kink, state, state, clamps=True, loaded=out, excess=excess))
    return limits


class _KinkPairs(NamedTuple):
    """Kinks, and the row or column of each."""

    kinks: NDArray[np.intp]
    others: NDArray[np.intp]

    @classmethod
    def of(cls, pairs: Sequence[tuple[int, int]]) -> _KinkPairs:
        return cls(*np.array(pairs, np.intp).reshape(-1, 2).T)


class Laws(NamedTuple):
    """Laws and kinks of a circuit as arrays.

    plus, minus, offset: by law; farads, rates (with a column), leak: by state, capacitors first; poles: rows of the
    op-amps; products: (row, column) of each product that drives a state; common: for each op-amp, None for none.
    law_of_kink: law of each kink; slewing: kinks and their laws; held: kinks and their states; loaded: kinks and nodes;
    missing: kinks and the columns of their excess. g: G without limiters and bends.
    """

    plus: NDArray[np.intp]
    minus: NDArray[np.intp]
    offset: Matrix
    farads: Matrix
    rates: Matrix
    leak: Matrix
    poles: slice
    products: Sequence[tuple[int, int]]
    common: Matrix | None
    law_of_kink: NDArray[np.intp]
    slewing: _KinkPairs
    held: _KinkPairs
    loaded: _KinkPairs
    missing: _KinkPairs
    g: Matrix

    @classmethod
    def of(cls, laws: Sequence[LawRecord], kinks: Sequence[KinkRecord], parts: LawParts) -> Laws:
        """Arrays of these records."""
        first, states = len(parts.capacitors), len(parts.held)
        poles = slice(first, first + len(parts.poles))
        common = [law.common for law in laws[poles]]
        g = np.zeros((states, len(kinks)))
        slewing, held, loaded, missing = [], [], [], []
        for kink, each in enumerate(kinks):
            if each.slews:
                g[each.law, kink] = 1.0
                slewing.append((kink, each.law))
            if each.clamps:
                g[each.law, kink] = -CLAMP_RATE
            if each.state is not None:
                held.append((kink, each.state))
            if each.loaded is not None:
                loaded.append((kink, each.loaded))
            if each.excess is not None:
                missing.append((kink, each.excess))
        return cls(
            plus=np.array([law.plus for law in laws], np.intp),
            minus=np.array([law.minus for law in laws], np.intp),
            offset=np.array([law.offset_v for law in laws]),
            farads=np.array([law.farad for law in laws[:first]]).reshape(-1, 1),
            rates=np.array([law.rate for law in laws[first:states]]).reshape(-1, 1),
            leak=np.array([law.leak for law in laws[first:states]]),
            poles=poles,
            products=[(row, law.product) for row, law in enumerate(laws) if law.product is not None],
            common=np.array(common).reshape(-1, 1) if any(common) else None,
            law_of_kink=np.array([each.law for each in kinks], np.intp),
            slewing=_KinkPairs.of(slewing),
            held=_KinkPairs.of(held),
            loaded=_KinkPairs.of(loaded),
            missing=_KinkPairs.of(missing),
            g=g,
        )

    def with_offsets(self, vos_v: Sequence[float]) -> Laws:
        """The same with other input offsets of the op-amps."""
        offset = self.offset.copy()
        offset[self.poles] = vos_v
        return self._replace(offset=offset)

    def apart(self, solution: Matrix) -> Matrix:
        """Voltage between the ends of each law, with what an op-amp passes of its common mode."""
        apart: Matrix = solution.take(self.plus, 0) - solution.take(self.minus, 0)
        if self.common is not None:
            apart[self.poles] += (solution[self.plus[self.poles]] + solution[self.minus[self.poles]]) * self.common
        return apart

    def drives(self, solution: Matrix, constant: int) -> Matrix:
        """A row for each capacitor (V/s), op-amp and multiplier with a pole (V/s, before any limit), and w (V)."""
        drives = self.apart(solution)
        drives[:, constant] += self.offset
        for row, product in self.products:
            drives[row, product] += 1.0
        slopes = self._scaled(drives)
        diagonal = slopes.reshape(-1)[:: slopes.shape[1] + 1]
        diagonal[len(self.farads) :] -= self.leak
        return drives

    def slopes(self, solution: Matrix) -> Matrix:
        """Rows of drives() with a state, without offsets and leaks."""
        return self._scaled(self.apart(solution))

    def _scaled(self, apart: Matrix) -> Matrix:
        """Rows with a state, scaled in place."""
        first = len(self.farads)
        slopes = apart[: first + len(self.rates)]
        slopes[:first] /= self.farads
        slopes[first:] *= self.rates
        return slopes
