"""Exact sample-by-sample solution of a piecewise-linear circuit; engine.h describes the method."""

from __future__ import annotations

import ctypes
import math
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator.engine import binding
from analogrig_emulator.engine.system import TICKS_PER_SAMPLE, Drive, EdgeRows, Edges, PiecewiseLinear
from analogrig_emulator.exceptions import EngineError

_Trains = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float64]]
"""Ticks, inputs and levels of all edges, in time order."""

_REASONS = {
    1: "out of memory",
    2: "the circuit is too stiff: it has a time constant 10^17 times shorter than a sample period",
    3: "more events within one sample than events_per_sample allows: does an amplifier oscillate?",
    4: "the state is no longer finite: the circuit is unstable",
    5: "the edges are out of order, before the last sample recorded, or beyond the last sample of the run; "
    "or a drive begins after it",
    6: "no circuit was set, or the last one was refused",
    7: "limiters, amplifiers and multipliers feed one another so that there is no unique solution: "
    "is there positive feedback, a loop of ideal elements, or a division by 0?",
    8: "the products of multipliers cannot be followed: they grow without bound, or a divisor reached zero",
}


@dataclass(frozen=True)
class EngineCounts:
    """Work counters of an engine.

    samples: samples recorded; events: mode changes between edges; steps: matrix products; quiet: samples stepped with
    the slow states alone; modes_built: ladders.
    """

    samples: int
    events: int
    steps: int
    quiet: int
    modes_built: int


class Plays(NamedTuple):
    """Plays of one schedule."""

    volts: NDArray[np.float64]
    """(plays, samples, outputs) V."""
    overdue_ticks: NDArray[np.int64]
    """(plays, kinks), as Engine.overdue_ticks."""
    states_v: NDArray[np.float64]
    """(plays, states) V at the last sample."""


class Engine:
    """Solver of one circuit. It starts at rest (x = 0, u = 0), before its first sample.

    system: circuit; outputs: nodes to record; events_per_sample: most mode changes within a sample period, or
    EngineError is raised. ahead_ticks: if not 0, the voltages so many ticks after each sample follow in its row, as
    they would be without edges and changes after the sample. drives: inputs that move between samples, which then take
    no edges.
    """

    def __init__(
        self,
        system: PiecewiseLinear,
        outputs: Sequence[str],
        sample_rate_hz: float = 20e3,
        events_per_sample: int = 10_000,
        ahead_ticks: int = 0,
        drives: Mapping[str, Drive] = MappingProxyType({}),
    ) -> None:
        system = system.driven(tuple(drives))
        self._drives: dict[str, Drive] = {}
        self._outputs = tuple(outputs)
        self._ahead_ticks = ahead_ticks
        self._names = (system.states, system.inputs)
        self._library = binding.load()
        if not 0 < sample_rate_hz < math.inf:
            raise EngineError(f"sample_rate_hz must be positive and finite, got {sample_rate_hz!r}")
        if len(self._outputs) > binding.MAX_OUTPUTS:
            raise EngineError(
                f"{len(self._outputs)} nodes are to be recorded; the engine takes at most {binding.MAX_OUTPUTS}"
            )
        inputs, products = len(system.inputs) + len(system.products), len(system.products)
        if products > binding.MAX_PRODUCTS:
            raise EngineError(
                f"{products - len(drives)} multipliers and {len(drives)} inputs that move all the time; "
                f"the engine takes at most {binding.MAX_PRODUCTS} together"
            )
        sizes = (len(system.states), inputs, products, len(system.kinks), len(self._outputs))
        kind = (self._library, (*sizes, 1.0 / sample_rate_hz, events_per_sample))
        self._handle = _take(kind)
        if not self._handle:
            raise EngineError(
                "cannot make an engine for {} states, {} inputs ({} of them products), {} kinks, {} outputs".format(
                    *sizes
                )
            )
        weakref.finalize(self, _release, kind, self._handle)
        self._library.engine_look_ahead(self._handle, ahead_ticks)
        self._kinks = len(system.kinks)
        self._driven = {name: product for product, name in enumerate(drives, products - len(drives))}
        self.follow(drives)
        self._recorded = 0
        self._now_tick = -1
        self._set(system)

    @property
    def recorded(self) -> int:
        """Number of samples recorded; the present instant is that of the last one."""
        return self._recorded

    @property
    def counts(self) -> EngineCounts:
        """Counters of samples, events, steps and modes."""
        counts = binding.Counts()
        self._library.engine_get_counts(self._handle, ctypes.byref(counts))
        return EngineCounts(counts.samples, counts.events, counts.steps, counts.quiet, counts.modes_built)

    @property
    def state(self) -> NDArray[np.float64]:
        """The voltages of PiecewiseLinear.states, (n,) in V."""
        state = np.empty(len(self._names[0]))
        self._library.engine_get_state(self._handle, state.ctypes.data)
        return state

    @state.setter
    def state(self, volts: NDArray[np.float64]) -> None:
        state = np.ascontiguousarray(volts, np.float64)
        if state.shape != (len(self._names[0]),):
            raise EngineError(f"the state has shape ({len(self._names[0])},), got {state.shape}")
        self._check(self._library.engine_set_state(self._handle, state.ctypes.data))

    def set_system(self, system: PiecewiseLinear) -> None:
        """Replace the circuit by another of the same states, inputs and kinks, at the last instant recorded.

        The next sample is the first of the new circuit. Voltages of capacitors and op-amps carry over. An equal circuit
        changes no bit. Raises EngineError; the engine then runs only after it has accepted another circuit.
        """
        self._set(system.driven(tuple(self._drives)))

    def _set(self, system: PiecewiseLinear) -> None:
        if (system.states, system.inputs) != self._names:
            raise EngineError(
                f"the new circuit has states {system.states} and inputs {system.inputs}, not {self._names}"
            )
        self._layout = system.layout(self._outputs)
        self._check(self._library.engine_set_system(self._handle, ctypes.byref(self._layout.circuit)))

    def follow(self, drives: Mapping[str, Drive]) -> None:
        """Replace drives by those of the coming samples, from the one last recorded on. Raises EngineError."""
        for name, drive in drives.items():
            terms = drive.terms
            if terms.shape != (len(terms), binding.DRIVE_TERMS) or not (len(terms) and np.isfinite(terms).all()):
                raise EngineError(f"a drive needs rows of {binding.DRIVE_TERMS} finite coefficients")
            placed = (drive.first, len(terms), terms.ctypes.data)
            self._check(self._library.engine_drive(self._handle, self._driven[name], *placed))
            self._drives[name] = drive

    def run(self, samples: int, edges: Mapping[str, Edges] | None = None) -> NDArray[np.float64]:
        """Record the next samples, each after the edges at its instant: float64 (samples, outputs), V.

        edges: by input, all within window(samples). Cutting a run into several calls changes no bit.
        Raises EngineError; the engine is then unusable.
        """
        volts = self._allocate(samples)
        trains = self._merge(edges or {})
        self._run_until((self._recorded + samples - 1) * TICKS_PER_SAMPLE, trains, volts)
        self._advance_clock(samples)
        return volts

    def _allocate(self, samples: int) -> NDArray[np.float64]:
        if samples < 0:
            raise EngineError(f"cannot record {samples} samples")
        return np.empty((samples, len(self._outputs) * (2 if self._ahead_ticks else 1)))

    def _advance_clock(self, samples: int) -> None:
        self._recorded += samples
        if samples:
            self._now_tick = (self._recorded - 1) * TICKS_PER_SAMPLE

    def _run_until(self, tick: int, trains: _Trains, volts: NDArray[np.float64]) -> None:
        addresses = [array.ctypes.data for array in (*trains, volts)]
        self._check(self._library.engine_run(self._handle, tick, trains[0].size, *addresses))

    def run_changing(
        self, samples: int, changes: Sequence[tuple[int, PiecewiseLinear]], edges: Mapping[str, Edges] | None = None
    ) -> NDArray[np.float64]:
        """Record the next samples like run(), and after each sample k of `changes` set its circuit.

        Equals alternating run() and set_system(), at a fraction of the cost. Raises EngineError like both.
        """
        volts = self._allocate(samples)
        drives = tuple(self._drives)
        layouts = [self._layout, *(system.driven(drives).layout(self._outputs) for _, system in changes)]
        circuits = (binding.System * len(layouts))(*(layout.circuit for layout in layouts))
        lasts = [*(sample for sample, _ in changes), self._recorded + samples - 1]
        until = np.array(lasts, np.int64) * TICKS_PER_SAMPLE
        trains = self._merge(edges or {})
        addresses = [array.ctypes.data for array in (*trains, volts)]
        turned = (len(circuits), circuits, until.ctypes.data, trains[0].size)
        self._check(self._library.engine_play(self._handle, *turned, *addresses))
        self._layout = layouts[-1]
        self._advance_clock(samples)
        return volts

    def run_turning(
        self,
        samples: int,
        turning: Callable[[float], PiecewiseLinear],
        edges: Mapping[str, Edges] | None = None,
        pieces_per_sample: int = 1,
    ) -> NDArray[np.float64]:
        """Record the next samples like run() while pots turn: turning(t) is the circuit at t sample periods.

        Each piece of 1/pieces_per_sample is stepped exactly with the circuit of its middle. Every sample is the middle
        of a piece, so it shows the circuit of its instant. The circuit of the last sample stays.
        Cutting a run into several calls changes no bit.

        Error for pieces of h seconds and a dial moving at r per second: at most r h^2 / 8 max |d(dx/dt)/d(dial)|, plus
        r h^2 / 12 times the integral of its rate of change over the circuit's memory. Four times as many pieces leave
        a sixteenth of the error.
        """
        if pieces_per_sample < 1:
            raise EngineError(f"pieces_per_sample must be at least 1, got {pieces_per_sample}")
        volts = self._allocate(samples)
        ticks, inputs, levels_v = self._merge(edges or {})
        last, first_edge = self._recorded + samples - 1, 0
        for piece in range(max(self._recorded - 1, 0) * pieces_per_sample, last * pieces_per_sample + 1):
            self.set_system(turning(piece / pieces_per_sample))
            stop = min((2 * piece + 1) * TICKS_PER_SAMPLE // (2 * pieces_per_sample), last * TICKS_PER_SAMPLE)
            next_edge = int(np.searchsorted(ticks, stop, "right"))
            now = slice(first_edge, next_edge if piece < last * pieces_per_sample else None)
            recorded = self.counts.samples
            self._run_until(stop, (ticks[now], inputs[now], levels_v[now]), volts[recorded - self._recorded :])
            first_edge = next_edge
        self._advance_clock(samples)
        return volts

    def play_all(
        self,
        schedule: CircuitSchedule,
        constants: NDArray[np.float64],
        edges: Mapping[str, EdgeRows],
        states_v: NDArray[np.float64] | None = None,
    ) -> Plays:
        """Play a schedule once for each row of constants (plays, systems, places) and of edges of one input.

        states_v: (plays, states) V at which the first circuit starts; None: at rest. Each play equals alternating
        set_system() and run() on a new engine, at a fraction of the cost. Clock and watch() restart.
        Raises EngineError.
        """
        if self._drives:
            raise EngineError("a schedule is for inputs with edges: play drives with run()")
        ((name, trains),) = edges.items()
        plays, room = trains.ticks.shape
        if not (np.isfinite(trains.levels_v).all() and len(constants) == plays):
            raise EngineError(f"the edges of {name} need as many finite levels as ticks")
        constants = np.ascontiguousarray(constants, np.float64)
        inputs = np.full(room, self._names[1].index(name), np.int32)
        volts = np.empty((plays, schedule.samples, len(self._outputs)))
        overdue = np.empty((plays, self._kinks), np.int64)
        ends_v = np.empty((plays, len(self._names[0])))
        starts_v = None if states_v is None else np.ascontiguousarray(states_v, np.float64)
        if starts_v is not None and starts_v.shape != ends_v.shape:
            raise EngineError(f"the states of the plays have shape {ends_v.shape}, got {starts_v.shape}")
        before, after = [
            [None if array is None else array.ctypes.data for array in arrays]
            for arrays in (
                (constants, starts_v, inputs),
                (trains.counts, trains.ticks, trains.levels_v, volts, overdue, ends_v),
            )
        ]
        status = self._library.engine_play_all(
            self._handle, ctypes.byref(schedule.struct), plays, *before, room, *after
        )
        self._check(status)
        self._recorded, self._now_tick = 0, -1
        self._advance_clock(schedule.samples)
        return Plays(volts, overdue, ends_v)

    def advance(self, tick: int, edges: Mapping[str, Edges] | None = None) -> None:
        """Go to an instant before the next sample without recording; apply the edges up to it.

        The circuit can then be changed between two samples. Raises EngineError like run(), and for another instant.
        """
        if not self._now_tick <= tick < self._recorded * TICKS_PER_SAMPLE:
            raise EngineError(f"after {self._recorded} samples: tick {tick} is past, or not before the next sample's")
        self._run_until(tick, self._merge(edges or {}), np.empty((0, len(self._outputs))))
        self._now_tick = tick

    def watch(self, patience_ticks: int) -> None:
        """Watch from now on for kinks outside their middle piece for patience_ticks without a break."""
        self._library.engine_watch(self._handle, patience_ticks)

    @property
    def overdue_ticks(self) -> NDArray[np.int64]:
        """First tick by kink at which it had been outside for the ticks of watch(), else -1: int64 (kinks,).

        Arguments of drives are no kinks of the circuit.
        """
        ticks = np.empty(self._kinks, np.int64)
        self._library.engine_get_overdue(self._handle, ticks.ctypes.data)
        return ticks[: self._kinks - 2 * len(self._driven)]

    @property
    def now_tick(self) -> int:
        """Present instant: that of the last sample or of advance(); -1 before either."""
        return self._now_tick

    def window(self, samples: int) -> tuple[int, int]:
        """Range of ticks (start, stop) of the edges that run(samples) accepts: start <= tick < stop."""
        return self._now_tick + 1, (self._recorded + samples - 1) * TICKS_PER_SAMPLE + 1

    def _merge(self, edges: Mapping[str, Edges]) -> _Trains:
        """All edges in time order; at the same tick in order of input."""
        for name, train in edges.items():
            if name not in self._names[1]:
                raise EngineError(f"no input is called {name!r}; there are {', '.join(self._names[1]) or 'none'}")
            if train.ticks.shape != train.levels_v.shape or not np.isfinite(train.levels_v).all():
                raise EngineError(f"the edges of {name} need as many finite levels as ticks")
        trains = [(self._names[1].index(name), train) for name, train in edges.items() if train.ticks.size]
        if not trains:
            return np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0)
        if len(trains) == 1:
            ((i, train),) = trains
            inputs = np.full(train.ticks.size, i, np.int32)
            return np.ascontiguousarray(train.ticks, np.int64), inputs, np.ascontiguousarray(train.levels_v, np.float64)
        ticks = np.concatenate([train.ticks for _, train in trains], dtype=np.int64)
        levels_v = np.concatenate([train.levels_v for _, train in trains], dtype=np.float64)
        inputs = np.repeat(np.array([i for i, _ in trains], np.int32), [train.ticks.size for _, train in trains])
        order = np.lexsort((inputs, ticks))
        return ticks[order], inputs[order], levels_v[order]

    def _check(self, status: int) -> None:
        if status:
            raise EngineError(f"after {self.counts.samples} samples: {_REASONS.get(status, f'status {status}')}")


_Kind: TypeAlias = tuple[ctypes.CDLL, tuple[float, ...]]
"""Library of an engine, and the arguments of its engine_new."""

_IDLE_KINDS, _IDLE_OF_A_KIND = 8, 2

_idle: dict[_Kind, deque[int]] = {}
"""Addresses of engines that nobody uses. They keep their matrices for the next machine of their kind."""


def _take(kind: _Kind) -> int | None:
    """Address of an engine at rest; None as from engine_new."""
    engines, arguments = kind
    try:
        handle = _idle[kind].pop()
    except LookupError:
        new: int | None = engines.engine_new(*arguments)
        return new
    engines.engine_restart(handle)
    return handle


def _release(kind: _Kind, handle: int) -> None:
    """Keep an engine, or free it if enough are kept. May run at any time and in any thread."""
    if kind in _idle or len(_idle) < _IDLE_KINDS:
        kept = _idle.setdefault(kind, deque())
        if len(kept) < _IDLE_OF_A_KIND:
            kept.append(handle)
            return
    kind[0].engine_free(handle)


class CircuitSchedule:
    """Circuits of one play in the engine's memory layout, for repeated plays with other constants.

    systems: of the same states, inputs and kinks; last_samples: last sample of each, ascending; patience_ticks: as for
    Engine.watch; varied: (row of abc, row of cde or None) of the last columns that constants of a play replace: that of
    abc only where there is none of cde.
    """

    def __init__(
        self,
        systems: Sequence[PiecewiseLinear],
        outputs: Sequence[str],
        last_samples: Sequence[int],
        patience_ticks: int,
        varied: Sequence[tuple[int, int | None]],
    ) -> None:
        layouts = [system.layout(tuple(outputs)) for system in systems]
        starts = layouts[0].starts
        self.samples = last_samples[-1] + 1
        self.until_ticks = np.array(last_samples, np.int64) * TICKS_PER_SAMPLE
        width = systems[0].abc.shape[1]
        abc, cde = (starts[field] // layouts[0].block.itemsize - 1 for field in (0, 2))
        places = [abc + (pole + 1) * width if kink is None else cde + (kink + 1) * width for pole, kink in varied]
        self._places = np.array(places, np.int64)
        self._blocks = np.stack([layout.block for layout in layouts])
        circuits = (binding.System * len(systems))(
            *(binding.System(*(row.ctypes.data + start for start in starts)) for row in self._blocks)
        )
        self.struct = binding.Schedule(
            turns=len(systems),
            circuit=circuits,
            until=self.until_ticks.ctypes.data,
            patience=patience_ticks,
            numbers=self._blocks.ctypes.data,
            row=self._blocks.shape[1],
            places=self._places.size,
            place=self._places.ctypes.data,
        )
