"""Estimates are right while the plant is constant, and finite with any input."""

from __future__ import annotations

import pytest
from hypothesis import assume, given

from analogrig.judging.verdict import ESTIMATES
from analogrig.rigs.emulator import EmulatorDescription, EmulatorRig
from analogrig.rigs.rig import Rig
from analogrig.scenario import Expectations, Scenario
from analogrig.testing.one_play import Played
from analogrig.testing.properties.experiments import (
    alarms_keep_hold_off_and_warm_up,
    answers_with_numbers,
    is_playable,
    needs_reported,
    pause_does_no_harm,
)
from analogrig.testing.statement import Finding, Play, with_some_seed
from analogrig.testing.strategies import profile, rigs, scenarios, seeds
from analogrig_emulator import Excitation

WITHIN = 0.1
"""Largest relative error of each estimate: six times the rms error of the worst plant drawn."""

PAUSED = Scenario(
    samples=16_000,
    excitation=Excitation(low_v=0.1, high_v=9.9, frequency_hz=200.0 / 130.0, shape="pulse", duty=0.01),
    expect=Expectations(least_exposure=0.0),
    name="paused",
)
"""An edge, and another 130 samples later, every 13,000: between them nothing is to be learned, and no trigger armed."""
PAUSE_END_N = 13_000

STEADY = Scenario(samples=2000, excitation=Excitation(low_v=0.1, high_v=9.9), name="steady")
HOLD_OFF_N, WARM_UP_N, AT_LEAST = 80, 120, 5


def estimates(played: Played) -> Finding:
    return played.estimates(WITHIN)


@pytest.mark.hil_needs("excite")
@profile()
@given(scenario=scenarios(most_changes=0), seed=seeds())
def test_estimates_come_to_the_truth(hil_rig: Rig, hil_play: Play, scenario: Scenario, seed: int) -> None:
    needs_reported(hil_play, ESTIMATES)
    assume(is_playable(hil_rig, scenario))
    assert with_some_seed(hil_play, scenario, seed, estimates)


@profile()
@given(drawn=rigs(most_noise_lsb=200.0), scenario=scenarios(), seed=seeds())
def test_whatever_comes_the_device_answers_with_numbers(
    hil_play: Play, drawn: EmulatorDescription, scenario: Scenario, seed: int
) -> None:
    assert answers_with_numbers(hil_play.on(EmulatorRig(drawn), hil_play.bench.dut), scenario, seed)


@pytest.mark.parametrize("hil_rig", ["emulator-ideal"], indirect=True)
def test_a_pause_of_the_excitation_does_no_harm(hil_play: Play) -> None:
    assert pause_does_no_harm(hil_play, PAUSED, 1, until=PAUSE_END_N)


@pytest.mark.hil_needs("excite")
def test_alarms_keep_the_hold_off_and_the_warm_up(hil_play: Play) -> None:
    assert alarms_keep_hold_off_and_warm_up(
        hil_play, STEADY, 1, hold_off_n=HOLD_OFF_N, warm_up_n=WARM_UP_N, at_least=AT_LEAST
    )
