"""The machine in its modes, against exponentials by hand, scipy and ngspice."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from analogrig_emulator import (
    COMPONENTS,
    FRONT,
    IDEAL,
    PROGRAMS,
    SHOCK,
    TICKS_PER_SAMPLE,
    AnalogComputer,
    Capacitor,
    Circuit,
    CircuitError,
    Components,
    Deck,
    DiodeLimiter,
    Edges,
    EngineError,
    Excitation,
    Mode,
    ModeError,
    OpAmp,
    OpAmpModel,
    Pot,
    PotError,
    PotGrade,
    PotTurn,
    Resistor,
    SuspensionComputer,
    Switch,
    VoltageSource,
    preset,
    to_spice,
)
from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.pot import coefficient_under_load
from analogrig_emulator.machine.relays import RelaySwitch
from tests.emulator.plays import LSB_V, NgSpice, Volts
from tests.emulator.programs import circuit_of

SAMPLE_S = 50e-6
UNLOCKED = Excitation(clock="free", phase=0.637, frequency_hz=317.0)
POT_SET, IC, HOLD, OPERATE = Mode.POT_SET, Mode.INITIAL_CONDITION, Mode.HOLD, Mode.OPERATE

_ALLOWED = {(POT_SET, IC), (IC, POT_SET), (IC, HOLD), (IC, OPERATE)} | {
    *((HOLD, mode) for mode in (POT_SET, IC, OPERATE)),
    *((OPERATE, mode) for mode in (IC, HOLD)),
}


def integrator(more: Iterable[Element] = (), model: OpAmpModel = IDEAL) -> Circuit:
    """Pot P1 (0.5) -> 100 k, 10 nF: tau = 1 ms."""
    return Circuit(
        [
            VoltageSource("V1", "in"),
            Pot("P1", "in", "w", "0", 10e3, 0.5),
            Resistor("R1", "w", "s", 100e3),
            Capacitor("C1", "s", "out", 10e-9),
            OpAmp("U1", "0", "s", "out", model),
            *more,
        ]
    )


def machine(circuit: Circuit | None = None, initial_v: float = 4.0, **settings: float | None) -> AnalogComputer:
    return AnalogComputer(circuit or integrator(), ["out"], initial_v={"U1": initial_v}, **settings)  # type: ignore[arg-type]


def level(volts: float, tick: int = 0) -> dict[str, Edges]:
    return {"V1": Edges(np.array([tick]), np.array([volts]))}


def ticks(samples: float) -> int:
    return round(samples * TICKS_PER_SAMPLE)


# ---- modes


def test_initial_condition_charges_with_the_time_constant_of_its_resistor() -> None:
    volts = machine(ic_ohm=20e3).run(100)[:, 0]
    np.testing.assert_allclose(volts, 4.0 * (1 - np.exp(-np.arange(100) * SAMPLE_S / 200e-6)), rtol=0, atol=1e-12)


def test_initial_condition_charges_at_once_when_told_so() -> None:
    assert machine(ic_ohm=None).run(3)[:, 0].tolist() == pytest.approx([4.0] * 3, abs=1e-12)


def test_initial_condition_leaves_the_inputs_out() -> None:
    volts = machine(ic_ohm=None).run(50, level(10.0))[:, 0]
    np.testing.assert_allclose(volts, 4.0, atol=1e-12)


def test_another_initial_voltage_is_taken_at_once_or_with_the_time_constant() -> None:
    at_once, slowly = machine(ic_ohm=None), machine(ic_ohm=10e3)
    slowly.run(100)
    for computer in (at_once, slowly):
        computer.set_initial({"U1": -2.0})
    assert at_once.read()["out"] == pytest.approx(-2.0, abs=1e-12)
    assert slowly.run(2)[-1, 0] == pytest.approx(-2.0 + 6.0 * math.exp(-2 * SAMPLE_S / 100e-6), abs=1e-9)


def test_operate_integrates_from_the_initial_voltage() -> None:
    computer = machine(ic_ohm=None)
    computer.switch(OPERATE)
    volts = computer.run(10, level(2.0))[:, 0]
    coefficient = coefficient_under_load(0.5, 10e3, 100e3)
    np.testing.assert_allclose(volts, 4.0 - 2.0 * coefficient * np.arange(10) * SAMPLE_S / 1e-3, rtol=0, atol=1e-9)


HELD_S: Volts = np.arange(1000, dtype=np.float64) * SAMPLE_S
BIAS = (VoltageSource("U1_minus_bias", "u1b", dc_v=-16.0), Resistor("U1_minus_ohm", "s", "u1b", 2e8))
HELD: Mapping[str, tuple[Circuit, Volts]] = {
    "whatever the inputs do": (integrator(), np.full(1000, 4.0)),
    # In INITIAL CONDITION the leak is across the resistor.
    "with a leaking capacitor": (
        integrator([Resistor("RLEAK", "s", "out", 1e8)]),
        4.0 * 1e8 / (1e8 + 10e3) * np.exp(-HELD_S / 1.0),
    ),
    # An input resistance to ground drains the capacitor through a junction that stands at -v / Avol.
    "with an amplifier of little gain": (
        integrator([Resistor("RIN", "s", "0", 1e6)], OpAmpModel(avol=1e4)),
        4.0 / (1.0 + (2.0 + 10e3 / 1e6) / 1e4) * np.exp(-HELD_S / (1e6 * 10e-9 * (1e4 + 1))),
    ),
    # 80 nA into 10 nF are 8 V/s; -16 V behind 200 M is how such a current is wired.
    "with a bias current": (integrator(BIAS), 4.0 + 80e-9 * 10e3 + 8.0 * HELD_S),
}


@pytest.mark.parametrize("name", HELD)
def test_hold_holds_and_droops_by_its_parts_alone(name: str) -> None:
    circuit, expected = HELD[name]
    computer = machine(circuit, ic_ohm=None)
    computer.switch(HOLD)
    np.testing.assert_allclose(computer.run(1000, level(10.0))[:, 0], expected, rtol=0, atol=1e-9)


def test_the_relays_may_switch_at_any_tick() -> None:
    """OPERATE from 1.25 to 7.75 samples: 6.5 samples of ramp."""
    switches = [(ticks(1.25), OPERATE), (ticks(7.75), HOLD)]
    volts = machine(ic_ohm=None).run(12, level(2.0), switches)[:, 0]
    slope = -2.0 * coefficient_under_load(0.5, 10e3, 100e3) * SAMPLE_S / 1e-3
    np.testing.assert_allclose(volts, 4.0 + slope * np.clip(np.arange(12) - 1.25, 0.0, 6.5), rtol=0, atol=1e-9)


@pytest.mark.parametrize("mode", [IC, POT_SET])
def test_every_mode_can_be_exported_and_agrees_with_ngspice(ngspice: NgSpice, mode: Mode) -> None:
    computer = SuspensionComputer("front", rng=np.random.default_rng(1)).machine
    computer.set_initial({"U2": -5.0, "U3": 7.0})
    computer.switch(mode)
    check_against_ngspice(ngspice, computer, UNLOCKED, 60)


def test_hold_drifts_by_the_offsets_as_in_ngspice(ngspice: NgSpice) -> None:
    """10 M from each junction to ground let an offset of 3 mV drift at 0.3 V/s on 1 nF."""
    front = SuspensionComputer("front", rng=np.random.default_rng(1)).circuit
    leaks = [Resistor(f"RIN{i}", f"s{i}", "0", 10e6) for i in (2, 3)]
    computer = AnalogComputer(Circuit([*front.elements, *leaks]), ["u2"], initial_v={"U2": 0.0, "U3": 0.0})
    computer.restart(HOLD)
    drift_v = check_against_ngspice(ngspice, computer, UNLOCKED, 200)[-1, 1]
    assert abs(drift_v) > LSB_V


def check_against_ngspice(ngspice: NgSpice, computer: AnalogComputer, excitation: Excitation, samples: int) -> Volts:
    nodes = ("u1", "u2", "u3", "u4", "u5")
    edges = {"F": excitation.edges(0, ticks(samples), 20e3)}
    deck = to_spice(computer.wiring, samples=samples, edges=edges)
    reference = ngspice(deck, nodes, samples)
    volts = np.empty((samples, len(nodes)))
    for k in range(samples):
        computer.run(1, {"F": excitation.edges(*computer.window(1), 20e3)})
        shown = computer.read()
        volts[k] = [shown[node] for node in nodes]
    assert np.abs(volts - reference).max() < 0.05 * LSB_V
    return volts


def test_a_limiter_across_the_capacitor_stays_there_and_readings_show_what_it_does() -> None:
    """It conducts from 5 V on, through 1 k: an initial 10 V, asked for through 10 k, ends at the divider of both."""
    limiter = DiodeLimiter("D1", "out", "s", 5.0, 1e3, 1e9)
    computer = machine(integrator([limiter]), 10.0, ic_ohm=10e3)
    last_v = computer.run(200)[-1, 0]
    through_limiter_s = 1e-3 - 1e-9
    settled_v = (10.0 / 10e3 + 5.0 * through_limiter_s) / (1 / 10e3 + 1e-9 + through_limiter_s)
    assert last_v == pytest.approx(settled_v, abs=1e-9)
    assert computer.read()["out"] == pytest.approx(settled_v, abs=1e-9)
    assert set(computer.lamps.values()) == {None}


def test_every_node_of_a_large_circuit_is_shown_and_played() -> None:
    """200 equal resistors in a row divide the voltage evenly."""
    nodes = ["in", *(f"n{i}" for i in range(1, 200)), "0"]
    row: list[Element] = [Resistor(f"R{i}", a, b, 1e3) for i, (a, b) in enumerate(itertools.pairwise(nodes))]
    circuit = Circuit([VoltageSource("V1", "in"), *row])
    computer = AnalogComputer(circuit, ["in"])
    computer.run(1, level(10.0))
    expected_v = 10.0 * (1.0 - np.arange(200) / 200)
    assert [computer.read()[node] for node in nodes[:-1]] == pytest.approx(expected_v.tolist(), abs=1e-9)
    assert Deck(circuit, samples=2, edges=level(10.0)).volts()[-1] == pytest.approx(expected_v, abs=1e-9)


def test_a_pot_into_a_limiter_is_read_and_set_as_the_engine_plays_it() -> None:
    """Half of 10 k on 10 V into R1 and, beyond 1 V, 10 ohm: by hand the wiper stands at 1.016 V."""
    computer = machine(integrator([DiodeLimiter("D1", "w", "0", 1.0, 10.0, 1e9)]), ic_ohm=None)
    computer.switch(POT_SET)
    legs, load, limiter = 2 / 5e3, 1 / 100e3 + 1e-9, 1 / 10.0 - 1e-9
    wiper_v = (10.0 / 5e3 + 1.0 * limiter) / (legs + load + limiter)
    assert computer.coefficient("P1") == pytest.approx(wiper_v / 10.0, abs=1e-9)
    computer.run(2, level(10.0))
    assert computer.read()["w"] == pytest.approx(wiper_v, abs=1e-6)
    computer.set_coefficient("P1", 0.1015)
    assert computer.coefficient("P1") == pytest.approx(0.1015, abs=1e-9)


def test_a_machine_that_charges_at_once_begins_where_its_limiters_leave_it() -> None:
    computer = SuspensionComputer(circuit_of("limited")).machine
    charged = AnalogComputer(computer.circuit, ["u1", "u3"], initial_v={"U2": 0.0, "U3": -8.0}, ic_ohm=None)
    volts = charged.run(50)
    assert volts[0, 0] == pytest.approx(13.364, abs=1e-3)
    np.testing.assert_allclose(volts, np.broadcast_to(volts[0], volts.shape), rtol=0, atol=1e-6)


def latching() -> AnalogComputer:
    """U2 doubles P1's wiper and feeds it back through S1 and a limiter: more than one for one when S1 is closed."""
    feedback: list[Element] = [
        Pot("P1", "in", "w", "0", 10e3, 0.5),
        OpAmp("U2", "w", "m", "o", IDEAL),
        Resistor("R1", "o", "m", 10e3),
        Resistor("R2", "m", "0", 10e3),
        DiodeLimiter("D1", "o", "f", 1.0, 1.0, 1e9),
        Switch("S1", "f", "w", 1.0, 1e9, closed=False),
    ]
    return AnalogComputer(Circuit([VoltageSource("V1", "in"), *feedback]), ["o"])


def test_a_switch_or_pot_that_the_engine_refuses_is_put_back_and_the_machine_plays_on() -> None:
    computer, undisturbed = latching(), latching()
    for each in (computer, undisturbed):
        each.turn({"P1": 0.0})
        each.run(3, level(1.0))
    computer.throw({"S1": True})
    undisturbed.throw({"S1": True})
    with pytest.raises(EngineError, match="no unique solution"):
        computer.turn({"P1": 0.5})
    assert computer.dials == {"P1": 0.0}
    np.testing.assert_array_equal(computer.run(5), undisturbed.run(5))
    for each in (computer, undisturbed):
        each.throw({"S1": False})
        each.turn({"P1": 0.5})
    with pytest.raises(EngineError, match="no unique solution"):
        computer.throw({"S1": True})
    assert not computer.circuit.of(Switch)[0].closed
    np.testing.assert_array_equal(computer.run(5), undisturbed.run(5))


def test_a_switch_of_the_circuit_can_be_thrown() -> None:
    computer = machine(integrator([Switch("S1", "in", "s", 100e3, 1e12, closed=False)]), ic_ohm=None)
    computer.switch(OPERATE)
    coefficient = coefficient_under_load(0.5, 10e3, 100e3)
    slopes = []
    for closed in (False, True):
        computer.throw({"S1": closed})
        slopes.append(np.diff(computer.run(5, level(2.0) if not closed else None)[:, 0])[-1])
    assert slopes[0] == pytest.approx(-2.0 * coefficient * SAMPLE_S / 1e-3, abs=1e-6)
    assert slopes[1] == pytest.approx(-2.0 * (1.0 + coefficient) * SAMPLE_S / 1e-3, abs=1e-6)
    assert computer.circuit.of(Switch)[0].closed
    with pytest.raises(CircuitError, match="no switch is called 'S2'; there are S1"):
        computer.throw({"S2": True})


# ---- the suspension, operated by hand


def free_response(program: str, x0: float, v0: float, times_s: Volts) -> Volts:
    """Displacement in m and velocity in m/s, (instants, 2), of M x'' + B x' + K x = 0, 200 times its own speed."""
    plant = {"front": FRONT, "shock": SHOCK}[program]
    a = np.array([[0.0, 1.0], [-plant.K_n_per_m / plant.M_kg, -plant.B_n_s_per_m / plant.M_kg]])
    return np.array([scipy.linalg.expm(a * 200.0 * t) @ (x0, v0) for t in times_s])


@pytest.mark.parametrize("program", ["front", "shock"])
def test_operate_from_an_initial_condition_is_the_free_response(program: str) -> None:
    computer = SuspensionComputer(program, opamp="ideal")
    volt_per_m, volt_per_m_s = computer.scales.volts("displacement"), computer.scales.volts("velocity")
    by_hand = computer.machine
    by_hand.set_initial({"U2": -0.5 * volt_per_m_s, "U3": -0.08 * volt_per_m})
    # 100 samples are 50 time constants of the larger capacitor.
    volts = by_hand.run(300, None, [(ticks(100.25), OPERATE), (ticks(120.75), HOLD), (ticks(180.125), OPERATE)])
    running_samples = np.clip(np.arange(100, 300) - 100.25, 0.0, 20.5) + np.maximum(np.arange(100, 300) - 180.125, 0.0)
    expected = free_response(program, 0.08, -0.5, running_samples * SAMPLE_S)
    np.testing.assert_allclose(volts[100:, 1], expected[:, 0] * volt_per_m, rtol=0, atol=1e-9)
    np.testing.assert_allclose(volts[100:, 2], expected[:, 1] * volt_per_m_s, rtol=0, atol=1e-9)


def test_the_states_are_continuous_where_relays_switch() -> None:
    computer = SuspensionComputer("front", rng=np.random.default_rng(1)).machine
    computer.set_initial({"U2": 3.0, "U3": -4.0})
    for mode in (HOLD, OPERATE, IC, POT_SET, IC, OPERATE, HOLD, POT_SET):
        computer.run(3, {"F": Excitation(frequency_hz=5e3).edges(*computer.window(3), 20e3)})
        before = charges(computer)
        computer.switch(mode)
        assert charges(computer) == pytest.approx(before, abs=1e-12)


def charges(computer: AnalogComputer) -> list[float]:
    volts = computer.read()
    return [volts["s2"] - volts["u2"], volts["s3"] - volts["u3"]]


def test_readings_of_every_mode_are_those_of_the_record() -> None:
    computer = SuspensionComputer("front").machine
    computer.set_initial({"U2": 3.0, "U3": -4.0})
    for mode in (IC, HOLD, OPERATE, HOLD, POT_SET):
        computer.switch(mode)
        last = computer.run(5, {"F": Excitation().edges(*computer.window(5), 20e3)})[-1]
        shown = computer.read()
        assert [shown[node] for node in ("in", "u5", "u2", "u1")] == pytest.approx(last.tolist(), abs=1e-12)
        assert shown.keys() == set(computer.circuit.nodes)


@st.composite
def operations(draw: st.DrawFn) -> list[RelaySwitch]:
    """Switches within 40 samples, every transition allowed."""
    instants = sorted(draw(st.lists(st.integers(0, ticks(39)), max_size=6)))
    switches, mode = [], IC
    for instant in instants:
        mode = draw(st.sampled_from([after for before, after in sorted(_ALLOWED, key=str) if before is mode]))
        switches.append((instant, mode))
    return switches


@settings(max_examples=40, deadline=None, derandomize=True)
@given(operations(), st.lists(st.integers(1, 12), max_size=4))
def test_a_run_may_be_cut_anywhere(switches: list[RelaySwitch], cuts: list[int]) -> None:
    excitation = Excitation(clock="free", phase=0.3, frequency_hz=900.0)
    assert sum(cuts) <= 48
    whole = played(switches, excitation, [50])
    assert np.array_equal(played(switches, excitation, [*cuts, 50 - sum(cuts)]), whole)


def played(switches: Sequence[RelaySwitch], excitation: Excitation, cuts: Sequence[int]) -> Volts:
    computer = SuspensionComputer("front").machine
    computer.set_initial({"U2": 2.0, "U3": -5.0})
    blocks, done = [], 0
    for samples in cuts:
        first = done
        while done < len(switches) and switches[done][0] < computer.window(samples)[1]:
            done += 1
        edges = {"F": excitation.edges(*computer.window(samples), 20e3)}
        blocks.append(computer.run(samples, edges, switches[first:done]))
    return np.concatenate(blocks)


# ---- repetitive operation


def test_repetitive_operation_repeats_bit_for_bit() -> None:
    front = SuspensionComputer("front", rng=np.random.default_rng(1))
    front.machine.turn({"K": 0.4})
    computer = AnalogComputer(front.circuit, ["u5", "u1"], initial_v={"U2": 1.0, "U3": -2.0}, ic_ohm=None)
    force = {"F": Edges(np.array([0, ticks(10.9), ticks(30.2)]), np.array([0.0, 10.0, -3.0]))}
    cycles = computer.repeat(5, ticks(4.3), ticks(55.7), force)
    assert cycles.shape == (5, 60, 2)
    assert all(np.array_equal(cycle, cycles[0]) for cycle in cycles)
    assert np.ptp(cycles[0, :, 0]) > 3.0
    assert computer.mode is OPERATE


def test_repetitive_operation_repeats_when_the_capacitors_have_time_to_charge() -> None:
    computer = machine(ic_ohm=10e3)
    cycles = computer.repeat(4, ticks(100), ticks(50), level(5.0))[:, :, 0]
    assert np.abs(cycles[1:] - cycles[0])[:, 60:].max() < 1e-12
    ramp = -5.0 * coefficient_under_load(0.5, 10e3, 100e3) * SAMPLE_S / 1e-3
    np.testing.assert_allclose(np.diff(cycles[:, 100:], axis=1), ramp, rtol=0, atol=1e-9)


def test_a_cycle_lasts_a_whole_number_of_samples() -> None:
    with pytest.raises(ModeError, match=r"a cycle of 4194304 \+ 1 ticks is no whole number of samples"):
        machine().repeat(2, ticks(1), 1)


# ---- transitions


@pytest.mark.parametrize("before", Mode)
@pytest.mark.parametrize("after", Mode)
def test_transitions_that_make_no_sense_are_refused_and_change_nothing(before: Mode, after: Mode) -> None:
    computer = machine()
    computer.restart(before)
    if before is after or (before, after) in _ALLOWED:
        computer.switch(after)
        assert computer.mode is after
        return
    with pytest.raises(ModeError, match=f"{before.value} cannot be followed by {after.value}, only by"):
        computer.run(5, switches=[(0, before), (ticks(1), after)])
    assert (computer.mode, computer.recorded) == (before, 0)


def test_the_present_mode_again_changes_no_bit() -> None:
    computers = machine(), machine()
    for computer in computers:
        computer.switch(OPERATE)
    computers[0].run(5, level(1.0))
    computers[1].run(5, level(1.0))
    computers[1].switch(OPERATE)
    assert np.array_equal(computers[0].run(5), computers[1].run(5))


@pytest.mark.parametrize("instants", [[5.5, 5.25], [3.0], [14.5]])
def test_switches_out_of_order_or_out_of_the_run_are_refused(instants: list[float]) -> None:
    computer = machine()
    computer.run(5)
    with pytest.raises(ModeError, match="not in order, or not within"):
        computer.run(10, switches=[(ticks(instant), IC) for instant in instants])
    assert computer.recorded == 5


def test_edges_beyond_the_run_are_refused_with_switches_too() -> None:
    with pytest.raises(EngineError, match="edges are out of order"):
        machine().run(5, level(1.0, ticks(7)), [(ticks(2.5), OPERATE)])


# ---- pots


@pytest.mark.parametrize("program", ["front", "shock"])
def test_pot_set_reads_coefficients_under_load(program: str) -> None:
    computer = SuspensionComputer(program, opamp="ideal")
    computer.machine.switch(POT_SET)
    for pot, expected in computer.coefficients.items():
        assert computer.machine.coefficient(pot) == pytest.approx(expected, rel=1e-9)


def test_a_pot_with_resistance_at_its_ends_is_read_at_its_terminals() -> None:
    """9990 of track, 5 at either end, 20 at the wiper; at 0.25 that is 2502.5 of 10 k; R1 takes all that it passes."""
    pot: list[Element] = [
        Pot("P1", "P1_top", "P1_wiper", "P1_bottom", 9990.0, 0.25),
        Resistor("P1_top_ohm", "in", "P1_top", 5.0),
        Resistor("P1_wiper_ohm", "P1_wiper", "w", 20.0),
        Resistor("P1_bottom_ohm", "P1_bottom", "0", 5.0),
    ]
    computer = machine(Circuit([*pot, *(part for part in integrator().elements if part.name != "P1")]))
    computer.switch(POT_SET)
    loaded = coefficient_under_load(0.25025, 10e3, 100e3 + 20.0) * 100e3 / (100e3 + 20.0)
    assert computer.coefficient("P1") == pytest.approx(loaded, rel=1e-9)


def test_pot_set_sets_coefficients_under_load() -> None:
    computer = SuspensionComputer("front", rng=np.random.default_rng(1))
    computer.machine.switch(POT_SET)
    wanted = computer.dials_for(M=30.0, B=3453.0, K=18000.0)
    for pot, coefficient in (("M", 0.980), ("B", 0.77987), ("K", 0.60980)):
        computer.machine.set_coefficient(pot, coefficient)
        assert computer.machine.coefficient(pot) == pytest.approx(coefficient, abs=1e-9)
    assert computer.dials == pytest.approx(wanted, abs=1e-4)


def test_pots_still_see_their_loads_while_no_amplifier_moves_in_pot_set() -> None:
    computer = SuspensionComputer("front", opamp="ideal").machine
    computer.switch(POT_SET)
    computer.run(200, {"F": Edges(np.array([0]), np.array([10.0]))})
    shown = computer.read()
    assert [shown[f"u{i}"] for i in range(1, 6)] == pytest.approx([0.0] * 5, abs=1e-9)


def test_a_coefficient_beyond_the_track_is_refused_and_nothing_turns() -> None:
    computer = machine()
    computer.switch(POT_SET)
    for coefficient in (-0.1, 1.1, math.nan):
        with pytest.raises(PotError, match="pot P1: coefficient .* is beyond the track"):
            computer.set_coefficient("P1", coefficient)
    assert computer.dials == {"P1": 0.5}
    computer.set_coefficient("P1", 1.0)
    computer.set_coefficient("P1", 0.0)
    assert computer.dials["P1"] == pytest.approx(0.0, abs=1e-5)


def test_coefficients_are_for_pot_set_and_for_pots_that_are_there() -> None:
    computer = machine()
    with pytest.raises(ModeError, match="read and set in POT SET, and this is INITIAL CONDITION"):
        computer.coefficient("P1")
    computer.switch(POT_SET)
    with pytest.raises(PotError, match="no pot is called 'P2'; there are P1"):
        computer.coefficient("P2")
    with pytest.raises(PotError, match="no pot is called 'P2'; there are P1"):
        computer.turn({"P1": 0.1, "P2": 0.1})
    assert computer.dials == {"P1": 0.5}


AT_REST_V = {"U2": 0.0, "U3": 0.0}
IMPOSSIBLE: Sequence[tuple[dict[str, Any], type[Exception], str]] = [
    *(({"sample_rate_hz": each}, EngineError, "sample_rate_hz must be") for each in (math.nan, math.inf, 0.0)),
    *(({"lamp_delay_s": each}, EngineError, "lamp_delay_s must be finite") for each in (math.nan, math.inf, -1.0)),
    ({"ic_ohm": -1.0}, CircuitError, "ic_ohm must be positive"),
    ({"readings": ["u5", "u9"]}, CircuitError, "readings: no node is called 'u9'; there are in, s1, u1"),
    ({"initial_v": {"U2": 0.0}}, CircuitError, r"OpAmp U3 .* an integrator needs an initial voltage, if only U3: 0.0"),
    ({"initial_v": AT_REST_V | {"U3": 50.0}}, CircuitError, "U3: initial voltage 50 V is beyond the reference of 10 V"),
    ({"initial_v": AT_REST_V | {"U3": math.nan}}, CircuitError, "U3: initial voltage nan is not finite"),
    ({"initial_v": {"U4": 1.0}}, CircuitError, r"OpAmp U4 \(0 s4 u4\): .* without a capacitor .* s4 and u4"),
    ({"initial_v": {"U9": 1.0}}, CircuitError, "no amplifier is called 'U9'; there are U1, U2, U3, U4, U5"),
]


@pytest.mark.parametrize(("wrong", "error", "message"), IMPOSSIBLE)
def test_a_machine_that_cannot_be_is_refused(wrong: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        AnalogComputer(SuspensionComputer().circuit, **{"readings": ["u1"], "initial_v": AT_REST_V} | wrong)


@pytest.mark.parametrize("initial_v", [{"U1": math.nan}, {"U2": 1.0}])
def test_an_initial_voltage_that_cannot_be_is_refused_and_not_set(initial_v: Mapping[str, float]) -> None:
    computer = machine(ic_ohm=None)
    with pytest.raises(CircuitError):
        computer.set_initial(initial_v)
    assert computer.read()["out"] == pytest.approx(4.0, abs=1e-12)


def test_a_circuit_too_large_is_refused_before_its_patching_is_looked_at() -> None:
    """A ladder of 4000 nodes in a row, which takes more than 90 s without limits."""
    ladder = [Resistor(f"R{i}", f"n{i}", f"n{i + 1}", 1.0) for i in range(4000)]
    circuit = Circuit([VoltageSource("V1", "n0"), *ladder, Resistor("Rend", "n4000", "0", 1.0)])
    with pytest.raises(CircuitError, match="4002 nodes and branches; the engine takes at most 640"):
        AnalogComputer(circuit, ["n1"])


# ---- overload


def acceleration_scaled(opamp: str = "tl07x") -> AnalogComputer:
    """The front suspension with the mass in front of the summer, which puts out acceleration: 10 V for 2940 N / 115 kg.

    Inputs of gain 10, so that the three pots pass 115 / (10 M) of 1, B vs / Fs and K xs / Fs.
    """
    model = preset(opamp)
    integrators: list[Element] = [
        OpAmp("U1", "0", "s1", "u1", model),
        Resistor("RFB", "s1", "u1", 100e3),
        Resistor("R1", "u1", "s2", 100e3 / 0.255652),
        Capacitor("C1", "s2", "u2", 1e-9),
        OpAmp("U2", "0", "s2", "u2", model),
        Resistor("R2", "u2", "s3", 49.9e3),
        Capacitor("C2", "s3", "u3", 10e-9),
        OpAmp("U3", "0", "s3", "u3", model),
        Resistor("R4", "u2", "s4", 10e3),
        Resistor("R4FB", "s4", "u4", 10e3),
        OpAmp("U4", "0", "s4", "u4", model),
    ]
    coefficients: list[Element] = []
    for pot, top in (("F", "in"), ("B", "u4"), ("K", "u3")):
        coefficients += [Pot(f"P{pot}", top, f"w{pot}", "0", 1e3, 0.5), Resistor(f"R{pot}", f"w{pot}", "s1", 10e3)]
    circuit = Circuit([VoltageSource("V1", "in"), *coefficients, *integrators])
    computer = AnalogComputer(circuit, ["u1", "u2", "u3"], initial_v={"U2": 0.0, "U3": 0.0})
    set_mass(computer, 115.0)
    computer.restart(OPERATE)
    return computer


def set_mass(computer: AnalogComputer, m_kg: float) -> None:
    """Coefficients read in POT SET on a machine of the same circuit."""
    bench = AnalogComputer(computer.circuit, ["u1"], initial_v={"U2": 0.0, "U3": 0.0})
    bench.switch(POT_SET)
    for pot, coefficient in (("PF", 1.0), ("PB", 3021.0 * 2.0 / 2940.0), ("PK", 24500.0 * 0.1996 / 2940.0)):
        bench.set_coefficient(pot, 0.1 * coefficient * 115.0 / m_kg)
    computer.turn(bench.dials)


def run_with_force(computer: AnalogComputer, samples: int) -> Volts:
    edges = {"V1": Excitation().edges(*computer.window(samples), 20e3)}
    return computer.run(samples, edges)


def test_the_mass_that_jumps_overloads_an_acceleration_scaled_summer_at_the_next_edge() -> None:
    """At M = 30 kg 2940 N ask 38 V of U1. The force steps at 600; 10 us later, before 601 is taken, the lamp lights."""
    computer = acceleration_scaled()
    run_with_force(computer, 571)
    assert set(computer.lamps.values()) == {None}
    set_mass(computer, 30.0)
    volts = run_with_force(computer, 30)
    assert set(computer.lamps.values()) == {None}
    assert abs(volts[0, 0]) < 13.5
    volts = run_with_force(computer, 30)
    assert computer.lamps == {"U1": 601, "U2": None, "U3": None, "U4": None}
    assert abs(volts).max() == pytest.approx(13.5, abs=0.02)


def test_a_lamp_stays_lit_until_it_is_cleared_and_lights_again_under_overload() -> None:
    computer = acceleration_scaled()
    run_with_force(computer, 571)
    set_mass(computer, 30.0)
    run_with_force(computer, 70)
    assert computer.lamps["U1"] == 601
    computer.clear_lamps()
    assert set(computer.lamps.values()) == {None}
    run_with_force(computer, 20)
    assert computer.lamps["U1"] == 651


def test_an_overload_shorter_than_the_delay_lights_nothing() -> None:
    """A TL07x follows a step of 10 V in 0.8 us; a lamp with 0.5 us of patience sees it, one with 1 us does not."""
    elements = integrator(model=preset("tl07x")).elements
    inverter: list[Element] = [
        Resistor("R2", "in", "n", 1e4),
        Resistor("R3", "n", "o", 1e4),
        OpAmp("U2", "0", "n", "o", preset("tl07x")),
    ]
    for delay_s, sample in ((0.5e-6, 1), (1e-6, None)):
        computer = machine(Circuit([*elements, *inverter]), lamp_delay_s=delay_s)
        computer.run(3, level(10.0, ticks(0.5)))
        assert computer.lamps == {"U1": None, "U2": sample}


@pytest.mark.parametrize("stock", ["polyester", "polypropylene"])
def test_a_machine_of_real_components_is_set_charged_and_held(stock: str) -> None:
    """Coefficients as pot.py has them; HOLD loses less than an LSB in 100 samples but does lose."""
    computer = SuspensionComputer("front", components=COMPONENTS[stock])
    by_hand = computer.machine
    by_hand.set_initial({"U2": 5.0, "U3": -5.0})
    by_hand.switch(POT_SET)
    for pot, expected in computer.coefficients.items():
        assert by_hand.coefficient(pot) == pytest.approx(expected, abs=1e-6)
    by_hand.switch(IC)
    by_hand.run(30000)
    assert by_hand.read()["u3"] == pytest.approx(-5.0, abs=0.12)
    by_hand.switch(HOLD)
    held = by_hand.run(101)[:, 1]
    assert 1e-6 < abs(held[-1] - held[0]) < LSB_V


@pytest.mark.parametrize("load", ["R1", "M_load"])
@pytest.mark.parametrize("noise_ohm", [0.0, 100.0])
def test_a_coefficient_is_read_beyond_the_wiper_whatever_its_load_is_called(load: str, noise_ohm: float) -> None:
    """10k at half its track into a wiper of 5k and a load of 95k: 1/2 / (1 + 1/4 10k / 100k) of which 95 %."""
    parts = Components(pots=PotGrade(wiper_ohm=5e3, wiper_noise_ohm=noise_ohm))
    elements: list[Element] = [
        VoltageSource("V1", "in"),
        Pot("M", "in", "M_w", "0", 10e3, 0.5),
        Resistor(load, "M_w", "s", 95e3),
        Resistor("R2", "s", "out", 1e5),
        OpAmp("U1", "0", "s", "out", IDEAL),
    ]
    machine = AnalogComputer(Circuit(parts.fit(elements)), ["out"], components=parts)
    machine.switch(Mode.POT_SET)
    assert machine.coefficient("M") == pytest.approx(0.5 / 1.025 * 0.95, rel=1e-5)


# ---- overloads: the table of the background page on the circuit


QUIET: dict[str, float] = {}


def lit(program: str, step_v: float = 0.0, opamp: str = "tl07x", **settings: float) -> set[str]:
    """The lamps after 400 samples of a square wave of 0..10 V, or of +-step_v / 2."""
    computer = SuspensionComputer(program, opamp=opamp)
    computer.set(**settings)
    excitation = Excitation(low_v=-step_v / 2, high_v=step_v / 2) if step_v else Excitation()
    for _ in computer.play(excitation, 400):
        pass
    return {amplifier for amplifier, sample in computer.machine.lamps.items() if sample is not None}


@pytest.mark.parametrize("program", PROGRAMS)
def test_nothing_overloads_at_the_programs_own_values(program: str) -> None:
    assert lit(program) == set()


@pytest.mark.parametrize(
    ("program", "good", "bad", "lamps"),
    [
        ("front", {"step_v": 13.5}, {"step_v": 16.0}, ("U1",)),
        ("shock", {"step_v": 16.0}, {"step_v": 20.0}, ("U2", "U4")),
        ("front", {"K": 9.8e3}, {"K": 8.6e3}, ("U3",)),
        ("shock", {"K": 6e3}, {"K": 4.9e3}, ("U3",)),
        ("shock", {"B": 540.0}, {"B": 450.0}, ("U2", "U4")),
        ("front", {"B": 150.0}, QUIET, ()),
        ("front", {"M": 29.5}, QUIET, ()),
        ("shock", {"M": 1.5}, QUIET, ()),
    ],
    ids=str,
)
def test_what_overloads(program: str, good: dict[str, float], bad: dict[str, float], lamps: tuple[str, ...]) -> None:
    assert lit(program, **good) == set()  # type: ignore[arg-type]
    assert lit(program, **bad) == set(lamps)  # type: ignore[arg-type]


@pytest.mark.parametrize("program", PROGRAMS)
def test_741s_slew_so_long_at_an_edge_that_the_summers_lamp_lights(program: str) -> None:
    assert "U1" in lit(program, opamp="741")


def test_stiffness_back_as_the_force_falls_clamps_the_summer_too_shortly_for_its_lamp() -> None:
    """K x = 24500 N/m times 0.163 m are 13.6 V; at 1 MHz the swing of 13.5 V shows, less what Rout takes."""
    computer = SuspensionComputer("front", sample_rate_hz=1e6)
    changes = [PotTurn(20, {"K": 18000.0}), PotTurn(7500, {"K": 24500.0})]
    volts = np.concatenate(list(computer.play(Excitation(frequency_hz=20e3 / 300), 7600, changes)))
    assert volts[7499, 1] * 24500.0 * 0.01996 / 294.0 == pytest.approx(13.6, abs=0.05)
    clamped = np.flatnonzero(volts[:, 3] < -13.34)
    assert 2 <= len(clamped) < 10
    assert computer.machine.lamps["U1"] is None


@pytest.mark.parametrize(
    ("program", "limits"),
    [
        ("front", {"M": (29.5, 29.3), "B": (4427.0, 4429.0), "K": (29517.0, 29519.0)}),
        ("shock", {"M": (1.48, 1.46), "B": (2213.0, 2214.5), "K": (14758.0, 14760.0)}),
    ],
)
def test_the_ends_of_the_pots(program: str, limits: dict[str, tuple[float, float]]) -> None:
    computer = SuspensionComputer(program)
    for name, (within, beyond) in limits.items():
        computer.set(**{name: within})
        with pytest.raises(PotError, match="beyond the track"):
            computer.set(**{name: beyond})


@pytest.mark.parametrize(
    ("program", "op_amps", "farads", "pots", "ohms"),
    [
        ("front", 5, {1e-9: 1, 1e-8: 1}, 3, {100e3: 3, 49.9e3: 2, 10e3: 4, 33.2e3: 1}),
        ("shock", 5, {1e-9: 1, 1e-8: 1}, 3, {100e3: 2, 49.9e3: 2, 10e3: 5, 33.2e3: 1}),
    ],
)
def test_the_list_of_components(
    program: str, op_amps: int, farads: dict[float, int], pots: int, ohms: dict[float, int]
) -> None:
    circuit = SuspensionComputer(program).circuit
    assert (len(circuit.of(OpAmp)), len(circuit.of(Pot))) == (op_amps, pots)
    for found, listed in (
        ([part.farad for part in circuit.of(Capacitor)], farads),
        ([part.ohm for part in circuit.of(Resistor)], ohms),
    ):
        assert {value: found.count(value) for value in found} == listed


def test_figures_to_check_a_new_machine_with() -> None:
    for program, peak_v in (("front", 3.5), ("shock", 7.5)):
        volts = np.concatenate(list(SuspensionComputer(program).play(Excitation(), 400)))
        assert volts[45:50, 1].max() == pytest.approx(6.01, abs=0.05)
        assert volts[:, 2].max() == pytest.approx(peak_v, abs=0.1)
