"""Speed of programs with multipliers in the loop, beside ngspice on the same circuit.

python -m tests.bench multipliers

The grid is that of bench_engine with tighter tolerances, each setting run once: looser ones are off by LSBs. A deck
that knows the circuit limits neither op-amps nor multipliers. The fastest FINALISTS of each deck within each of
ACCURACIES_LSB run again; the best run counts. Times are of the processor. build/ngspice-NAME.csv has the whole grid.
"""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analogrig.config import fixtures
from analogrig_emulator import (
    MULTIPLIERS,
    TICKS_PER_SAMPLE,
    Deck,
    Excitation,
    PatchedProgram,
    SuspensionComputer,
    load_patch,
)
from tests.emulator.test_compiler import levels_v

from .bench_engine import (
    FINALISTS,
    METHODS,
    RATE_HZ,
    REPEATS,
    TOLERATED_LSB,
    Setting,
    Simulated,
    best_s,
    fastest,
    in_setting,
    simulate,
)
from .figure import Figure

PROGRAMS = ("duffing", "van-der-pol")
SAMPLES, LONG = 800, 8000
"""Lengths of a play in samples."""
OP_AMPS = ("exported", "knowing")
SETTINGS = tuple(
    itertools.starmap(
        Setting,
        itertools.product(
            METHODS, OP_AMPS, ("every sample", "start"), (1e-4, 1e-6, 1e-7), (7.0, 1.0, 0.1), (50e-6, 12e-6, 4e-6)
        ),
    )
)
"""The searched grid."""
ACCURACIES_LSB = (TOLERATED_LSB, 0.1)
"""Largest errors of ngspice: that of bench_engine, and half of it. With edges on samples its best leaves 0.07."""
WARM_PLAYS, COLD_PLAYS = 10, 20

_LIMITS = """\
Bstate 0 state I = 1e-10 * (max(-{slew}, min({slew}, {rate} * (v(inner) - v(state))))
+ - 1000000000.0 * (max(0, v(state) - {swing_high}) + min(0, v(state) - {swing_low})))
"""
"""Law of the multiplier's state in the exported deck."""
_LINEAR_STATE = "Gstate 0 state inner state {1e-10 * rate}\n"

NOTE = f"""\
A square wave between the levels of the trial play, nominal TL07x and AD633. The grid has {len(SETTINGS)}
settings of method, time points, reltol, trtol and longest step, searched with {SAMPLES} samples. Its
{FINALISTS} fastest settings within an error at the output run again: {TOLERATED_LSB:g} LSB as in the
table of the linear trial, and {ACCURACIES_LSB[-1]:g} LSB. The first also play {LONG:,} samples.
Exported decks are those of `analogrig netlist`. Knowing ones limit neither op-amps nor multipliers,
for none leaves its range. Ratios are times of ngspice over those of the emulator.

The emulator, cold: the first play in a new process, machine and all matrices included, the best of
{COLD_PLAYS} processes. Own offsets: each machine has op-amps of its own. Again: the same machine as
before, built anew.
"""
"""Paragraphs below the table."""


@dataclass(frozen=True)
class Played:
    """A program under its square wave."""

    program: PatchedProgram
    samples: int = SAMPLES

    @cached_property
    def excitation(self) -> Excitation:
        low_v, high_v = levels_v(self.program)
        return Excitation(low_v=low_v, high_v=high_v)

    @cached_property
    def node(self) -> str:
        """Node of the output."""
        return self.program.scales.quantities[self.program.channels[1]].node

    @classmethod
    def of(cls, name: str, samples: int = SAMPLES) -> Played:
        """A shipped program."""
        return cls(load_patch(fixtures() / "programs" / f"{name}.toml"), samples)

    def computer(self, rng: np.random.Generator | None = None) -> SuspensionComputer:
        """A machine with AD633; rng draws offsets of the op-amps."""
        return SuspensionComputer(self.program, multiplier=MULTIPLIERS["ad633"], rng=rng)

    def play(self, computer: SuspensionComputer) -> NDArray[np.float64]:
        return np.concatenate(list(computer.play(self.excitation, self.samples)))

    @cached_property
    def exact_v(self) -> NDArray[np.float64]:
        """Output at its node, by the emulator."""
        sign = self.program.scales.quantities[self.program.channels[1]].sign
        return sign * self.play(self.computer())[:, 1]

    def deck(self, setting: Setting) -> str:
        edges = self.excitation.edges(0, self.samples * TICKS_PER_SAMPLE, RATE_HZ)
        deck = Deck(self.computer().circuit, self.samples, RATE_HZ, {"F": edges})
        text = in_setting(deck.text([self.node], setting.accuracy), setting, r"U\d+")
        return text.replace(_LIMITS, _LINEAR_STATE) if setting.op_amps == "knowing" else text

    def simulate(self, setting: Setting) -> Simulated:
        try:
            return simulate(self.deck(setting), self.exact_v, self.node)
        except (subprocess.CalledProcessError, OSError):
            return Simulated(math.inf, math.inf)


def figures() -> Iterator[Figure]:
    """Times of ngspice at its best for each kind of deck and each accuracy, and the emulator beside them."""
    for name in PROGRAMS:
        finalists = _finalists(name)
        for played in (Played.of(name), Played.of(name, LONG)):
            label = f"{name}, {played.samples:,} samples"
            emulated = {"cold": _cold_s(name, played.samples), "own offsets": _own_s(played)}
            for what, spent_s in (*emulated.items(), ("again", _warm_s(played))):
                yield Figure(f"emulator, {label}, {what}", 1e3 * spent_s, "ms")
            for (op_amps, accuracy_lsb), settings in finalists.items():
                if played.samples == LONG and accuracy_lsb < TOLERATED_LSB:
                    continue
                setting, run = _best(played, settings, accuracy_lsb)
                for what, spent_s in emulated.items():
                    deck = f"ngspice, {label}, within {accuracy_lsb:g} LSB: {op_amps} op-amps, emulator {what}"
                    told = f"{setting}; {run.error_lsb:.3f} LSB"
                    yield Figure(deck, 1e3 * run.spent_s, "ms", told, run.spent_s / spent_s)


def _finalists(name: str) -> dict[tuple[str, float], list[Setting]]:
    """Fastest settings of a short play, of each kind of op-amps and each accuracy, with both solvers."""
    played = Played.of(name)
    found = {setting: played.simulate(setting) for setting in SETTINGS}
    rows = [f"{1e3 * run.spent_s:.1f},{run.error_lsb:.3f},{setting}" for setting, run in found.items()]
    Path(f"build/ngspice-{name}.csv").write_text("\n".join(["CPU ms,error LSB,setting", *rows, ""]))
    finalists: dict[tuple[str, float], list[Setting]] = {}
    for kind in itertools.product(OP_AMPS, ACCURACIES_LSB):
        op_amps, accuracy_lsb = kind
        of_kind = {key: run for key, run in found.items() if key.op_amps == op_amps}
        fast = fastest(of_kind, accuracy_lsb)[:FINALISTS]
        finalists[kind] = [replace(each, solver=solver) for each in fast for solver in ("sparse", "klu")]
    return finalists


def _best(played: Played, settings: Iterable[Setting], accuracy_lsb: float) -> tuple[Setting, Simulated]:
    """The fastest accurate one of several settings, with its best run; the most accurate one if none is."""
    runs = [(each, played.simulate(each)) for each, _ in itertools.product(settings, range(REPEATS))]
    accurate = [each for each in runs if each[1].error_lsb <= accuracy_lsb]
    if not accurate:
        return min(runs, key=lambda each: each[1].error_lsb)
    return min(accurate, key=lambda each: each[1].spent_s)


def _warm_s(played: Played) -> float:
    return best_s(lambda: [played.play(played.computer()) for _ in range(WARM_PLAYS)]) / WARM_PLAYS


def _own_s(played: Played) -> float:
    """CPU time of a play whose machine has offsets of its own."""
    seeds = itertools.count()

    def run() -> None:
        for seed in itertools.islice(seeds, WARM_PLAYS):
            played.play(played.computer(np.random.default_rng(seed)))

    return best_s(run) / WARM_PLAYS


_COLD = """\
import sys, time
from tests.bench.bench_multipliers import Played, SuspensionComputer
played = Played.of(sys.argv[1], int(sys.argv[2]))
played.excitation
next(SuspensionComputer("front").play(played.excitation, 1))
start_s = time.process_time()
played.play(played.computer())
print(time.process_time() - start_s)
"""
"""The engine itself is loaded by another circuit."""


def _cold_s(name: str, samples: int) -> float:
    """CPU time of the first play in a process."""
    command = [sys.executable, "-c", _COLD, name, str(samples)]
    return min(
        float(subprocess.run(command, capture_output=True, text=True, check=True).stdout) for _ in range(COLD_PLAYS)
    )
