"""Estimates are right when the plant has been still, and numbers whatever comes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given

from emulator.excitation import Excitation
from harness.bench import Bench
from harness.dut import Dut
from harness.played import Finding, Played
from harness.properties import Play, is_playable, with_some_seed
from harness.rigs.emulator import EmulatorDescription, EmulatorRig
from harness.rigs.rig import Rig
from harness.scenario import Scenario
from harness.strategies import profile, rigs, scenarios, seeds
from harness.verdict import judge

WITHIN = 0.1
"""Of M, B and K each: six times the rms error of the worst plant drawn."""

PAUSED = Scenario(
    samples=16_000,
    excitation=Excitation(low_v=0.1, high_v=9.9, frequency_hz=200.0 / 130.0, shape="pulse", duty=0.01),
    name="paused",
)
"""An edge, and another 130 samples later, every 13,000: between them nothing is to be learned."""
PAUSE_END_N = 13_000

STEADY = Scenario(samples=2000, excitation=Excitation(low_v=0.1, high_v=9.9), name="steady")
HOLD_OFF_N, WARM_UP_N = 80, 120


def estimates(played: Played) -> Finding:
    return played.estimates(WITHIN)


@pytest.mark.needs("excite")
@profile()
@given(scenario=scenarios(most_changes=0), seed=seeds())
def test_estimates_come_to_the_truth(rig: Rig, play: Play, scenario: Scenario, seed: int) -> None:
    assume(is_playable(rig, scenario))
    assert with_some_seed(play, scenario, seed, estimates)


@profile()
@given(rig=rigs(most_noise_lsb=200.0), scenario=scenarios(), seed=seeds())
def test_whatever_comes_the_device_answers_with_numbers(
    dut: Dut, rig: EmulatorDescription, scenario: Scenario, seed: int
) -> None:
    run = Bench(EmulatorRig(rig), dut).play(scenario, seed)
    assert not run.conditions.faults
    for name in ("theta", "innovation", "statistic"):
        assert np.isfinite(getattr(run, name)).all(), name
    assert (run.statistic >= 0.0).all()
    ceiling = judge(run).ceiling
    assert ceiling is None or (run.statistic[run.alarm_index] >= np.float32(ceiling)).all()


@pytest.fixture
def trusting(dut: Dut) -> Dut:
    """A device that takes a displacement that does not move for a measurement."""
    dut.configure(dataclasses.replace(dut.estimator, stuck_n=0))
    return dut


@pytest.mark.parametrize("rig", ["emulator-ideal"], indirect=True)
def test_a_pause_of_the_excitation_does_no_harm(trusting: Dut, play: Play) -> None:
    played = play(PAUSED, 1)
    assert played.run.samples == PAUSED.samples, trusting.name
    while_paused = played.run.alarm_index[played.run.alarm_index < PAUSE_END_N]
    assert not len(while_paused), f"alarms at {while_paused.tolist()}"
    assert np.isfinite(played.run.theta).all()


@pytest.fixture
def restless(dut: Dut) -> Dut:
    """A device that raises alarms as often as it is allowed to."""
    dut.configure(
        dataclasses.replace(
            dut.estimator,
            trigger="prediction-error",
            ceiling=0.5,
            arl0=None,
            hold_off_n=HOLD_OFF_N,
            warm_up_n=WARM_UP_N,
            isolation=False,
        )
    )
    return dut


@pytest.mark.needs("excite")
def test_alarms_keep_the_hold_off_and_the_warm_up(restless: Dut, play: Play) -> None:
    index = play(STEADY, 1).run.alarm_index
    assert len(index) >= 5, f"{restless.name} raised {len(index)} alarms"
    assert index[0] >= WARM_UP_N
    assert np.diff(index).min() >= HOLD_OFF_N
