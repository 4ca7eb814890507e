"""Decks read into circuits."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    CircuitError,
    CurrentSource,
    Deck,
    EmulatorError,
    Excitation,
    OpAmp,
    OpAmpModel,
    Pot,
    PotError,
    Resistor,
    SuspensionComputer,
    VoltageSource,
    read_deck,
)
from analogrig_emulator.circuit import Element

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]

LSB_V = 10.0 / 4096
RATE_HZ = 20e3

INVERTER = """* an inverter on a step
V1 in 0 PULSE(0 5 1m 1n 1n 2m 4m)
R1 in s 10k
R2 s out 20k
X_U1 0 s out opamp
.tran 50u 5m 0 10u uic
.end
"""


def played() -> Deck:
    """A machine with offsets, edges of a free generator, pots turned, voltages to begin with."""
    computer = SuspensionComputer("front", rng=np.random.default_rng(1), offset_v=3e-3)
    excitation = Excitation(clock="free", drift_ppm=200.0, phase=0.637, frequency_hz=317.0)
    tweaks = ((60, {"K_n_per_m": 18000.0}), (90, {"B_n_s_per_m": 2123.0, "K_n_per_m": 20000.0}))
    return Deck(
        computer.circuit,
        samples=120,
        edges={"F": excitation.edges(0, 120 * TICKS_PER_SAMPLE, RATE_HZ)},
        turns=[(sample, computer.dials_for(**settings)) for sample, settings in tweaks],
        initial_v={"C2": 1.5, "U3": -1.5, "U5": 1.5},
        title="played",
    )


def test_a_deck_that_was_written_is_read_back_equal_and_gives_the_same_volts_to_the_bit() -> None:
    deck = played()
    read = read_deck(deck.text())
    assert read.circuit == deck.circuit
    assert (read.samples, read.sample_rate_hz, read.title) == (120, RATE_HZ, "played")
    assert list(read.turns) == list(deck.turns)
    assert read.initial_v == deck.initial_v
    assert np.array_equal(read.edges["F"].ticks, deck.edges["F"].ticks)
    assert np.array_equal(read.edges["F"].levels_v, deck.edges["F"].levels_v)
    assert np.array_equal(read.volts(), deck.volts())
    assert read.text() == deck.text()


def test_a_deck_with_initial_conditions_agrees_with_ngspice(ngspice: NgSpice) -> None:
    deck = played()
    nodes = ("u1", "u2", "u3", "u4", "u5")
    reference = ngspice(deck.text(), nodes, deck.samples)
    assert np.abs(deck.volts(nodes) - reference).max() < 0.05 * LSB_V


@pytest.mark.parametrize("opamp", ["ideal", OpAmpModel(avol=1e4, vos_v=1e-3), OpAmpModel(gbw_hz=1e6, rout_ohm=50.0)])
def test_op_amps_without_some_of_the_limits_are_read_back(opamp: str | OpAmpModel) -> None:
    circuit = SuspensionComputer("shock", opamp=opamp).circuit
    assert read_deck(Deck(circuit, samples=10).text()).circuit == circuit


def test_a_deck_by_hand_is_a_circuit_with_the_defaults_of_the_library() -> None:
    deck = read_deck(INVERTER)
    tl07x = OpAmpModel(avol=2e5, gbw_hz=3e6, slew_v_per_s=13e6, swing_v=(-13.5, 13.5), rout_ohm=100.0)
    assert deck.circuit.elements == (
        VoltageSource("V1", "in"),
        Resistor("R1", "in", "s", 10e3),
        Resistor("R2", "s", "out", 20e3),
        OpAmp("U1", "0", "s", "out", tl07x),
    )
    assert deck.title == "an inverter on a step"
    assert deck.samples == 101
    volts = deck.volts(["in", "out"])
    np.testing.assert_array_equal(volts[[0, 19, 20, 59, 60, 61, 99, 100], 0], [0, 0, 5, 5, 5, 0, 0, 5])
    # Gain -2, short of it by 3/Avol and by Rout over the load's conductance.
    assert volts[40, 1] == pytest.approx(-10.0, abs=3e-4)


def test_what_is_read_by_hand_agrees_with_ngspice(ngspice: NgSpice) -> None:
    text = """nested subcircuits, parameters, continuation
.param r = 10k  tau={r * c}  c=1n   ; in any order
.param ratio = '(1 + 3) / 2'
* a first-order lag with gain
.subckt lag in out r=1k gain=1
.param rf={r * gain}
R1 in s {r}
R2 s out {rf}
C1 s out {tau / rf}
X_U 0 s out amp
.subckt amp plus minus out
X_1 plus minus out opamp gbw=1meg slew=500k
.ends
.ends lag
V1 IN gnd PWL(0 0 1.01m 0
+ 1.010001m 4 $ the step
* a comment between
+ 2.02m 4 2.020001m -1)
Xa in mid lag r={r}
Xb mid out lag r={r / 2} gain={ratio}
P1 out
""".replace("P1 out\n", "")
    deck = read_deck(text + ".tran 50u 4m 0 10u uic\n.end\nnonsense after the end")
    assert [amp.name for amp in deck.circuit.of(OpAmp)] == ["Xa_U_1", "Xb_U_1"]
    assert [c.farad for c in deck.circuit.of(Capacitor)] == pytest.approx([1e-9, 1e-9])
    nodes = ("mid", "out")
    reference = ngspice(deck.text(), nodes, 81)
    assert np.abs(deck.volts(nodes) - reference).max() < 0.05 * LSB_V


def test_the_deck_of_the_readme_runs() -> None:
    readme = (Path(__file__).parents[2] / "emulator" / "README.md").read_text()
    _, _, after = readme.partition("```\nan inverter")
    volts = read_deck("an inverter" + after.partition("```")[0]).volts(["out", "w"])
    # The pot, 10k at 0.3 without load, is the amplifier's.
    np.testing.assert_allclose(volts[40], [-10.0, -3.0], atol=1e-3)


def test_initial_conditions_of_nodes_reach_the_capacitors_between_them() -> None:
    deck = read_deck("t\nR1 a 0 1k\nR2 b 0 1k\nC1 a b 1u\nC2 b 0 1u IC=3\n.ic v(a)=5 V( b ) = 2\n.tran 1m 1m uic")
    assert deck.initial_v == {"C1": 3.0, "C2": 3.0}


def test_a_pulse_without_delay_begins_at_its_second_level() -> None:
    deck = read_deck("t\nV1 a 0 PULSE(1 5 0 1n 1n 99.999u 200u)\nR1 a 0 1k\n.tran 50u 250u uic")
    np.testing.assert_array_equal(deck.volts(["a"])[:, 0], [5, 5, 1, 1, 5, 5])
    assert read_deck(deck.text()).circuit == deck.circuit


def test_names_keep_their_prefix_where_they_would_be_the_same_without() -> None:
    deck = read_deck("t\nR_1 a 0 1k\nC_1 a 0 1n\nR_2 a 0 1k")
    assert [element.name for element in deck.circuit.elements] == ["R_1", "C_1", "2"]


def test_an_element_may_be_called_as_the_source_of_a_dial_would_be() -> None:
    elements: list[Element] = [
        VoltageSource("V1", "in"),
        Pot("K", "in", "w", "0", 1e4, 0.5),
        Resistor("dial_K", "w", "0", 1e3),
    ]
    deck = Deck(Circuit(elements), samples=9, turns=[(4, {"K": 0.25})])
    read = read_deck(deck.text())
    assert (read.circuit, read.turns) == (deck.circuit, deck.turns)


def test_a_deck_may_have_its_own_subcircuit_of_a_name_in_the_library() -> None:
    deck = read_deck("t\n.subckt pot a b c\nR1 a b 1k\nR2 b c 1k\n.ends\nX1 in w 0 pot\nV1 in 0 DC 4\n.tran 1m 1m uic")
    assert deck.volts(["w"])[-1, 0] == pytest.approx(2.0)


HEAD = "t\nV1 in 0 DC 5\n"


@pytest.mark.parametrize(
    ("cards", "message"),
    [
        ("R1 in out 1k\nX1 0 n out opamp", r"deck:4: OpAmp X1 \(0 n out\): node n floats"),
        ("R1 in s 1k\nR2 s 0 1k\nX1 0 s out opamp", r"deck:5: OpAmp X1 .*no feedback: .*node out, .*nodes 0 and s"),
        (
            "R1 in s 1k\nR2 a 0 1k\nX1 0 s a opamp_without_pole\nX2 0 a b opamp_without_pole\nR3 b 0 1k",
            "deck:5: OpAmp X1 .*no feedback",
        ),
        ("X1 in w 0 pot dial=1.2\nR1 w 0 1k", r"deck:3: pot X1: dial 1.2 is beyond the track"),
        ("X1 in w 0 pot track=-10k", r"deck:3: Pot X1 \(in w 0\): track_ohm must be positive"),
        ("Q1 a b c bc547", "deck:3: Q1: transistors are not supported"),
        (".include /etc/passwd", "deck:3: .include: is not supported"),
        (".control\nshell ls\n.endc", "deck:3: .control: is not supported"),
        (
            "V2 in 0 DC 4",
            r"deck:3: VoltageSource V2 \(in 0\): closes a loop without resistance from node in to node 0 with V1",
        ),
        ("C1 in 0 1n", r"deck:3: Capacitor C1 \(in 0\): closes a loop without resistance .* with V1"),
        (
            "R1 in o 1k\nX1 0 in o opamp_without_pole",
            r"deck:4: OpAmp X1 \(0 in o\): the circuit is singular: nothing determines the",
        ),
        ("R1 in 0 -1k", r"deck:3: Resistor R1 \(in 0\): ohm must be positive and finite, got -1000.0"),
        ("R1 in 0 nan", "deck:3: R1: no parameter is called 'nan'"),
        ("R1 in 0 1e999", "deck:3: R1: '1e999' is not a finite number"),
        ("R1 in 0 {1k", "deck:3: R1: '{1k': only numbers, parameters"),
        ("R1 in 0 {1/(2-2)}", "divides by zero"),
        ("R1 in 0 {__import__('os')}", "deck:3: R1"),
        ("R1 in 0 {" + "(" * 60 + "1" + ")" * 60 + "}", "nested deeper than 50"),
        (".param a={b} b={a}\nR1 in 0 {a}", "deck:4: R1: parameter a needs itself"),
        ("R1 in 0 1k\nr1 in 0 2k", "deck:4: r1: there is a card of this name already"),
        ("R1 in 0 1k tc1=0.1", "deck:3: R1: 'tc1' is not supported here"),
        ("R1 in 0", "deck:3: R1: needs two nodes and a value"),
        ("R1 in in 1k", "deck:3: Resistor R1 .*both ends are on node in"),
        ("X1 in nothing", "deck:3: X1: no subcircuit is called 'nothing'"),
        (".subckt a p\nX1 p a\n.ends\nX1 in a", "deck:6: X1: deck:4: X1: subcircuit a contains itself"),
        (".subckt a p\nX1 p b\n.ends\n.subckt b p\nX1 p a\n.ends\nX1 in a", "subcircuit a contains itself"),
        (".subckt a p\nR1 p 0 1k", "deck: subcircuit a has no .ends"),
        (".ends", "deck:3: .ends: there is no .subckt before it"),
        ("X1 in 0 s opamp speed=3", "deck:3: X1: subcircuit opamp has no parameter speed; there are avol, gbw"),
        ("X1 in 0 opamp", "deck:3: X1: needs 3 nodes, got 2"),
        ("X1 0 in in opamp gbw=-1", "deck:3: X1: op-amp: gbw_hz must be positive"),
        ("V2 a 0 SIN(0 1 1k)", "deck:3: V2: SIN sources are not supported"),
        ("V2 a 0 PWL(0 0 1m 5)", "deck:3: V2: a source must step: within 1e-09 s"),
        ("V2 a 0 PULSE(0 1 0 0 0)", "deck:3: V2: a source must step"),
        ("V2 a 0 PULSE(0 1 0 1n 1n 1n 1n)", "deck:3: V2: PULSE: "),
        (".tran 1m 1", "deck:3: .tran: needs uic"),
        (".tran 1n 1 uic", "deck:3: .tran: has more than 10000000 samples"),
        ("X1 in w 0 d turned_pot", "deck:3: X1: node d, its dial, needs a PULSE or PWL source"),
        (
            "X1 in w 0 d turned_pot\nVd d 0 PWL(0 .5 1.7m .5 1.7000001m .6)\n.tran 1m 4m uic",
            "not an instant of a sample",
        ),
        (".ic v(q)=3", "deck:3: .ic: no node is called 'q'"),
        (".subckt a p\nR1 p m 1k\nR2 m 0 1k\n.ends\nX1 in a\nR1 in X1_m 1k", "node X1_m is also the node x1.m"),
        (
            ".subckt a p\nR1 p 0 1k\n.ends\n.subckt b p\nXb p a\n.ends\nXa in b\nXa_Xb in a",
            r"deck:4: Resistor Xa_Xb_R1 \(in 0\): two elements are called 'Xa_Xb_R1'",
        ),
        ("R1 in n+1 1k", "only letters, digits and _ are allowed"),
    ],
)
def test_a_wrong_deck_is_refused_naming_line_element_and_node(cards: str, message: str) -> None:
    with pytest.raises(EmulatorError, match=message):
        read_deck(HEAD + cards)


def test_a_turned_pot_beyond_its_track_is_a_pot_error() -> None:
    with pytest.raises(PotError, match=r"deck:3: X1: pot X1: dial 1.5"):
        read_deck(HEAD + "X1 in w 0 d turned_pot\nVd d 0 PWL(0 .5 1m .5 1.000001m 1.5)\n.tran 1m 4m uic")


LADDER = "\n".join(f"R{i} n{i} n{i + 1} 1k" for i in range(10_000))
DOUBLING = "\n".join(f".subckt s{i} p\nXa p s{i + 1}\nXb p s{i + 1}\n.ends" for i in range(18))
CHAIN = ".param " + " ".join(f"p{i}={{p{i + 1}+p{i + 1}}}" for i in range(40_000)) + " p40000=1"


@pytest.mark.parametrize(
    ("cards", "message"),
    [
        (LADDER, "more than 1000 elements"),
        (DOUBLING + "\n.subckt s18 p\n.ends\nX in s0", "too large"),
        (CHAIN + "\nR1 in 0 {p0}", "nested deeper than 50"),
        ("\n".join(f"C{i} in n{i} 1n\nR{i} n{i} 0 1k" for i in range(40)), "40 states; the engine takes at most 32"),
        ("R1 in 0 " + "9" * 100_000, "characters; at most 1000"),
        ("a" * 4_000_000 + "(", "cards of this kind are not supported"),
        ("* " + "x" * (9 << 20), "at most 8388608 are read"),
        ("V2 a 0 PULSE(0 1 0 1p 1p 1p 1n)\nR2 a 0 1k\n.tran 1m 10 uic", "more than 1000000 edges"),
    ],
    ids=["elements", "doubling", "parameters", "states", "digits", "word", "text", "edges"],
)
def test_a_deck_beyond_the_limits_is_refused_at_once(cards: str, message: str) -> None:
    start_s = time.process_time()
    with pytest.raises(CircuitError, match=message):
        read_deck(HEAD + cards)
    assert time.process_time() - start_s < 5.0


def test_a_file_may_be_given_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "a.cir").write_text("t\nV1 a 0 1\nR1 a 0 1k\n.tran 50u 100u uic")
    assert Deck.load(str(tmp_path / "a.cir")).samples == 3


def test_a_file_is_named_in_its_errors(tmp_path: Path) -> None:
    path = tmp_path / "wrong.cir"
    with pytest.raises(CircuitError, match="wrong.cir: No such file"):
        Deck.load(path)
    path.write_bytes(b"t\xff\nQ1 a b c\n")
    with pytest.raises(CircuitError, match="wrong.cir:2: Q1: transistors"):
        Deck.load(path)


CURRENTS = """a current switched into a filter, and another through its middle
I1 0 a PULSE(0 2m 1.013m 1n 1n 1.011m)
I2 b a DC 0.1m
R1 a 0 2k
R2 a b 1k
C1 b 0 100n IC=0.5
X1 0 m out opamp
R3 b m 10k
R4 m out 10k
.tran 50u 5m uic
.end
"""


def test_current_sources_agree_with_ngspice_and_are_read_back(ngspice: NgSpice) -> None:
    deck = read_deck(CURRENTS)
    assert deck.circuit.of(CurrentSource) == (CurrentSource("I1", "0", "a"), CurrentSource("I2", "b", "a", 0.1e-3))
    nodes = ("a", "b", "out")
    assert np.abs(deck.volts(nodes) - ngspice(deck.text(nodes), nodes, deck.samples)).max() < 0.05 * LSB_V
    again = read_deck(deck.text())
    assert again.circuit == deck.circuit
    assert np.array_equal(again.volts(nodes), deck.volts(nodes))


def test_current_comes_out_of_a_sources_second_node() -> None:
    """1 mA into 2 kOhm and 1 nF: 2 V (1 - exp(-t / 2 us)), at rest by the first sample."""
    circuit = Circuit(
        [CurrentSource("I", "0", "a", 1e-3), Resistor("R", "a", "0", 2e3), Capacitor("C", "a", "0", 1e-9)]
    )
    assert Deck(circuit, samples=5).volts(["a"])[1:, 0] == pytest.approx(2.0, abs=1e-9)


@pytest.mark.parametrize(
    ("card", "message"),
    [
        ("I1 a 0 nan", "I1"),
        ("I1 a a 1m", "both ends are on node a"),
        ("I1 a b 1m", "node b floats"),
        ("I1 a 0 SIN(0 1 1k)", "SIN sources are not supported"),
    ],
)
def test_bad_current_source_is_named(card: str, message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        read_deck(f"title\nR1 a 0 1k\n{card}\n.tran 50u 1m uic\n.end\n")


def test_level_that_is_to_come_long_after_the_end_does_not_come() -> None:
    deck = read_deck("late\nV1 a 0 PWL(0 5 3000 5 3000.0000000005 1)\nR1 a 0 1k\n.tran 1n 5n uic\n.end\n")
    assert deck.volts(["a"]).ravel().tolist() == [5.0] * 6


@pytest.mark.parametrize("period", ["5e-324", "1e-13", "1e7"])
def test_sample_period_beyond_all_reason_is_refused(period: str) -> None:
    with pytest.raises(CircuitError, match="the sample period must be from 1e-12 to 1e.06 s"):
        read_deck(f"period\nV1 a 0 1\nR1 a 0 1k\n.tran {period} {period} uic\n.end\n")


def test_card_of_assignments_without_end_is_refused() -> None:
    with pytest.raises(CircuitError, match="R1: has more than 50000 assignments"):
        read_deck("many\nR1 " + "a=" * 100_000 + "\n.tran 50u 1m uic\n.end\n")


def test_more_than_memory_should_hold_is_refused() -> None:
    resistors = "\n".join(f"R{i} n{i} 0 1k\nV{i} n{i} 0 1" for i in range(20))
    deck = read_deck(f"large\n{resistors}\n.tran 1u 9 uic\n.end\n")
    with pytest.raises(CircuitError, match="9000001 samples of 20 nodes: more than 50000000 values; name fewer nodes"):
        deck.volts()


def test_slices_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = read_deck(INVERTER).volts()
    monkeypatch.setattr("analogrig_emulator.deck.SLICE_SAMPLES", 7)
    assert read_deck(INVERTER).volts().tobytes() == whole.tobytes()


def test_circuit_that_oscillates_without_end_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """A relaxation oscillator: some events a period of 0.2 ms, for ten seconds."""
    text = """relaxation
X1 p m out opamp
R1 out p 10k
R2 p 0 10k
R3 out m 10k
C1 m 0 10n IC=1
.tran 50u 10 uic
.end
"""
    monkeypatch.setattr("analogrig_emulator.deck.MAX_EVENTS", 10_000)
    with pytest.raises(CircuitError, match="more than 10000 events in [0-9]+ samples: it oscillates"):
        read_deck(text).volts(["out"])


def test_error_of_a_deck_without_a_title_says_what_was_taken_for_it() -> None:
    with pytest.raises(CircuitError, match=r"no parameter is called 'r'.* \(line 1 is the title: '.param r=10k'\)"):
        read_deck(".param r=10k\nV1 a 0 1\nR1 a 0 {r}\n.tran 50u 1m uic\n.end\n")


def test_megahertz_written_as_millihertz_are_refused() -> None:
    with pytest.raises(CircuitError, match="gbw_hz 0.001 is below 1 Hz .in a deck 1M is 1e-3."):
        read_deck(INVERTER.replace("opamp", "opamp gbw=1M"))
