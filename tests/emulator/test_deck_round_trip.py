"""Circuits to decks and back: equal, and played alike by ngspice, for every kind of element and for random circuits."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    CurrentSource,
    Deck,
    DiodeLimiter,
    Edges,
    OpAmp,
    OpAmpModel,
    Pot,
    Resistor,
    Switch,
    VoltageSource,
    read_deck,
)
from analogrig_emulator.circuit import Element
from analogrig_emulator.deck_library import LIBRARY
from analogrig_emulator.opamp import PRESETS

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]

LSB_V = 10.0 / 4096
SAMPLES = 41

OHMS = st.floats(1.0, 1e9)
LEVELS = st.floats(-100.0, 100.0)
NODES = st.sampled_from(("a", "b", "in1", "X", "Clock", "dial_K", "state"))
NAMES = st.sampled_from(("", "_", "1", "_1", "R", "R_1", "V_dial_K", "dial_K", "clock", "X_", "k", "U_1", "C1_leak"))
MODELS = st.builds(
    OpAmpModel,
    avol=st.floats(1.0, 1e7),
    gbw_hz=st.floats(1e3, 1e8),
    slew_v_per_s=st.one_of(st.just(np.inf), st.floats(1e3, 1e9)),
    swing_v=st.sampled_from(((-np.inf, np.inf), (-13.5, 13.5), (-1.0, np.inf), (-np.inf, 2.5))),
    rout_ohm=st.floats(0.0, 1e3),
    vos_v=st.floats(-1e-2, 1e-2),
)
POLELESS = st.builds(OpAmpModel, avol=st.one_of(st.just(np.inf), st.floats(10.0, 1e6)), vos_v=st.floats(-0.1, 0.1))


def ohms_of(draw: st.DrawFn) -> dict[str, float]:
    """Of a limiter or a switch."""
    on_ohm = draw(OHMS)
    return {"on_ohm": on_ohm, "off_ohm": on_ohm * draw(st.floats(1.0, 1e6))}


@st.composite
def parts(draw: st.DrawFn, name: str, own: str) -> list[Element]:
    """An element between nodes that others may be at, and what it needs to stand there; own: a node of its own."""
    a, b = draw(NODES), draw(st.one_of(NODES, st.just("0")))
    b = "0" if a == b else b
    lead = Resistor(f"{name}_s", own, a, draw(OHMS))
    kinds: dict[str, Callable[[], list[Element]]] = {
        "R": lambda: [Resistor(name, a, b, draw(OHMS))],
        "C": lambda: [Capacitor(name, own, b, draw(st.floats(1e-15, 1e-3))), lead],
        "V": lambda: [VoltageSource(name, own, "0", draw(st.none() | LEVELS)), lead],
        "I": lambda: [CurrentSource(name, a, b, draw(st.none() | LEVELS))],
        "pot": lambda: [Pot(name, a, own, b, draw(OHMS), draw(st.floats(0.0, 1.0)))],
        "limiter": lambda: [DiodeLimiter(name, a, b, draw(LEVELS), **ohms_of(draw))],
        "switch": lambda: [Switch(name, a, b, **ohms_of(draw), closed=draw(st.booleans()))],
        "op-amp": lambda: [
            OpAmp(name, "0", own, f"{own}o", draw(MODELS | POLELESS)),
            Resistor(f"{name}_fb", f"{own}o", own, draw(OHMS)),
            lead,
        ],
    }
    return kinds[draw(st.sampled_from(sorted(kinds)))]()


@st.composite
def decks(draw: st.DrawFn) -> Deck:
    """Any circuit of up to six such, every node of which has a way to ground, with all that can be played on it."""
    prefixes = draw(st.lists(NAMES, min_size=1, max_size=6))
    elements: list[Element] = []
    for i, prefix in enumerate(prefixes):
        elements += draw(parts(f"{prefix}{i}" if prefix else f"e{i}", f"n{i}"))
    taken = dict.fromkeys(node for element in elements for node in element.nodes if node != "0")
    elements += [Resistor(f"to_ground_{node}", node, "0", draw(OHMS)) for node in taken]
    circuit = Circuit(elements)
    return Deck(
        circuit,
        samples=draw(st.integers(2, 9)),
        edges={source.name: draw(trains()) for source in circuit.inputs},
        turns=[(sample, {pot.name: 0.9 * pot.dial + 0.05 * sample}) for pot in circuit.of(Pot)[:1] for sample in (1,)],
        initial_v={c.name: draw(st.floats(0.1, 10.0)) for c in circuit.of(Capacitor) if draw(st.booleans())},
        title=draw(st.text("abc *.=", max_size=12)).strip("* "),
    )


@st.composite
def trains(draw: st.DrawFn) -> Edges:
    ticks = sorted({0, *draw(st.lists(st.integers(0, TICKS_PER_SAMPLE), max_size=4))})
    levels = [draw(LEVELS) for _ in ticks]
    changed = [i for i, level in enumerate(levels) if i == 0 or level != levels[i - 1]]
    return Edges(np.array(ticks, np.int64)[changed], np.array(levels)[changed])


@settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(decks())
def test_any_circuit_comes_back_from_its_deck_with_all_that_is_played_on_it(deck: Deck) -> None:
    read = read_deck(deck.text())
    assert read.circuit == deck.circuit
    assert (read.samples, read.sample_rate_hz, read.initial_v) == (deck.samples, deck.sample_rate_hz, deck.initial_v)
    turns = [turn for turn in deck.turns if any(dial != _dial(deck, pot) for pot, dial in turn[1].items())]
    assert list(read.turns) == turns
    for name, train in deck.edges.items():
        np.testing.assert_array_equal(read.edges[name].ticks, train.ticks)
        np.testing.assert_array_equal(read.edges[name].levels_v, train.levels_v)


def _dial(deck: Deck, pot: str) -> float:
    return next(each.dial for each in deck.circuit.of(Pot) if each.name == pot)


STEP = "V1 in 0 PULSE(0 5 1.013m 1n 1n 0.5m)"
BY_HAND = {
    "resistors and capacitors": (f"{STEP}\nR1 in a 10k\nC1 a 0 20n\nR2 a b 5k\nC2 b 0 5n", ("a", "b")),
    "a constant and a stepped current": (
        "I1 0 a PULSE(0 1m 0.513m 1n 1n 0.7m)\nI2 a b 0.3m\nR1 a 0 2k\nR2 b 0 1k\nC1 a b 100n",
        ("a", "b"),
    ),
    "a pot as two resistors": (f".param k=0.3\n{STEP}\nR1 in w {{10k*(1-k)}}\nR2 w 0 {{10k*k}}\nC1 w 0 10n", ("w",)),
    "a pot of the deck's own": (
        ".subckt coefficient top wiper k=0.5 r=10k\nR1 top wiper {r*(1-k)}\nR2 wiper 0 {r*k}\n.ends\n"
        + STEP
        + """
X1 in w coefficient k=0.7
X2 w v coefficient
C1 v 0 10n""",
        ("w", "v"),
    ),
    "a pot": (f"{STEP}\nX1 in w 0 pot track=20k dial=0.25\nC1 w 0 10n", ("w",)),
    "an op-amp by its datasheet": (
        f"{STEP}\nR1 in s 10k\nR2 s o 20k\nC1 s o 1n\nX1 0 s o opamp avol=1e5 gbw=1meg slew=0.5e6 swing_high=7 rout=75",
        ("s", "o"),
    ),
    "an op-amp without a pole": (f"{STEP}\nR1 in s 10k\nR2 s o 20k\nC1 s o 1n\nX1 0 s o opamp_without_pole", ("o",)),
    "a switch, open and closed": (
        STEP
        + """
R1 in a 10k
X1 a 0 switch on=100 off=1g closed=0
C1 a 0 1n
R2 in b 10k
X2 b 0 switch on=1k
C2 b 0 1n""",
        ("a", "b"),
    ),
    "a diode limiter": (f"{STEP}\nR1 in a 1k\nX1 a 0 diode_limiter threshold=2 on=100\nC1 a 0 20n", ("a",)),
    "initial conditions": (
        "R1 a 0 10k\nC1 a 0 10n IC=4\nR2 b c 10k\nC2 b c 10n\nR3 c 0 1k\nC3 c 0 50n\n.ic v(b)=3 v(c)=1",
        ("a", "b", "c"),
    ),
    "parameters in any order": (
        f".param r={{2*base/(1+1)}} tau='r*c'\n.param base=10k c=10n\n{STEP}\nR1 in a {{r}}\nC1 a 0 {{tau/r}}",
        ("a",),
    ),
}


def as_ngspice_wants_it(cards: str) -> str:
    """The cards with the library that they use, a run, time points on the samples, and tight tolerances."""
    return "\n".join(
        (
            "by hand",
            *(text for name, text in LIBRARY.items() if f" {name}" in cards or name == "time_points"),
            cards,
            "Xclock clock time_points period=50u",
            ".options reltol=1e-7 vntol=1e-9 abstol=1e-12 trtol=0.1",
            ".tran 50u 2m 0 2u uic",
            ".end\n",
        )
    )


@pytest.mark.parametrize(("cards", "nodes"), BY_HAND.values(), ids=BY_HAND)
def test_what_is_read_is_what_ngspice_makes_of_the_same_text_and_of_the_deck_written_back(
    ngspice: NgSpice, cards: str, nodes: tuple[str, ...]
) -> None:
    text = as_ngspice_wants_it(cards)
    deck = read_deck(text)
    volts = deck.volts(nodes)
    assert np.abs(volts).max() > 0.1
    assert np.abs(volts - ngspice(text, nodes, SAMPLES)).max() < 0.05 * LSB_V
    assert np.abs(volts - ngspice(deck.text(nodes), nodes, SAMPLES)).max() < 0.05 * LSB_V
    again = read_deck(deck.text())
    assert (again.circuit, again.initial_v) == (deck.circuit, deck.initial_v)
    assert np.array_equal(again.volts(nodes), volts)


def random_chain(rng: np.random.Generator) -> Deck:
    """Three to five stages of random kind behind a generator, each an op-amp of random type with one more element."""
    elements: list[Element] = [VoltageSource("V", "n0")]
    stages = int(rng.integers(3, 6))
    for i in range(1, stages + 1):
        before, s, out = f"n{i - 1}", f"s{i}", f"n{i}"
        elements += [
            Pot(f"P{i}", before, f"w{i}", "0", 1e4, rng.uniform(0.3, 1.0)),
            Resistor(f"RI{i}", f"w{i}", s, rng.uniform(2e4, 1e5)),
            Resistor(f"RF{i}", s, out, rng.uniform(2e4, 1e5)),
            Capacitor(f"C{i}", s, out, rng.uniform(2e-10, 5e-9)),
            OpAmp(f"U{i}", "0", s, out, PRESETS[str(rng.choice(["tl07x", "741", "opa627"]))]),
        ]
        more: tuple[Element, ...] = (
            CurrentSource(f"I{i}", "0", s, rng.uniform(-2e-5, 2e-5)),
            DiodeLimiter(f"D{i}", s, out, rng.uniform(0.5, 3.0), rng.uniform(1e3, 1e4), 1e9),
            Switch(f"S{i}", s, out, rng.uniform(1e4, 1e5), 1e9, closed=bool(rng.integers(2))),
            VoltageSource(f"B{i}", f"b{i}", "0", rng.uniform(-3, 3)),
        )
        elements += [more[int(rng.integers(4))]]
        if isinstance(elements[-1], VoltageSource):
            elements += [Resistor(f"RB{i}", f"b{i}", s, rng.uniform(5e4, 2e5))]
    # Between the samples, for at its own instant ngspice shows the level before an edge.
    ticks = np.append(
        0, (np.sort(rng.choice(SAMPLES - 2, 4, replace=False)) + rng.uniform(0.1, 0.9, 4)) * TICKS_PER_SAMPLE
    )
    turned = f"P{int(rng.integers(1, stages + 1))}"
    return Deck(
        Circuit(elements),
        samples=SAMPLES,
        edges={"V": Edges(ticks.astype(np.int64), rng.uniform(-5, 5, 5))},
        turns=[(int(rng.integers(5, 30)), {turned: rng.uniform(0.3, 1.0)})],
        initial_v={"C1": rng.uniform(0.5, 3.0)},
    )


@pytest.mark.parametrize("seed", range(10))
def test_random_circuits_are_written_played_by_ngspice_and_read_back(ngspice: NgSpice, seed: int) -> None:
    deck = random_chain(np.random.default_rng(seed))
    nodes = [amp.out for amp in deck.circuit.of(OpAmp)]
    assert read_deck(deck.text()).circuit == deck.circuit
    assert np.abs(deck.volts(nodes) - ngspice(deck.text(nodes), nodes, SAMPLES)).max() < 0.05 * LSB_V
