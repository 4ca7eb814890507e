"""Detectable changes are detected in time, a constant plant raises no alarm, and most diagnoses are right.

The text at each number states how late is in time, how often chance may fail a test, and how many diagnoses may be
wrong. harness/docs/background/properties.md derives these limits.
"""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import assume, given

from analogrig.datasheet import DEFAULT_ARL0
from analogrig.judging.information import detectable
from analogrig.judging.verdict import DIAGNOSES
from analogrig.rigs.rig import Rig
from analogrig.scenario import Expectations, PotChange, Scenario
from analogrig.testing.one_play import Played
from analogrig.testing.properties.experiments import (
    changes_are_noticed_soon_and_rightly_named,
    is_playable,
    needs_reported,
    single_changes_are_rightly_named,
)
from analogrig.testing.statement import Play, with_some_seed
from analogrig.testing.strategies import FIRST_CHANGE_N, profile, scenarios, seeds
from analogrig_emulator import Excitation

MOST_INFORMATION = 6.0
"""A change is found once its information has reached so many times ln ARL0, and MOST_SLACK_N samples more."""
MOST_SLACK_N = 40
PATIENT = Expectations(late_information_ratio=MOST_INFORMATION, late_slack_n=MOST_SLACK_N)

PLAYS_N, MOST_PLAYS_N = 40, 100
MOST_LATENCY, DOUBTFUL_LATENCY = 1.35, 1.42
"""Mean latency over mean bound: 1.22 on the thesis profile, with a standard error of 0.029 over PLAYS_N plays; what is
between the two is played MOST_PLAYS_N times."""
LEAST_RIGHT, SURELY = 0.9, 1.0 - 1e-7
"""Least part of right diagnoses on the thesis profile. Two of its changes are hard: M falls by three quarters, and B
and K change at once."""

SINGLE_WRONG, SINGLE_FAR_TOO_WRONG = 0.01, 0.05
"""Part of wrong diagnoses of single changes by 20 %: the largest expected, and the refuted alternative."""
SINGLE_MISS, SINGLE_FALSE_FAILURE = 1e-3, 1e-7
MOST_SINGLE_PLAYS_N, SILENT_N = 300, 5

_TURNED = {
    "K": (24500.0, (0.8,)),
    "B": (3021.0, (0.8, 1.2)),
    "M": (115.0, (0.8, 1.2)),
}
_SETTINGS: list[dict[str, Any]] = [
    {name: value * each} for name, (value, factors) in _TURNED.items() for factor in factors for each in (factor, 1.0)
]
_EACH_N = 250
SINGLY = Scenario(
    samples=FIRST_CHANGE_N + _EACH_N * len(_SETTINGS),
    excitation=Excitation(low_v=0.1, high_v=9.0),
    random_phase=True,
    changes=tuple(PotChange(FIRST_CHANGE_N + _EACH_N * i, setting) for i, setting in enumerate(_SETTINGS)),
    name="singly",
    description="front suspension: one parameter at a time, by 20 % and back; K does not rise, for want of pot",
)


@pytest.mark.hil_needs("change", "excite")
@profile()
@given(scenario=scenarios(expect=PATIENT), seed=seeds())
def test_every_change_that_can_be_seen_is_found_once(
    hil_rig: Rig, hil_play: Play, scenario: Scenario, seed: int
) -> None:
    assume(is_playable(hil_rig, scenario))
    emulated = hil_rig if hil_rig.computes_circuit else "emulator"
    assume(detectable(scenario, DEFAULT_ARL0**MOST_INFORMATION, rig=emulated))
    assert with_some_seed(hil_play, scenario, seed, Played.passes)


@pytest.mark.hil_needs("excite")
@profile()
@given(scenario=scenarios(most_changes=0), seed=seeds())
def test_a_plant_that_does_not_change_raises_no_alarm(
    hil_rig: Rig, hil_play: Play, scenario: Scenario, seed: int
) -> None:
    assume(is_playable(hil_rig, scenario))
    assert with_some_seed(hil_play, scenario, seed, Played.stays_quiet)


@pytest.mark.hil_needs("change", "excite")
def test_changes_are_noticed_soon_and_rightly_named(hil_play: Play) -> None:
    assert changes_are_noticed_soon_and_rightly_named(
        hil_play,
        Scenario.load("thesis"),
        0,
        plays=PLAYS_N,
        latency=MOST_LATENCY,
        doubtful_latency=DOUBTFUL_LATENCY,
        most_plays=MOST_PLAYS_N,
        right=LEAST_RIGHT,
        confidence=SURELY,
    )


@pytest.mark.hil_needs("change", "excite")
def test_a_single_change_is_rightly_named(hil_play: Play) -> None:
    needs_reported(hil_play, DIAGNOSES)
    assert single_changes_are_rightly_named(
        hil_play,
        SINGLY,
        0,
        expected=SINGLE_WRONG,
        refuted=SINGLE_FAR_TOO_WRONG,
        miss=SINGLE_MISS,
        false_failure=SINGLE_FALSE_FAILURE,
        most_plays=MOST_SINGLE_PLAYS_N,
        silent=SILENT_N,
    )
