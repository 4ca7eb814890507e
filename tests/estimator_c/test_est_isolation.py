"""Isolation of the change among M, B, K: promises of est_isolation.h, on simulated plants.

Seeds are fixed, so that a test passes or fails for good; the probabilities stated are those of another seed.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.estimator_c import isolation
from tests.estimator_c.est_driver import ANYWHERE, GATHERING, PREDICTION_ERROR, REFUSED, SLICES_N, Estimator
from tests.estimator_c.isolation import Change
from tests.estimator_c.performance import FULL, FULL_FREE, OWN_CLOCK, SHARED_CLOCK, Settings
from tests.estimator_c.plants import FRONT, SHOCK, Excitation, random_plants, simulate

CLOCKS = {"one clock": (SHARED_CLOCK, FULL), "edges anywhere": (OWN_CLOCK, FULL_FREE)}
SINGLE = [{name: factor} for name in "MBK" for factor in (0.8, 1.2)]
TWO = [{"B": 1.2, "K": 1.2}, {"B": 0.8, "K": 0.8}, {"M": 1.2, "B": 1.2}, {"M": 1.2, "K": 1.2}, {"B": 0.8, "K": 1.2}]
"""Single changes, of which each of the first four looks like one of the third parameter at first."""


@pytest.mark.parametrize(("settings", "excitation"), CLOCKS.values(), ids=CLOCKS)
@pytest.mark.parametrize("change", SINGLE, ids=str)
def test_changed_parameter_is_named_in_time_and_its_extent_told(
    estimator: Estimator, settings: Settings, excitation: Excitation, change: Change
) -> None:
    """95 % of 400 is missed with a probability of 2 % where the rate is 97 %."""
    found = isolation.measure(estimator, settings, FRONT, change, excitation, 400, seed=31, bounded=False)
    assert found.reported > 0.98
    assert found.right >= 0.95
    assert found.error < 0.02
    assert found.error_refined < 0.01


@pytest.mark.heavy
@pytest.mark.parametrize("change", SINGLE, ids=str)
def test_report_comes_within_twice_the_isolation_bound_on_average(estimator: Estimator, change: Change) -> None:
    """The rivals of the bound are all that the isolation weighs. As long as no force acts two others at once are the
    hardest: with single rivals the bound is half as long."""
    found = isolation.measure(estimator, SHARED_CLOCK, FRONT, change, FULL, 40, seed=31)
    assert found.bound_n < found.bound_of_pairs_n <= found.bound_of_all_n
    assert found.bound_n < found.mean_n <= 1.5 * found.bound_of_all_n


@pytest.mark.parametrize(("settings", "excitation"), CLOCKS.values(), ids=CLOCKS)
@pytest.mark.parametrize("fault", isolation.FAULTS)
def test_fault_of_a_channel_is_not_taken_for_a_change_of_the_plant(
    estimator: Estimator, settings: Settings, excitation: Excitation, fault: str
) -> None:
    """At most 5 % are named a parameter: more than 5 of 60 have a probability of 7 % there, of 0.0005 % at 1 %."""
    found, _ = isolation.diagnose_fault(estimator, settings, FRONT, fault, excitation, 60, seed=31)
    assert np.isin(found.change, ("M", "B", "K")).sum() <= 5


@pytest.mark.parametrize("fault", isolation.FAULTS)
def test_fault_of_a_channel_is_named(estimator: Estimator, fault: str) -> None:
    """A gain of the force and one of the displacement are the same as long as the plant is at rest at the onset."""
    found, _ = isolation.diagnose_fault(estimator, SHARED_CLOCK, FRONT, fault, FULL, 60, seed=31)
    assert (found.change == fault).mean() >= (0.4 if fault == "force gain" else 0.85)


@pytest.mark.parametrize("fault", ["force gain", "displacement gain"])
def test_extent_of_a_gain_is_told(estimator: Estimator, fault: str) -> None:
    played = isolation.play(FRONT, {}, FULL, 60, seed=31)
    u, y, size = isolation.faulty(fault, played.u, played.y, played.onset, np.random.default_rng(2))
    assert estimator.init(**SHARED_CLOCK)
    found = estimator.isolate(u, y, played.onset)
    named = found.change == fault
    assert np.percentile(np.abs(found.extent / (1.0 + size) - 1.0)[named], 90) < 0.02


@pytest.mark.parametrize("change", TWO, ids=str)
def test_two_changes_at_once_are_not_taken_for_one(estimator: Estimator, change: Change) -> None:
    """95 % of 400 is missed with a probability of 2 % where the rate is 97 %."""
    found = isolation.measure(estimator, SHARED_CLOCK, FRONT, change, FULL, 400, seed=31, bounded=False)
    assert found.reported > 0.98
    assert found.right >= 0.95


def test_several_changes_at_once_are_stated_as_such(estimator: Estimator) -> None:
    played = isolation.play(FRONT, {"B": 1.2, "K": 1.2}, FULL, 8, seed=31)
    assert estimator.init(**SHARED_CLOCK)
    assert (estimator.isolate(played.u, played.y, played.onset).change == "several").sum() >= 6


@pytest.mark.parametrize(
    "change",
    [pytest.param(each, id=str(each), marks=() if each in SINGLE[3:5] else pytest.mark.heavy) for each in SINGLE],
)
def test_random_plants_are_isolated_as_well(estimator: Estimator, change: Change) -> None:
    """With 20 trials each of ten."""
    found = [
        isolation.measure(estimator, SHARED_CLOCK, plant, change, FULL, 20, seed=5 + i, bounded=False)
        for i, plant in enumerate(random_plants(10, seed=1))
    ]
    assert np.mean([each.reported for each in found]) > 0.95
    assert np.mean([each.right for each in found]) > 0.94


def test_mass_that_hardly_matters_is_not_named_for_what_damping_did(estimator: Estimator) -> None:
    """A mass a hundred times as heavy explains any change of the shock absorber: 19 of 100 were named so."""
    played = isolation.play(SHOCK, {"B": 1.2}, FULL, 100, seed=31)
    assert estimator.init(**SHARED_CLOCK)
    named = estimator.isolate(played.u, played.y, played.onset).change
    assert (named == "M").mean() <= 0.02
    assert (named == "B").mean() > 0.7


def test_less_work_per_sample_delays_the_verdict_by_few_samples(estimator: Estimator) -> None:
    """Fewer samples are weighed, and the first ones wait."""
    played = isolation.play(FRONT, {"B": 1.2}, FULL, 20, seed=2)
    assert estimator.init(**SHARED_CLOCK)
    at_once = estimator.isolate(played.u, played.y, played.onset, slices=1000)
    later = estimator.isolate(played.u, played.y, played.onset)
    assert np.array_equal(at_once.change, later.change)
    assert np.allclose(at_once.refined, later.refined, rtol=1e-4)
    assert 1.0 < (later.at - at_once.at).mean() < 6.0


def test_too_little_work_leaves_it_undecided(estimator: Estimator) -> None:
    played = isolation.play(FRONT, {"B": 1.2}, FULL, 5, seed=2)
    assert estimator.init(**SHARED_CLOCK)
    assert (estimator.isolate(played.u, played.y, played.onset, slices=1).change == "undecided").all()


def test_gap_right_after_the_alarm_leaves_it_undecided(estimator: Estimator) -> None:
    played = isolation.play(FRONT, {"K": 0.8}, FULL, 10, seed=3)
    assert estimator.init(**SHARED_CLOCK)
    alarm = estimator.isolate(played.u, played.y, played.onset).alarm
    valid = np.ones(played.u.shape, np.uint8)
    valid[np.arange(10), alarm.astype(int) + 1] = 0
    found = estimator.isolate(played.u, played.y, played.onset, valid=valid)
    assert np.array_equal(found.alarm, alarm)
    assert (found.change == "undecided").all()


def test_gap_before_the_change_does_no_harm(estimator: Estimator) -> None:
    played = isolation.play(FRONT, {"K": 0.8}, FULL, 20, seed=3)
    assert estimator.init(**SHARED_CLOCK)
    valid = np.ones(played.u.shape, np.uint8)
    valid[np.arange(20), played.onset - 60] = 0
    assert (estimator.isolate(played.u, played.y, played.onset, valid=valid).change == "K").mean() >= 0.8


def test_interval_of_onsets_mostly_contains_the_true_one(estimator: Estimator) -> None:
    """In 89 % of the trials; onsets are tried at every fourth sample at most, hence two on either side."""
    played = isolation.play(FRONT, {"M": 1.2}, FULL, 200, seed=4)
    assert estimator.init(**SHARED_CLOCK)
    found = estimator.isolate(played.u, played.y, played.onset)
    before_n = found.alarm - played.onset
    inside = (found.least_n - 2 <= before_n) & (before_n <= found.most_n + 2)
    assert inside[found.change == "M"].mean() > 0.8
    assert (found.most_n - found.least_n).mean() < 5.0, "an interval that holds everything says nothing"
    assert np.sqrt(np.mean((found.onset_n - before_n) ** 2)) < 0.5 * np.sqrt(np.mean(before_n**2))


def test_healthy_plant_has_no_diagnosis(estimator: Estimator) -> None:
    played = simulate((FRONT, FRONT), np.full(5, 2000), FULL, 2000, seed=6)
    assert estimator.init(**SHARED_CLOCK)
    found = estimator.isolate(played.u, played.y, np.zeros(5, np.int64))
    assert (found.change == "undecided").all()
    assert (found.refined == 1.0).all()


def test_offset_of_the_displacement_is_not_taken_for_stiffness(estimator: Estimator) -> None:
    """A card whose zero is in the middle of its range: K x is the force of the spring only with x from where F = 0."""
    played = isolation.play(FRONT, {"M": 0.8}, FULL, 60, seed=7)
    assert estimator.init(**OWN_CLOCK)
    assert (estimator.isolate(played.u, played.y + 2048.0, played.onset).change == "M").mean() > 0.9


def test_zero_of_the_force_may_lie_anywhere_in_its_range(estimator: Estimator) -> None:
    """A card from -1 to 11 V; were 0 taken for its offset, the spring would carry another force."""
    played = isolation.play(FRONT, {"K": 0.8}, FULL, 60, seed=7)
    assert estimator.init(**OWN_CLOCK)
    found = estimator.isolate(played.u + 1000.0, played.y + 2048.0, played.onset, force_zero=1000.0)
    assert (found.change == "K").mean() > 0.9
    assert abs(found.extent[found.change == "K"].mean() - 0.8) < 0.01


@pytest.mark.parametrize(
    "settings", [{"na": 1}, {"kind": PREDICTION_ERROR}, {"nb": 3, "nk": 1}, {"edge_instants": ANYWHERE}], ids=str
)
def test_what_is_no_suspension_or_hides_its_edges_is_refused(estimator: Estimator, settings: Settings) -> None:
    assert estimator.init(**{"c": (0.0, 0.0), **settings})
    assert not estimator.can_isolate()


# ---- steps made by hand: what est_isolation says of them, whatever an estimator would

SETTLED_N = 100
"""After a start or an alarm so many samples pass before theta is taken for the plant."""

SUSPENSION = (-1.7, 0.74, 0.0, 0.02, 0.02, 0.0)


def steps(quiet_n: int = SETTLED_N + 20, rising_n: int = 5, after_n: int = 30) -> NDArray[np.float64]:
    """(n, 3): samples with statistic zero, some in which it rises to an alarm, and those after it."""
    out = np.zeros((quiet_n + rising_n + after_n, 3))
    out[quiet_n : quiet_n + rising_n, STATISTIC] = np.arange(1.0, rising_n + 1.0)
    out[quiet_n + rising_n - 1, ALARM] = 1.0
    return out


STATISTIC, STATUS, ALARM = range(3)


def alarm_at(played: NDArray[np.float64]) -> int:
    return int(np.flatnonzero(played[:, ALARM])[0])


@pytest.fixture
def by_hand(estimator: Estimator) -> Estimator:
    assert estimator.init()
    return estimator


def test_work_is_due_from_the_alarm_on_and_done_in_slices(by_hand: Estimator) -> None:
    left = by_hand.diagnose(SUSPENSION, steps()).left
    alarm = alarm_at(steps())
    assert not left[:alarm].any()
    assert (left[alarm : alarm + 5] > 0).all()
    plenty = by_hand.diagnose(SUSPENSION, steps(), slices=1000)
    assert (plenty.left[alarm + 1 :] == SLICES_N - 1).all()
    assert plenty.samples_n == 30


@pytest.mark.parametrize(
    ("a1", "a2"),
    [
        pytest.param(-0.4, -0.05, id="one pole is negative"),
        pytest.param(-2.001, 1.011, id="it is not stable"),
        pytest.param(-1.5, 0.5, id="it has no stiffness"),
        pytest.param(-1.501, 0.5005, id="its stiffness is negative"),
        pytest.param(1.6, 0.64, id="it swings with every sample"),
        pytest.param(-1.02540195, 0.0254034959, id="its stiffness is lost in rounding"),
    ],
)
def test_estimate_that_is_no_suspension_leaves_it_undecided(by_hand: Estimator, a1: float, a2: float) -> None:
    assert not by_hand.diagnose((a1, a2, *SUSPENSION[2:]), steps()).left.any()


@pytest.mark.parametrize(("a1", "a2"), [(-0.9, 0.01), (-0.2, 0.6)], ids=["overdamped", "hardly damped"])
def test_fast_poles_are_a_suspension_too(by_hand: Estimator, a1: float, a2: float) -> None:
    assert by_hand.diagnose((a1, a2, *SUSPENSION[2:]), steps()).left.any()


def test_model_may_have_fewer_lags_than_the_longest(by_hand: Estimator) -> None:
    assert by_hand.init(nb=2, nk=0)
    assert by_hand.diagnose((-1.7, 0.74, 0.02, 0.02, 0.0), steps()).left.any()


def test_alarm_before_the_plant_was_ever_well_leaves_it_undecided(by_hand: Estimator) -> None:
    assert not by_hand.diagnose(SUSPENSION, steps(quiet_n=SETTLED_N - 20)).left.any()


def test_statistic_that_rises_for_hundreds_of_samples_is_no_obstacle(by_hand: Estimator) -> None:
    assert by_hand.diagnose(SUSPENSION, steps(rising_n=300)).left.any()


def test_alarm_right_after_a_gap_has_too_few_samples_before_it(by_hand: Estimator) -> None:
    played = steps(rising_n=1)
    played[alarm_at(played) - 2, STATUS] = REFUSED
    assert not by_hand.diagnose(SUSPENSION, played).left.any()


@pytest.mark.parametrize(("before_n", "isolated"), [(SETTLED_N + 20, True), (SETTLED_N - 20, False)])
def test_theta_has_to_settle_after_a_slip(by_hand: Estimator, before_n: int, *, isolated: bool) -> None:
    """Whitening begins anew without a gap."""
    played = steps(quiet_n=2 * SETTLED_N + 40)
    played[alarm_at(played) - before_n, STATUS] = GATHERING
    assert by_hand.diagnose(SUSPENSION, played).left.any() == isolated


def test_refused_sample_after_the_alarm_leaves_it_undecided(by_hand: Estimator) -> None:
    played = steps()
    refused = alarm_at(played) + 10
    played[refused, STATUS] = REFUSED
    left = by_hand.diagnose(SUSPENSION, played).left
    assert left[refused - 1] > 0
    assert not left[refused:].any()


def test_second_alarm_after_the_diagnosis_ends_the_work_on_it(by_hand: Estimator) -> None:
    played = steps()
    second = alarm_at(played) + 10
    played[second, ALARM] = 1.0
    assert by_hand.diagnose(SUSPENSION, played[:second]).change != "undecided"
    left = by_hand.diagnose(SUSPENSION, played).left
    assert left[second - 1] > 0
    assert not left[second:].any()


def test_second_alarm_before_the_diagnosis_does_not_end_the_work_on_it(by_hand: Estimator) -> None:
    played = steps()
    second = alarm_at(played) + 1
    played[second, ALARM] = 1.0
    assert by_hand.diagnose(SUSPENSION, played[:second]).change == "undecided"
    assert (by_hand.diagnose(SUSPENSION, played).left[second : second + 5] > 0).all()


def test_onset_counts_from_the_last_alarm(estimator: Estimator) -> None:
    """Noise of the displacement raises one alarm after another."""
    found, onset = isolation.diagnose_fault(estimator, SHARED_CLOCK, FRONT, "displacement noise", FULL, 60, seed=31)
    named = found.change == "displacement noise"
    assert named.any()
    assert (found.onset_n[named] <= (found.at - onset)[named] + 2).all()
    assert (found.onset_n[named] > (found.alarm - onset)[named]).any()


def test_extent_is_refined_until_a_hundred_samples_after_the_alarm(by_hand: Estimator) -> None:
    played = steps(after_n=150)
    found = by_hand.diagnose(SUSPENSION, played, slices=1000)
    assert found.samples_n == SETTLED_N - 1
    assert not found.left[alarm_at(played) + SETTLED_N :].any()


def test_mass_that_all_but_holds_the_plant_still_is_told_as_a_hundredfold(estimator: Estimator) -> None:
    played = isolation.play(FRONT, {"M": 1000.0}, FULL, 20, seed=8)
    assert estimator.init(**SHARED_CLOCK)
    found = estimator.isolate(played.u, played.y, played.onset)
    assert (found.change == "M").mean() > 0.5
    assert (found.extent[found.change == "M"] <= 100.0).all()
    assert (found.extent == 100.0).any()
