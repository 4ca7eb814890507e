"""Speed of the emulator, beside ngspice and gnucap on the same circuit.

python -m tests.bench engine

Times are of the processor, not of the clock on the wall: the machine is shared. ngspice runs once with every setting of
SETTINGS. The fastest FINALISTS that come within TOLERATED_LSB run again with both solvers, in turn and just before the
emulator. The best run of each counts. build/ngspice.csv has the whole grid.
"""

from __future__ import annotations

import functools
import itertools
import math
import re
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.interpolate
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
    Pot,
    PotTurn,
    RepeatedPlay,
    Resistor,
    Sampler,
    SuspensionComputer,
    acquired,
    piecewise_linear,
    probes_per_sample,
    to_spice,
)
from analogrig_emulator.circuit.pot import legs_ohm
from analogrig_emulator.circuit.spice import Accuracy
from analogrig_emulator.machine.suspension import BLOCK_SAMPLES
from tests.emulator.conftest import _read_raw

from . import gnucap
from .figure import Figure

THESIS_CHANGES: tuple[PotTurn, ...] = (
    PotTurn(200, {"K": 18000.0}),
    PotTurn(400, {"B": 3453.0}),
    PotTurn(500, {"B": 2123.0, "K": 20000.0}),
    PotTurn(600, {"M": 30.0}),
)

REPEATS = 5
"""Number of repetitions, of which the best is reported."""

RATE_HZ = 20e3
LSB_V = 10.0 / 4096
TOLERATED_LSB = 0.2

MOST_TRIALS_OF_THEIR_OWN = 20
FINALISTS = 3
GRID = Path("build/ngspice.csv")


@dataclass(frozen=True, order=True)
class Setting:
    """One way to run ngspice. Fields have the values of SETTINGS, but for knowing op-amps, altered pots and the solver.

    op_amps: "exported", as `analogrig netlist` writes them; "lean", the same with a Norton output; "knowing", lean ones
    without limits where the circuit never reaches them. points: time points at "every sample" or at the "start" alone.
    pots: "turned" by a voltage in one run, or resistors that are "altered" where the run stops and resumes.
    """

    method: Literal["trap", "gear"]
    op_amps: str
    points: str
    reltol: float
    trtol: float
    max_step_s: float
    solver: str = "sparse"
    pots: str = "turned"

    @property
    def accuracy(self) -> Accuracy:
        """Tolerances, longest step and method, as the deck writer takes them."""
        return Accuracy(
            reltol=self.reltol, vntol_v=1e-6, trtol=self.trtol, max_step_s=self.max_step_s, method=self.method
        )

    def __str__(self) -> str:
        """The setting in words."""
        return (
            f"{self.method}, {self.op_amps} op-amps, {self.pots} pots, points at {self.points}, "
            f"reltol {self.reltol:g}, trtol {self.trtol:g}, tmax {1e6 * self.max_step_s:g} us, {self.solver}"
        )


METHODS: tuple[Literal["trap", "gear"], ...] = ("trap", "gear")
SETTINGS = tuple(
    itertools.starmap(
        Setting,
        itertools.product(
            METHODS,
            ("exported", "lean"),
            ("every sample", "start"),
            (1e-3, 1e-4, 1e-6),
            (7.0, 1.0),
            (50e-6, 12e-6, 8e-6),
        ),
    )
)
"""The searched grid."""


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


def front(seed: int, *, noisy: bool, sample_rate_hz: float = RATE_HZ) -> SuspensionComputer | NoisySuspension:
    computer = SuspensionComputer("front", sample_rate_hz=sample_rate_hz)
    if not noisy:
        return computer
    return NoisySuspension(computer, np.random.default_rng(seed), op_amps=OP_AMP_GRADES["tl07x"])


def run_trials(count: int, *, noisy: bool = False) -> None:
    for seed in range(count):
        for _ in front(seed, noisy=noisy).play(Excitation(), 800, THESIS_CHANGES):
            pass


def digitise(card: Card, samples: int, *, noisy: bool) -> None:
    """Play circuit and card with 4 channels, in blocks."""
    sampler, rng = Sampler(card, np.random.default_rng(1)), np.random.default_rng(2)
    machine = front(1, noisy=noisy, sample_rate_hz=card.true_rate_hz * probes_per_sample(card))
    for volts in acquired(machine, card, Excitation(), samples, rng=rng, block_samples=4096):
        sampler.sample(volts)


def turn(computer: SuspensionComputer, count: int) -> None:
    next(computer.play(Excitation(), 100))
    for i in range(count):
        computer.set(M=100.0 + i)


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
    cards |= {"dt2821 with its aperture": (CARDS["dt2821"], False)}
    cards |= {"noisy circuit, dt2821 with its aperture": (CARDS["dt2821"], True)}
    samples = 100_000
    for name, (card, noisy) in cards.items():
        rate = samples / best_s(functools.partial(digitise, card, samples, noisy=noisy))
        yield Figure(f"emulator and card, {name}", rate, "samples/s")


def trial_s(*, noisy: bool = False) -> float:
    trials = 50
    return best_s(functools.partial(run_trials, trials, noisy=noisy)) / trials


def own_trial_s() -> float:
    """CPU time of a trial whose machine has offsets of its own: nothing is kept from the trial before."""
    seeds = itertools.count()

    def run() -> None:
        for seed in itertools.islice(seeds, MOST_TRIALS_OF_THEIR_OWN):
            computer = SuspensionComputer("front", rng=np.random.default_rng(seed))
            for _ in computer.play(Excitation(), 800, THESIS_CHANGES):
                pass

    return best_s(run) / MOST_TRIALS_OF_THEIR_OWN


def repeated_trial_s() -> float:
    """CPU time of such a trial as campaigns play it: the machine is made once."""
    computer, rng = SuspensionComputer("front"), np.random.default_rng(1)
    repeated = RepeatedPlay(computer, 800, THESIS_CHANGES)

    def run() -> None:
        for _ in range(MOST_TRIALS_OF_THEIR_OWN):
            repeated.play(Excitation(), rng.uniform(-3e-3, 3e-3, computer.program.amplifiers))

    return best_s(run) / MOST_TRIALS_OF_THEIR_OWN


def stream_s() -> float:
    return best_s(functools.partial(play, Excitation(), 500_000)) * 800 / 500_000


OWN_TRIALS: Mapping[str, Callable[[], float]] = {
    "machine included": trial_s,
    "every machine with offsets of its own": own_trial_s,
}
OWN_STREAM: Mapping[str, Callable[[], float]] = {"machine included": stream_s}


# ---- ngspice


def deck(setting: Setting, samples: int, changes: Sequence[PotTurn]) -> str:
    """Text of the front suspension with a square wave for ngspice.

    Without any time point at the start ngspice's first step is too long, and it misses the first edge by 0.3 LSB.
    """
    computer = SuspensionComputer("front")
    text = to_spice(
        computer.circuit,
        samples=samples,
        edges={"F": Excitation().edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)},
        turns=[PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes],
        nodes=["u5"],
        accuracy=setting.accuracy,
    )
    text = in_setting(text, setting, "U[2-5]")
    return text if setting.pots == "turned" else _with_altered_pots(text, computer, changes)


def in_setting(text: str, setting: Setting, linear: str) -> str:
    """The deck in a setting, but for its accuracy. linear: expression of the op-amps without limits."""
    if setting.solver == "klu":
        text = _replaced(r"^(\.options reltol=.*)$", r"\g<1>\n.options klu", text)
    if setting.points == "start":
        text = _replaced(r"^(X\S* clock\S* time_points period=)\S+$", r"\g<1>1", text)
    if setting.op_amps != "exported":
        thevenin = r"^Einner inner 0 state 0 1\nRout inner out \{max\(rout, 1e-4\)\}$"
        text = _replaced(thevenin, NORTON, text)
    if setting.op_amps == "knowing":
        text = _replaced(r"^(\* analogue computer)$", rf"\g<1>\n{LINEAR}", text)
        text = re.sub(
            rf"^(X_{linear} .*) opamp avol=(\S+) gbw=(\S+) .* rout=(\S+) .*$", LINEAR_CALL, text, flags=re.MULTILINE
        )
    return text


def _with_altered_pots(text: str, computer: SuspensionComputer, changes: Sequence[PotTurn]) -> str:
    """The same deck with two resistors for each pot. They are altered where the run stops."""

    def legs(pot: str, dial: float) -> dict[str, float]:
        track_ohm = next(each.track_ohm for each in computer.circuit.of(Pot) if each.name == pot)
        return dict(zip((f"R_{pot}_upper", f"R_{pot}_lower"), legs_ohm(dial, track_ohm), strict=True))

    def resistors(call: re.Match[str]) -> str:
        pot, top, wiper, bottom = call.groups()
        upper, lower = legs(pot, computer.dials[pot]).items()
        return "\n".join(
            f"{name} {a} {b} {ohm!r}" for (name, ohm), a, b in ((upper, top, wiper), (lower, wiper, bottom))
        )

    text = re.sub(r"^V_dial_.*\n(\+.*\n)+", "", text, flags=re.MULTILINE)
    text = re.sub(r"^X_(\S+) (\S+) (\S+) (\S+) \S+ turned_pot .*$", resistors, text, flags=re.MULTILINE)
    # A step of the source ends at the instant. ngspice passes over one that it has begun when it stops.
    commands = [f"stop when time = {change.sample / RATE_HZ - 1e-9!r}" for change in changes] + [r"\g<1>"]
    for change in changes:
        turned = [legs(pot, dial) for pot, dial in computer.dials_for(**change.values).items()]
        commands += [f"alter {name} = {ohm!r}" for ohms in turned for name, ohm in ohms.items()] + ["resume"]
    control = "\n".join([".control", *commands, "write out.raw v(u5)", "quit 0", ".endc"])
    return _replaced(r"^\.(tran .*)$", control, text)


NORTON = "Gout 0 out state 0 {1 / max(rout, 1e-4)}\nRout out 0 {max(rout, 1e-4)}"

LINEAR = r""".subckt linear plus minus out avol=2e5 gbw=3e6 rout=100
Cstate state 0 1e-10
Gstate 0 state plus minus {6.283185307179586e-10 * gbw}
Rstate state 0 {avol / (6.283185307179586e-10 * gbw)}
Gout 0 out state 0 {1 / rout}
Rout out 0 {rout}
.ends"""

LINEAR_CALL = r"\g<1> linear avol=\g<2> gbw=\g<3> rout=\g<4>"


def _replaced(expression: str, by: str, deck: str) -> str:
    """Replace the one match in a deck. Another number of matches would measure the wrong deck and is an error."""
    out, count = re.subn(expression, by, deck, flags=re.MULTILINE)
    if count != 1:
        raise ValueError(f"the deck has {count} matches of {expression!r}: adapt tests/bench to the deck's text")
    return out


@dataclass(frozen=True)
class Simulated:
    """One run of ngspice: its CPU time, and its largest error at a sample."""

    spent_s: float
    error_lsb: float


def simulate(text: str, exact_v: NDArray[np.float64], node: str = "u5") -> Simulated:
    """Run a deck and compare a node. Between time points the better of a straight line and a smooth curve counts."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "deck.cir").write_text(text)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        raw = () if ".control" in text else ("-r", "out.raw")
        subprocess.run(["ngspice", "-b", *raw, "deck.cir"], cwd=folder, capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        names, table = _read_raw(Path(folder, "out.raw"))
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    t_s, first = np.unique(table[:, 0], return_index=True)
    volts = table[first, names.index(f"v({node})")]
    at_s = np.clip(np.arange(exact_v.size) / RATE_HZ, t_s[0], t_s[-1])
    errors_v = [
        np.abs(curve - exact_v).max()
        for curve in (np.interp(at_s, t_s, volts), scipy.interpolate.Akima1DInterpolator(t_s, volts)(at_s))
    ]
    return Simulated(spent_s, float(min(errors_v)) / LSB_V)


def exact_v(samples: int, changes: Sequence[PotTurn]) -> NDArray[np.float64]:
    """Displacement at the samples, by the emulator."""
    return np.concatenate(list(SuspensionComputer("front").play(Excitation(), samples, changes)))[:, 1]


def search(samples: int, changes: Sequence[PotTurn]) -> dict[Setting, Simulated]:
    """Run the whole grid once, write it to GRID, and return it."""
    exact = exact_v(samples, changes)
    found = {setting: simulate(deck(setting, samples, changes), exact) for setting in SETTINGS}
    GRID.parent.mkdir(exist_ok=True)
    rows = [f"{1e3 * run.spent_s:.1f},{run.error_lsb:.3f},{setting}" for setting, run in found.items()]
    GRID.write_text("\n".join(["CPU ms,error LSB,setting", *rows, ""]))
    return found


def fastest(found: Mapping[Setting, Simulated], accuracy_lsb: float = TOLERATED_LSB) -> list[Setting]:
    """Settings with an error of accuracy_lsb at most, the fastest first."""
    return sorted(
        (setting for setting, run in found.items() if run.error_lsb <= accuracy_lsb),
        key=lambda setting: found[setting].spent_s,
    )


def leanest(samples: int, changes: Sequence[PotTurn]) -> Setting:
    """The fastest setting with knowing op-amps and altered pots."""
    exact = exact_v(samples, changes)
    settings = {
        replace(each, op_amps="knowing", points="start", pots="altered", reltol=reltol)
        for each in SETTINGS
        for reltol in (1e-3, 1e-4, 1e-5, 1e-6)
    }
    return fastest({each: simulate(deck(each, samples, changes), exact) for each in settings})[0]


def final(
    settings: Iterable[Setting], samples: int, changes: Sequence[PotTurn]
) -> tuple[dict[Setting, Simulated], float]:
    """Best of REPEATS runs of each setting, and of the start of ngspice alone, all in turn."""
    exact, best, start_s = exact_v(samples, changes), dict[Setting, Simulated](), math.inf
    texts = {setting: deck(setting, samples, changes) for setting in settings}
    short = deck(SETTINGS[-1], 2, ())
    for _ in range(REPEATS):
        start_s = min(start_s, simulate(short, exact[:2]).spent_s)
        for setting, text in texts.items():
            run = simulate(text, exact)
            if setting not in best or run.spent_s < best[setting].spent_s:
                best[setting] = run
    return best, start_s


def ngspice_figures() -> Iterator[Figure]:
    """Trial and stream beside ngspice at its best, and beside a deck that knows which amplifiers never limit."""
    for name, samples, changes, own in (
        ("trial of 800 samples with 4 changes", 800, THESIS_CHANGES, OWN_TRIALS),
        ("square wave of 800 samples in a stream", 800, (), OWN_STREAM),
    ):
        found = search(samples, changes)
        order = fastest(found)
        winner = order[0]
        knowing = {"the same with op-amps that know the circuit": replace(winner, op_amps="knowing")}
        if changes:
            knowing["the leanest that knows the circuit"] = leanest(samples, changes)
        finalists = [replace(each, solver=solver) for each in order[:FINALISTS] for solver in ("sparse", "klu")]
        runs, start_s = final([*finalists, *knowing.values()], samples, changes)
        general = min(finalists, key=lambda setting: runs[setting].spent_s)
        for group, settings in itertools.groupby(
            sorted(found), key=lambda each: (each.method, each.op_amps, each.points)
        ):
            yield _group_figure(f"ngspice, {name}: {', '.join(group)}", list(settings), found)
        compared = {"best general setting": general, **knowing}
        for what, each in compared.items():
            run = runs[each]
            label = f"{each}; {run.error_lsb:.3f} LSB; {1e3 * start_s:.1f} ms of it are the start"
            yield Figure(f"ngspice, {name}: {what}", 1e3 * run.spent_s, "ms", label)
        for label, job in own.items():
            spent_s = job()
            for what, each in compared.items():
                ratio = runs[each].spent_s / spent_s
                yield Figure(f"emulator, {name}, {label}", 1e3 * spent_s, "ms", f"ngspice: {what}", ratio)
    yield own_error()


GNUCAP_SETTINGS = tuple(
    itertools.starmap(
        gnucap.Setting, itertools.product(("trap", "gear"), (1e-3, 1e-4, 1e-6), (7.0, 1.0), (50e-6, 25e-6, 12e-6, 8e-6))
    )
)


def gnucap_figures() -> Iterator[Figure]:
    """The stream beside gnucap at its best."""
    samples, circuit = 800, SuspensionComputer("front").circuit
    edges, exact = Excitation().edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ), exact_v(samples, ())

    def simulate_once(setting: gnucap.Setting) -> Simulated:
        spent_s, rows = gnucap.run(gnucap.deck(setting, circuit, edges, samples, RATE_HZ))
        at_samples_v = np.interp(np.arange(samples) / RATE_HZ, *rows.T)
        return Simulated(spent_s, float(np.abs(at_samples_v - exact).max()) / LSB_V)

    found = {setting: simulate_once(setting) for setting in GNUCAP_SETTINGS}
    accurate = [setting for setting, run in found.items() if run.error_lsb <= TOLERATED_LSB]
    winner = min(accurate, key=lambda setting: found[setting].spent_s)
    spent_s, own_s = min(simulate_once(winner).spent_s for _ in range(REPEATS)), stream_s()
    name = "square wave of 800 samples in a stream"
    label = f"best of {len(found)}: {winner}; {found[winner].error_lsb:.3f} LSB"
    yield Figure(f"gnucap, {name}", 1e3 * spent_s, "ms", label)
    yield Figure(f"emulator, {name}, machine included", 1e3 * own_s, "ms", "gnucap", spent_s / own_s)


def _group_figure(name: str, settings: Sequence[Setting], found: Mapping[Setting, Simulated]) -> Figure:
    best = fastest({setting: found[setting] for setting in settings})
    if not best:
        least = min(found[setting].error_lsb for setting in settings)
        return Figure(name, math.inf, "ms", f"none of {len(settings)} settings: {least:.2g} LSB at best")
    run = found[best[0]]
    return Figure(name, 1e3 * run.spent_s, "ms", f"best of {len(settings)}: {best[0]}; {run.error_lsb:.3f} LSB")


def own_error() -> Figure:
    """Largest difference of the trial from ngspice at its tightest setting: a bound of the emulator's own error."""
    tight = Setting("trap", "exported", "every sample", 1e-7, 0.1, 1e-5)
    run = simulate(deck(tight, 800, THESIS_CHANGES), exact_v(800, THESIS_CHANGES))
    return Figure("emulator, trial: difference from ngspice at its tightest", run.error_lsb, "LSB", str(tight))


def figures() -> Iterator[Figure]:
    yield from emulator_figures()
    spent_s, noisy_s = trial_s(), trial_s(noisy=True)
    yield Figure("emulator, trial of 800 samples with 4 changes", 1e3 * spent_s, "ms")
    yield Figure("emulator, the same trial repeated with other offsets", 1e3 * repeated_trial_s(), "ms")
    yield Figure("emulator, noisy trial", 1e3 * noisy_s, "ms", "the quiet trial", spent_s / noisy_s)
    if shutil.which("ngspice") is not None:
        yield from ngspice_figures()
    if shutil.which("gnucap") is not None:
        yield from gnucap_figures()
