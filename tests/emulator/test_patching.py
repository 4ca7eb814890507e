"""Errors of patching, made one at a time on a healthy machine, are refused naming the element and the node."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import pytest

from analogrig_emulator import (
    IDEAL,
    AnalogComputer,
    Capacitor,
    Circuit,
    CircuitError,
    OpAmp,
    Pot,
    Resistor,
    SuspensionComputer,
    VoltageSource,
    preset,
)
from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.machine.patch_panel import Patch, patches

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


def test_a_reading_of_no_node_is_refused_when_the_machine_is_made() -> None:
    with pytest.raises(CircuitError, match="readings: no node is called 'u9'; there are in, s1, u1"):
        AnalogComputer(SuspensionComputer("front").circuit, ["u5", "u9"])


def test_an_integrator_without_a_capacitor_is_refused() -> None:
    circuit = SuspensionComputer("front").circuit
    with pytest.raises(CircuitError, match=r"OpAmp U4 \(0 s4 u4\): an integrator without a capacitor .* s4 and u4"):
        AnalogComputer(circuit, ["u5"], initial_v={"U4": 1.0})
    with pytest.raises(CircuitError, match="no amplifier is called 'U9'; there are U1, U2, U3, U4, U5"):
        AnalogComputer(circuit, ["u5"], initial_v={"U9": 1.0})


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
