"""Properties of every machine of the family, and the overload of a summer against ngspice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from analogrig_emulator import (
    FRONT,
    OP_AMP_GRADES,
    SHOCK,
    TICKS_PER_SAMPLE,
    Capacitor,
    Card,
    Circuit,
    Edges,
    Engine,
    Excitation,
    NoisySuspension,
    OpAmp,
    OpAmpModel,
    Pot,
    PotTurn,
    Resistor,
    Sampler,
    SuspensionComputer,
    SuspensionProgram,
    VoltageSource,
    piecewise_linear,
    preset,
    to_spice,
)
from analogrig_emulator.circuit.nodal import Nodal
from analogrig_emulator.circuit.pot import dial_for
from tests.emulator.plays import LSB_V, SAMPLE_RATE_HZ, NgSpice, Volts

programs = st.sampled_from((FRONT, SHOCK))
factors = st.tuples(*[st.floats(0.5, 1.2)] * 3)
excitations = st.builds(
    Excitation,
    shape=st.sampled_from(("square", "prbs")),
    low_v=st.floats(-3.0, 0.0),
    high_v=st.floats(0.5, 6.0),
    frequency_hz=st.floats(100.0, 900.0),
    phase=st.floats(0.0, 0.99),
    clock=st.sampled_from(("card", "free")),
)
changes = st.lists(
    st.builds(
        PotTurn,
        st.integers(0, 299),
        st.dictionaries(st.sampled_from(("M_dial", "B_dial", "K_dial")), st.floats(0.1, 0.9), min_size=1),
        ramp_n=st.just(0),
    ),
    max_size=4,
)
deterministic = settings(max_examples=40, deadline=None, derandomize=True)


def scaled(program: SuspensionProgram, by: tuple[float, float, float]) -> SuspensionProgram:
    """The same machine with other M (never lighter), B and K."""
    m, b, k = by
    return replace(
        program, M_kg=program.M_kg * (m + 0.5), B_n_s_per_m=program.B_n_s_per_m * b, K_n_per_m=program.K_n_per_m * k
    )


def volts_of(computer: SuspensionComputer, excitation: Excitation, samples: int, block: int = 4096) -> Volts:
    return np.concatenate(list(computer.play(excitation, samples, [PotTurn(40, {"B_dial": 0.5})], block)))


def kept(computer: SuspensionComputer, start: Volts, opamp_v: float) -> Volts:
    """Energy in J at 300 samples of a machine left alone: M v^2 / 2 + K x^2 / 2."""
    system = piecewise_linear(computer.circuit)
    engine = Engine(system, ["u2", "u3"])
    engine.run(1)
    state = np.full(len(system.states), opamp_v)
    # The capacitors' voltages are those of the integrators' virtual grounds less their outputs.
    state[:2] = -start
    engine.state = state
    volts = engine.run(300)
    scales, values = computer.scales, computer.program.values
    velocity, displacement = volts[:, 0] / scales.volts("velocity"), volts[:, 1] / scales.volts("displacement")
    return np.asarray(0.5 * values["M"] * velocity**2 + 0.5 * values["K"] * displacement**2)


@deterministic
@given(programs, factors, st.tuples(st.floats(-6, 6), st.floats(-6, 6)))
def test_energy_never_grows_with_excitation_off_and_pots_still(
    program: SuspensionProgram, by: tuple[float, float, float], start: tuple[float, float]
) -> None:
    energy_j = kept(SuspensionComputer(scaled(program, by), opamp="ideal"), np.array(start), 0.0)
    assert (np.diff(energy_j) <= 1e-12 * energy_j[0]).all()


@deterministic
@given(programs, factors, st.tuples(st.floats(-5, 5), st.floats(-5, 5)))
def test_energy_never_grows_with_real_amplifiers_once_they_have_settled(
    program: SuspensionProgram, by: tuple[float, float, float], start: tuple[float, float]
) -> None:
    model = replace(preset("tl07x"), avol=1e6)
    energy_j = kept(SuspensionComputer(scaled(program, by), opamp=model), np.array(start), 0.0)
    assert (np.diff(energy_j[1:]) <= 1e-9 * energy_j[1]).all()


@deterministic
@given(programs, factors, excitations, excitations)
def test_superposition_holds_while_nothing_limits(
    program: SuspensionProgram, by: tuple[float, float, float], one: Excitation, other: Excitation
) -> None:
    """Two generators into the summer, alone and together; amplifiers do not slew and stay below their clamps."""
    computer = SuspensionComputer(scaled(program, by), opamp=replace(preset("tl07x"), slew_v_per_s=float("inf")))
    circuit = Circuit([*computer.circuit.elements, VoltageSource("G", "in2"), Resistor("RG", "in2", "s1", 200e3)])
    system = piecewise_linear(circuit)

    def response(f: Excitation | None, g: Excitation | None) -> Volts:
        engine = Engine(system, ["u1", "u2", "u3", "u4", "u5"])
        sources = {name: train for name, train in (("F", f), ("G", g)) if train is not None}
        window = engine.window(150)
        volts = engine.run(150, {name: e.edges(*window, SAMPLE_RATE_HZ) for name, e in sources.items()})
        assert np.abs(volts).max() < 13.5
        return volts

    np.testing.assert_allclose(response(one, other), response(one, None) + response(None, other), atol=1e-9)


@deterministic
@given(programs, factors, excitations, changes, st.integers(1, 300), st.integers(0, 99))
def test_halving_the_block_size_changes_no_code(
    program: SuspensionProgram,
    by: tuple[float, float, float],
    excitation: Excitation,
    turns: list[PotTurn],
    block: int,
    seed: int,
) -> None:
    """With the noise of resistors, amplifiers and card, and 16 bits to see the smaller ones."""
    codes = []
    for size in (block, max(block // 2, 1)):
        computer = SuspensionComputer(scaled(program, by), rng=np.random.default_rng(seed))
        machine = NoisySuspension(computer, np.random.default_rng(seed), op_amps=OP_AMP_GRADES["tl07x"])
        sampler = Sampler(Card(bits=16, noise_lsb=(1.0,) * 4), np.random.default_rng(seed))
        volts = list(machine.play(excitation, 300, turns, size))
        codes.append(np.concatenate([sampler.sample(block_v)[0] for block_v in volts]))
    assert np.array_equal(codes[0], codes[1])


@deterministic
@given(programs, factors, excitations, st.integers(1, 40), st.floats(-0.4, 0.4), st.integers(1, 3))
def test_block_size_changes_no_bit_while_a_pot_turns(
    program: SuspensionProgram,
    by: tuple[float, float, float],
    excitation: Excitation,
    block: int,
    turn: float,
    pieces: int,
) -> None:
    nodal = Nodal(SuspensionComputer(scaled(program, by)).circuit)

    def played(size: int) -> Volts:
        engine = Engine(nodal.at({}), ["u1", "u2", "u5"])
        blocks = []
        while engine.recorded < 60:
            count = min(size, 60 - engine.recorded)
            edges = {"F": excitation.edges(*engine.window(count), SAMPLE_RATE_HZ)}
            blocks.append(engine.run_turning(count, lambda t: nodal.at({"B": 0.5 + turn * t / 60}), edges, pieces))
        return np.concatenate(blocks)

    assert np.array_equal(played(block), played(60))


@deterministic
@given(programs, factors, excitations, st.integers(0, 298), st.sampled_from(("M", "B", "K")))
def test_a_change_to_the_same_value_changes_nothing(
    program: SuspensionProgram, by: tuple[float, float, float], excitation: Excitation, sample: int, setting: str
) -> None:
    plain, touched = (SuspensionComputer(scaled(program, by)) for _ in range(2))
    change = PotTurn(sample, {setting: touched.program.values[setting]})
    untouched = np.concatenate(list(plain.play(excitation, 300)))
    assert np.array_equal(np.concatenate(list(touched.play(excitation, 300, [change]))), untouched)


def test_cost_grows_linearly_with_samples() -> None:
    """Engine work is linear: sixteen times the samples, sixteen times the steps, to within a period."""

    def steps(samples: int) -> int:
        excitation = Excitation(clock="free", phase=0.137, drift_ppm=20.0)
        engine = Engine(piecewise_linear(SuspensionComputer("front").circuit), ["u5"])
        engine.run(samples, {"F": excitation.edges(*engine.window(samples), SAMPLE_RATE_HZ)})
        return engine.counts.steps + engine.counts.quiet

    few, many = steps(10_000), steps(160_000)
    assert 15.5 < many / few < 16.5


# ---- overload

ACCELERATION_SCALED = ("u1", "u2", "u3", "u4", "u5")


def acceleration_scaled(dials: dict[str, float], model: OpAmpModel) -> Circuit:
    """The summer puts out acceleration: F, B and K go through pots that all turn when M jumps."""
    return Circuit(
        [
            VoltageSource("F", "in"),
            *(Pot("PF", "in", "wf", "0", 10e3, dials["PF"]), Resistor("RF", "wf", "s1", 25e3)),
            *(Resistor("RFB", "s1", "u1", 100e3), OpAmp("U1", "0", "s1", "u1", model)),
            *(
                Resistor("R1", "u1", "s2", 100e3),
                Capacitor("C1", "s2", "u2", 1e-9),
                OpAmp("U2", "0", "s2", "u2", model),
            ),
            *(
                Resistor("R2", "u2", "s3", 49.9e3),
                Capacitor("C2", "s3", "u3", 10e-9),
                OpAmp("U3", "0", "s3", "u3", model),
            ),
            *(Resistor("R4", "u2", "s4", 10e3), Resistor("R4F", "s4", "u4", 10e3), OpAmp("U4", "0", "s4", "u4", model)),
            *(Resistor("R5", "u3", "s5", 10e3), Resistor("R5F", "s5", "u5", 10e3), OpAmp("U5", "0", "s5", "u5", model)),
            *(Pot("PB", "u4", "wb", "0", 10e3, dials["PB"]), Resistor("RB", "wb", "s1", 10e3)),
            *(Pot("PK", "u3", "wk", "0", 10e3, dials["PK"]), Resistor("RK", "wk", "s1", 12e3)),
        ]
    )


def acceleration_dials(m_kg: float) -> dict[str, float]:
    """Front suspension: at 115 kg the summer's coefficients are those of the force-scaled machine times k_M = .2557."""
    k_m = 0.2557 * 115.0 / m_kg
    coefficients = {"PF": (k_m, 25e3), "PB": (k_m * 0.6823 / 0.332, 10e3), "PK": (k_m * 0.83 / 0.499, 12e3)}
    return {name: dial_for(k * load / 100e3, 10e3, load, name) for name, (k, load) in coefficients.items()}


def test_overload_of_an_acceleration_scaled_summer_agrees_with_ngspice(ngspice: NgSpice) -> None:
    before, after = acceleration_dials(115.0), acceleration_dials(30.0)
    circuit = acceleration_scaled(before, preset("tl07x"))
    # Edges come 2.5 us before a sample, when U1 stands in its clamp.
    excitation = Excitation(low_v=-10.0, high_v=10.0, clock="free", phase=0.2305)
    edges = {"F": excitation.edges(0, 300 * TICKS_PER_SAMPLE, SAMPLE_RATE_HZ)}
    deck = to_spice(circuit, samples=300, edges=edges, turns=[PotTurn(100, after)])
    reference = ngspice(deck, ACCELERATION_SCALED, 300)
    nodal = Nodal(circuit)
    engine = Engine(nodal.at({}), ACCELERATION_SCALED)
    first = engine.run(101, {"F": excitation.edges(*engine.window(101), SAMPLE_RATE_HZ)})
    engine.set_system(nodal.at(after))
    second = engine.run(199, {"F": excitation.edges(*engine.window(199), SAMPLE_RATE_HZ)})
    volts = np.concatenate((first, second))
    assert np.abs(second[:, 0]).max() > 13.45  # of 13.5 V behind the output resistance
    assert np.abs(volts - reference).max() < 0.05 * LSB_V


def test_edges_of_two_inputs_in_one_run_are_played_in_order_of_time() -> None:
    circuit = Circuit([VoltageSource("A", "a"), VoltageSource("B", "b"), Resistor("R", "a", "b", 1.0)])
    a = Edges(np.array([0, 3 * TICKS_PER_SAMPLE]), np.array([1.0, 2.0]))
    b = Edges(np.array([2 * TICKS_PER_SAMPLE + 1]), np.array([5.0]))
    volts = Engine(piecewise_linear(circuit), ["a", "b"]).run(5, {"A": a, "B": b})
    assert volts.tolist() == [[1, 0], [1, 0], [1, 0], [2, 5], [2, 5]]
