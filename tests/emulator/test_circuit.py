"""Checks of a netlist and their messages."""

from __future__ import annotations

import math
import sys
from types import FrameType
from typing import Any

import pytest

from analogrig_emulator import (
    IDEAL,
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
    Switch,
    VoltageSource,
    preset,
)
from analogrig_emulator.circuit.circuit import Element

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


@pytest.mark.parametrize(
    ("elements", "message"),
    [
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
def test_a_loop_without_resistance_is_refused_naming_what_is_in_it(elements: list[Element], message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        Circuit(elements)


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
