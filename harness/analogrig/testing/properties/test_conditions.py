"""Imperfections of generator, card and line are not taken for a change of the plant."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analogrig.datasheet import DEFAULT_ARL0
from analogrig.judging.bursts import Design
from analogrig.scenario import Scenario
from analogrig.testing.one_play import Played
from analogrig.testing.properties.experiments import (
    device_with_faults,
    false_alarms_at_most,
    false_alarms_of_plants_rarer,
    faults_among_the_samples_cost_no_more_than_samples,
    faults_of_the_line_do_no_harm,
)
from analogrig.testing.properties.test_detection import SURELY
from analogrig.testing.statement import Play, with_some_seed
from analogrig.testing.strategies import link_faults, profile, seeds
from analogrig_emulator import Excitation

SHORT = Scenario(samples=700, excitation=Excitation(low_v=0.1, high_v=9.9), name="short")
FAULTS_EACH, LEAST_VALID_KINDS = 4, 4
CERTIFIED = Design(rate=1.0 / DEFAULT_ARL0, confidence=0.999, allowed=50)
CERTIFIED_RUN_N = 100_000
PLANTS_N, PLANTS_RUN_N = 40, 60_000
HEAVY = {"M": 150.0, "B": 1668.5, "K": 29_000.0}
HEAVY_N, HEAVY_ALLOWED = 4_000_000, 20
"""Half of the promise. A sound device has 1.2e-6 here, with a damping ratio of 0.4."""


@pytest.mark.hil_needs("excite")
@pytest.mark.parametrize("drift_ppm", [-20.0, 20.0])
@profile()
@given(seed=seeds())
def test_edges_that_drift_past_the_samples_are_no_change(hil_play: Play, drift_ppm: float, seed: int) -> None:
    phase = 2e-4 if drift_ppm < 0.0 else 1.0 - 2e-4  # they come to a sample's instant after a thousand samples
    excitation = Excitation(low_v=0.1, high_v=9.9, phase=phase, clock="free", drift_ppm=drift_ppm)
    assert with_some_seed(hil_play, Scenario(2000, excitation, name="drifting"), seed, Played.stays_quiet)


@pytest.mark.parametrize("hil_rig", ["emulator-0-10v"], indirect=True)
@profile()
@given(seed=seeds())
def test_samples_that_are_missing_are_no_change(hil_play: Play, seed: int) -> None:
    assert with_some_seed(hil_play, "thesis", seed, Played.passes)


@profile()
@given(drawn=st.data(), seed=seeds())
def test_faults_of_the_line_leave_the_estimate_or_the_run_is_inconclusive(
    hil_play: Play, drawn: st.DataObject, seed: int
) -> None:
    faults = drawn.draw(link_faults(sorted(device_with_faults(hil_play).fault_kinds())), "faults of the line")
    assert faults_of_the_line_do_no_harm(hil_play, SHORT, seed, faults)


def test_faults_of_the_line_among_the_samples_cost_no_more_than_those_samples(hil_play: Play) -> None:
    assert faults_among_the_samples_cost_no_more_than_samples(
        hil_play, SHORT, 1, each=FAULTS_EACH, least_valid=LEAST_VALID_KINDS
    )


@pytest.mark.hil_needs("excite")
def test_false_alarms_are_rarer_than_one_in_a_hundred_thousand_samples(hil_play: Play) -> None:
    assert false_alarms_at_most(
        hil_play,
        Scenario.load("healthy"),
        0,
        allowed=CERTIFIED.allowed,
        samples=CERTIFIED.trials,
        samples_each=CERTIFIED_RUN_N,
    )


@pytest.mark.hil_needs("excite")
def test_plants_of_all_kinds_raise_no_more_false_alarms_than_promised(hil_play: Play) -> None:
    assert false_alarms_of_plants_rarer(
        hil_play,
        Scenario.load("healthy"),
        1,
        rate=CERTIFIED.rate,
        confidence=SURELY,
        plants=PLANTS_N,
        samples_each=PLANTS_RUN_N,
    )


@pytest.mark.hil_needs("excite")
def test_false_alarms_stay_rare_on_a_plant_that_the_prefilter_has_to_follow(hil_play: Play) -> None:
    healthy = Scenario.load("healthy")
    excitation = dataclasses.replace(healthy.excitation, high_v=8.0)
    heavy = dataclasses.replace(healthy, set=HEAVY, excitation=excitation)
    assert false_alarms_at_most(
        hil_play, heavy, 0, allowed=HEAVY_ALLOWED, samples=HEAVY_N, samples_each=CERTIFIED_RUN_N
    )
