"""Checks of a netlist and their messages."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import FrameType
from typing import Any

import pytest

from analogrig_emulator import (
    IDEAL,
    AnalogComputer,
    Capacitor,
    Circuit,
    CircuitError,
    CurrentSource,
    DiodeLimiter,
    OpAmp,
    OpAmpModel,
    Pot,
    PotError,
    Resistor,
    SuspensionComputer,
    Switch,
    VoltageSource,
    preset,
)
from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.pot import coefficient_under_load, dial_for
from analogrig_emulator.machine.patch_panel import Patch, patches

SOURCE = VoltageSource("V1", "in")


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ([SOURCE, Resistor("R1", "in", "0", 1e3), Resistor("r1", "in", "0", 1e3)], "two elements are called 'r1'"),
        ([SOURCE, Resistor("R1", "in", "0", -1.0)], r"Resistor R1 \(in 0\): ohm must be positive and finite, got -1.0"),
        ([SOURCE, Resistor("R1", "in", "0", math.nan)], "Resistor R1 .* got nan"),
        ([SOURCE, Capacitor("C1", "in", "0", 0.0)], r"Capacitor C1 \(in 0\): farad must be positive"),
        ([SOURCE, Resistor("R1", "in", "0", 1e-309)], r"Resistor R1 \(in 0\): ohm must be at least 1e-100"),
        ([SOURCE, Pot("P1", "in", "w", "0", 5e-324, 0.5)], r"Pot P1 \(in w 0\): track_ohm must be at least 1e-100"),
        ([SOURCE, Resistor("R1", "in", "in", 1e3)], r"Resistor R1 \(in in\): both ends are on node in"),
        ([SOURCE, Resistor("R1", "a", "b", 1e3)], r"Resistor R1 \(a b\): node a floats"),
        ([SOURCE, OpAmp("U1", "in", "x", "out", IDEAL)], r"OpAmp U1 \(in x out\): node x floats"),
        ([SOURCE, Resistor("R1", "in", "IN", 1e3)], "nodes 'in' and 'IN' differ in case only"),
        ([SOURCE, Resistor("R 1", "in", "0", 1e3)], "element name 'R 1'"),
        ([SOURCE, Resistor("R1", "in", "a;b", 1e3)], "node name 'a;b'"),
        ([SOURCE, VoltageSource("V2", "a", dc_v=math.inf)], r"VoltageSource V2 \(a 0\): dc_v must be finite"),
        ([CurrentSource("I1", "0", "0")], r"CurrentSource I1 \(0 0\): both ends are on node 0"),
        (
            [SOURCE, CurrentSource("I1", "in", dc_a=math.nan)],
            r"CurrentSource I1 \(in 0\): dc_a must be finite, got nan",
        ),
        ([SOURCE, Resistor("R1", "in", "0", "1k")], r"Resistor R1 \(in 0\): ohm must be positive and finite, got '1k'"),  # type: ignore[arg-type]
        ([SOURCE, Pot("P1", "in", "w", "0", math.inf, 0.5)], r"Pot P1 \(in w 0\): track_ohm must be positive"),
        ([SOURCE, DiodeLimiter("D1", "in", "0", math.nan, 1.0, 1e9)], "DiodeLimiter D1 .*threshold_v must be finite"),
        ([SOURCE, Switch("S1", "in", "0", 10.0, 1.0, closed=True)], "Switch S1 .*on_ohm 10.0 exceeds off_ohm 1.0"),
        # Loops without resistance, with what is in them.
        ([SOURCE, VoltageSource("V2", "in", dc_v=1.0)], r"VoltageSource V2 \(in 0\): .* node in to node 0 with V1"),
        (
            [SOURCE, VoltageSource("V2", "b", "a"), Capacitor("C1", "in", "a", 1e-9), Capacitor("C2", "0", "b", 1e-9)],
            r"Capacitor C2 \(0 b\): closes a loop without resistance from node 0 to node b with V1, C1, V2",
        ),
        ([Capacitor("C1", "a", "0", 1e-9), Capacitor("C2", "0", "a", 1e-9)], r"Capacitor C2 \(0 a\): .* with C1"),
        (
            [SOURCE, OpAmp("U1", "in", "a", "a", IDEAL), OpAmp("U2", "in", "a", "a", OpAmpModel(gbw_hz=1e6))],
            r"OpAmp U2 \(in a a\): closes a loop without resistance from node a to node 0 with U1",
        ),
    ],
)
def test_a_wrong_netlist_is_refused_naming_element_and_node(elements: list[Element], message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        Circuit(elements)


def test_the_cost_of_checking_a_ladder_grows_linearly_with_its_length() -> None:
    """Counted in lines of Python: no step of the check may look at every element again."""

    def lines(length: int) -> int:
        ladder = [Resistor(f"R{i}", f"n{i}", f"n{i + 1}", 1.0) for i in range(length)]
        elements: list[Element] = [VoltageSource("V1", "n0"), *ladder, Resistor("Rend", f"n{length}", "0", 1.0)]
        count = 0

        def trace(_frame: FrameType, _event: str, _arg: object) -> Any:
            nonlocal count
            count += 1
            return trace

        before = sys.gettrace()
        sys.settrace(trace)
        try:
            Circuit(elements)
        finally:
            sys.settrace(before)
        return count

    assert lines(800) < 9 * lines(100)


def test_amplifiers_with_output_resistance_may_join_their_outputs() -> None:
    model = OpAmpModel(avol=1e5, gbw_hz=1e6, rout_ohm=100.0)
    Circuit([SOURCE, OpAmp("U1", "in", "a", "a", model), OpAmp("U2", "in", "a", "a", model)])


def test_an_error_carries_the_name_of_the_element() -> None:
    with pytest.raises(CircuitError) as caught:
        Circuit([SOURCE, Resistor("R7", "in", "0", 0.0)])
    assert caught.value.element == "R7"


@pytest.mark.parametrize("dial", [-0.001, 1.001, math.nan])
def test_a_dial_off_the_track_is_refused_naming_the_pot(dial: float) -> None:
    with pytest.raises(PotError, match="pot P1: dial .* is beyond the track"):
        Circuit([SOURCE, Pot("P1", "in", "w", "0", 10e3, dial)])


def test_turning_a_pot_that_is_not_there_names_those_that_are() -> None:
    with pytest.raises(CircuitError, match="no pot is called 'P2'; there are P1"):
        Circuit([SOURCE, Pot("P1", "in", "w", "0", 10e3, 0.5)]).with_dials({"P2": 0.1})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("avol", 0.0),
        ("gbw_hz", -1.0),
        ("slew_v_per_s", math.nan),
        ("rout_ohm", -1.0),
        ("vos_v", math.nan),
        ("swing_v", (1.0, 2.0)),
    ],
)
def test_an_impossible_op_amp_is_refused_naming_the_field(field: str, value: float) -> None:
    with pytest.raises(CircuitError, match=f"op-amp: {field}"):
        OpAmpModel(**{"gbw_hz": 1e6, field: value})  # type: ignore[arg-type]


def test_limits_on_an_op_amp_without_a_pole_are_refused() -> None:
    with pytest.raises(CircuitError, match="need a finite gbw_hz"):
        OpAmpModel(slew_v_per_s=1e6)


def test_an_unknown_op_amp_lists_the_known_ones() -> None:
    with pytest.raises(CircuitError, match="unknown op-amp 'op07'; there are ideal, tl07x, 741"):
        preset("op07")


# ---- pots and their load


DIALS = (0.0, 0.01, 0.25, 0.5, 0.8358, 0.99, 1.0)


@pytest.mark.parametrize("dial", DIALS)
@pytest.mark.parametrize("load_ohm", [10e3, 33.2e3, 100e3])
def test_coefficient_is_that_of_the_divider_solved_by_hand(dial: float, load_ohm: float) -> None:
    track_ohm = 10e3
    upper_ohm, lower_ohm = (1 - dial) * track_ohm, dial * track_ohm
    loaded_ohm = lower_ohm * load_ohm / (lower_ohm + load_ohm)
    assert coefficient_under_load(dial, track_ohm, load_ohm) == pytest.approx(loaded_ohm / (loaded_ohm + upper_ohm))


@pytest.mark.parametrize("dial", DIALS)
@pytest.mark.parametrize("load_ohm", [1e3, 10e3, 1e9])
def test_dial_for_undoes_the_load(dial: float, load_ohm: float) -> None:
    assert dial_for(coefficient_under_load(dial, 10e3, load_ohm), 10e3, load_ohm) == pytest.approx(dial, abs=1e-14)


@pytest.mark.parametrize(
    ("coefficient", "load_ohm", "dial"),
    [
        (0.7350, 10e3, 0.8358),
        (0.4065, 33.2e3, 0.4367),
        (0.8300, 49.9e3, 0.8511),
        (0.2557, 100e3, 0.2606),
        (0.9800, 100e3, 0.9818),
    ],
)
def test_dials_are_those_of_the_set_up_sheet(coefficient: float, load_ohm: float, dial: float) -> None:
    assert dial_for(coefficient, 10e3, load_ohm) == pytest.approx(dial, abs=1e-4)


@pytest.mark.parametrize("coefficient", [-1e-9, 1.000001, float("nan")])
def test_coefficient_beyond_the_track_is_refused_naming_the_pot(coefficient: float) -> None:
    with pytest.raises(PotError, match="pot M: coefficient .* is beyond the track"):
        dial_for(coefficient, 10e3, 100e3, name="M")


# ---- errors of patching, made one at a time on a healthy machine, are refused naming the element and the node


Change = Callable[[list[Element]], Iterable[Element]]


def without(name: str) -> Change:
    return lambda elements: [element for element in elements if element.name != name]


def with_more(*more: Element) -> Change:
    return lambda elements: [*elements, *more]


def moved(name: str, **ends: Any) -> Change:
    return lambda elements: [replace(e, **ends) if e.name == name else e for e in elements]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (moved("U5", out="u4"), r"OpAmp U5 \(0 s5 u4\): its output at node u4 is joined to that of OpAmp U4"),
        (with_more(VoltageSource("V1", "u2")), r"VoltageSource V1 \(u2 0\): its output at node u2 is joined to .* U2"),
        (moved("U5", out="0"), r"OpAmp U5 \(0 s5 0\): both ends are on node 0"),
        (without("RB"), r"Pot B \(u4 wb 0\): its wiper, node wb, is left open"),
        (moved("K", bottom="kb"), r"Pot K \(u3 wk kb\): its bottom, node kb, is left open"),
        (moved("K", top="kt"), r"Pot K \(kt wk 0\): nothing feeds its node kt"),
        (moved("R5", a="nowhere"), r"Resistor R5 \(nowhere s5\): nothing feeds its node nowhere"),
        (moved("U5", minus="x"), r"OpAmp U5 \(0 x u5\): node x floats"),
        (moved("U5", plus="x"), r"OpAmp U5 \(x s5 u5\): node x floats"),
        (
            without("R5FB"),
            r"OpAmp U5 \(0 s5 u5\): no feedback: its output, node u5, acts on neither of its inputs, nodes 0 and s5",
        ),
        (without("RFB"), r"OpAmp U1 \(0 s1 u1\): no feedback leads from its output, node u1, to node s1"),
        (without("C2"), r"OpAmp U3 \(0 s3 u3\): no feedback"),
        (without("R4"), r"OpAmp U4 \(0 s4 u4\): nothing feeds its input at node s4"),
        (without("F"), r"Resistor RF \(in s1\): nothing feeds its node in"),
        (
            with_more(Resistor("RX", "x", "s5", 1e4), Resistor("RY", "x", "y", 1e4), Capacitor("CY", "y", "x", 1e-9)),
            r"Resistor RX \(x s5\): nothing feeds its node x",
        ),
    ],
)
def test_an_error_of_patching_is_refused(change: Change, message: str) -> None:
    healthy = list(SuspensionComputer("front").circuit.elements)
    with pytest.raises(CircuitError, match=message):
        AnalogComputer(Circuit(change(healthy)), ["u5"])


@pytest.mark.parametrize("program", ["front", "shock"])
def test_the_suspension_is_patched_as_its_drawing_says(program: str) -> None:
    found = patches(SuspensionComputer(program).circuit)
    assert found["U1"] == Patch("U1", "s1", "u1", ("RF", "RB", "RK"), ())
    assert found["U2"] == Patch("U2", "s2", "u2", ("R1",), ("C1",))
    assert found["U5"] == Patch("U5", "s5", "u5", ("R5",), ())


def test_what_belongs_to_an_amplifier_is_none_of_its_inputs() -> None:
    """A leak across the capacitor, dielectric absorption, an input's resistance and capacitance, bias."""
    circuit = Circuit(
        [
            VoltageSource("V1", "in"),
            Resistor("R1", "in", "s", 1e5),
            Capacitor("C1", "s", "out", 1e-8),
            Resistor("RLEAK", "out", "s", 1e10),
            Resistor("RDA", "s", "d", 1e8),
            Capacitor("CDA", "d", "out", 1e-10),
            Resistor("RIN", "s", "0", 1e9),
            Capacitor("CIN", "s", "0", 1e-11),
            VoltageSource("U1_minus_bias", "U1_minus_bias", dc_v=-65.0),
            Resistor("U1_minus_ohm", "s", "U1_minus_bias", 1e12),
            Resistor("RBIAS", "p", "0", 1e5),
            OpAmp("U1", "p", "s", "out", preset("tl07x")),
        ]
    )
    assert patches(circuit) == {"U1": Patch("U1", "s", "out", ("R1",), ("C1",))}


def test_a_follower_and_an_amplifier_with_gain_need_no_junction() -> None:
    elements: list[Element] = [
        VoltageSource("V1", "in"),
        Pot("P1", "in", "w", "0", 1e4, 0.5),
        OpAmp("U1", "w", "a", "a", IDEAL),
        OpAmp("U2", "a", "n", "b", IDEAL),
        Resistor("R1", "n", "b", 1e4),
        Resistor("R2", "n", "0", 1e4),
    ]
    assert patches(Circuit(elements)) == {
        "U1": Patch("U1", "a", "a", (), ()),
        "U2": Patch("U2", "n", "b", (), ()),
    }


def test_an_input_named_after_its_amplifier_is_an_input_like_any_other() -> None:
    circuit = Circuit(
        [
            VoltageSource("V1", "in"),
            Resistor("R1", "in", "s", 1e5),
            Resistor("U1_in", "in", "s", 1e5),
            Capacitor("C1", "s", "out", 1e-8),
            OpAmp("U1", "0", "s", "out", IDEAL),
        ]
    )
    assert patches(circuit) == {"U1": Patch("U1", "s", "out", ("R1", "U1_in"), ("C1",))}
