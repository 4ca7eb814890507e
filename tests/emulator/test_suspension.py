"""The suspension against the equations of its plant."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import scipy.signal

from analogrig_emulator import (
    FRONT,
    PROGRAMS,
    CircuitError,
    Components,
    EngineError,
    Excitation,
    ExcitationError,
    OpAmpModel,
    PotError,
    PotTurn,
    ProgramCircuit,
    SuspensionComputer,
)
from tests.emulator.plays import LSB_V, THESIS_CHANGES, Volts


def played(
    computer: SuspensionComputer, samples: int, changes: Sequence[PotTurn] = (), excitation: Excitation | None = None
) -> Volts:
    return np.concatenate(list(computer.play(excitation or Excitation(), samples, changes)))


def plant(program: ProgramCircuit, force_n: Volts, changes: Sequence[PotTurn] = ()) -> Volts:
    """M x'' + B x' + K x = F with F held between samples, exactly, by scipy: x in m, v in m/s, (samples, 2)."""
    values = program.values
    turns = {change.sample: change.values for change in changes}
    x = np.zeros(2)
    rows = []
    for k, force in enumerate(force_n):
        rows.append(x)
        if k in turns or not k:
            values = {**values, **turns.get(k, {})}
            mass, damping, stiffness = values["M"], values["B"], values["K"]
            a = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]])
            b = np.array([[0.0], [1.0 / mass]])
            step, drive, *_ = scipy.signal.cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), 200 * 50e-6)
        x = step @ x + drive[:, 0] * force
    return np.array(rows)


@pytest.mark.parametrize(("program", "changes"), [("front", THESIS_CHANGES), ("shock", ())])
def test_with_ideal_amplifiers_it_is_the_plant(program: str, changes: Sequence[PotTurn]) -> None:
    computer = SuspensionComputer(program, opamp="ideal")
    volts = played(computer, 800, changes)
    scales = computer.scales
    expected = plant(computer.program, volts[:, 0] / scales.volts("force"), changes)
    np.testing.assert_allclose(volts[:, 1], expected[:, 0] * scales.volts("displacement"), rtol=0, atol=1e-9)
    np.testing.assert_allclose(volts[:, 2], expected[:, 1] * scales.volts("velocity"), rtol=0, atol=1e-9)


def test_net_force_is_force_less_damper_and_spring() -> None:
    computer = SuspensionComputer("front", opamp="ideal")
    force_v, x_v, v_v, net_v = played(computer, 200).T
    scales = computer.scales
    net_n = (
        force_v / scales.volts("force")
        - 3021.0 * v_v / scales.volts("velocity")
        - 24500.0 * x_v / scales.volts("displacement")
    )
    np.testing.assert_allclose(net_v, net_n * scales.volts("net_force"), rtol=0, atol=1e-9)


def test_the_shock_absorber_obeys_the_difference_equation_of_the_thesis() -> None:
    """Equ 4.3, recomputed: y in m, u in N."""
    computer = SuspensionComputer("shock", opamp="ideal")
    volts = played(computer, 300, excitation=Excitation(shape="prbs", frequency_hz=1000.0))
    u, y = volts[:, 0] / computer.scales.volts("force"), volts[:, 1] / computer.scales.volts("displacement")
    predicted = 0.88171 * y[1:-1] - 0.01111 * y[:-2] + 0.83726e-5 * u[1:-1] + 0.21906e-5 * u[:-2]
    # Coefficients of five digits on a swing of 0.12 m.
    np.testing.assert_allclose(y[2:], predicted, rtol=0, atol=2e-6)


def test_amplifiers_much_faster_than_the_samples_are_ideal() -> None:
    ideal = played(SuspensionComputer("front", opamp="ideal"), 200)
    fast = played(SuspensionComputer("front", opamp=OpAmpModel(gbw_hz=1e11)), 200)
    assert np.abs(fast - ideal)[:, 1:3].max() < 0.01 * LSB_V


def test_tl07x_amplifiers_differ_from_ideal_ones_by_about_an_lsb() -> None:
    """1 to 3 LSB, for bandwidth and slew together, is what ngspice gave for this circuit."""
    ideal = played(SuspensionComputer("front", opamp="ideal"), 800, THESIS_CHANGES)
    real = played(SuspensionComputer("front"), 800, THESIS_CHANGES)
    assert 1.0 < np.abs(real - ideal)[:, 1].max() / LSB_V < 3.0


def test_the_thesis_profile_stays_within_the_ranges_seen() -> None:
    volts = played(SuspensionComputer("front"), 800, THESIS_CHANGES)
    assert volts[:, 1].min() == pytest.approx(-0.34, abs=0.01)
    assert volts[:, 1].max() == pytest.approx(8.01, abs=0.01)
    assert np.abs(volts[:, 2]).max() < 5.7


@pytest.mark.parametrize(
    ("program", "coefficients"),
    [("shock", {"M": 0.7350, "B": 0.4065, "K": 0.8300}), ("front", {"M": 0.2557, "B": 0.6823, "K": 0.8300})],
)
def test_coefficients_are_those_of_the_set_up_sheet(program: str, coefficients: dict[str, float]) -> None:
    assert SuspensionComputer(program).coefficients == pytest.approx(coefficients, abs=6e-5)


@pytest.mark.parametrize("program", PROGRAMS)
def test_all_programs_move_as_far_for_10_v(program: str) -> None:
    """README.md: 200 times 2 m/s times R2 C2 = 49.9k 10n."""
    assert PROGRAMS[program].scales.full("displacement") == pytest.approx(0.1996, rel=1e-12)


def test_a_change_at_k_shows_first_at_the_next_sample() -> None:
    computer = SuspensionComputer("front")
    plain = played(computer, 300)
    changeed = played(computer, 300, [PotTurn(130, {"K": 18000.0})])
    assert np.array_equal(changeed[:131], plain[:131])
    assert abs(changeed[131, 3] - plain[131, 3]) > 1.0


def test_a_change_to_the_same_value_changes_no_bit() -> None:
    plain = played(SuspensionComputer("front"), 300)
    same = played(SuspensionComputer("front"), 300, [PotTurn(123, {"M": FRONT.M_kg, "K": FRONT.K_n_per_m})])
    assert np.array_equal(plain, same)


@pytest.mark.parametrize("block_samples", [1, 7, 200, 5000])
def test_the_size_of_the_blocks_changes_no_bit(block_samples: int) -> None:
    excitation = Excitation(clock="free", phase=0.77, drift_ppm=20.0)
    whole = played(SuspensionComputer("front"), 800, THESIS_CHANGES, excitation)
    blocks = list(SuspensionComputer("front").play(excitation, 800, THESIS_CHANGES, block_samples))
    assert {len(block) for block in blocks[:-1]} <= {block_samples}
    assert np.array_equal(np.concatenate(blocks), whole)


def test_setting_a_pot_between_blocks_is_a_change() -> None:
    changeed = played(SuspensionComputer("front"), 300, [PotTurn(199, {"M": 30.0})])
    computer = SuspensionComputer("front")
    blocks = []
    for block in computer.play(Excitation(), 300, block_samples=100):
        blocks.append(block)
        if len(blocks) == 2:
            computer.set(M=30.0)
    assert np.array_equal(np.concatenate(blocks), changeed)


def test_every_play_starts_from_rest_with_the_pots_where_they_were_left() -> None:
    computer = SuspensionComputer("front")
    first = played(computer, 100)
    assert np.array_equal(played(computer, 100), first)
    played(computer, 100, [PotTurn(50, {"M": 60.0})])
    assert np.array_equal(played(computer, 100), played(_set(SuspensionComputer("front"), M=60.0), 100))


def _set(computer: SuspensionComputer, **settings: float) -> SuspensionComputer:
    computer.set(**settings)
    return computer


def test_a_newer_play_ends_the_older_one() -> None:
    computer = SuspensionComputer("front")
    older = computer.play(Excitation(), 100, block_samples=10)
    next(older)
    computer.play(Excitation(), 100)
    with pytest.raises(EngineError, match="ended by a newer one"):
        next(older)


def test_a_dial_is_set_as_it_stands_and_a_coefficient_under_load() -> None:
    computer = SuspensionComputer("front")
    computer.set(K_dial=0.5)
    # 10 k in the middle, loaded by 49.9 k: 5 k against 5 k parallel to 49.9 k.
    assert computer.coefficients["K"] == pytest.approx(1 / (1 + 5e3 * (1 / 5e3 + 1 / 49.9e3)))
    assert computer.dials_for(M=30.0) == pytest.approx({"M": 0.9818}, abs=1e-4)
    assert computer.circuit.with_dials({}) == computer.circuit


def test_offsets_come_from_the_generator_and_move_the_rest_position() -> None:
    still = Excitation(low_v=0.0, high_v=0.0)
    rest = [
        played(SuspensionComputer("front", rng=np.random.default_rng(seed), offset_v=3e-3), 400, excitation=still)[-1]
        for seed in (1, 1, 2)
    ]
    assert np.array_equal(rest[0], rest[1])
    assert not np.array_equal(rest[0], rest[2])
    assert 0.1 * LSB_V < abs(rest[0][1]) < 10 * LSB_V
    assert np.abs(played(SuspensionComputer("front"), 10, excitation=still)).max() == 0.0


def test_parts_off_their_nominal_values_move_the_plant_and_not_the_pots() -> None:
    soft = SuspensionComputer("front", opamp="ideal", components=Components(given={"RFB": 0.01}))
    assert soft.coefficients == pytest.approx(SuspensionComputer("front").coefficients)
    assert played(soft, 100, excitation=Excitation(frequency_hz=10.0))[-1, 3] != 0.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"M": 29.0},
            r"M = 29 cannot be set on program front, whose M is at least 29\.4: pot M: coefficient 1.01379 is beyond",
        ),
        ({"K": -1.0}, "pot K: K must be positive"),
        ({"B_dial": 1.5}, "pot B: dial 1.5 is beyond the track"),
        ({"M": 50.0, "M_dial": 0.5}, "pot M: set twice"),
        ({"mass": 50.0}, "unknown setting 'mass'; there are M,"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_and_nothing_turns(settings: dict[str, float], message: str) -> None:
    computer = SuspensionComputer("front")
    before = computer.dials
    with pytest.raises(PotError, match=message):
        computer.set(K=20000.0, **settings) if "K" not in settings else computer.set(**settings)
    assert computer.dials == before
    with pytest.raises(PotError, match=message):
        computer.play(Excitation(), 100, [PotTurn(10, settings)])


def test_arguments_that_cannot_be_are_refused_before_the_first_sample() -> None:
    computer = SuspensionComputer("front")
    with pytest.raises(PotError, match="change of M at sample 100: the run has samples 0 to 99"):
        computer.play(Excitation(), 100, [PotTurn(100, {"M": 60.0})])
    for sample in (5.0, 5.5, math.nan):
        with pytest.raises(PotError, match="change of M at sample .*: the run has samples 0 to 99"):
            computer.play(Excitation(), 100, [PotTurn(sample, {"M": 60.0})])  # type: ignore[arg-type]
    with pytest.raises(PotError, match=r"pots M: cannot turn in 2\.5 samples"):
        computer.play(Excitation(), 100, [PotTurn(5, {"M": 60.0}, 2.5)])  # type: ignore[arg-type]
    with pytest.raises(ExcitationError, match="half the sample rate"):
        computer.play(Excitation(frequency_hz=15e3), 100)
    with pytest.raises(EngineError, match="-1 samples"):
        computer.play(Excitation(), -1)
    with pytest.raises(CircuitError, match="unknown program 'rear'; there are front, shock, or load_patch"):
        SuspensionComputer("rear")
    for offset_v in (math.nan, math.inf, -1e-3):
        with pytest.raises(CircuitError, match="offset_v must be finite and not negative"):
            SuspensionComputer("front", rng=np.random.default_rng(1), offset_v=offset_v)


@pytest.mark.parametrize(("program", "changes"), [("front", THESIS_CHANGES), ("shock", ())])
def test_a_healthy_play_lights_no_lamp(program: str, changes: Sequence[PotTurn]) -> None:
    computer = SuspensionComputer(program, rng=np.random.default_rng(1))
    played(computer, 800, changes)
    assert computer.machine.lamps == dict.fromkeys(("U1", "U2", "U3", "U4", "U5"))


def test_a_play_that_overloads_the_summer_lights_its_lamp() -> None:
    """A force that falls from +10 to -10 V asks -20 V of it at sample 50; 10 us later its lamp is lit."""
    computer = SuspensionComputer("front")
    volts = played(computer, 100, excitation=Excitation(low_v=-10.0))
    assert volts[:, 3].min() == pytest.approx(-13.5, abs=0.2)
    assert computer.machine.lamps == {"U1": 51, "U2": None, "U3": None, "U4": None, "U5": None}
    played(computer, 100)
    assert computer.machine.lamps["U1"] is None
