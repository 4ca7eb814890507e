"""Real components: drawn, given, warmed, aged, and each of their faults by itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from analogrig_emulator import (
    COMPONENTS,
    DIELECTRICS,
    IDEAL,
    Capacitor,
    Circuit,
    CircuitError,
    Components,
    Dielectric,
    Edges,
    Engine,
    Excitation,
    Grade,
    OpAmp,
    OpAmpGrade,
    OpAmpModel,
    Pot,
    PotError,
    PotGrade,
    PotModel,
    Resistor,
    SuspensionComputer,
    VoltageSource,
    piecewise_linear,
    preset,
    to_spice,
)
from analogrig_emulator.circuit.circuit import Element
from tests.emulator.plays import LSB_V, NgSpice

NETLIST: tuple[Element, ...] = (
    VoltageSource("F", "in"),
    Resistor("R1", "in", "s", 10e3),
    Capacitor("C1", "s", "out", 1e-9),
    OpAmp("U1", "0", "s", "out", IDEAL),
    Pot("P", "out", "w", "0", 10e3, 0.5),
    Resistor("RL", "w", "0", 100e3),
)


def fitted(components: Components, netlist: Sequence[Element] = NETLIST) -> dict[str, Element]:
    return {element.name: element for element in components.fit(netlist)}


def value(elements: dict[str, Element], name: str) -> float:
    element = elements[name]
    assert isinstance(element, Resistor | Capacitor)
    return element.ohm if isinstance(element, Resistor) else element.farad


def model(elements: dict[str, Element], name: str) -> OpAmpModel:
    element = elements[name]
    assert isinstance(element, OpAmp)
    return element.model


def displacement_v(components: Components, samples: int = 800) -> np.ndarray:
    return np.concatenate(list(SuspensionComputer("front", components=components).play(Excitation(), samples)))[:, 1]


def test_perfect_components_change_no_bit() -> None:
    assert Components().fit(NETLIST) == NETLIST
    assert Components(seed=7, temperature_c=80.0, age_h=1e5).fit(NETLIST) == NETLIST


def test_tolerances_fill_their_range_evenly() -> None:
    """400 draws: the extremes come within 1 % of the bounds' width but for a probability of 2 x 0.99^400 = 4 %; the
    seeds are fixed. The mean of a uniform variable over 400 has the standard error 1 / sqrt(1200)."""
    deviations = np.array(
        [value(fitted(Components(resistors=Grade(0.05), seed=i)), "R1") / 10e3 - 1 for i in range(400)]
    )
    assert np.abs(deviations).max() <= 0.05
    assert deviations.max() > 0.049
    assert deviations.min() < -0.049
    assert abs(deviations.mean()) < 0.05 * 4 / math.sqrt(1200)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, len(NETLIST)))
def test_adding_an_element_changes_no_other_draw(seed: int, place: int) -> None:
    components = replace(COMPONENTS["polyester"], seed=seed)
    longer = (*NETLIST[:place], Resistor("extra", "in", "0", 1e3), *NETLIST[place:])
    before, after = fitted(components), fitted(components, longer)
    assert {name: after[name] for name in before} == before


def test_switching_one_fault_on_changes_no_other_draw() -> None:
    resistors_only = fitted(Components(resistors=Grade(0.01), seed=3))
    warm = Components(resistors=Grade(0.01), dielectric=DIELECTRICS["polyester"], op_amps=OpAmpGrade(offset_v=1e-3))
    assert value(fitted(replace(warm, seed=3)), "R1") == value(resistors_only, "R1")


def test_given_deviations_take_the_place_of_the_drawn() -> None:
    parts = fitted(Components(resistors=Grade(0.05), given={"R1": 0.02, "U1": -1e-3, "P": 0.1}, seed=1))
    assert value(parts, "R1") == pytest.approx(10.2e3)
    assert model(parts, "U1").vos_v == -1e-3
    track = parts["P"]
    assert isinstance(track, Pot) and track.track_ohm == pytest.approx(11e3)
    assert value(parts, "RL") != 100e3


def test_given_bandwidth_and_slew_take_the_place_of_the_drawn_and_of_nothing_else() -> None:
    netlist = (*NETLIST, OpAmp("U2", "0", "s", "out2", preset("tl07x")))
    drawn = Components(op_amps=OpAmpGrade(offset_v=3e-3, bandwidth=0.2, slew=0.2), seed=5)
    known = replace(drawn, given_bandwidth={"U2": 0.1}, given_slew={"U2": -0.05})
    there, before = model(fitted(known, netlist), "U2"), model(fitted(drawn, netlist), "U2")
    assert (there.gbw_hz, there.slew_v_per_s) == pytest.approx((3.3e6, 12.35e6))
    assert there.vos_v == before.vos_v


def test_what_is_undrawn_is_the_same_for_every_seed_and_keeps_what_all_specimens_share() -> None:
    stock = replace(COMPONENTS["polyester"].without_draws(), temperature_c=35.0, age_h=1e4)
    machines = [fitted(replace(stock, seed=seed)) for seed in (1, 2)]
    assert machines[0] == machines[1]
    assert value(machines[0], "R1") == 10e3
    assert value(machines[0], "C1") == pytest.approx(1e-9 * (1 + 400e-6 * 10) * DIELECTRICS["polyester"].instantaneous)
    assert {"C1_leak", "C1_soak1", "P_wiper_ohm"} <= set(machines[0])
    assert stock.pots.windings == 0


def test_temperature_and_age_change_values_by_their_law() -> None:
    cold = Grade(temperature_per_k=100e-6)
    assert value(fitted(Components(capacitors=cold, temperature_c=35.0)), "C1") == pytest.approx(1e-9 * 1.001)
    worn = [
        value(fitted(Components(resistors=Grade(ageing=0.01), age_h=hours)), "R1") / 10e3 - 1
        for hours in (1000.0, 4000.0)
    ]
    assert 0 < abs(worn[0]) <= 0.01
    assert worn[1] == pytest.approx(2 * worn[0])


def test_offset_drifts_and_bias_of_a_fet_doubles_with_warming() -> None:
    grade = OpAmpGrade(offset_v_per_k=10e-6, bias_a=65e-12, bias_doubles_k=10.0)
    warm = fitted(Components(op_amps=grade, temperature_c=45.0))
    assert 0 < abs(model(warm, "U1").vos_v) <= 200e-6
    bias = warm["U1_minus_bias"]
    assert isinstance(bias, VoltageSource) and bias.dc_v == pytest.approx(-65e-12 * 4e12)
    assert "U1_plus_bias" not in warm  # the + input is at ground


def test_bias_current_ramps_an_integrator_as_i_over_c() -> None:
    """With the input at ground, 1 nA into the summing junction of 1 nF: dv/dt = +1 V/s."""
    parts = Components(op_amps=OpAmpGrade(bias_a=1e-9, input_ohm=1e12)).fit(NETLIST)
    engine = Engine(piecewise_linear(Circuit(parts)), ("out",))
    out_v = engine.run(2001)[:, 0]
    assert out_v[-1] - out_v[0] == pytest.approx(1.0 * 2000 * 50e-6, rel=1e-6)


def test_dielectric_absorption_gives_back_part_of_the_charge() -> None:
    """Step response of 10 k into a lossy capacitor against scipy's integration of the same branches."""
    dielectric = Dielectric(leakage_s=1e-2, absorption=((0.02, 1e-3), (0.01, 1e-4)))
    netlist = (VoltageSource("F", "in"), Resistor("R", "in", "c", 10e3), Capacitor("C", "c", "0", 1e-8))
    circuit = Circuit(Components(dielectric=dielectric).fit(netlist))
    edges = Edges(np.array([0, 20 << 22]), np.array([10.0, 0.0]))
    volts = Engine(piecewise_linear(circuit), ("c",)).run(60, {"F": edges})[:, 0]

    def slope(_: float, v: np.ndarray, drive_v: float) -> list[float]:
        soak_a = [(v[0] - v[i]) * f * 1e-8 / tau for i, (f, tau) in enumerate(dielectric.absorption, start=1)]
        current = (drive_v - v[0]) / 10e3 - sum(soak_a) - v[0] * 1e-8 / 1e-2
        return [current / 1e-8, *((v[0] - v[i]) / tau for i, (_, tau) in enumerate(dielectric.absorption, start=1))]

    settings_ = {"rtol": 1e-10, "atol": 1e-12, "method": "LSODA"}
    times_s = np.arange(21) * 50e-6
    up = scipy.integrate.solve_ivp(slope, (0, 1e-3), [0, 0, 0], t_eval=times_s, args=(10.0,), **settings_)
    times_s = np.arange(40) * 50e-6
    down = scipy.integrate.solve_ivp(slope, (0, 2e-3), up.y[:, -1], t_eval=times_s, args=(0.0,), **settings_)
    np.testing.assert_allclose(volts, np.append(up.y[0, :-1], down.y[0]), rtol=0, atol=1e-7)


@pytest.mark.parametrize("load_ohm", [10e3, 100e3])
def test_a_real_pot_passes_what_its_network_passes(load_ohm: float) -> None:
    grade = PotGrade(wiper_ohm=50.0, end_ohm=20.0)
    netlist = (VoltageSource("F", "in"), Pot("P", "in", "w", "0", 10e3, 0.3), Resistor("RL", "w", "0", load_ohm))
    system = piecewise_linear(Circuit(Components(pots=grade).fit(netlist)))
    assert grade.model(10e3).coefficient(0.3, load_ohm) == pytest.approx(
        float(system.readings(("w",))[0, 0]), rel=1e-12
    )


@settings(deadline=None)
@given(st.floats(0.0, 1.0), st.floats(0.0, 100.0), st.floats(0.0, 100.0), st.floats(1e3, 1e6))
def test_the_dial_undoes_the_coefficient(dial: float, wiper_ohm: float, end_ohm: float, load_ohm: float) -> None:
    pot = PotModel(10e3, wiper_ohm, end_ohm)
    try:
        again = pot.dial(pot.coefficient(dial, load_ohm), load_ohm)
    except PotError:  # rounding at the very stop
        assert min(dial, 1 - dial) < 1e-12
    else:
        assert again == pytest.approx(dial, abs=1e-11)


def test_end_stops_limit_the_coefficient() -> None:
    message = r"pot M: coefficient 0.0001 is beyond the track \(0.0019917 to 0.9978\)"
    with pytest.raises(PotError, match=message):
        PotModel(10e3, end_ohm=20.0).dial(1e-4, 1e5, "M")


def test_the_wiper_rests_on_a_winding() -> None:
    computer = SuspensionComputer("front", components=Components(pots=PotGrade(windings=1000)))
    computer.set(K_dial=0.12345)
    assert computer.dials["K"] == 0.123
    assert all(dial * 1000 == pytest.approx(round(dial * 1000)) for dial in computer.dials.values())


def test_a_coefficient_is_set_with_the_real_load_and_track() -> None:
    """Pots pass the program's coefficients, whatever track, wiper and load are: they are set, not read."""
    components = replace(COMPONENTS["polypropylene"], seed=5, pots=PotGrade(Grade(0.05), wiper_ohm=30.0, end_ohm=5.0))
    coefficients = SuspensionComputer("front", components=components).coefficients
    assert coefficients == pytest.approx(SuspensionComputer("front").coefficients, rel=1e-12)


def test_the_same_seed_gives_the_same_machine() -> None:
    machine = replace(COMPONENTS["polyester"], seed=11)
    assert displacement_v(machine, 100).tobytes() == displacement_v(replace(machine), 100).tobytes()
    assert np.abs(displacement_v(replace(machine, seed=12), 100) - displacement_v(machine, 100)).max() > LSB_V


@pytest.mark.parametrize("op_amp", ["tl07x", "opa627"])
def test_a_real_machine_agrees_with_ngspice(ngspice: NgSpice, op_amp: str) -> None:
    components = replace(COMPONENTS["polyester"], seed=4, temperature_c=40.0, age_h=2000.0)
    computer = SuspensionComputer("front", opamp=preset(op_amp), components=components)
    samples, nodes = 120, ("u1", "u2", "u3", "u4", "u5")
    edges = {"F": Excitation().edges(0, (samples - 1) << 22, 20e3)}
    deck = to_spice(computer.circuit, samples=samples, edges=edges, nodes=nodes)
    engine = Engine(piecewise_linear(computer.circuit), nodes)
    volts = engine.run(samples, edges)
    # At the instant of an edge ngspice still shows the level before it, and so does the summer behind it.
    quiet = [k for k in range(samples) if k % 50 != 0]
    assert np.abs(ngspice(deck, nodes, samples) - volts)[quiet].max() < 0.05 * LSB_V


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Grade(tolerance=-0.1), "Grade: tolerance"),
        (lambda: Grade(ageing=math.nan), "Grade: ageing"),
        (lambda: Dielectric(absorption=((0.1, 0.0),)), "Dielectric: absorption"),
        (lambda: OpAmpGrade(offset_v=math.inf), "OpAmpGrade: offset_v"),
        (lambda: OpAmpGrade(bias_a=1e-9, input_ohm=math.inf), "OpAmpGrade: input_ohm"),
        (lambda: PotGrade(wiper_ohm=-1.0), "pot: wiper_ohm"),
        (lambda: Components(temperature_c=400.0), "Components: temperature_c"),
        (lambda: Components(given={"R9": 0.1}).fit(NETLIST), "no element is called 'R9'"),
        (lambda: Components(given_slew={"R1": 0.1}).fit(NETLIST), "given_slew: no op-amp is called 'R1'"),
        (lambda: Components(given_bandwidth={"U9": 0.1}).fit(NETLIST), "given_bandwidth: no op-amp is called 'U9'"),
        (lambda: Components(given={"R1": -1.0}).fit(NETLIST), "R1 would have 0 times its nominal value"),
    ],
)
def test_what_cannot_be_is_refused_by_name(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(CircuitError, match=message):
        make()
