"""What can be seen is seen, soon; what has not happened is not; what is said to have changed has changed."""

from __future__ import annotations

import pytest
from hypothesis import assume, given

from harness.information import detectable
from harness.played import Finding, Played
from harness.properties import Play, is_playable, with_some_seed
from harness.rigs.rig import Rig
from harness.scenario import Scenario
from harness.statistics import lower_rate
from harness.strategies import profile, scenarios, seeds
from harness.verdict import Expectations

ARL0 = 1e5
MOST_INFORMATION = 6.0
"""A change is found once its information has reached so many times ln ARL0, and MOST_SLACK_N samples more."""
MOST_SLACK_N = 40
PATIENT = Expectations(late_information_ratio=MOST_INFORMATION, late_slack_n=MOST_SLACK_N)

PLAYS_N = 40
MOST_LATENCY = 1.35
"""Mean latency over mean bound: 1.20 on the thesis profile, with a standard error of 0.025 over PLAYS_N plays."""
LEAST_RIGHT, SURELY = 0.9, 1.0 - 1e-7


def passes(played: Played) -> Finding:
    return Finding(played.verdict.outcome == "passed", "; ".join(played.verdict.reasons))


def stays_quiet(played: Played) -> Finding:
    return played.stays_quiet()


@pytest.mark.needs("tweak", "excite")
@profile()
@given(scenario=scenarios(expect=PATIENT), seed=seeds())
def test_every_change_that_can_be_seen_is_found_once(rig: Rig, play: Play, scenario: Scenario, seed: int) -> None:
    assume(is_playable(rig, scenario))
    assume(detectable(scenario, ARL0**MOST_INFORMATION))
    assert with_some_seed(play, scenario, seed, passes)


@pytest.mark.needs("excite")
@profile()
@given(scenario=scenarios(most_changes=0), seed=seeds())
def test_a_plant_that_does_not_change_raises_no_alarm(rig: Rig, play: Play, scenario: Scenario, seed: int) -> None:
    assume(is_playable(rig, scenario))
    assert with_some_seed(play, scenario, seed, stays_quiet)


@pytest.mark.needs("tweak", "excite")
def test_changes_are_noticed_soon_and_rightly_named(play: Play) -> None:
    tweaks = [tweak for seed in range(PLAYS_N) for tweak in play("thesis", seed).verdict.tweaks]
    noticed = [tweak for tweak in tweaks if tweak.latency_n is not None and tweak.bound_n is not None]
    assert len(noticed) == len(tweaks), f"{len(tweaks) - len(noticed)} of {len(tweaks)} changes were missed"
    ratio = sum(tweak.latency_n or 0 for tweak in noticed) / sum(tweak.bound_n or 0 for tweak in noticed)
    assert ratio <= MOST_LATENCY, f"mean latency is {ratio:.2f} times the mean bound"
    said = [tweak.diagnosis for tweak in tweaks if tweak.diagnosis is not None]
    wrong = sum(not diagnosis.right for diagnosis in said)
    if said:
        assert lower_rate(wrong, len(said), SURELY) <= 1.0 - LEAST_RIGHT, f"{wrong} of {len(said)} were called wrongly"
