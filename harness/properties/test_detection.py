"""What can be seen is seen in time; where nothing happens nothing is seen; what is said to have changed has, mostly.

How late is in time, how often chance may spoil it, and how often a name may be wrong is said beside each number here,
and derived in harness/README.md.
"""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import assume, given

from emulator.excitation import Excitation
from harness.information import detectable
from harness.played import Finding, Played
from harness.properties import Play, is_playable, with_some_seed
from harness.rigs.rig import Rig
from harness.scenario import Expectations, Scenario, Tweak
from harness.statistics import Decision, SequentialTest, lower_rate
from harness.strategies import WARM_UP_N, profile, scenarios, seeds

ARL0 = 1e5
MOST_INFORMATION = 6.0
"""A change is found once its information has reached so many times ln ARL0, and MOST_SLACK_N samples more."""
MOST_SLACK_N = 40
PATIENT = Expectations(late_information_ratio=MOST_INFORMATION, late_slack_n=MOST_SLACK_N)

PLAYS_N = 40
MOST_LATENCY = 1.35
"""Mean latency over mean bound: 1.20 on the thesis profile, with a standard error of 0.025 over PLAYS_N plays."""
LEAST_RIGHT, SURELY = 0.9, 1.0 - 1e-7
"""Of the diagnoses on the thesis profile, of which two are hard: M falls by three quarters, B and K change at once."""

SINGLE_WRONG, SINGLE_FAR_TOO_WRONG = 0.01, 0.05
"""Of the diagnoses of single changes by 20 %: what is expected at most, and what is refuted."""
SINGLE_MISS, SINGLE_FALSE_FAILURE = 1e-3, 1e-7
MOST_SINGLE_PLAYS_N, SILENT_N = 300, 5
"""A device that has named nothing in so many plays does not name changes at all."""

_TURNED = {
    "stiffness_n_per_m": (24500.0, (0.8,)),
    "damping_n_s_per_m": (3021.0, (0.8, 1.2)),
    "mass_kg": (115.0, (0.8, 1.2)),
}
_SETTINGS: list[dict[str, Any]] = [
    {name: value * each} for name, (value, factors) in _TURNED.items() for factor in factors for each in (factor, 1.0)
]
_EACH_N = 250
SINGLY = Scenario(
    samples=WARM_UP_N + _EACH_N * len(_SETTINGS),
    excitation=Excitation(low_v=0.1, high_v=9.0),
    random_phase=True,
    tweaks=tuple(Tweak(WARM_UP_N + _EACH_N * i, **setting) for i, setting in enumerate(_SETTINGS)),
    name="singly",
    description="front suspension: one parameter at a time, by 20 % and back; K does not rise, for want of pot",
)


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


@pytest.mark.needs("tweak", "excite")
def test_a_single_change_is_rightly_named(play: Play) -> None:
    test = SequentialTest(SINGLE_WRONG, SINGLE_FAR_TOO_WRONG, miss=SINGLE_MISS, false_alarm=SINGLE_FALSE_FAILURE)
    for seed in range(MOST_SINGLE_PLAYS_N):
        tweaks = play(SINGLY, seed).verdict.tweaks
        right = [tweak.diagnosis.right for tweak in tweaks if tweak.diagnosis is not None]
        test.add(len(right), right.count(False))
        if test.decision is not Decision.OPEN:
            break
        if seed + 1 >= SILENT_N and not test.trials:
            return  # to name nothing is allowed
    assert test.decision is Decision.BELOW, f"{test.events} of {test.trials} single changes were called wrongly"
