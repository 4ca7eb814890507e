"""What can be seen is seen, soon; what has not happened is not; what is said to have changed has changed."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import assume, given

from harness.information import detectable
from harness.played import Played
from harness.scenario import Scenario
from harness.strategies import profile, scenarios, seeds
from harness.verdict import Expectations

Play = Callable[..., Played]

ARL0 = 1e5
MOST_BOUNDS = 6.0
"""A change is found within so many times its information bound, and MOST_SLACK_N samples."""
MOST_SLACK_N = 15
PATIENT = Expectations(late_information_ratio=MOST_BOUNDS, late_slack_n=MOST_SLACK_N)


@pytest.mark.needs("tweak", "excite")
@profile()
@given(scenario=scenarios(expect=PATIENT), seed=seeds())
def test_every_change_that_can_be_seen_is_found(play: Play, scenario: Scenario, seed: int) -> None:
    assume(detectable(scenario, ARL0))
    assert play(scenario, seed).detects()


@pytest.mark.needs("excite")
@profile()
@given(scenario=scenarios(most_changes=0), seed=seeds())
def test_a_plant_that_does_not_change_raises_no_alarm(play: Play, scenario: Scenario, seed: int) -> None:
    assert play(scenario, seed).stays_quiet()
