"""Speed of the emulator, beside ngspice on the same deck.

python -m tests.benchmarks engine

Times are of the processor, not of the clock on the wall: the machine is shared.
"""

from __future__ import annotations

import functools
import itertools
import re
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analogrig_emulator import (
    CARDS,
    OP_AMP_GRADES,
    TICKS_PER_SAMPLE,
    Capacitor,
    Card,
    Circuit,
    Engine,
    Excitation,
    NoisySuspension,
    PotTurn,
    Resistor,
    Sampler,
    SuspensionComputer,
    piecewise_linear,
    to_spice,
)
from analogrig_emulator.circuit.spice import Accuracy
from analogrig_emulator.machine.suspension import BLOCK_SAMPLES
from tests.emulator.conftest import _read_raw

from .figure import Figure

THESIS_TWEAKS: tuple[PotTurn, ...] = (
    PotTurn(200, {"K_n_per_m": 18000.0}),
    PotTurn(400, {"B_n_s_per_m": 3453.0}),
    PotTurn(500, {"B_n_s_per_m": 2123.0, "K_n_per_m": 20000.0}),
    PotTurn(600, {"M_kg": 30.0}),
)

REPEATS = 5
"""Number of repetitions, of which the best is reported."""

RATE_HZ = 20e3
LSB_V = 10.0 / 4096
TOLERATED_LSB = 0.2

ACCURACIES = (
    Accuracy(reltol=1e-3, vntol_v=1e-6, trtol=7.0, max_step_s=5e-5),
    Accuracy(reltol=1e-3, vntol_v=1e-6, trtol=7.0, max_step_s=1e-5),
    Accuracy(reltol=1e-3, vntol_v=1e-6, trtol=1.0, max_step_s=8e-6),
    Accuracy(reltol=1e-4, vntol_v=1e-6, trtol=7.0, max_step_s=5e-6),
    Accuracy(reltol=1e-6, vntol_v=1e-7, trtol=1.0, max_step_s=1e-4),
)
"""Settings of ngspice; each is tried with every deck of `variants`."""


def best_s(job: Callable[[], object]) -> float:
    def once() -> float:
        start = time.process_time()
        job()
        return time.process_time() - start

    return min(once() for _ in range(REPEATS))


# ---- the emulator


def play(excitation: Excitation, samples: int, block_samples: int = BLOCK_SAMPLES) -> None:
    for _ in SuspensionComputer("front").play(excitation, samples, (), block_samples):
        pass


def front(seed: int, *, noisy: bool) -> SuspensionComputer | NoisySuspension:
    computer = SuspensionComputer("front")
    if not noisy:
        return computer
    return NoisySuspension(computer, np.random.default_rng(seed), op_amps=OP_AMP_GRADES["tl07x"])


def run_trials(count: int, *, noisy: bool = False) -> None:
    for seed in range(count):
        for _ in front(seed, noisy=noisy).play(Excitation(), 800, THESIS_TWEAKS):
            pass


def digitise(card: Card, samples: int, *, noisy: bool) -> None:
    """Play circuit and card with 4 channels, in blocks."""
    sampler = Sampler(card, np.random.default_rng(1))
    for volts in front(1, noisy=noisy).play(Excitation(), samples, (), 4096):
        sampler.sample(volts)


def turn(computer: SuspensionComputer, count: int) -> None:
    next(computer.play(Excitation(), 100))
    for i in range(count):
        computer.set(M_kg=100.0 + i)


def streams() -> Iterator[tuple[str, Excitation]]:
    yield "quiet", Excitation(low_v=5.0, high_v=5.0)
    yield "200 Hz square wave, free-running", Excitation(clock="free", phase=0.137, drift_ppm=20.0)
    yield "10 kHz PRBS", Excitation(shape="prbs", frequency_hz=10e3)


def with_states(states: int) -> Circuit:
    """Front suspension with low-passes behind its output, one state each."""
    ends = ["u5", *(f"x{i}" for i in range(states - 7))]
    elements = list(SuspensionComputer("front").circuit.elements)
    for i, (a, b) in enumerate(itertools.pairwise(ends)):
        elements += [Resistor(f"RX{i}", a, b, 10e3), Capacitor(f"CX{i}", b, "0", 2e-9)]
    return Circuit(elements)


def run_states(states: int, samples: int) -> None:
    engine, excitation = Engine(piecewise_linear(with_states(states)), ["in", "u5", "u2", "u1"]), Excitation()
    while engine.recorded < samples:
        count = min(BLOCK_SAMPLES, samples - engine.recorded)
        engine.run(count, {"F": excitation.edges(*engine.window(count), RATE_HZ)})


def emulator_figures() -> Iterator[Figure]:
    samples = 500_000
    for name, excitation in streams():
        rate = samples / best_s(functools.partial(play, excitation, samples))
        yield Figure(f"emulator, {name}", rate, "samples/s")
    for block in (1, 64, 4096):
        samples = min(samples, 20_000 * block)
        rate = samples / best_s(functools.partial(play, Excitation(), samples, block))
        yield Figure(f"emulator, 200 Hz square wave, blocks of {block}", rate, "samples/s")
    yield from card_figures()
    turns = 200
    turn_s = best_s(functools.partial(turn, SuspensionComputer("front"), turns)) / turns
    yield Figure("emulator, pot turned", 1e6 * turn_s, "us")
    for states in (7, 12, 16, 32):
        spent_s = best_s(functools.partial(run_states, states, 100_000)) / 100_000
        yield Figure(f"emulator, square wave, {states} states", 1e9 * spent_s, "ns/sample")
        yield Figure(f"emulator, square wave, {states} states, each", 1e9 * spent_s / states, "ns/sample/state")
    few, many = (best_s(functools.partial(run_states, 7, count)) for count in (100_000, 800_000))
    yield Figure("emulator, 8 times as many samples", many / few, "times as long", "8 times", 8 * few / many)


def card_figures() -> Iterator[Figure]:
    cards = {"ideal card": (CARDS["ideal"], False), "card of 1 LSB noise": (Card(noise_lsb=(1.0,) * 4), False)}
    cards |= {"noisy circuit, dt2821 without aperture": (CARDS["dt2821"], True)}
    samples = 100_000
    for name, (card, noisy) in cards.items():
        rate = samples / best_s(functools.partial(digitise, card, samples, noisy=noisy))
        yield Figure(f"emulator and card, {name}", rate, "samples/s")


def trial_s(*, noisy: bool = False) -> float:
    trials = 50
    return best_s(functools.partial(run_trials, trials, noisy=noisy)) / trials


# ---- ngspice


def decks(samples: int, tweaks: Sequence[PotTurn]) -> Iterator[str]:
    computer = SuspensionComputer("front")
    edges = {"F": Excitation().edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)}
    turns = [PotTurn(change.sample, computer.dials_for(**change.values)) for change in tweaks]
    for accuracy in ACCURACIES:
        deck = to_spice(computer.circuit, samples=samples, edges=edges, turns=turns, nodes=["u5"], accuracy=accuracy)
        yield from variants(deck)


def variants(deck: str) -> Iterator[str]:
    """Variants of a deck: time points on every sample, at the start alone, and the latter with leaner op-amps.

    Without any time point at the start ngspice's first step is too long, and it misses the first edge by 0.3 LSB.
    """
    yield deck
    at_start = _replaced(r"^(X\S* clock\S* time_points period=)\S+$", r"\g<1>1", deck)
    yield at_start
    thevenin = r"^Einner inner 0 state 0 1\nRout inner out \{max\(rout, 1e-4\)\}$"
    yield _replaced(thevenin, "Gout 0 out state 0 {1 / max(rout, 1e-4)}\nRout out 0 {max(rout, 1e-4)}", at_start)


def _replaced(expression: str, by: str, deck: str) -> str:
    """Replace the one match in a deck. Another number of matches would measure the wrong deck and is an error."""
    out, count = re.subn(expression, by, deck, flags=re.MULTILINE)
    if count != 1:
        raise ValueError(f"the deck has {count} matches of {expression!r}: adapt tests/benchmarks to the deck's text")
    return out


def simulate(deck: str, samples: int) -> tuple[float, NDArray[np.float64]]:
    """CPU time in seconds, and the displacement at the samples in V."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "deck.cir").write_text(deck)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(["ngspice", "-b", "-r", "out.raw", "deck.cir"], cwd=folder, capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        names, table = _read_raw(Path(folder, "out.raw"))
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent_s, np.interp(np.arange(samples) / RATE_HZ, table[:, 0], table[:, names.index("v(u5)")])


def fastest_ngspice_s(samples: int, tweaks: Sequence[PotTurn]) -> float:
    """Fastest deck that comes within TOLERATED_LSB of the displacement at every sample."""
    exact = np.concatenate(list(SuspensionComputer("front").play(Excitation(), samples, tweaks)))[:, 1]
    runs = [simulate(deck, samples) for deck in decks(samples, tweaks)]
    return min(spent_s for spent_s, volts in runs if np.abs(volts - exact).max() <= TOLERATED_LSB * LSB_V)


def compared(name: str, own_s: float, value: float, unit: str, ngspice_s: float | None) -> Figure:
    if ngspice_s is None:
        return Figure(name, value, unit)
    what = f"ngspice within {TOLERATED_LSB} LSB: {ngspice_s:.3g} s"
    return Figure(name, value, unit, what, ngspice_s / own_s)


def figures() -> Iterator[Figure]:
    yield from emulator_figures()
    found = shutil.which("ngspice") is not None
    spent_s = trial_s()
    reference_s = fastest_ngspice_s(800, THESIS_TWEAKS) if found else None
    name = "emulator, trial of 800 samples with 4 tweaks"
    yield compared(name, spent_s, 1e3 * spent_s, "ms", reference_s)
    noisy_s = trial_s(noisy=True)
    yield Figure(f"{name}, noisy", 1e3 * noisy_s, "ms", "the quiet trial", spent_s / noisy_s)
    spent_s = best_s(functools.partial(play, Excitation(), 500_000)) * 800 / 500_000
    reference_s = fastest_ngspice_s(800, ()) if found else None
    yield compared("emulator, 200 Hz square wave", spent_s, 800 / spent_s, "samples/s", reference_s)
