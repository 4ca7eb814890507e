"""Quiet stretches, where the slow states alone are stepped, and pots that turn continuously."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from analogrig_emulator import (
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    Components,
    Edges,
    Engine,
    Excitation,
    OpAmp,
    OpAmpModel,
    Pot,
    Resistor,
    SuspensionComputer,
    VoltageSource,
    piecewise_linear,
)
from analogrig_emulator.circuit.nodal import Nodal
from tests.emulator.plays import SAMPLE_RATE_HZ, Volts

NODES = ("u1", "u2", "u3", "u4", "u5", "wm", "wb", "wk")


def machine(program: str, opamp: str = "tl07x", given: Mapping[str, float] | None = None) -> Circuit:
    rng = np.random.default_rng(4)
    return SuspensionComputer(
        program, opamp=opamp, components=Components(given=given or {}), rng=rng, offset_v=3e-3
    ).circuit


def played(circuit: Circuit, excitation: Excitation, samples: int, *, reduced: bool) -> tuple[Volts, Engine]:
    """Without reduction the state is set to itself at every sample, from where steps grow from one tick anew."""
    engine = Engine(piecewise_linear(circuit), NODES)
    volts = np.empty((samples, len(NODES)))
    for k in range(samples) if not reduced else [0]:
        count = samples if reduced else 1
        volts[k : k + count] = engine.run(count, {"F": excitation.edges(*engine.window(count), SAMPLE_RATE_HZ)})
        if not reduced:
            engine.state = engine.state
    return volts, engine


@pytest.mark.parametrize("program", ["front", "shock"])
@pytest.mark.parametrize(
    "excitation", [Excitation(), Excitation(clock="free", phase=0.137, frequency_hz=333.0, low_v=-3.0)]
)
def test_slow_states_alone_give_the_same_voltages(program: str, excitation: Excitation) -> None:
    full, _ = played(machine(program), excitation, 600, reduced=False)
    volts, engine = played(machine(program), excitation, 600, reduced=True)
    assert np.abs(volts - full).max() < 1e-9
    assert engine.counts.quiet > 300


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.sampled_from(("front", "shock")),
    st.sampled_from(("tl07x", "741", "ideal")),
    st.tuples(*[st.floats(0.6, 1.8)] * 4),
    st.builds(
        Excitation,
        low_v=st.floats(-12.0, 0.0),
        high_v=st.floats(0.0, 12.0),
        frequency_hz=st.floats(60.0, 900.0),
        clock=st.just("free"),
        phase=st.floats(0.0, 0.99),
    ),
)
def test_slow_states_alone_give_the_same_voltages_whatever_limits(
    program: str, opamp: str, by: tuple[float, float, float, float], excitation: Excitation
) -> None:
    """Amplifiers slew and clamp at will: no event may be slept through."""
    given = {name: factor - 1.0 for name, factor in zip(("RFB", "RB", "C1", "C2"), by, strict=True)}
    full, _ = played(machine(program, opamp, given), excitation, 200, reduced=False)
    volts, _ = played(machine(program, opamp, given), excitation, 200, reduced=True)
    assert np.abs(volts - full).max() < 1e-7


def test_a_clamped_amplifier_may_be_quiet_too() -> None:
    """Twice the summer's gain and 13.5 V of swing: U1 stays in its clamp while nothing moves, and comes out of it."""
    circuit = Circuit(
        [
            VoltageSource("F", "in"),
            *(Resistor("R1", "in", "s", 10e3), Resistor("R2", "s", "u1", 20e3)),
            OpAmp("U1", "0", "s", "u1", OpAmpModel(avol=1e5, gbw_hz=3e6, slew_v_per_s=13e6, swing_v=(-13.5, 13.5))),
            *(Resistor("R3", "u1", "u2", 10e3), Capacitor("C1", "u2", "0", 100e-9)),
        ]
    )
    engine = Engine(piecewise_linear(circuit), ["u1", "u2"])
    volts = engine.run(400, {"F": Edges(np.array([0, 200 * TICKS_PER_SAMPLE + 77]), np.array([-9.0, 1.0]))})
    assert volts[199, 0] == pytest.approx(13.5, abs=0.02)
    t_s = np.arange(2, 200) / SAMPLE_RATE_HZ
    # Slewing takes 1.04 us, half of which the low-pass of 1 ms loses.
    expected = volts[199, 0] * (1.0 - np.exp(-(t_s - 0.52e-6) / 1e-3))
    np.testing.assert_allclose(volts[2:200, 1], expected, atol=2e-3)
    assert volts[-1, 0] == pytest.approx(-2.0, abs=1e-3)
    assert engine.counts.quiet > 390


def test_a_circuit_that_does_not_come_to_rest_is_never_called_quiet() -> None:
    elements = (
        Resistor("R1", "in", "n", 1e5),
        Capacitor("C1", "n", "o", 1e-7),
        OpAmp("U1", "0", "n", "o", OpAmpModel()),
    )
    engine = Engine(piecewise_linear(Circuit([VoltageSource("V1", "in"), *elements])), ["o"])
    volts = engine.run(50, {"V1": Edges(np.array([0]), np.array([1.0]))})[:, 0]
    np.testing.assert_allclose(volts, -np.arange(50) / SAMPLE_RATE_HZ / 1e-2, atol=1e-12)
    assert engine.counts.quiet == 0


def test_no_event_is_slept_through_when_a_slow_state_runs_into_a_clamp() -> None:
    """An integrator of 10 ms towards -20 V: every sample before the clamp is quiet by the eye, and none may be."""
    model = OpAmpModel(avol=1e6, gbw_hz=3e6, slew_v_per_s=13e6, swing_v=(-13.5, 13.5))
    elements = (
        *(Resistor("R1", "in", "n", 10e3), Resistor("R2", "n", "o", 20e3), Capacitor("C1", "n", "o", 500e-9)),
        OpAmp("U1", "0", "n", "o", model),
    )
    engine = Engine(piecewise_linear(Circuit([VoltageSource("V1", "in"), *elements])), ["o"])
    volts = engine.run(2000, {"V1": Edges(np.array([0]), np.array([10.0]))})[:, 0]
    t_s = np.arange(2000) / SAMPLE_RATE_HZ
    expected = np.maximum(-20.0 * (1.0 - np.exp(-t_s / 10e-3)), -13.5)
    # In the clamp it stands up to slew / CLAMP_RATE = 13 mV beyond the swing.
    np.testing.assert_allclose(volts, expected, atol=13.1e-3)
    assert volts[-1] == pytest.approx(-13.513, abs=1e-6)
    assert engine.counts.events == 2  # into the clamp; then the slope asked for exceeds the slew rate


# ---- pots that turn continuously


def turning_lag(samples_to_turn: int) -> tuple[Nodal, float]:
    """A pot into an RC low-pass: dv/dt = (k_loaded u - v) / tau, both depending on the dial."""
    circuit = Circuit(
        [
            VoltageSource("V1", "in"),
            Pot("P1", "in", "w", "0", 10e3, 0.2),
            Resistor("R1", "w", "o", 5e3),
            Capacitor("C1", "o", "0", 20e-9),
        ]
    )
    return Nodal(circuit), 0.6 / samples_to_turn


@pytest.mark.parametrize(("pieces", "scale"), [(1, 1.0), (2, 0.25), (4, 0.0625)])
def test_a_pot_that_turns_follows_the_differential_equation_within_the_stated_bound(pieces: int, scale: float) -> None:
    nodal, per_sample = turning_lag(40)
    drive_v = 10.0

    def dial(t: float) -> float:
        return min(0.2 + per_sample * t, 0.8)

    def slope(t_s: float, v: Volts) -> Volts:
        k = dial(t_s * SAMPLE_RATE_HZ)
        return (k * drive_v - v) / (20e-9 * (5e3 + 10e3 * k * (1.0 - k)))

    engine = Engine(nodal.at({}), ["o"])
    edges = {"V1": Edges(np.array([0]), np.array([drive_v]))}
    volts = engine.run_turning(60, lambda t: nodal.at({"P1": dial(t)}), edges, pieces)[:, 0]
    t_s = np.arange(60) / SAMPLE_RATE_HZ
    exact = scipy.integrate.solve_ivp(
        slope, (0.0, t_s[-1]), [0.0], "DOP853", t_s, rtol=1e-12, atol=1e-13, max_step=20e-6
    )
    error_v = np.abs(volts - exact.y[0]).max()
    # r h^2 / 8 with r = 300 /s, h = 50 us / pieces, and |d(dv/dt)/dk| below 10 V / 100 us; twice for memory.
    r, h_s = per_sample * SAMPLE_RATE_HZ, 50e-6 / pieces
    assert error_v < 2.0 * r * h_s**2 / 8.0 * drive_v / 100e-6
    assert error_v < scale * 0.0125
    assert volts[-1] == pytest.approx(8.0, abs=0.1)


@pytest.mark.parametrize("block", [1, 7])
def test_cutting_a_turn_into_blocks_changes_no_bit(block: int) -> None:
    nodal, per_sample = turning_lag(30)
    edges = Edges(np.array([0, 1234567, 20 * TICKS_PER_SAMPLE + 5]), np.array([10.0, -3.0, 7.0]))

    def turning(t: float) -> object:
        return nodal.at({"P1": min(0.2 + per_sample * t, 0.8)})

    whole = Engine(nodal.at({}), ["o", "w"]).run_turning(40, turning, {"V1": edges}, 3)  # type: ignore[arg-type]
    engine, parts = Engine(nodal.at({}), ["o", "w"]), []
    while engine.recorded < 40:
        count = min(block, 40 - engine.recorded)
        start, stop = engine.window(count)
        now = (edges.ticks >= start) & (edges.ticks < stop)
        train = Edges(edges.ticks[now], edges.levels_v[now])
        parts.append(engine.run_turning(count, turning, {"V1": train}, 3))  # type: ignore[arg-type]
    assert np.array_equal(np.concatenate(parts), whole)


def test_a_pot_that_turns_nowhere_is_a_pot_that_stands() -> None:
    nodal, _ = turning_lag(1)
    edges = {"V1": Edges(np.array([0, 1234567]), np.array([10.0, -3.0]))}
    turned = Engine(nodal.at({}), ["o"]).run_turning(30, lambda _: nodal.at({}), edges, 2)
    np.testing.assert_allclose(turned, Engine(nodal.at({}), ["o"]).run(30, edges), atol=1e-12)
