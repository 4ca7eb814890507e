"""Pots that are turned while the machine plays: the way they take, where wipers rest, and what their contacts do."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from analogrig_emulator import (
    COMPONENTS,
    TICKS_PER_SAMPLE,
    AnalogComputer,
    Card,
    Components,
    Excitation,
    Mode,
    ModeError,
    NoisySuspension,
    OpAmpGrade,
    PotError,
    PotGrade,
    PotTurn,
    SuspensionComputer,
    acquired,
    probes_per_sample,
)
from tests.emulator.plays import LSB_V, Volts

PERIOD_S = 50e-6
BUSY = Excitation(low_v=1.0, high_v=9.0)
K_RAMP: PotTurn = PotTurn(120, {"K": 18000.0}, 80)


def played(computer: SuspensionComputer, samples: int, changes: Sequence[PotTurn] = (), block: int = 4096) -> Volts:
    return np.concatenate(list(computer.play(BUSY, samples, changes, block)))


def under_load(dial: float, load_ohm: float) -> float:
    """Coefficient of a 10k track by Kirchhoff: the lower leg parallel to the load, after the upper leg."""
    lower_ohm = 1.0 / (1.0 / (dial * 10e3) + 1.0 / load_ohm)
    return lower_ohm / (lower_ohm + (1.0 - dial) * 10e3)


def by_equation(goal_dials: dict[str, float], sample: int, ramp_n: int, samples: int) -> Volts:
    """Displacement and velocity in V, (samples, 2), of the front suspension whose dials turn evenly, by integration.

    10 V: 2940 N, 0.1996 m, 2 m/s; k_M feeds 100k and 1 nF, k_B 33.2k and k_K 49.9k into a summer of 100k.
    """
    start = SuspensionComputer("front").dials
    loads_ohm = {"M": 100e3, "B": 33.2e3, "K": 49.9e3}

    def coefficient(pot: str, tau_s: float) -> float:
        part = min(max((tau_s / PERIOD_S - sample) / ramp_n, 0.0), 1.0)
        return under_load(start[pot] + (goal_dials.get(pot, start[pot]) - start[pot]) * part, loads_ohm[pot])

    def slope(tau_s: float, state: Volts, force_v: float) -> list[float]:
        x, v = state
        net_v = force_v - coefficient("B", tau_s) * v / 0.332 - coefficient("K", tau_s) * x / 0.499
        return [v / (49.9e3 * 10e-9), coefficient("M", tau_s) * net_v / (100e3 * 1e-9)]

    state, rows = np.zeros(2), [np.zeros(2)]
    for k in range(samples - 1):
        force_v = 9.0 if k % 100 < 50 else 1.0
        span = (k * PERIOD_S, (k + 1) * PERIOD_S)
        state = solve_ivp(slope, span, state, "DOP853", rtol=1e-9, atol=1e-10, args=(force_v,)).y[:, -1]
        rows.append(state)
    return np.array(rows)


@pytest.mark.parametrize(
    ("settings", "ramp_n"),
    [({"K": 18000.0}, 80), ({"M": 60.0}, 37), ({"B": 2123.0, "M": 90.0}, 3)],
    ids=str,
)
def test_a_turning_pot_is_an_equation_with_moving_coefficients(settings: dict[str, float], ramp_n: int) -> None:
    computer = SuspensionComputer("front", opamp="ideal")
    expected = by_equation(computer.dials_for(**settings), 120, ramp_n, 230)
    volts = played(computer, 230, [PotTurn(120, settings, ramp_n)])
    assert np.abs(volts[:, 1:3] - expected)[:, 0].max() < 0.1 * LSB_V
    assert np.abs(volts[:, 1:3] - expected)[:, 1].max() < 0.2 * LSB_V


def test_a_ramp_begins_at_its_sample_and_ends_with_the_pot_at_its_goal() -> None:
    computer = SuspensionComputer("front")
    still = played(computer, 400)
    ramped = played(computer, 400, [K_RAMP])
    assert np.array_equal(ramped[:121], still[:121])
    assert not np.array_equal(ramped[121:125], still[121:125])
    assert computer.dials == SuspensionComputer("front").dials | computer.dials_for(K=18000.0)


def test_a_ramp_of_no_length_is_a_jump_and_one_to_the_same_value_is_nothing() -> None:
    jumped = played(SuspensionComputer("front"), 300, [PotTurn(120, {"K": 18000.0}, 0)])
    plain = np.concatenate(list(SuspensionComputer("front").play(BUSY, 300, [PotTurn(120, {"K": 18000.0})])))
    assert np.array_equal(jumped, plain)
    same = played(SuspensionComputer("front"), 300, [PotTurn(120, {"K": 24500.0}, 50)])
    assert np.array_equal(same, played(SuspensionComputer("front"), 300))


@pytest.mark.parametrize("block", [1, 7, 150])
def test_the_size_of_the_blocks_changes_no_bit_of_ramps_that_overlap(block: int) -> None:
    built = Components(pots=PotGrade(windings=1000, wiper_noise_ohm=100.0))
    ramps: list[PotTurn] = [K_RAMP, PotTurn(150, {"M": 60.0}, 100), PotTurn(180, {"K": 22000.0}, 0)]
    whole = played(SuspensionComputer("front", components=built), 300, ramps)
    assert np.array_equal(played(SuspensionComputer("front", components=built), 300, ramps, block), whole)


def test_a_pot_turned_again_on_its_way_goes_on_from_where_it_is() -> None:
    machine = SuspensionComputer("front").machine
    machine.switch(Mode.OPERATE)
    machine.run(11)
    machine.turn({"K": 0.4512}, ramp_n=40)
    machine.run(10)
    assert machine.dials["K"] == pytest.approx(0.8511 + (0.4512 - 0.8511) / 4, abs=1e-4)
    machine.turn({"K": 0.8}, ramp_n=10)
    machine.run(10)
    assert machine.dials["K"] == 0.8


def test_wipers_rest_on_windings_however_the_pot_is_turned() -> None:
    built = Components(pots=PotGrade(windings=200))
    machine = SuspensionComputer("front", components=built).machine
    machine.turn({"K": 0.5012})
    assert machine.dials["K"] == 0.5
    machine.switch(Mode.POT_SET)
    machine.set_coefficient("K", 0.61)
    assert machine.dials["K"] * 200 == round(machine.dials["K"] * 200)
    assert machine.coefficient("K") == pytest.approx(0.61, abs=0.5 / 200)
    assert SuspensionComputer("front", components=built).dials["B"] * 200 == pytest.approx(145.0, abs=1e-9)


def test_a_turning_wiper_goes_from_winding_to_winding() -> None:
    built = Components(pots=PotGrade(windings=20))
    machine = SuspensionComputer("front", components=built).machine
    machine.switch(Mode.OPERATE)
    machine.run(1)
    machine.turn({"K": 0.45}, ramp_n=160)
    stood = []
    for _ in range(160):
        machine.run(1)
        stood.append(machine.dials["K"] * 20)
    assert {round(place) for place in stood} == set(range(9, 18))
    assert np.allclose(stood, np.round(stood))


def noisy(seed: int = 1, **grade: float) -> SuspensionComputer:
    return SuspensionComputer("front", opamp="ideal", components=Components(pots=PotGrade(**grade), seed=seed))  # type: ignore[arg-type]


def test_a_wiper_is_noisy_while_it_turns_and_at_no_other_time() -> None:
    silent, loud = played(noisy(), 400, [K_RAMP]), played(noisy(wiper_noise_ohm=100.0), 400, [K_RAMP])
    deviation = np.abs(loud - silent)
    # A contact that stands has 100 ohm / 10^6 and 1e12 ohm beside it.
    assert deviation[:121].max() < 1e-3 * LSB_V
    # 0..100 ohm in series with 49.9k and 2.1k of the track: up to 0.2 % of what the spring contributes, some 8 V.
    turning = deviation[122:200, 3]
    assert 1e-3 < turning.mean() < 16e-3
    assert deviation[202:210, 3].max() < deviation[122:200, 3].max()
    assert deviation[-1].max() < 0.05 * LSB_V


def test_contact_noise_comes_from_the_seed() -> None:
    first, again, other = (played(noisy(seed, wiper_noise_ohm=100.0), 250, [K_RAMP]) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert np.abs(other - first).max() > LSB_V


def test_lists_of_pots_do_not_show_their_contacts() -> None:
    computer = SuspensionComputer("front", components=Components(pots=PotGrade(wiper_noise_ohm=100.0)))
    assert set(computer.dials) == set(computer.coefficients) == {"M", "B", "K"}
    with pytest.raises(PotError, match="no pot is called 'K_contact'; there are B, K, M"):
        computer.machine.turn({"K_contact": 0.5})
    silent = SuspensionComputer("front").machine
    for machine in (computer.machine, silent):
        machine.switch(Mode.POT_SET)
    assert computer.machine.coefficient("K") == pytest.approx(silent.coefficient("K"), rel=1e-7)


def test_relays_do_not_switch_within_a_run_while_a_pot_turns() -> None:
    machine = SuspensionComputer("front").machine
    machine.switch(Mode.OPERATE)
    machine.run(2)
    machine.turn({"K": 0.5}, ramp_n=10)
    with pytest.raises(ModeError, match="while K are being turned"):
        machine.run(5, switches=[(machine.window(5)[0], Mode.HOLD)])
    with pytest.raises(ModeError, match="within a run"):
        machine.run(5, switches=[(2 * TICKS_PER_SAMPLE, Mode.HOLD)])
    machine.switch(Mode.HOLD)
    machine.restart()
    assert 0.8 < machine.dials["K"] < 0.86


def test_a_ramp_lasts_as_many_samples_of_the_card_however_fast_the_machine_runs() -> None:
    card = Card(ranges_v=((-1.0, 11.0),) * 4)
    fast = Card(ranges_v=((-1.0, 11.0),) * 4, skew_s=(0.0, 0.0, 0.0, 25e-6))
    assert probes_per_sample(fast) == 2
    seen = []
    for each in (card, fast):
        machine = SuspensionComputer("front", sample_rate_hz=each.rate_hz * probes_per_sample(each))
        blocks = acquired(machine, each, BUSY, 300, [K_RAMP], rng=np.random.default_rng(1))
        seen.append(np.concatenate(list(blocks))[:, 1])
    assert np.abs(seen[0] - seen[1]).max() < 0.1 * LSB_V


def test_a_noisy_machine_is_ramped_too() -> None:
    computer = SuspensionComputer("front", components=COMPONENTS["polypropylene"])
    silent = played(SuspensionComputer("front", components=COMPONENTS["polypropylene"]), 300, [K_RAMP])
    machine = NoisySuspension(computer, np.random.default_rng(1), op_amps=OpAmpGrade(noise_v_per_rthz=18e-9))
    volts = np.concatenate(list(machine.play(BUSY, 300, [K_RAMP])))
    assert 0.0 < np.abs(volts - silent)[:, 1].max() < LSB_V


def test_a_ramp_that_cannot_be_is_refused() -> None:
    machine = SuspensionComputer("front").machine
    before = machine.dials
    for ramp_n in (-1, 2.5, 5.0, math.nan):
        with pytest.raises(PotError, match=f"pots K: cannot turn in {ramp_n} samples"):
            machine.turn({"K": 0.5}, ramp_n=ramp_n)  # type: ignore[arg-type]
    assert machine.dials == before
    assert isinstance(machine, AnalogComputer)
