"""The emulator against ngspice on the exported circuit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

import numpy as np
import pytest
from numpy.typing import NDArray

from analogrig_emulator import (
    FRONT,
    SHOCK,
    TICKS_PER_SAMPLE,
    Circuit,
    CircuitError,
    Components,
    Engine,
    Excitation,
    OpAmpModel,
    PotTurn,
    SuspensionComputer,
    piecewise_linear,
    to_spice,
)

NgSpice = Callable[[str, Sequence[str], int], NDArray[np.float64]]
Volts = NDArray[np.float64]

LSB_V = 10.0 / 4096
SAMPLE_RATE_HZ = 20e3
THESIS_CHANGES = (
    PotTurn(200, {"K": 18000.0}),
    PotTurn(400, {"B": 3453.0}),
    PotTurn(500, {"B": 2123.0, "K": 20000.0}),
    PotTurn(600, {"M": 30.0}),
)
AMPLIFIERS = ("u1", "u2", "u3", "u4", "u5")
LINEAR_PLAYS = pytest.mark.parametrize(
    ("program", "changes", "samples"),
    [
        ("front", THESIS_CHANGES, 800),
        ("shock", (), 200),
        pytest.param("front", (), 800, marks=pytest.mark.heavy),
        pytest.param("shock", (), 800, marks=pytest.mark.heavy),
    ],
)


def deck_of(
    computer: SuspensionComputer,
    excitation: Excitation,
    samples: int,
    changes: Sequence[PotTurn] = (),
) -> str:
    return to_spice(
        computer.circuit,
        samples=samples,
        edges={"F": excitation.edges(0, samples * TICKS_PER_SAMPLE, SAMPLE_RATE_HZ)},
        turns=[PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes],
    )


def every_amplifier(computer: SuspensionComputer, excitation: Excitation, samples: int) -> Volts:
    engine = Engine(piecewise_linear(computer.circuit), AMPLIFIERS)
    return engine.run(samples, {"F": excitation.edges(*engine.window(samples), SAMPLE_RATE_HZ)})


@LINEAR_PLAYS
def test_displacement_and_velocity_agree_with_ngspice_at_every_sample(
    ngspice: NgSpice, program: str, changes: Sequence[PotTurn], samples: int
) -> None:
    computer = SuspensionComputer(program)
    reference = ngspice(deck_of(computer, Excitation(), samples, changes), ("u5", "u2"), samples)
    volts = np.concatenate(list(computer.play(Excitation(), samples, changes)))
    assert np.abs(volts[:, 1:3] - reference).max() < 0.05 * LSB_V


@LINEAR_PLAYS
def test_every_amplifier_agrees_with_ngspice_at_every_sample(
    ngspice: NgSpice, program: str, changes: Sequence[PotTurn], samples: int
) -> None:
    """The edges come between samples: at an edge's own instant ngspice still shows the level before it."""
    computer, excitation = SuspensionComputer(program), Excitation(clock="free", phase=0.637)
    reference = ngspice(deck_of(computer, excitation, samples, changes), AMPLIFIERS, samples)
    turns = [PotTurn(change.sample, computer.dials_for(**change.values)) for change in changes]
    volts = played_with_turns(computer.circuit, excitation, samples, turns)
    assert np.abs(volts - reference).max() < 0.05 * LSB_V


def test_a_generator_with_a_clock_of_its_own_agrees_with_ngspice_at_every_amplifier(ngspice: NgSpice) -> None:
    computer = SuspensionComputer("front", rng=np.random.default_rng(1), offset_v=3e-3)
    excitation = Excitation(clock="free", drift_ppm=200.0, phase=0.637, frequency_hz=317.0)
    reference = ngspice(deck_of(computer, excitation, 400), AMPLIFIERS, 400)
    assert np.abs(every_amplifier(computer, excitation, 400) - reference).max() < 0.05 * LSB_V


def test_slewing_and_clamping_amplifiers_agree_with_ngspice(ngspice: NgSpice) -> None:
    # 741s slew for 40 us at each edge of this drive, and twice the summer's gain drives U1 into its clamp.
    computer = SuspensionComputer("front", opamp="741", components=Components(given={"RFB": 1.0}))
    excitation = Excitation(low_v=-10.0, high_v=10.0, frequency_hz=400.0, clock="free", phase=0.237)
    reference = ngspice(deck_of(computer, excitation, 300), AMPLIFIERS, 300)
    volts = every_amplifier(computer, excitation, 300)
    assert np.abs(volts[:, 0]).max() > 13.3
    assert np.abs(volts - reference).max() < 0.05 * LSB_V


@pytest.mark.parametrize("seed", [*range(12), *(pytest.param(seed, marks=pytest.mark.heavy) for seed in range(12, 50))])
def test_random_machines_agree_with_ngspice_at_every_amplifier(ngspice: NgSpice, seed: int) -> None:
    """Parts, op-amps, pots turned, edges at any instant: all drawn from the seed in the test's name."""
    rng = np.random.default_rng(seed)
    computer = random_machine(rng)
    excitation = random_excitation(rng)
    samples = 70
    # Not right after sample 0: ngspice has no time point between the two.
    instants = np.sort(rng.choice(np.arange(1, samples - 10), 3, replace=False)).tolist()
    turns = [PotTurn(int(instant), {str(rng.choice(["M", "B", "K"])): rng.uniform(0.1, 1.0)}) for instant in instants]
    edges = excitation.edges(0, samples * TICKS_PER_SAMPLE, SAMPLE_RATE_HZ)
    deck = to_spice(computer.circuit, samples=samples, edges={"F": edges}, turns=turns)
    reference = ngspice(deck, AMPLIFIERS, samples)
    volts = played_with_turns(computer.circuit, excitation, samples, turns)
    assert np.abs(volts - reference).max() < 0.05 * LSB_V


def random_machine(rng: np.random.Generator) -> SuspensionComputer:
    program = (FRONT, SHOCK)[rng.integers(2)]
    given = {_element(field.name): rng.uniform(0.7, 1.4) - 1.0 for field in fields(program.parts)}
    model = OpAmpModel(
        avol=10 ** rng.uniform(4, 6),
        gbw_hz=10 ** rng.uniform(5.7, 7.3),
        slew_v_per_s=10 ** rng.uniform(5.5, 7.5),
        swing_v=(-rng.uniform(8, 14), rng.uniform(8, 14)),
        rout_ohm=rng.uniform(10, 300),
    )
    # Pots are set from the program's nominal parts, whatever these are.
    for pot in ("M", "B", "K"):
        del given[pot]
    return SuspensionComputer(program, opamp=model, components=Components(given=given), rng=rng, offset_v=5e-3)


def _element(part: str) -> str:
    """The element that has the value of a field of SuspensionParts: RFB for rfb_ohm, R4 for r4_in_ohm."""
    return "".join(word for word in part.split("_") if word not in ("pot", "in", "ohm", "farad")).upper()


def random_excitation(rng: np.random.Generator) -> Excitation:
    return Excitation(
        shape=str(rng.choice(["square", "prbs"])),
        low_v=rng.uniform(-10, 0),
        high_v=rng.uniform(0, 10),
        frequency_hz=rng.uniform(100, 900),
        clock="free",
        phase=rng.uniform(),
    )


def played_with_turns(circuit: Circuit, excitation: Excitation, samples: int, turns: Sequence[PotTurn]) -> Volts:
    engine = Engine(piecewise_linear(circuit), AMPLIFIERS)
    blocks = []
    for sample, dials, _ in [*turns, PotTurn(samples - 1, {})]:
        count = sample + 1 - engine.recorded
        blocks.append(engine.run(count, {"F": excitation.edges(*engine.window(count), SAMPLE_RATE_HZ)}))
        circuit = circuit.with_dials(dials)
        engine.set_system(piecewise_linear(circuit))
    return np.concatenate(blocks)


def test_ideal_amplifiers_can_be_exported(ngspice: NgSpice) -> None:
    computer = SuspensionComputer("shock", opamp="ideal")
    excitation = Excitation()
    reference = ngspice(deck_of(computer, excitation, 120), ("u5", "u2"), 120)
    volts = np.concatenate(list(computer.play(excitation, 120)))
    assert np.abs(volts[:, 1:3] - reference).max() < 0.05 * LSB_V


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"nodes": ["nowhere"]}, "no node is called 'nowhere'"),
        ({"edges": {"G": Excitation().edges(0, 1, SAMPLE_RATE_HZ)}}, "no input is called 'G'; there are F"),
        ({"turns": [PotTurn(3, {"Q": 0.5})]}, "no pot is called 'Q'; there are B, K, M"),
    ],
)
def test_what_the_circuit_does_not_have_is_refused_by_name(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(CircuitError, match=message):
        to_spice(SuspensionComputer().circuit, samples=10, **arguments)  # type: ignore[arg-type]
