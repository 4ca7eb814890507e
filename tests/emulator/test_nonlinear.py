"""Multipliers and diode function generators: against closed forms, the AD633's data sheet and ngspice."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from analogrig_emulator import (
    MULTIPLIERS,
    TICKS_PER_SAMPLE,
    AnalogComputer,
    Capacitor,
    Circuit,
    CircuitError,
    CircuitNoise,
    Deck,
    Edges,
    Element,
    Engine,
    EngineError,
    Excitation,
    Function,
    Mode,
    Multiplier,
    MultiplierModel,
    OpAmp,
    OpAmpModel,
    Pot,
    PotTurn,
    Resistor,
    VoltageSource,
    piecewise_linear,
    preset,
)
from analogrig_emulator.circuit.components import MULTIPLIER_GRADES, OP_AMP_GRADES, Components, MultiplierGrade
from analogrig_emulator.circuit.spice import Accuracy
from analogrig_emulator.engine import engine as engine_module
from analogrig_emulator.engine.system import Law, Product
from tests.emulator.plays import LSB_V, SAMPLE_RATE_HZ, NgSpice, Volts

IDEAL, AD633, TL07X = MULTIPLIERS["ideal"], MULTIPLIERS["ad633"], preset("tl07x")
FINE = Accuracy(reltol=1e-8, max_step_s=2e-6)
AMPLIFIERS = ("u1", "u2", "u3", "u4", "m1", "m2")


def oscillator(model: OpAmpModel, damping: Resistor, *law: Element) -> Circuit:
    """Patch of x'' = F - x - ...: u2 is +v, u3 is -x, u4 is -v; the summer U1 takes damping and law."""
    stages = (("RF", "in", 100e3), ("R2", "u1", 40e3), ("R3", "u2", 100e3), ("R4", "u2", 10e3))
    inputs = [Resistor(name, node, f"s{i}", ohm) for i, (name, node, ohm) in enumerate(stages, 1)]
    amps = [OpAmp(f"U{i}", "0", f"s{i}", f"u{i}", model) for i in range(1, 5)]
    feedback: list[Element] = [
        Resistor("R1FB", "s1", "u1", 40e3),
        Capacitor("C2", "s2", "u2", 1e-9),
        Capacitor("C3", "s3", "u3", 1e-9),
        Resistor("R4FB", "s4", "u4", 10e3),
        Pot("K", "u3", "wk", "0", 10e3, 0.9),
        Resistor("RK", "wk", "s1", 90e3),
    ]
    return Circuit([VoltageSource("F", "in"), *inputs, *feedback, *amps, damping, *law])


def duffing(model: OpAmpModel = TL07X, multiplier: MultiplierModel = AD633) -> Circuit:
    """Spring with a cubic part: M2 is -x^3 / 100."""
    return oscillator(
        model,
        Resistor("RB", "u4", "s1", 300e3),
        Multiplier("M1", "u3", "u3", "m1", model=multiplier),
        Multiplier("M2", "m1", "u3", "m2", model=multiplier),
        Resistor("RC", "m2", "s1", 20e3),
    )


def van_der_pol(model: OpAmpModel = TL07X, multiplier: MultiplierModel = AD633) -> Circuit:
    """Damping that changes sign: M2 is -x^2 v / 100."""
    return oscillator(
        model,
        Resistor("RB", "u2", "s1", 100e3),
        Multiplier("M1", "u3", "u3", "m1", model=multiplier),
        Multiplier("M2", "m1", "u4", "m2", model=multiplier),
        Resistor("RC", "m2", "s1", 10e3),
    )


def square(samples: int, high_v: float) -> Edges:
    excitation = Excitation(clock="free", phase=0.637, low_v=-high_v, high_v=high_v, frequency_hz=900.0)
    return excitation.edges(0, samples * TICKS_PER_SAMPLE, SAMPLE_RATE_HZ)


# ---- whole machines


@pytest.mark.parametrize(
    ("circuit", "high_v", "turns"),
    [
        (duffing(), 6.0, [PotTurn(25, {"K": 0.3})]),
        (van_der_pol(), 1.0, []),
        (duffing(preset("741")), 8.0, []),  # U1 slews
        (duffing(OpAmpModel(gbw_hz=3e6, swing_v=(-1.5, 2.5), rout_ohm=100.0)), 6.0, []),  # U1 to U3 clamp
    ],
)
def test_amplifiers_and_multipliers_agree_with_ngspice(
    ngspice: NgSpice, circuit: Circuit, high_v: float, turns: list[PotTurn]
) -> None:
    deck = Deck(circuit, samples=40, edges={"F": square(40, high_v)}, turns=turns)
    reference = ngspice(deck.text(AMPLIFIERS, FINE), AMPLIFIERS, 40)
    assert np.abs(deck.volts(AMPLIFIERS) - reference).max() < 0.05 * LSB_V


def test_real_multipliers_agree_with_ngspice(ngspice: NgSpice) -> None:
    """Every field of the model in use, with amplitudes at which the multipliers bend, slew and clamp."""
    real = replace(
        AD633,
        gain_error=0.0025,
        x_offset_v=5e-3,
        y_offset_v=-5e-3,
        z_offset_v=5e-3,
        x_nonlinearity=0.004,
        y_nonlinearity=0.001,
        slew_v_per_s=0.05e6,
        swing_v=(-1.0, 1.0),
        rout_ohm=50.0,
    )
    deck = Deck(duffing(multiplier=real), samples=40, edges={"F": square(40, 8.0)})
    volts = deck.volts(AMPLIFIERS)
    assert np.abs(volts[:, 4:]).max() > 0.99
    assert np.abs(volts - ngspice(deck.text(AMPLIFIERS, FINE), AMPLIFIERS, 40)).max() < 0.05 * LSB_V


def test_cutting_a_run_into_calls_changes_no_bit() -> None:
    system, edges = piecewise_linear(duffing()), square(120, 8.0)
    whole, cut = Engine(system, AMPLIFIERS), Engine(system, AMPLIFIERS)
    volts = whole.run(120, {"F": edges.within(*whole.window(120))})
    parts = [cut.run(n, {"F": edges.within(*cut.window(n))}) for n in (1, 50, 0, 7, 62)]
    assert np.array_equal(volts, np.concatenate(parts))


def test_other_offsets_in_a_kept_engine_are_those_in_an_engine_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    shifted = replace(AD633, x_offset_v=0.02, z_offset_v=0.01)
    circuits = [duffing(replace(TL07X, vos_v=vos_v), law) for vos_v in (0.0, 2e-3) for law in (AD633, shifted)]
    edges = square(80, 6.0)

    def played(circuit: Circuit) -> Volts:
        engine = Engine(piecewise_linear(circuit), ("u1", "u3", "m2"), SAMPLE_RATE_HZ)
        return engine.run(80, {"F": edges.within(*engine.window(80))})

    kept = [played(circuit) for circuit in (*circuits, circuits[0])]
    for circuit, volts in zip((*circuits, circuits[0]), kept, strict=True):
        monkeypatch.setattr(engine_module, "_idle", {})
        assert np.array_equal(volts, played(circuit))
    assert not np.array_equal(kept[0], kept[1])


def test_voltages_ahead_are_those_of_a_finer_grid() -> None:
    finer = 64
    looking = Engine(piecewise_linear(duffing()), ("u3", "m2"), SAMPLE_RATE_HZ, ahead_ticks=TICKS_PER_SAMPLE // finer)
    edges = square(60, 6.0)
    volts = looking.run(60, {"F": edges.within(*looking.window(60))})
    fast = Engine(piecewise_linear(duffing()), ("u3", "m2"), SAMPLE_RATE_HZ * finer)
    every = fast.run(59 * finer + 2, {"F": Edges(edges.ticks * finer, edges.levels_v)})
    np.testing.assert_allclose(volts[:, :2], every[::finer][:60], rtol=0, atol=5e-5)
    np.testing.assert_allclose(volts[:, 2:], every[1::finer][:60], rtol=0, atol=5e-5)


def test_a_ramp_of_a_pot_ends_where_a_pot_at_once_does() -> None:
    """The oscillator is damped: both rest under the spring of the new dial in the end."""
    rests = []
    for ramp_n in (0, 40):
        machine = AnalogComputer(duffing(), ("u3",), initial_v={"U2": 0.0, "U3": 0.0})
        machine.restart(Mode.OPERATE)
        machine.run(10, {"F": Edges(np.zeros(1, np.int64), np.array([3.0]))})
        machine.turn({"K": 0.4}, ramp_n)
        rests.append(machine.run(600)[-1, 0])
    assert abs(rests[0]) > 1.0
    assert rests[1] == pytest.approx(rests[0], abs=1e-6)


def test_initial_condition_at_once_is_that_after_charging() -> None:
    rests = []
    for ic_ohm in (None, 10e3):
        machine = AnalogComputer(duffing(), ("u3", "m2"), initial_v={"U2": 0.0, "U3": 6.0}, ic_ohm=ic_ohm)
        rests.append(machine.run(20)[-1])
    assert rests[0] == pytest.approx([6.0, 2.16], abs=1e-3)
    assert rests[1] == pytest.approx(rests[0], abs=1e-6)


def test_noise_of_the_linear_part_is_played_beside_multipliers() -> None:
    noise = CircuitNoise(duffing(), ("u3",), op_amps=OP_AMP_GRADES["tl07x"])
    assert 0 < noise.volts(100, np.random.default_rng(1)).std() < 1e-3


# ---- laws


def outputs(*elements: Element, rate_hz: float = SAMPLE_RATE_HZ, samples: int = 1, **levels_v: float) -> Volts:
    """Voltage of node o at the samples, with sources of these names and nodes stepping to their levels at sample 0."""
    circuit = Circuit([*(VoltageSource(f"V{node}", node) for node in levels_v), *elements])
    engine = Engine(piecewise_linear(circuit), ("o",), rate_hz)
    edges = {f"V{node}": Edges(np.zeros(1, np.int64), np.array([volts])) for node, volts in levels_v.items()}
    return engine.run(samples, edges)[:, 0]


@pytest.mark.parametrize(
    ("model", "scale_v", "expected_v"),
    [
        (IDEAL, 10.0, 4.0 * -5.0 / 10.0),
        (IDEAL, -10.0, 4.0 * 5.0 / 10.0),
        (MultiplierModel(gain_error=0.0025), 10.0, -2.0 * 1.0025),
        (MultiplierModel(x_offset_v=0.01), 10.0, 4.01 * -5.0 / 10.0),
        (MultiplierModel(y_offset_v=0.01), 10.0, 4.0 * -4.99 / 10.0),
        (MultiplierModel(z_offset_v=0.01), 10.0, -2.0 + 0.01),
    ],
)
def test_each_error_of_a_multiplier_enters_as_its_law_says(
    model: MultiplierModel, scale_v: float, expected_v: float
) -> None:
    volts = outputs(Multiplier("M", "x", "y", "o", scale_v, model), x=4.0, y=-5.0)
    assert volts[0] == pytest.approx(expected_v, rel=1e-14)


@pytest.mark.parametrize(("side", "fraction"), [("x", 0.004), ("y", 0.001)])
def test_nonlinearity_is_the_data_sheet_s_fraction_of_full_scale(side: str, fraction: float) -> None:
    model = replace(IDEAL, **{f"{side}_nonlinearity": fraction})  # type: ignore[arg-type]
    other = "y" if side == "x" else "x"
    inputs = np.linspace(-10.0, 10.0, 41)
    bent = [outputs(Multiplier("M", "x", "y", "o", model=model), **{side: v, other: 10.0})[0] - v for v in inputs]
    assert np.abs(bent).max() == pytest.approx(fraction * 10.0, rel=0.01)
    assert bent[0] == pytest.approx(0.0, abs=1e-12)
    assert bent[-1] == pytest.approx(0.0, abs=1e-12)


def test_specimens_of_a_grade_stay_within_the_data_sheet_s_typical_errors() -> None:
    """Each error is drawn from the multiplier's name, and its own switch draws no other."""
    grade = MULTIPLIER_GRADES["ad633"]
    nominal = Multiplier("M1", "x", "y", "o", model=AD633)
    models = [_fitted(nominal, grade, seed) for seed in range(200)]
    for field in ("gain_error", "x_offset_v", "y_offset_v", "z_offset_v", "x_nonlinearity", "y_nonlinearity"):
        limit = getattr(grade, field)
        drawn = np.array([getattr(model, field) for model in models])
        assert 0.95 * limit < np.abs(drawn).max() <= limit
        alone = _fitted(nominal, MultiplierGrade(**{field: limit}), 7)
        assert alone == replace(AD633, **{field: drawn[7]})


def _fitted(multiplier: Multiplier, grade: MultiplierGrade, seed: int) -> MultiplierModel:
    (fitted,) = Components(multipliers=grade, seed=seed).fit([multiplier])
    assert isinstance(fitted, Multiplier)
    return fitted.model


def test_the_bandwidth_is_one_pole() -> None:
    model = MultiplierModel(bandwidth_hz=1e6)
    volts = outputs(Multiplier("M", "x", "y", "o", model=model), rate_hz=20e6, samples=30, x=6.0, y=5.0)
    times_s = np.arange(30) / 20e6
    assert volts == pytest.approx(3.0 * (1.0 - np.exp(-2.0 * math.pi * 1e6 * times_s)), abs=1e-9)


def test_the_slew_rate_is_that_of_the_data_sheet() -> None:
    volts = outputs(Multiplier("M", "x", "y", "o", model=AD633), rate_hz=20e6, samples=6, x=10.0, y=10.0)
    assert volts == pytest.approx(20e6 * np.arange(6) / 20e6, abs=1e-9)


def test_the_output_stops_at_its_swing() -> None:
    """Pulled at its slew rate, it settles SR / CLAMP_RATE = 20 mV beyond."""
    assert outputs(Multiplier("M", "x", "y", "o", 5.0, AD633), samples=2, x=10.0, y=10.0)[1] == pytest.approx(11.02)


def test_the_output_resistance_divides_with_the_load() -> None:
    for model in (MultiplierModel(rout_ohm=100.0), MultiplierModel(bandwidth_hz=1e6, rout_ohm=100.0)):
        load = Resistor("RL", "o", "0", 900.0)
        volts = outputs(Multiplier("M", "x", "y", "o", model=model), load, samples=2, x=10.0, y=5.0)
        assert volts[1] == pytest.approx(4.5, rel=1e-12)


def test_a_multiplier_in_the_feedback_divides_and_takes_square_roots() -> None:
    amp = OpAmp("U", "0", "s", "o", OpAmpModel(gbw_hz=3e6))
    around: list[Element] = [
        Resistor("R1", "u", "s", 10e3),
        Resistor("R2", "m", "s", 10e3),
        Capacitor("C", "s", "o", 50e-12),
        amp,
    ]
    for u, y in ((3.0, 5.0), (-2.0, 4.0), (6.0, 8.0)):
        quotient = outputs(*around, Multiplier("M", "o", "y", "m", model=AD633), samples=10, u=u, y=y)[-1]
        assert quotient == pytest.approx(-10.0 * u / y, abs=1e-6)
    for u in (-0.5, -2.0, -8.0):
        root = outputs(*around, Multiplier("M", "o", "o", "m", model=AD633), samples=10, u=u)[-1]
        assert abs(root) == pytest.approx(math.sqrt(-10.0 * u), abs=1e-6)


def test_ideal_elements_divide_and_take_roots_as_in_ngspice(ngspice: NgSpice) -> None:
    elements: list[Element] = [
        Resistor("R1", "x", "a", 10e3),
        Capacitor("C1", "a", "0", 10e-9),
        Multiplier("D", "a", "y", "q", -10.0, law=Law.QUOTIENT),
        Multiplier("W", "q", "q", "r", -10.0, law=Law.ROOT, sign=-1),
        Resistor("R2", "r", "b", 10e3),
        Capacitor("C2", "b", "0", 10e-9),
    ]
    sources = (VoltageSource("X", "x", "0"), VoltageSource("Y", "y", "0", 4.0))
    deck = Deck(Circuit([*elements, *sources]), samples=60, edges={"X": square(60, 6.0)})
    volts = ngspice(deck.text(("q", "r", "b"), FINE), ("q", "r", "b"), 60)
    assert np.abs(deck.volts(("q", "r", "b")) - volts).max() < 0.05 * LSB_V
    q, r, _ = deck.volts(("q", "r", "b")).T
    assert r == pytest.approx(-np.sqrt(np.maximum(0.0, -10.0 * q)), abs=1e-9)


def test_division_by_a_voltage_that_reaches_zero_is_refused() -> None:
    divider = Multiplier("D", "x", "y", "o", law=Law.QUOTIENT)
    with pytest.raises(EngineError, match="a loop of ideal elements, or a division by 0"):
        outputs(divider, x=3.0, y=0.0)


def test_ideal_multipliers_follow_one_another_without_a_state_between() -> None:
    fifth: list[Element] = [
        Multiplier("M1", "x", "x", "a"),
        Multiplier("M2", "a", "a", "b"),
        Multiplier("M3", "b", "x", "o"),
    ]
    assert outputs(*fifth, x=8.0)[0] == pytest.approx(8.0**5 / 1e4, rel=1e-14)


# ---- functions


@pytest.mark.parametrize("seed", range(8))
def test_a_function_generator_follows_its_breakpoints(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bends = np.sort(rng.uniform(-10, 10, int(rng.integers(2, 9))))
    table = np.column_stack((bends, rng.uniform(-10, 10, bends.size)))
    function = Function("G", "x", "o", tuple(map(tuple, table.tolist())))
    for x in rng.uniform(-12, 12, 10):
        piece = int(np.clip(np.searchsorted(bends, x) - 1, 0, bends.size - 2))
        (a, b), (c, d) = table[piece : piece + 2]
        assert outputs(function, x=float(x))[0] == pytest.approx(b + (x - a) * (d - b) / (c - a), abs=1e-9)


def test_a_cubic_by_segments_stiffens_the_spring_as_in_ngspice(ngspice: NgSpice) -> None:
    bends = tuple((x, x**3 / 100.0) for x in (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0))
    circuit = oscillator(
        TL07X, Resistor("RB", "u4", "s1", 300e3), Function("G", "u3", "m1", bends), Resistor("RC", "m1", "s1", 20e3)
    )
    deck = Deck(circuit, samples=40, edges={"F": square(40, 6.0)})
    nodes = AMPLIFIERS[:5]
    assert np.abs(deck.volts(nodes) - ngspice(deck.text(nodes, FINE), nodes, 40)).max() < 0.05 * LSB_V


def test_a_comparator_switches_a_multiplier() -> None:
    switch: list[Element] = [Function.comparator("G", "x", "c", (0.0, 10.0)), Multiplier("M", "c", "y", "o")]
    assert [outputs(*switch, x=x, y=7.0)[0] for x in (-3.0, -0.01, 0.01, 3.0)] == pytest.approx(
        [0.0, 0.0, 7.0, 7.0], abs=1e-9
    )


def test_a_function_bends_the_argument_of_a_multiplier_in_a_loop(ngspice: NgSpice) -> None:
    """The damping works where |x| > 1 V: dead zone, multiplier, and the bends on the way to its argument."""
    zone = ((-5.0, -4.0), (-1.0, 0.0), (1.0, 0.0), (5.0, 4.0))
    circuit = oscillator(
        TL07X,
        Resistor("RB", "u4", "s1", 300e3),
        Function("G", "u3", "m1", zone),
        Multiplier("M", "m1", "u2", "m2", model=AD633),
        Resistor("RC", "m2", "s1", 30e3),
    )
    deck = Deck(circuit, samples=40, edges={"F": square(40, 6.0)})
    assert np.abs(deck.volts(AMPLIFIERS) - ngspice(deck.text(AMPLIFIERS, FINE), AMPLIFIERS, 40)).max() < 0.05 * LSB_V


# ---- refusals


def test_ideal_multipliers_in_a_loop_are_refused() -> None:
    """With the node at p, 2 p = 10 + 2 p^2 has no solution."""
    loop: list[Element] = [
        Resistor("R1", "x", "p", 1e3),
        Resistor("R2", "o", "p", 1e3),
        Multiplier("M", "p", "p", "o", 0.5),
    ]
    with pytest.raises(EngineError, match="a loop of ideal elements"):
        outputs(*loop, x=10.0)


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (Multiplier("M", "x", "x", "o", 0.0), r"Multiplier M \(x x o\): scale_v must not be 0"),
        (Multiplier("M", "x", "x", "o", math.nan), "scale_v must be finite"),
        (Multiplier("M", "x", "x", "o", model=AD633, law=Law.ROOT), "takes roots by itself is ideal"),
        (Function("G", "x", "o", ((0.0, 1.0),)), r"Function G \(x o\): needs at least two breakpoints"),
        (Function("G", "x", "o", ((0.0, 1.0), (0.0, 2.0))), "must ascend"),
        (Function("G", "x", "o", ((0.0, 1.0), (1.0, math.inf))), "must be finite"),
    ],
)
def test_an_element_without_a_law_is_refused_by_name(element: Element, message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        Circuit([VoltageSource("Vx", "x"), element])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"slew_v_per_s": 1e6}, "slew_v_per_s and swing_v need a finite bandwidth_hz"),
        ({"bandwidth_hz": -1.0}, "bandwidth_hz must be positive"),
        ({"gain_error": math.inf}, "gain_error must be finite"),
        ({"swing_v": (1.0, 2.0)}, "on both sides of 0 V"),
        ({"full_v": 0.0}, "full_v must be positive"),
        ({"rout_ohm": -1.0}, "rout_ohm must be finite and not negative"),
    ],
)
def test_a_multiplier_model_out_of_range_is_refused_by_field(fields: dict[str, float], message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        MultiplierModel(**fields)  # type: ignore[arg-type]


def test_a_deck_without_a_term_of_a_multiplier_is_refused() -> None:
    class Bent(MultiplierModel):
        def product(self, scale_v: float, element: str = "") -> Product:
            return Product((0.0, 1.0 / scale_v, 1e-3), (0.0, 1.0), element)

    with pytest.raises(CircuitError, match="multiplier M1: the deck has no power 2 of its x input"):
        Deck(duffing(multiplier=Bent()), samples=2, edges={"F": square(2, 8.0)}).text()


def test_more_multipliers_than_the_engine_takes_are_refused() -> None:
    many = [Multiplier(f"M{i}", "x", "x", f"o{i}") for i in range(17)]
    with pytest.raises(CircuitError, match="17 multipliers; the engine takes at most 16"):
        piecewise_linear(Circuit([VoltageSource("Vx", "x"), *many]))
