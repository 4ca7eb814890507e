"""Nodal analysis against circuits solved by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest

from analogrig_emulator import (
    IDEAL,
    Capacitor,
    Circuit,
    CircuitError,
    Components,
    DiodeLimiter,
    OpAmp,
    OpAmpModel,
    PiecewiseLinear,
    Pot,
    Resistor,
    VoltageSource,
    piecewise_linear,
)
from analogrig_emulator.circuit.elements import _TwoEnded
from analogrig_emulator.circuit.nodal import Nodal
from analogrig_emulator.circuit.opamp import CLAMP_RATE
from analogrig_emulator.engine.system import Kink

SOURCE = VoltageSource("V1", "in")


def inverter(model: OpAmpModel, gain: float = 10.0) -> Circuit:
    return Circuit(
        [
            SOURCE,
            Resistor("R1", "in", "n", 1e3),
            Resistor("R2", "n", "out", gain * 1e3),
            OpAmp("U1", "0", "n", "out", model),
        ]
    )


def test_a_low_pass_has_its_time_constant() -> None:
    system = piecewise_linear(Circuit([SOURCE, Resistor("R1", "in", "out", 2e3), Capacitor("C1", "out", "0", 3e-9)]))
    assert system.states == ("C1",)
    assert system.inputs == ("V1",)
    np.testing.assert_allclose(system.abc, [[-1 / 6e-6, 1 / 6e-6, 0.0]], rtol=1e-14)
    np.testing.assert_allclose(system.readings(["out", "in"]), [[1, 0, 0], [0, 1, 0]], atol=1e-15)


def test_a_loaded_pot_divides_as_by_hand() -> None:
    circuit = Circuit([SOURCE, Pot("P1", "in", "w", "0", 10e3, 0.6), Resistor("RL", "w", "0", 6e3)])
    # 6 k parallel to 6 k is 3 k, below 4 k.
    np.testing.assert_allclose(piecewise_linear(circuit).readings(["w"]), [[3.0 / 7.0, 0.0]], rtol=1e-14)


def test_turning_a_pot_gives_the_system_of_the_circuit_built_so() -> None:
    elements = (
        SOURCE,
        Pot("P1", "in", "w", "0", 10e3, 0.6),
        Resistor("R1", "w", "o", 1e3),
        Capacitor("C1", "o", "0", 1e-9),
    )
    turned = Nodal(Circuit(elements)).at({"P1": 0.25})
    built = piecewise_linear(Circuit(elements).with_dials({"P1": 0.25}))
    assert np.array_equal(turned.abc, built.abc)
    assert np.array_equal(turned.lmn, built.lmn)


def test_a_constant_source_enters_the_constant_column() -> None:
    circuit = Circuit(
        [VoltageSource("REF", "ref", dc_v=-10.0), Resistor("R1", "ref", "o", 1e3), Resistor("R2", "o", "0", 3e3)]
    )
    system = piecewise_linear(circuit)
    assert system.inputs == ()
    np.testing.assert_allclose(system.readings(["o"]), [[-7.5]], rtol=1e-14)


def test_an_ideal_inverter_has_its_gain_and_amplifies_its_offset() -> None:
    system = piecewise_linear(inverter(replace(IDEAL, vos_v=1e-3)))
    np.testing.assert_allclose(system.readings(["out"]), [[-10.0, 11e-3]], rtol=1e-13)


def test_a_finite_gain_without_pole_gives_the_textbook_error() -> None:
    # Gain -10 with Avol = 1000: -10 / (1 + 11/1000).
    system = piecewise_linear(inverter(OpAmpModel(avol=1000.0)))
    np.testing.assert_allclose(system.readings(["out"]), [[-10.0 / 1.011, 0.0]], rtol=1e-13)


def test_output_resistance_of_an_op_amp_without_pole_costs_loop_gain() -> None:
    follower = OpAmp("U1", "in", "out", "out", OpAmpModel(avol=1000.0, rout_ohm=100.0))
    system = piecewise_linear(Circuit([SOURCE, follower, Resistor("RL", "out", "0", 300.0)]))
    np.testing.assert_allclose(system.readings(["out"]), [[750.0 / 751.0, 0.0]], rtol=1e-13)


def test_a_pole_gives_the_closed_loop_bandwidth_and_the_static_gain() -> None:
    system = piecewise_linear(inverter(OpAmpModel(avol=1000.0, gbw_hz=1e6)))
    [[slope, drive, _]] = system.abc
    assert -slope == pytest.approx(2 * math.pi * 1e6 * (1 / 11 + 1 / 1000), rel=1e-13)
    assert drive / -slope == pytest.approx(-10.0 / 1.011, rel=1e-13)


def test_output_resistance_divides_with_the_load() -> None:
    follower = OpAmp("U1", "in", "out", "out", OpAmpModel(avol=1e5, gbw_hz=1e6, rout_ohm=100.0))
    system = piecewise_linear(Circuit([SOURCE, follower, Resistor("RL", "out", "0", 300.0)]))
    np.testing.assert_allclose(system.readings(["out"]), [[0.75, 0.0, 0.0]], rtol=1e-14)


def test_slew_and_clamp_are_kinks_with_the_law_of_the_op_amp() -> None:
    model = OpAmpModel(avol=1e5, gbw_hz=1e6, slew_v_per_s=5e5, swing_v=(-12.0, 13.0), vos_v=2e-3)
    system = piecewise_linear(Circuit([SOURCE, OpAmp("U1", "in", "out", "out", model)]))
    slew, clamp = system.kinks
    assert (slew.lower, slew.upper, slew.slopes) == (-5e5, 5e5, (0.0, 1.0, 0.0))
    assert (clamp.lower, clamp.upper, clamp.slopes) == (-12.0, 13.0, (1.0, 0.0, 1.0))
    assert clamp.intercepts == (12.0, 0.0, -13.0)
    np.testing.assert_array_equal(system.abc, [[0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(system.g, [[1.0, -CLAMP_RATE]])
    rate = 2 * math.pi * 1e6
    np.testing.assert_allclose(system.cde, [[-rate - rate / 1e5, rate, rate * 2e-3], [1.0, 0.0, 0.0]], rtol=1e-14)


def test_a_singular_circuit_is_refused_naming_element_and_node() -> None:
    """The input holds the amplifier's - input, so that no output of it makes v+ = v-."""
    circuit = Circuit([SOURCE, Resistor("R1", "in", "out", 1e3), OpAmp("U1", "0", "in", "out", IDEAL)])
    with pytest.raises(
        CircuitError, match=r"^\w+ (V1 \(in 0\)|R1 \(in out\)|U1 \(0 in out\)): the circuit is singular"
    ):
        piecewise_linear(circuit)


def test_an_ideal_op_amp_that_drives_nothing_back_is_refused_naming_the_node() -> None:
    with pytest.raises(
        CircuitError, match="OpAmp U1 .* no feedback: its output, node out, acts on neither of its inputs"
    ):
        Circuit([SOURCE, OpAmp("U1", "0", "in", "out", IDEAL)])


def test_more_than_the_engine_takes_is_refused_with_the_number() -> None:
    ladder = [Capacitor(f"C{i}", f"n{i}", "0", 1e-9) for i in range(97)]
    links = [Resistor(f"R{i}", f"n{i}", "0", 1e3) for i in range(97)]
    with pytest.raises(CircuitError, match="97 states; the engine takes at most 96"):
        piecewise_linear(Circuit([*ladder, *links]))


def test_a_constant_source_and_an_offset_are_constants_beside_a_limiter_too() -> None:
    elements = [
        VoltageSource("V1", "in", dc_v=3.0),
        *inverter(OpAmpModel(vos_v=2e-3), gain=1.0).elements[1:],
        DiodeLimiter("D1", "out", "0", 20.0, 1e3, 1e9),
    ]
    system = piecewise_linear(Circuit(elements))
    np.testing.assert_allclose(system.readings(["in", "n", "out"])[:, -1], [3.0, 2e-3, -3.0 + 4e-3], rtol=1e-12)


def test_a_rest_lies_in_the_piece_of_the_limiter_where_it_is() -> None:
    """dx/dt = -x + a + g max(0, x - 5): at a = 4 below the threshold, at a = 6 where x = (a - 5 g) / (1 - g)."""
    assert limited(-1.0, 4.0, 0.5).rest(np.empty(0)).state.tolist() == [4.0]
    assert limited(-1.0, 6.0, 0.5).rest(np.empty(0)).state == pytest.approx([7.0])
    assert limited(-1.0, 6.0, -2.0).rest(np.empty(0)).state == pytest.approx([16 / 3])


def test_a_limiter_without_a_rest_on_either_side_is_named() -> None:
    """dx/dt = -x + 6 + 2 max(0, x - 5) is never below 1."""
    with pytest.raises(CircuitError, match="nothing brings D1 to rest"):
        limited(-1.0, 6.0, 2.0).rest(np.empty(0))


def limited(slope: float, constant: float, gain: float) -> PiecewiseLinear:
    """dx/dt = slope x + constant + gain max(0, x - 5)."""
    kink = Kink(-math.inf, 5.0, (1.0, 0.0, 1.0), "D1")
    zero = np.zeros((1, 1))
    flow, w = np.array([[slope, constant]]), np.array([[1.0, 0.0]])
    return PiecewiseLinear(("C1",), (), ("n",), (kink,), flow, np.array([[gain]]), w, zero, w, zero)


@dataclass(frozen=True)
class Inductor(_TwoEnded):
    """An element that nobody has provided for."""


def test_an_element_of_no_known_kind_is_refused_by_its_name() -> None:
    strange = cast(Any, Inductor("L1", "in", "0"))
    with pytest.raises(CircuitError, match=r"Inductor L1 \(in 0\): no such kind of element"):
        Nodal(Circuit([SOURCE, strange]))
    with pytest.raises(CircuitError, match=r"Inductor L1 \(in 0\): no such kind of element"):
        Components(given={"V1": 0.0}).fit([SOURCE, strange])
