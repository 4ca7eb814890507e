"""Input of the engine: a piecewise-linear state space, and the edges of its inputs.

    dx/dt = A x + B u + c + G phi(w),   w = C x + D u + e + P phi(w),   v = L x + M u + n + R phi(w)

x: states, u: inputs and, after them, products of two elements of w each; v: node voltages, phi: one Kink per element of
w.
"""

from __future__ import annotations

import enum
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine import binding
from analogrig_emulator.exceptions import CircuitError

TICKS_PER_SAMPLE = 1 << 22
"""Ticks per sample period: the unit of time of edges and relays, 12 ps at 20 kHz."""

Matrix = NDArray[np.float64]

_PIECE_SLACK = 1e-9
"""Relative excess over a kink's bound that may be rounding."""

_REST_PASSES = 200
_REST_V = 1e-12


def is_integer(number: object) -> bool:
    """True for an integer of Python or numpy; 5.0 is none."""
    return isinstance(number, Integral)


class EdgeRows(NamedTuple):
    """Level changes of one input in several plays: the first counts[i] of row i, as in Edges."""

    counts: NDArray[np.int64]
    """(plays,)"""
    ticks: NDArray[np.int64]
    """(plays, room)"""
    levels_v: NDArray[np.float64]
    """(plays, room), all finite."""

    def between(self, first: int, last: int) -> EdgeRows:
        """Level at tick first, with the edges up to tick last, counted from first. Each row has an edge by then."""
        begins = np.count_nonzero((self.ticks <= first) & self._exist, axis=1) - 1
        counts = np.count_nonzero((self.ticks <= last) & self._exist, axis=1) - begins
        places = np.minimum(begins[:, None] + np.arange(counts.max()), self.ticks.shape[1] - 1)
        ticks = np.take_along_axis(self.ticks, places, axis=1) - first
        ticks[:, 0] = 0
        return EdgeRows(counts, ticks, np.take_along_axis(self.levels_v, places, axis=1))

    @property
    def _exist(self) -> NDArray[np.bool_]:
        """Mask of the edges of each row, (plays, room)."""
        return np.arange(self.ticks.shape[1]) < self.counts[:, None]


@dataclass(frozen=True)
class Edges:
    """Level changes of one input: levels_v[i] applies from tick ticks[i] on.

    ticks: int64 (n,), not decreasing; levels_v: float64 (n,), V.
    """

    ticks: NDArray[np.int64]
    levels_v: NDArray[np.float64]

    @classmethod
    def none(cls) -> Edges:
        """Empty train of edges."""
        return cls(np.empty(0, np.int64), np.empty(0))

    def within(self, start: int, stop: int) -> Edges:
        """Edges at ticks start <= tick < stop."""
        part = slice(*self.ticks.searchsorted((start, stop)))
        return Edges(self.ticks[part], self.levels_v[part])

    def until(self, tick: int) -> Edges:
        """Edges up to and including a tick."""
        part = slice(None, self.ticks.searchsorted(tick, "right"))
        return Edges(self.ticks[part], self.levels_v[part])

    def after(self, tick: int) -> Edges:
        """Edges later than a tick."""
        part = slice(self.ticks.searchsorted(tick, "right"), None)
        return Edges(self.ticks[part], self.levels_v[part])

    def shifted(self, ticks: int) -> Edges:
        """The same edges, later by so many ticks."""
        return Edges(self.ticks + ticks, self.levels_v)


@dataclass(frozen=True, eq=False)
class Drive:
    """Level of one input that moves all the time: a polynomial in each sample period.

    terms: float64 (samples, DRIVE_TERMS), V: coefficients in order of powers of the time since each sample, in sample
    periods; first: sample of the first row. Neighbours meet. The level at the end of the last row holds.
    """

    terms: Matrix
    first: int = 0

    @classmethod
    def band_limited(cls, samples_v: Matrix) -> Drive:
        """Band-limited interpolation of samples (n,) in V, which go on in their mirror image; the last one holds.

        The polynomials pass through the interpolation at the nodes of the engine's longest step.
        """
        mirrored = np.concatenate((samples_v, samples_v[::-1]))
        spectrum, turns = np.fft.rfft(mirrored), np.fft.rfftfreq(mirrored.size)
        inner = [
            np.fft.irfft(spectrum * np.exp(2j * np.pi * turns * node), mirrored.size)[: samples_v.size]
            for node in _NODES[1:-1]
        ]
        after = np.append(samples_v[1:], samples_v[-1])
        values = np.stack([samples_v, *inner, after])
        values[:, -1] = samples_v[-1]
        return cls._through(values)

    @classmethod
    def sampled(cls, volts: Callable[[Matrix], Matrix], start_tick: int, stop_tick: int) -> Drive:
        """Signal of ticks start_tick <= t < stop_tick, by a function of the time in sample periods.

        The polynomials pass through it at the nodes of the engine's longest step.
        """
        first, last = start_tick // TICKS_PER_SAMPLE, (stop_tick - 1) // TICKS_PER_SAMPLE
        at = np.arange(first, last + 1, dtype=np.float64)
        values = np.stack([volts(at + node) for node in _NODES])
        values[-1, :-1] = values[0, 1:]
        return cls._through(values, first)

    @classmethod
    def _through(cls, values: Matrix, first: int = 0) -> Drive:
        """Polynomials through the values at the nodes of each sample, (nodes, n), which are overwritten."""
        solve_in_place(np.vander(_NODES, increasing=True), values)
        return cls(np.ascontiguousarray(values.T), first)

    def at(self, tick: int) -> float:
        """Level at a tick from the first sample on."""
        return float(self.volts(np.array([tick / TICKS_PER_SAMPLE]))[0])

    def volts(self, at: Matrix) -> Matrix:
        """Level at instants in sample periods, from the first sample on."""
        row = np.minimum(at.astype(np.int64) - self.first, len(self.terms) - 1)
        since = np.minimum(at - (row + self.first), 1.0)
        level = np.zeros(at.shape)
        for power in reversed(range(binding.DRIVE_TERMS)):
            level *= since
            level += self.terms[row, power]
        return level

    def after(self, sample: int) -> Drive:
        """The same from a sample on, counted from there."""
        return Drive(self.terms[sample - self.first :])


_NODES = (0.0, 0.5 - 0.5 * math.sqrt(3.0 / 7.0), 0.5, 0.5 + 0.5 * math.sqrt(3.0 / 7.0), 1.0)
"""Lobatto nodes of a step."""


class Kink(NamedTuple):
    """A continuous function of three linear pieces, with slopes below lower, between, and above upper.

    Between, phi(w) = slopes[1] w.
    """

    lower: float
    upper: float
    slopes: tuple[float, float, float]
    element: str = ""
    """Name of the element with this limit."""

    @classmethod
    def clip(cls, limit: float, element: str = "") -> Kink:
        """clip(w, -limit, +limit)."""
        return cls(-limit, limit, (0.0, 1.0, 0.0), element)

    @classmethod
    def deadzone(cls, lower: float, upper: float, element: str = "") -> Kink:
        """Excess of w over lower..upper, 0 within."""
        return cls(lower, upper, (1.0, 0.0, 1.0), element)

    @classmethod
    def none(cls, element: str = "") -> Kink:
        """No kink: an argument of a product."""
        return cls(-math.inf, math.inf, (0.0, 0.0, 0.0), element)

    @property
    def intercepts(self) -> tuple[float, float, float]:
        """Constant terms of the pieces, such that they meet; 0 for a piece that an infinite bound removes."""
        below, between, above = self.slopes
        at_lower = (between - below) * self.lower if math.isfinite(self.lower) else 0.0
        at_upper = (between - above) * self.upper if math.isfinite(self.upper) else 0.0
        return at_lower, 0.0, at_upper

    def piece(self, w: float, now: int) -> int:
        """Piece of w: 0, 1 or 2; stays `now` if only rounding may put w beyond its bound."""
        for piece, bound in ((0, self.lower), (1, self.upper)):
            slack = _PIECE_SLACK * (1.0 + abs(bound))
            if math.isfinite(bound) and w < bound + (slack if now <= piece else -slack):
                return piece
        return 2 if math.isfinite(self.upper) else 1


class Law(enum.IntEnum):
    """Laws of a product: X Y, X / Y or sqrt(max(0, X)) Y."""

    PRODUCT = 0
    QUOTIENT = 1
    ROOT = 2


class Product(NamedTuple):
    """Product of two polynomials, each of one element of w: coefficients x and y in order of powers."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    element: str = ""
    """Name of the element that multiplies."""
    law: Law = Law.PRODUCT

    def at(self, p: float, q: float) -> float:
        """Value at two arguments; that of a division by 0 is infinite or no number."""
        x, y = np.float64(_polynomial(self.x, p)), _polynomial(self.y, q)
        if self.law is Law.ROOT:
            return math.sqrt(max(0.0, x)) * y
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(x / y if self.law is Law.QUOTIENT else x * y)


def _polynomial(coefficients: tuple[float, ...], at: float) -> float:
    value = 0.0
    for coefficient in reversed(coefficients):
        value = value * at + coefficient
    return value


class Rest(NamedTuple):
    """Rest of a circuit: its state, (n,) in V, and the voltage of every node."""

    state: Matrix
    volts: Mapping[str, float]


class Layout(NamedTuple):
    """Arrays of an engine_system_t: one block of memory, the offset of each in bytes, and the structure itself."""

    block: Matrix
    starts: tuple[int, ...]
    circuit: binding.System

    @classmethod
    def of(cls, system: PiecewiseLinear, outputs: tuple[str, ...]) -> Layout:
        rows = system.rows(outputs)
        arrays = (system.abc, system.g, system.cde, system.w_phi, system.lmn.take(rows, 0), system.v_phi.take(rows, 0))
        tables = (_kink_table(system.kinks), _product_table(system.products))
        block = np.concatenate((*arrays, *tables), axis=None)
        starts = tuple(itertools.accumulate([part.nbytes for part in (*arrays, *tables[:-1])], initial=0))
        return cls._placed(block, starts)

    def with_drives(self, abc: Matrix, cde: Matrix) -> Layout:
        """The same layout with other abc and cde."""
        block = self.block.copy()
        for start, matrix in ((self.starts[0], abc), (self.starts[2], cde)):
            first = start // block.itemsize
            block[first : first + matrix.size] = matrix.ravel()
        return Layout._placed(block, self.starts)

    @classmethod
    def _placed(cls, block: Matrix, starts: tuple[int, ...]) -> Layout:
        start_of_block = block.ctypes.data
        return cls(block, starts, binding.System(*(start_of_block + start for start in starts)))


@functools.lru_cache(maxsize=64)
def _kink_table(kinks: tuple[Kink, ...]) -> Matrix:
    """Rows of engine_kink_t: (kinks, 8)."""
    return np.array([_kink_row(kink.lower, kink.upper, kink.slopes) for kink in kinks]).reshape(-1, 8)


@functools.lru_cache(maxsize=64)
def _kink_row(lower: float, upper: float, slopes: tuple[float, float, float]) -> tuple[float, ...]:
    """Row of an engine_kink_t. The amplifiers of a machine have few limits that differ."""
    return lower, upper, *slopes, *Kink(lower, upper, slopes).intercepts


@functools.lru_cache(maxsize=64)
def _product_table(products: tuple[Product, ...]) -> Matrix:
    """Rows of engine_product_t: (products, 2 MAX_FACTOR_TERMS + 1)."""
    second = binding.MAX_FACTOR_TERMS
    table = np.zeros((len(products), 2 * second + 1))
    for row, product in zip(table, products, strict=True):
        row[: len(product.x)], row[second : second + len(product.y)] = product.x, product.y
        row[-1] = product.law
    return table


@dataclass(frozen=True)
class PiecewiseLinear:
    """The state space of a circuit, in the form of the module docstring.

    Columns of abc, cde and lmn: states, inputs, products, constant. m counts inputs and products.

    abc: (n, n+m+1) in 1/s and V/s; g: (n, q); cde: (q, n+m+1); w_phi: P, (q, q); lmn: (nodes, n+m+1), dimensionless but
    for its last column in V; v_phi: R, (nodes, q).
    states, inputs, nodes: names; ground is not among the nodes. products: the last rows of w are their arguments, two
    each, of which phi makes nothing. origin: state space with the same matrices but abc and
    cde, whose layouts are made into those of this one.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    nodes: tuple[str, ...]
    kinks: tuple[Kink, ...]
    abc: Matrix
    g: Matrix
    cde: Matrix
    w_phi: Matrix
    lmn: Matrix
    v_phi: Matrix
    products: tuple[Product, ...] = ()
    origin: PiecewiseLinear | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        for matrix in (self.abc, self.g, self.cde, self.w_phi, self.lmn, self.v_phi):
            matrix.setflags(write=False)  # the layouts are copies

    def __reduce__(self) -> tuple[type[PiecewiseLinear], tuple[Any, ...]]:
        """Pickle and copy the fields alone, not the layouts."""
        return PiecewiseLinear, tuple(getattr(self, each.name) for each in fields(self))

    def with_drives(self, abc: Matrix, cde: Matrix) -> PiecewiseLinear:
        """The same state space with other abc and cde."""
        return replace(self, abc=abc, cde=cde, origin=self.origin or self)

    def driven(self, names: Sequence[str]) -> PiecewiseLinear:
        """The same state space with these inputs moved to the end of the products, for drives. Raises CircuitError."""
        if missing := [name for name in names if name not in self.inputs]:
            raise CircuitError(f"no input is called {missing[0]!r}; there are {', '.join(self.inputs) or 'none'}")
        if not names:
            return self
        last, more = self.abc.shape[1] - 1, 2 * len(names)
        moved = [len(self.states) + self.inputs.index(name) for name in names]
        columns = [*(j for j in range(last) if j not in moved), *moved, last]
        return PiecewiseLinear(
            states=self.states,
            inputs=tuple(name for name in self.inputs if name not in names),
            nodes=self.nodes,
            kinks=(*self.kinks, *(Kink.none(name) for name in names for _ in range(2))),
            abc=self.abc[:, columns],
            g=np.pad(self.g, ((0, 0), (0, more))),
            cde=np.pad(self.cde[:, columns], ((0, more), (0, 0))),
            w_phi=np.pad(self.w_phi, (0, more)),
            lmn=self.lmn[:, columns],
            v_phi=np.pad(self.v_phi, ((0, 0), (0, more))),
            products=(*self.products, *(Product((0.0,), (0.0,), name) for name in names)),
        )

    @functools.cached_property
    def layouts(self) -> dict[tuple[str, ...], Layout]:
        """Layouts by outputs, as far as made."""
        return {}

    def layout(self, outputs: tuple[str, ...]) -> Layout:
        """Layout for the engine, with these nodes as outputs. Raises CircuitError for an unknown node."""
        if outputs not in self.layouts:
            if self.origin is None:
                self.layouts[outputs] = Layout.of(self, outputs)
            else:
                self.layouts[outputs] = self.origin.layout(outputs).with_drives(self.abc, self.cde)
        return self.layouts[outputs]

    def readings(self, nodes: Sequence[str]) -> Matrix:
        """Rows of lmn for these nodes, in this order. Raises CircuitError for an unknown node."""
        return self.lmn[self.rows(nodes)]

    def rows(self, nodes: Sequence[str]) -> list[int]:
        """Row indices of these nodes in lmn and v_phi. Raises CircuitError for an unknown node."""
        try:
            return [self.nodes.index(node) for node in nodes]
        except ValueError:
            missing = next(node for node in nodes if node not in self.nodes)
            raise CircuitError(f"no node is called {missing!r}; there are {', '.join(self.nodes)}") from None

    def rest(self, levels_v: Matrix) -> Rest:
        """Rest with the inputs held at levels_v (m,), limits included.

        Pieces are tried from the middle ones on: each time those that hold the rest of the last ones, until they agree.
        The rest need not be unique, nor the one that the circuit would reach from its present state.
        Products are iterated until they no longer change.
        Raises CircuitError naming a state that nothing brings to rest, or elements without a rest in any piece tried.
        """
        if not self.products:
            return self._rest_with(levels_v)[0]
        values = np.zeros(len(self.products))
        for _ in range(_REST_PASSES):
            rest, w = self._rest_with(np.concatenate((levels_v, values)))
            arguments = w[len(w) - 2 * values.size :].reshape(-1, 2)
            found = np.array([f.at(*pair) for f, pair in zip(self.products, arguments, strict=True)])
            if (np.abs(found - values) <= _REST_V).all():
                return rest
            values = np.where(np.isfinite(found), found, values)  # a quotient waits for a divisor that is a product
        names = ", ".join(dict.fromkeys(product.element for product in self.products))
        raise CircuitError(f"nothing brings {names} to rest: the products do not settle")

    def _rest_with(self, levels_v: Matrix) -> tuple[Rest, Matrix]:
        """Rest and its w with the products held as well."""
        pieces = np.ones(len(self.kinks), np.intp)
        for _ in range(2 * len(self.kinks) + 1):
            rest, w = self._rest_within(pieces, levels_v)
            reached = np.array([kink.piece(*at) for kink, *at in zip(self.kinks, w, pieces, strict=True)], np.intp)
            if (reached == pieces).all():
                return rest, w
            unsettled, pieces = reached != pieces, reached
        names = dict.fromkeys(kink.element for kink, moves in zip(self.kinks, unsettled, strict=True) if moves)
        raise CircuitError(f"nothing brings {', '.join(names)} to rest: no piece of its limits holds a rest")

    def _rest_within(self, pieces: NDArray[np.intp], levels_v: Matrix) -> tuple[Rest, Matrix]:
        """Rest and its w if every kink were the line of its piece everywhere."""
        states, kinks = len(self.states), range(len(self.kinks))
        slopes = np.array([self.kinks[k].slopes[pieces[k]] for k in kinks])
        intercepts = np.array([self.kinks[k].intercepts[pieces[k]] for k in kinks])
        w_of_z = self.cde.copy()
        for k in kinks:
            w_of_z[:, -1] += self.w_phi[:, k] * intercepts[k]
        failed = solve_in_place(np.eye(len(self.kinks)) - self.w_phi * slopes, w_of_z)
        if failed >= 0:
            raise CircuitError(f"the limits of {self.kinks[failed].element} leave no unique solution")
        flow = self.abc.copy()
        for k in kinks:
            flow += np.outer(self.g[:, k] * slopes[k], w_of_z[k])
            flow[:, -1] += self.g[:, k] * intercepts[k]
        held = np.append(levels_v, 1.0)
        right = -(flow[:, states:] * held).sum(axis=1, keepdims=True)
        failed = solve_in_place(flow[:, :states], right)
        if failed >= 0:
            raise CircuitError(f"nothing brings {self.states[failed]} to rest")
        z = np.concatenate((right[:, 0], held))
        w = np.asarray((w_of_z * z).sum(axis=1))
        volts = (self.lmn * z).sum(axis=1) + (self.v_phi * (slopes * w + intercepts)).sum(axis=1)
        return Rest(right[:, 0], dict(zip(self.nodes, volts.tolist(), strict=True))), w


def solve_in_place(left: Matrix, solution: Matrix) -> int:
    """Solve left x = solution in place; return the unknown without a pivot, or -1.

    solution: contiguous, with at least as many rows as left.
    """
    matrix = left.copy(order="C")
    return int(binding.load().engine_solve(len(left), solution.shape[1], matrix.ctypes.data, solution.ctypes.data))
