"""A play that is repeated gives what SuspensionComputer.play gives, to the bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analogrig_emulator import (
    Card,
    CircuitError,
    Courses,
    EngineError,
    Excitation,
    OpAmpModel,
    PotError,
    PotTurn,
    RepeatedCourses,
    RepeatedPlay,
    SuspensionComputer,
    Wired,
    drawn_offsets_v,
    is_repeatable,
    preset,
)
from analogrig_emulator.circuit.opamp import PRESETS
from tests.emulator.programs import circuit_of

OFFSET_V, SAMPLES = 3e-3, 400
JUMPS = [
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
    jumps = JUMPS if program == "front" else [PotTurn(150, {next(iter(first.dials)) + "_dial": 0.3})]
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
    assert is_repeatable(computer, JUMPS)
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
