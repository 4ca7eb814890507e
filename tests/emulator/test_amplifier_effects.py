"""Common mode, output current, recovery, hum and 1/f noise of op-amps against closed forms and ngspice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from analogrig_emulator import (
    COMPONENTS,
    DIELECTRICS,
    FINE_OP_AMP_GRADES,
    MULTIPLIER_GRADES,
    MULTIPLIERS,
    OP_AMP_GRADES,
    TICKS_PER_SAMPLE,
    Capacitor,
    Circuit,
    CircuitError,
    CircuitNoise,
    Components,
    Deck,
    Edges,
    Engine,
    Excitation,
    Multiplier,
    NoisySuspension,
    OpAmp,
    OpAmpGrade,
    OpAmpModel,
    PotTurn,
    Resistor,
    Supply,
    SuspensionComputer,
    VoltageSource,
    piecewise_linear,
)
from analogrig_emulator.circuit.circuit import Element
from analogrig_emulator.circuit.opamp import CLAMP_RATE, PRESETS
from tests.emulator.plays import LSB_V, NgSpice

TL07X = PRESETS["tl07x"]


def inverter(model: OpAmpModel, load_ohm: float = 10e3) -> Circuit:
    """Gain of -1 by two resistors of 10 k."""
    return Circuit(
        [
            VoltageSource("F", "in"),
            Resistor("R1", "in", "s", 10e3),
            Resistor("R2", "s", "out", 10e3),
            OpAmp("U1", "0", "s", "out", model),
            Resistor("RL", "out", "0", load_ohm),
        ]
    )


def follower(model: OpAmpModel) -> Circuit:
    return Circuit([VoltageSource("F", "in"), OpAmp("U1", "in", "out", "out", model)])


@pytest.mark.parametrize("model", [OpAmpModel(), OpAmpModel(gbw_hz=3e6)], ids=["ideal", "with a pole"])
def test_a_follower_shows_its_common_mode(model: OpAmpModel) -> None:
    """v+ - v- + (v+ + v-) / (2 CMRR) = 0: out = in (1 + 1/2C) / (1 - 1/2C)."""
    at_rest = piecewise_linear(follower(replace(model, cmrr=1e3))).rest(np.array([5.0]))
    assert at_rest.volts["out"] == pytest.approx(5.0 * (1 + 0.5e-3) / (1 - 0.5e-3), rel=1e-12)
    assert piecewise_linear(follower(model)).rest(np.array([5.0])).volts["out"] == pytest.approx(5.0, rel=1e-12)


@pytest.mark.parametrize("load_ohm", [100.0, 300.0])
def test_an_output_gives_no_more_than_its_current(load_ohm: float) -> None:
    """Load and feedback share the current; at full slew it is SR / (CLAMP_RATE Rout) beyond the limit."""
    model = replace(TL07X, current_limit_a=20e-3)
    volts = piecewise_linear(inverter(model, load_ohm)).rest(np.array([9.0])).volts
    current_a = -volts["out"] / load_ohm + (9.0 - volts["out"]) / 20e3
    assert current_a == pytest.approx(20e-3 + TL07X.slew_v_per_s / CLAMP_RATE / TL07X.rout_ohm, rel=1e-9)
    light = piecewise_linear(inverter(model)).rest(np.array([9.0])).volts
    assert light["out"] == piecewise_linear(inverter(TL07X)).rest(np.array([9.0])).volts["out"]


@pytest.mark.parametrize("recovery_s", [1e-6, 7e-6])
def test_an_output_stays_at_its_swing_for_the_time_of_recovery(recovery_s: float) -> None:
    edges = Edges(np.array([0, 2000 * TICKS_PER_SAMPLE]), np.array([-30.0, 0.0]))

    def leaves_at_s(model: OpAmpModel) -> float:
        volts = Engine(piecewise_linear(inverter(model)), ["out"], 100e6).run(4000, {"F": edges})[2000:, 0]
        return int(np.argmax(volts < 13.0)) / 100e6

    late_s = leaves_at_s(replace(TL07X, recovery_s=recovery_s)) - leaves_at_s(TL07X)
    assert late_s == pytest.approx(recovery_s, abs=2e-8)


def test_the_lamp_of_an_overload_that_is_recovered_from_lights_as_without() -> None:
    lamps = [
        SuspensionComputer(
            "front", opamp=replace(TL07X, recovery_s=recovery_s), components=Components(given={"RFB": 1.0})
        )
        for recovery_s in (0.0, 5e-6)
    ]
    for computer in lamps:
        list(computer.play(Excitation(low_v=-10.0), 200))
    assert lamps[0].machine.lamps["U1"] is not None
    assert lamps[1].machine.lamps == lamps[0].machine.lamps


@pytest.mark.parametrize(
    "fields",
    [
        {"current_limit_a": 2e-3},
        {"recovery_s": 3e-6},
        {"cmrr": 100.0},
        {"current_limit_a": 3e-3, "recovery_s": 3e-6, "cmrr": 300.0},
    ],
    ids=["current", "recovery", "common mode", "all"],
)
def test_an_overdriven_amplifier_agrees_with_ngspice(ngspice: NgSpice, fields: dict[str, Any]) -> None:
    model = replace(TL07X, **fields)
    elements: Sequence[Element] = (
        VoltageSource("F", "in"),
        Resistor("R1", "in", "s", 10e3),
        Resistor("R2", "s", "out", 18e3),
        Resistor("R3", "in", "p", 10e3),
        Resistor("R4", "p", "0", 1e3),
        OpAmp("U1", "p", "s", "out", model),
        Resistor("RL", "out", "0", 5e3),
        Capacitor("CL", "out", "0", 1e-9),
    )
    ticks = np.array([0.0, 0.96, 1.98, 2.94, 3.97, 5.9]) * TICKS_PER_SAMPLE
    edges = {"F": Edges(ticks.astype(np.int64), np.array([0.0, 9.0, -9.0, 2.0, 9.0, -2.0]))}
    deck = Deck(Circuit(elements), samples=12, edges=edges)
    assert np.abs(deck.volts(["out"]) - ngspice(deck.text(["out"]), ["out"], 12)).max() < 0.05 * LSB_V
    plain = Deck(Circuit([*elements[:5], OpAmp("U1", "p", "s", "out", TL07X), *elements[6:]]), samples=12, edges=edges)
    assert np.abs(deck.volts(["out"]) - plain.volts(["out"])).max() > LSB_V


def test_a_real_machine_with_every_effect_agrees_with_ngspice(ngspice: NgSpice) -> None:
    """Input capacitances, absorption from 10 us on, common mode and limited currents; at a free instant."""
    real = replace(COMPONENTS["polyester"], op_amps=replace(FINE_OP_AMP_GRADES["741"], recovery_s=2e-6), seed=3)
    computer = SuspensionComputer("front", opamp="741", components=real)
    excitation, nodes = Excitation(low_v=-8.0, clock="free", phase=0.637), ["u1", "u2", "u5"]
    edges = {"F": excitation.edges(0, 120 * TICKS_PER_SAMPLE, 20e3)}
    deck = Deck(computer.circuit, samples=120, edges=edges)
    assert np.abs(deck.volts(nodes) - ngspice(deck.text(nodes), nodes, 120)).max() < 0.05 * LSB_V


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"current_limit_a": 1e-3}, "current_limit_a needs"),
        ({"recovery_s": 1e-6, "gbw_hz": 1e6}, "recovery_s needs"),
        ({"recovery_s": -1.0}, "recovery_s must be"),
        ({"cmrr": 0.0}, "cmrr must be positive"),
    ],
)
def test_effects_that_the_model_cannot_have_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        OpAmpModel(**fields)


def test_every_grade_has_the_figures_of_its_data_sheet() -> None:
    for name, grade in FINE_OP_AMP_GRADES.items():
        if name != "ideal":
            assert 1e-12 <= grade.input_farad <= 20e-12
            assert 20 * math.log10(min(grade.cmrr, grade.psrr)) + 0.2 >= 90
            assert 20 * math.log10(max(grade.cmrr, grade.psrr)) < 121
            assert 25e-3 <= grade.current_limit_a <= 55e-3 and grade.flicker_hz > 0


@pytest.mark.parametrize("name", [name for name in OP_AMP_GRADES if name != "ideal"])
def test_a_coarse_grade_lacks_what_makes_less_than_a_tenth_of_an_lsb(name: str) -> None:
    """Displacement of both suspensions, with a change of the spring; 1/f noise is in the table of effects."""
    fine, coarse = FINE_OP_AMP_GRADES[name], OP_AMP_GRADES[name]
    left_out = {"cmrr": fine.cmrr, "current_limit_a": fine.current_limit_a, "flicker_hz": fine.flicker_hz}
    if not coarse.input_farad:
        left_out["input_farad"] = fine.input_farad
    assert replace(coarse, **left_out) == fine
    for program in ("front", "shock"):
        with_them, without = (
            SuspensionComputer(program, opamp=name, components=Components(op_amps=grade))
            for grade in (OpAmpGrade(**left_out), OpAmpGrade())
        )
        turn = PotTurn(200, {"K": 0.8 * with_them.program.values["K"]})
        volts = [np.concatenate(list(each.play(Excitation(), 400, [turn]))) for each in (with_them, without)]
        assert 0.0 < np.abs(volts[0] - volts[1])[:, 1].max() < 0.1 * LSB_V


# ---- dielectric absorption


@pytest.mark.parametrize("name", ["polyester", "polypropylene"])
def test_a_capacitor_has_its_marked_value_at_1_khz(name: str) -> None:
    parts = Components(dielectric=DIELECTRICS[name]).fit([Capacitor("C", "a", "0", 1e-9), Resistor("R", "a", "0", 1.0)])
    farads = {part.name: part.farad for part in parts if isinstance(part, Capacitor)}
    ohms = {part.name: part.ohm for part in parts if isinstance(part, Resistor)}
    s = 2j * math.pi * 1e3
    admittance = s * farads["C"] + sum(
        s * farad / (1 + s * farad * ohms[f"{soak}_ohm"]) for soak, farad in farads.items() if soak != "C"
    )
    assert admittance.imag / abs(s) == pytest.approx(1e-9, rel=1e-12)


def test_the_loss_angle_is_flat_from_10_hz_to_3_khz() -> None:
    """The branches make the dielectric's tan delta of 0.2 % constant but for a ripple of a fifth."""
    branches = DIELECTRICS["polyester"].absorption
    for hz in np.geomspace(10.0, 3e3, 40):
        s = 2j * math.pi * hz
        c = 1 + sum(part / (1 + s * tau_s) for part, tau_s in branches)
        assert -c.imag / c.real == pytest.approx(2e-3, rel=0.2)


# ---- noise and hum


def spectrum(noise: CircuitNoise, states: int, hz: float, rate_hz: float) -> float:
    """One-sided density of a state of the sampled noise, V^2/Hz."""
    turn = np.exp(2j * math.pi * hz / rate_hz)
    gain = np.linalg.inv(turn * np.eye(len(noise.transition)) - noise.transition)[states]
    return float(2.0 / rate_hz * (gain @ noise.covariance @ gain.conj()).real)


@pytest.mark.parametrize("hz", [2.0, 10.0, 30.0, 100.0, 300.0])
def test_noise_of_an_amplifier_is_white_plus_one_over_f(hz: float) -> None:
    """Follower: the density of the data sheet, en^2 (1 + fc / f), within the ripple of one process a decade."""
    grade = OpAmpGrade(noise_v_per_rthz=18e-9, flicker_hz=100.0)
    noise = CircuitNoise(follower(OpAmpModel(gbw_hz=3e4)), ["out"], op_amps=grade, sample_rate_hz=1e6)
    assert spectrum(noise, 0, hz, 1e6) == pytest.approx((18e-9) ** 2 * (1 + 100.0 / hz), rel=0.12)


def test_one_over_f_noise_begins_as_it_goes_on() -> None:
    """Over seeds, the first levels have the variance of the stationary state."""
    grade, circuit = OpAmpGrade(noise_v_per_rthz=18e-9, flicker_hz=1e4), follower(OpAmpModel(gbw_hz=1e5))

    def noise() -> CircuitNoise:
        return CircuitNoise(circuit, ["out"], op_amps=grade, sample_rate_hz=1e3)

    volts = [noise().volts(2, np.random.default_rng(s))[1, 0] for s in range(400)]
    still = noise()
    state = scipy.linalg.solve_discrete_lyapunov(still.transition, still.covariance)
    assert np.std(volts) == pytest.approx(math.sqrt(state[0, 0]), rel=0.15)


def test_hum_of_the_supply_comes_through_by_the_rejection() -> None:
    """Inverter: 0.1 V at 100 Hz over a rejection of 1e4, times a noise gain of 2; nothing is drawn."""
    grade, circuit = OpAmpGrade(psrr=1e4), inverter(OpAmpModel(gbw_hz=3e6))
    hum = CircuitNoise(circuit, ["out"], op_amps=grade, temperature_c=-273.15, supply=Supply(0.1, 100.0))
    volts = hum.volts(400, np.random.default_rng(1))[:, 0]
    wave = 2e-5 * np.sin(2 * math.pi * 100.0 * np.arange(400) / 20e3)
    assert np.abs(volts - wave)[1:].max() < 1e-4 * 2e-5


def test_hum_is_switched_by_itself_and_does_not_depend_on_blocks() -> None:
    def played(supply: Supply, block_samples: int) -> np.ndarray:
        quiet = SuspensionComputer("front")
        machine = NoisySuspension(quiet, np.random.default_rng(1), op_amps=FINE_OP_AMP_GRADES["tl07x"], supply=supply)
        return np.concatenate(list(machine.play(Excitation(), 100, (), block_samples)))

    hum = Supply(hum_v=1.0)
    assert np.array_equal(played(hum, 100), played(hum, 7))
    assert np.abs(played(hum, 100) - played(Supply(), 100)).max() > 1e-5


@pytest.mark.parametrize("fields", [{"hum_v": -1.0}, {"hum_v": math.inf}, {"hum_hz": 0.0}])
def test_a_supply_that_cannot_be_is_refused(fields: dict[str, float]) -> None:
    with pytest.raises(CircuitError, match=f"supply: {next(iter(fields))} must be"):
        Supply(**fields)


def test_noise_of_a_multiplier_is_its_density_over_its_bandwidth() -> None:
    """One pole has a bandwidth of pi/2 times 1 MHz. The data sheet of the AD633 has 100 uV rms up to 10 kHz."""
    assert 50e-6 < MULTIPLIERS["ad633"].noise_v_per_rthz * math.sqrt(10e3) < 100e-6
    elements: list[Element] = [
        VoltageSource("F", "in"),
        Multiplier("M1", "in", "in", "out", model=MULTIPLIERS["ad633"]),
    ]
    noise = CircuitNoise(Circuit(elements), ["out"], op_amps=OpAmpGrade())
    assert math.sqrt(noise.covariance[0, 0]) == pytest.approx(0.8e-6 * math.sqrt(math.pi / 2 * 1e6), rel=1e-9)
    silent = replace(MULTIPLIERS["ad633"], noise_v_per_rthz=0.0)
    circuit = Circuit([elements[0], Multiplier("M1", "in", "in", "out", model=silent)])
    assert not CircuitNoise(circuit, ["out"], op_amps=OpAmpGrade()).covariance.any()
    with pytest.raises(CircuitError, match="noise_v_per_rthz must not be negative"):
        replace(silent, noise_v_per_rthz=-1.0)


def test_a_multiplier_of_the_grade_has_offsets_and_errors_within_its_data_sheet_and_its_swing() -> None:
    """Drawn over 200 specimens. Squaring 12 V asks for 14.4 V and gets the swing of 11 V and SR / CLAMP_RATE more."""
    part = Multiplier("M1", "in", "in", "out", model=MULTIPLIERS["ad633"])
    models = [
        next(each.model for each in fit if isinstance(each, Multiplier))
        for fit in (Components(multipliers=MULTIPLIER_GRADES["ad633"], seed=s).fit([part]) for s in range(200))
    ]
    for field, most in (("x_offset_v", 5e-3), ("y_offset_v", 5e-3), ("z_offset_v", 5e-3), ("gain_error", 2.5e-3)):
        drawn = np.array([getattr(model, field) for model in models])
        assert 0.9 * most < np.abs(drawn).max() <= most and abs(drawn.mean()) < 0.2 * most
    at_rest = piecewise_linear(Circuit([VoltageSource("F", "in"), part])).rest(np.array([12.0])).volts["out"]
    assert at_rest == pytest.approx(11.0 + 20e6 / CLAMP_RATE, rel=1e-9)
