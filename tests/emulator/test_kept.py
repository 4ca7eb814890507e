"""Circuits, engines and noise that are kept for the next machine change no bit, and belong to nobody."""

from __future__ import annotations

import copy
import gc
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from analogrig_emulator import (
    OP_AMP_GRADES,
    Capacitor,
    Card,
    Circuit,
    CircuitError,
    CircuitNoise,
    Courses,
    Edges,
    Engine,
    EngineError,
    Excitation,
    OpAmp,
    OpAmpModel,
    Pot,
    PotError,
    PotTurn,
    RepeatedCourses,
    RepeatedPlay,
    Resistor,
    SuspensionComputer,
    Switch,
    VoltageSource,
    Wired,
    drawn_offsets_v,
    is_repeatable,
    piecewise_linear,
    preset,
)
from analogrig_emulator.circuit.nodal import Nodal, analyse
from analogrig_emulator.circuit.opamp import PRESETS
from analogrig_emulator.engine import engine as engine_module
from tests.emulator.plays import Volts
from tests.emulator.programs import circuit_of

JUMPS = [
    PotTurn(0, {"M": 80.0}),
    PotTurn(30, {"K": 18000.0}),
    PotTurn(30, {"B": 3453.0}),
    PotTurn(63, {"K": 24500.0}),
    PotTurn(99, {"M": 30.0}),
]
LOUD = Excitation(low_v=-9.0, high_v=9.0, clock="free", phase=0.3, frequency_hz=900.0)


def played(computer: SuspensionComputer, changes: Sequence[PotTurn] = (), block: int = 4096) -> Volts:
    return np.concatenate(list(computer.play(LOUD, 100, changes, block)))


def turned_by_hand() -> Volts:
    """The jumps as an operator makes them, one run after another."""
    computer, parts = SuspensionComputer("front"), []
    blocks = computer.play(LOUD, 100, (), 1)
    for sample in range(100):
        parts.append(next(blocks))
        for change in JUMPS:
            if change.sample == sample:
                computer.set(**change.values)
    return np.concatenate(parts)


@pytest.mark.parametrize("block", [1, 31, 64, 100])
def test_jumps_played_at_once_are_those_of_an_operator(block: int) -> None:
    computer = SuspensionComputer("front")
    assert played(computer, JUMPS, block).tobytes() == turned_by_hand().tobytes()
    assert computer.dials == computer.dials_for(M=30.0) | computer.dials_for(K=24500.0, B=3453.0)


def test_a_ramp_before_a_jump_is_still_a_ramp() -> None:
    changes = [PotTurn(10, {"K": 18000.0}, 20), PotTurn(15, {"M": 60.0}), PotTurn(50, {"M": 90.0})]
    whole, apart = (played(SuspensionComputer("front"), changes, block) for block in (100, 1))
    assert whole.tobytes() == apart.tobytes()
    assert not np.array_equal(whole, played(SuspensionComputer("front"), changes[1:]))


def test_equal_machines_share_nothing_that_changes() -> None:
    one, other = SuspensionComputer("front"), SuspensionComputer("front")
    untouched = played(other)
    one.set(M=60.0)
    one.machine.set_initial({"U3": 4.0})
    played(one, JUMPS)
    assert other.program.values["M"] == 115.0
    assert played(other).tobytes() == untouched.tobytes()
    assert played(SuspensionComputer("front")).tobytes() == untouched.tobytes()


@pytest.mark.parametrize("program", ["front", "bump-stop", "two-mass"])
@pytest.mark.parametrize("opamp", ["tl07x", "ideal"])
def test_a_machine_with_other_offsets_is_that_of_a_netlist_with_them(program: str, opamp: str) -> None:
    circuit = SuspensionComputer(circuit_of(program), opamp=opamp, rng=np.random.default_rng(5)).circuit
    nominal = SuspensionComputer(circuit_of(program), opamp=opamp).circuit
    trimmed = nominal.with_offsets({amp.name: amp.model.vos_v for amp in circuit.of(OpAmp)})
    alone = Circuit(circuit.elements)
    assert trimmed.elements == alone.elements
    turned = {circuit.of(Pot)[0].name: 0.1}
    assert trimmed.with_dials(turned).elements == alone.with_dials(turned).elements
    for dial in (0.2, 0.7):
        dials = {circuit.of(Pot)[0].name: dial}
        shared, own = analyse(trimmed).at(dials), Nodal(alone).at(dials)
        for field in ("abc", "g", "cde", "w_phi", "lmn", "v_phi"):
            assert getattr(shared, field).tobytes() == getattr(own, field).tobytes()
        assert shared.layout(shared.nodes[:3]).block.tobytes() == own.layout(own.nodes[:3]).block.tobytes()
    with pytest.raises(CircuitError, match="no op-amp is called 'U99'"):
        nominal.with_offsets({"U99": 0.0})


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy])
def test_circuits_and_state_spaces_that_were_played_can_be_copied(again: Callable[[Any], Any]) -> None:
    computer = SuspensionComputer("front", rng=np.random.default_rng(1))
    played(computer)
    circuit = again(computer.machine.wiring)
    assert circuit == computer.machine.wiring
    system = again(piecewise_linear(computer.machine.wiring))
    assert system.abc.tobytes() == piecewise_linear(circuit).abc.tobytes()
    assert not system.abc.flags.writeable


def test_state_spaces_that_are_shared_cannot_be_written() -> None:
    system = piecewise_linear(SuspensionComputer("front").circuit)
    for matrix in (system.abc, system.g, system.cde, system.w_phi, system.lmn, system.v_phi):
        with pytest.raises(ValueError, match="read-only"):
            matrix[...] = 0.0


def low_pass(ohm: float) -> Circuit:
    source, pot = VoltageSource("V1", "in"), Pot("P", "in", "w", "0", 10e3, 0.5)
    load = Resistor("R", "w", "out", ohm), Capacitor("C", "out", "0", 10e-9)
    return Circuit([source, pot, *load, Switch("S", "out", "0", 1.0, 1e9, closed=False)])


EDGES = {"V1": Edges(np.array([0]), np.array([10.0]))}


@pytest.mark.parametrize("others", [1, 7, 8, 20])
def test_return_to_an_earlier_circuit_is_that_circuit(others: int) -> None:
    """Eight circuits are kept: this one is among them, or it is computed anew."""
    systems = [piecewise_linear(low_pass(1e3 * (1 + i))) for i in range(others + 1)]
    engine = Engine(systems[0], ["out"])
    engine.run(1, EDGES)
    for system in [*systems[1:], systems[0]]:
        engine.set_system(system)
        engine.run(1)
    fresh = Engine(systems[0], ["out"])
    fresh.run(1, EDGES)
    engine.state = fresh.state = engine.state
    assert engine.run(5).tobytes() == fresh.run(5).tobytes()


@pytest.mark.parametrize("program", ["front", "bump-stop", "two-mass"])
def test_other_offsets_have_the_bits_of_a_new_engine(program: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference gets no engine that was used before, and builds every mode."""
    computer = SuspensionComputer(circuit_of(program))
    jumps = [PotTurn(150, {f"{next(iter(computer.dials))}_dial": 0.3})]
    repeated = RepeatedPlay(computer, 300, jumps)
    for number, seed in enumerate((1, 2, 1)):
        offsets_v = np.random.default_rng(seed).uniform(-3e-3, 3e-3, computer.program.amplifiers)
        monkeypatch.setattr(engine_module, "_idle", {})
        new = RepeatedPlay(computer, 300, jumps)
        assert repeated.play(LOUD, offsets_v).volts.tobytes() == new.play(LOUD, offsets_v).volts.tobytes()
        built, built_anew = repeated._engine.counts.modes_built, new._engine.counts.modes_built
        assert built_anew > 0
        assert built < built_anew or number == 0


def test_engine_that_is_used_again_begins_at_rest() -> None:
    def run(ohm: float) -> tuple[bytes, int, list[int]]:
        engine = Engine(piecewise_linear(low_pass(ohm)), ["out", "w"])
        ticks = engine.overdue_ticks.tolist()
        return engine.run(10, EDGES).tobytes(), engine.counts.samples, ticks

    first = run(3.21e3)
    run(4.56e3)
    gc.collect()
    assert run(3.21e3) == first


def test_variants_of_a_circuit_are_told_apart() -> None:
    circuit = low_pass(1e3)
    assert circuit.with_dials({"P": 0.25}) is circuit.with_dials({"P": 0.25})
    for i in range(10):
        dials = {"P": i / 10}
        assert circuit.with_dials(dials).of(Pot)[0].dial == i / 10
        assert circuit.with_switches({"S": i % 2 == 0}).of(Switch)[0].closed == (i % 2 == 0)
        assert np.array_equal(Nodal(circuit).at(dials).abc, circuit.with_dials(dials).derive(Nodal).at({}).abc)
    for _ in range(2):
        with pytest.raises(CircuitError, match="no pot is called 'Q'"):
            circuit.with_dials({"Q": 0.5})


def test_state_space_of_dials_that_were_left_long_ago_is_the_same() -> None:
    nodal = Nodal(low_pass(1e3))
    first = nodal.at({"P": 0.3}, {"S": True}).abc.copy()
    assert not np.array_equal(nodal.at({"P": 0.3}, {"S": False}).abc, first)
    for i in range(40):
        nodal.at({"P": i / 40})
    assert np.array_equal(nodal.at({"P": 0.3}, {"S": True}).abc, first)


def test_noise_is_that_of_its_own_conditions_and_dials() -> None:
    circuit = low_pass(1e3)
    grade = OP_AMP_GRADES["tl07x"]
    cold, warm = (CircuitNoise(circuit, ["out"], op_amps=grade, temperature_c=t) for t in (-20.0, 80.0))
    assert warm.covariance[0, 0] == pytest.approx(cold.covariance[0, 0] * (80.0 + 273.15) / (-20.0 + 273.15))
    before = warm.transition.copy()
    warm.turn({"P": 0.9})
    assert not np.array_equal(warm.transition, before)
    assert np.array_equal(CircuitNoise(low_pass(1e3), ["out"], op_amps=grade).transition, before)
    for i in range(40):
        warm.turn({"P": i / 40})
    warm.turn({"P": 0.5})
    assert np.array_equal(warm.transition, before)


# ---- a play that is repeated gives what SuspensionComputer.play gives, to the bit


OFFSET_V, SAMPLES = 3e-3, 400
REPEATED_JUMPS = [
    PotTurn(150, {"K": 18000.0}),
    PotTurn(151, {"B": 3453.0}),
    PotTurn(SAMPLES - 1, {"K": 24500.0}),
]
FULL = Excitation(low_v=0.1, high_v=9.9)
NO_SLEW = replace(preset("tl07x"), slew_v_per_s=float("inf"))


def fresh(model: OpAmpModel, program: str, seed: int) -> SuspensionComputer:
    return SuspensionComputer(circuit_of(program), opamp=model, rng=np.random.default_rng(seed), offset_v=OFFSET_V)


def offsets_v(model: OpAmpModel, computer: SuspensionComputer, seed: int) -> np.ndarray:
    return drawn_offsets_v(model, np.random.default_rng(seed).random(computer.program.amplifiers), OFFSET_V)


@pytest.mark.parametrize("model", [preset("tl07x"), preset("741"), NO_SLEW], ids=["tl07x", "741", "no slew"])
@pytest.mark.parametrize("program", ["front", "bump-stop", "two-mass"])
def test_every_repeat_is_the_play_of_a_machine_of_its_own(model: OpAmpModel, program: str) -> None:
    first = fresh(model, program, 0)
    jumps = REPEATED_JUMPS if program == "front" else [PotTurn(150, {next(iter(first.dials)) + "_dial": 0.3})]
    repeated = RepeatedPlay(first, SAMPLES, jumps)
    for seed in (5, 0, 7):
        excitation = replace(FULL, clock="free", drift_ppm=5.0 * seed, phase=0.1 * seed)
        own = fresh(model, program, seed)
        volts = np.concatenate(list(own.play(excitation, SAMPLES, jumps)))
        repeat = repeated.play(excitation, offsets_v(model, own, seed))
        assert repeat.volts.tobytes() == volts.tobytes()
        assert repeat.lamps == own.machine.lamps


def test_lamp_of_an_overload_is_lit_in_its_own_repeat_alone() -> None:
    heavy = [PotTurn(100, {"K": 9000.0})]
    computer = fresh(preset("tl07x"), "front", 0)
    computer.set(K=18000.0)
    repeated = RepeatedPlay(computer, SAMPLES, heavy)
    loud, quiet = replace(FULL, low_v=-40.0, high_v=40.0), replace(FULL, high_v=1.0)
    zero_v = np.zeros(computer.program.amplifiers)
    assert any(lamp is not None for lamp in repeated.play(loud, zero_v).lamps.values())
    assert all(lamp is None for lamp in repeated.play(quiet, zero_v).lamps.values())


def test_change_beyond_the_play_is_refused() -> None:
    with pytest.raises(PotError, match="at sample 400"):
        RepeatedPlay(fresh(preset("tl07x"), "front", 0), SAMPLES, [PotTurn(SAMPLES, {"K": 18000.0})])


def test_play_that_fails_does_not_spoil_the_next() -> None:
    computer = fresh(preset("tl07x"), "front", 1)
    repeated = RepeatedPlay(computer, SAMPLES)
    offset_v = offsets_v(preset("tl07x"), computer, 1)
    before = repeated.play(FULL, offset_v).volts
    with pytest.raises(EngineError):
        repeated.play(replace(FULL, high_v=1e308), offset_v * 1e300)
    assert repeated.play(FULL, offset_v).volts.tobytes() == before.tobytes()


def test_ramps_and_amplifiers_without_a_pole_are_not_repeatable() -> None:
    computer = fresh(preset("tl07x"), "front", 0)
    assert is_repeatable(computer, REPEATED_JUMPS)
    assert not is_repeatable(computer, [PotTurn(10, {"K": 18000.0}, 5)])
    assert not is_repeatable(SuspensionComputer("front", opamp="ideal"), [])
    with pytest.raises(CircuitError, match="without a pole"):
        RepeatedPlay(SuspensionComputer("front", opamp="ideal"), SAMPLES)
    assert PRESETS["ideal"] == OpAmpModel()


def test_courses_of_many_are_each_those_of_a_machine_of_its_own() -> None:
    """From rest to a change, and from there on; edges fall between samples, and one of them on a sample."""
    model, seeds, phases = preset("tl07x"), (5, 0, 7), np.array([0.0, 0.123, 0.5])
    excitation = replace(FULL, clock="free", drift_ppm=3.0)
    first = fresh(model, "front", 0)
    offsets = np.stack([offsets_v(model, first, seed) for seed in seeds])
    together = RepeatedCourses(Wired(first, first), excitation, phases, offsets, SAMPLES, 1)
    before, after = dict(first.program.values), {**first.program.values, "K": 18000.0}
    courses, states = together.play(before, 0, 150, None)
    later, ends = together.play(after, 150, 100, states)
    for i, seed in enumerate(seeds):
        own = fresh(model, "front", seed)
        wired = {1.0: Wired(own, own)}
        alone = Courses(wired.__getitem__, Card(), replace(excitation, phase=float(phases[i])), SAMPLES, 1)
        course = alone.course(alone.at_rest(before), before, before)
        assert course.advance(150).tobytes() == courses[i].tobytes()
        moment = course.moment()
        assert (moment.sample, moment.state.tobytes()) == (150, states[i].tobytes())
        following = alone.course(moment, after, after)
        assert following.advance(100).tobytes() == later[i].tobytes()
        assert following.moment().state.tobytes() == ends[i].tobytes()


def test_courses_from_states_of_another_machine_are_refused() -> None:
    first = fresh(preset("tl07x"), "front", 0)
    offsets = np.zeros((2, first.program.amplifiers))
    together = RepeatedCourses(Wired(first, first), FULL, np.zeros(2), offsets, SAMPLES, 1)
    with pytest.raises(EngineError, match=r"the states of the plays have shape \(2, 7\), got \(2, 1\)"):
        together.play(first.program.values, 10, 20, np.zeros((2, 1)))
