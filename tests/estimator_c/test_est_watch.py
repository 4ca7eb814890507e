"""Readings that come from no plant, and a force that does not move."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.estimator_c.est_driver import CUSTOM, LOCKED, MISSING, NONE, REFUSED, UPDATED, Estimator
from tests.estimator_c.test_est_trigger import FRONT, suspension

N = 800


def front(seed: int = 3) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return suspension([(0, FRONT)], np.arange(10.0, N, 50.0), N, 1.0, seed)


def test_stuck_displacement_is_refused_from_the_stated_sample_on_until_it_moves(estimator: Estimator) -> None:
    u, y = front()
    y[400:720] = y[399]  # longer than the samples can be counted
    assert estimator.init(stuck_n=16, kind=NONE, refresh_n=0)
    result = estimator.run(u, y)
    # The first edge of the stuck stretch comes at 410: that sample is the first of the sixteen.
    assert (result.status[410:425] == UPDATED).all()
    assert (result.status[425:720] == REFUSED).all()
    assert (result.status[722:] == UPDATED).all()
    assert result.theta[719].tobytes() == result.theta[424].tobytes()
    assert (result.counters["stuck"], result.counters["refused"]) == (295, 295)


@pytest.mark.parametrize(("stuck_n", "status"), [(1, REFUSED), (2, UPDATED)])
def test_a_displacement_may_be_stuck_with_the_edge_that_it_does_not_answer(
    estimator: Estimator, stuck_n: int, status: int
) -> None:
    u, y = front()
    y[400:] = y[399]
    assert estimator.init(stuck_n=stuck_n, kind=NONE, refresh_n=0)
    assert estimator.run(u[:411], y[:411]).status[410] == status


def test_an_edge_within_a_gap_need_not_be_answered_after_it(estimator: Estimator) -> None:
    """The gap may have been long enough for the plant to come to rest."""
    u, y, valid = np.zeros(100), np.full(100, 410.0), np.ones(100)
    u[51:], valid[50] = 1000.0, 0
    assert estimator.init(kind=NONE, refresh_n=0)
    assert (estimator.run(u, y, valid).status[53:] == UPDATED).all()


def test_c_follows_a_with_edges_in_quick_succession(estimator: Estimator) -> None:
    """The doubt about an edge lasts 12 samples: here it never ends."""
    u, y = suspension([(0, FRONT)], np.arange(10.0, N, 10.0), N, 1.0, 3)
    assert estimator.init()
    assert estimator.run(u, y).counters["refreshes"] > 0


@pytest.mark.parametrize("slip", [1, -1], ids=["late", "early"])
@pytest.mark.parametrize("refresh_n", [1, 2, 3])
def test_c_is_not_taken_while_another_reading_of_an_edge_leads(estimator: Estimator, refresh_n: int, slip: int) -> None:
    """The edge of sample 910 is recorded one sample later or earlier than those before it."""
    edges = np.arange(10.0, 1800.0, 50.0)
    u, y = suspension([(0, FRONT)], edges + (edges - 900.0) * 20e-6 * slip, 1800, 1.0, 1)
    assert estimator.init(refresh_n=refresh_n)
    refreshes = [estimator.run(u[k : k + 1], y[k : k + 1]).counters["refreshes"] for k in range(len(u))]
    assert refreshes[911] == refreshes[920]
    assert refreshes[-1] > refreshes[920]


def test_c_that_is_to_stay_as_it_is_does_so_for_more_equations_than_can_be_counted(estimator: Estimator) -> None:
    u, y = (np.tile(x, 90) for x in front())
    assert estimator.init(kind=NONE, refresh_n=0)
    assert estimator.run(u, y).counters["refreshes"] == 0


def test_c_stays_as_it_is_where_the_last_edge_is_long_past(estimator: Estimator) -> None:
    """A forgetting of 0.99 remembers 100 samples; after twice that A comes from noise, and would lead C anywhere."""
    u, y = suspension([(0, FRONT)], np.arange(10.0, 400.0, 50.0), 1400, 1.0, 3)
    assert estimator.init(kind=NONE)
    before = estimator.run(u[:700], y[:700]).counters["refreshes"]
    assert before > 0
    assert estimator.run(u[700:], y[700:]).counters["refreshes"] == before


def test_displacement_may_rest_while_the_force_does(estimator: Estimator) -> None:
    u, y = np.zeros(300), np.full(300, 410.0)
    assert estimator.init(refresh_n=0)
    assert (estimator.run(u, y).status[2:] == UPDATED).all()


def test_a_gap_does_not_make_a_stuck_displacement_good(estimator: Estimator) -> None:
    u, y = front()
    y[400:600] = y[399]
    valid = np.ones(N)
    valid[[450, 500, 501]] = 0
    assert estimator.init(kind=NONE, refresh_n=0)
    status = estimator.run(u, y, valid).status
    assert (status[[450, 500, 501]] == MISSING).all()
    assert (np.delete(status[425:600], [25, 75, 76]) == REFUSED).all()


@pytest.mark.parametrize("channel", ["u", "y"])
@pytest.mark.parametrize("code", [0.0, 4095.0])
def test_reading_at_the_end_of_the_converter_is_saturated(estimator: Estimator, channel: str, code: float) -> None:
    u, y = front()
    u, y = u * 0.8 + 300.0, y * 0.8 + 300.0
    (u if channel == "u" else y)[300] = code
    assert estimator.init(code_low=0.0, code_high=4095.0, kind=NONE, refresh_n=0)
    result = estimator.run(u, y)
    assert result.status[299:304].tolist() == [UPDATED, REFUSED, UPDATED, UPDATED, UPDATED]
    assert result.theta[300].tobytes() == result.theta[299].tobytes()
    assert (result.counters["saturated"], result.counters["refused"]) == (1, 1)


def test_absurd_reading_does_not_count_as_saturated(estimator: Estimator) -> None:
    u, y = front()
    u[300], y[350] = np.nan, 2e6
    assert estimator.init(code_low=-10.0, code_high=4e3 + 100.0, kind=NONE)
    counters = estimator.run(u, y).counters
    assert (counters["saturated"], counters["refused"]) == (0, 2)


def test_lost_excitation_is_reported_and_its_return(estimator: Estimator) -> None:
    u, y = front()
    u[361:700] = u[360]
    assert estimator.init(idle_n=100, kind=NONE, stuck_n=0)
    idle = estimator.run(u, y).idle
    last, back = 360, 710  # the edges before and after
    assert not idle[:last].any()
    assert np.flatnonzero(idle).tolist() == list(range(last + 100, back))


@pytest.mark.parametrize("step", [64.0, -64.0])
def test_a_step_of_just_so_many_codes_is_an_edge(estimator: Estimator, step: float) -> None:
    """Only an edge makes the excitation return."""
    idle = []
    for part in (1.0, 0.99):
        u = np.where(np.arange(60) < 50, 0.0, part * step)
        assert estimator.init(edge_codes=64.0, idle_n=5, kind=NONE, stuck_n=0, refresh_n=0)
        idle.append(estimator.run(u, np.full(60, 410.0)).idle[48:51].tolist())
    assert idle == [[1, 1, 0], [1, 1, 1]]


def test_excitation_may_be_wanted_in_every_sample(estimator: Estimator) -> None:
    u = np.where(np.arange(60) < 50, 0.0, 1000.0)
    assert estimator.init(idle_n=1, kind=NONE, stuck_n=0, refresh_n=0)
    assert np.flatnonzero(estimator.run(u, np.full(60, 410.0)).idle == 0).tolist() == [50]


def test_own_trigger_is_asked_at_every_innovation_and_told_when_it_begins_anew(estimator: Estimator) -> None:
    u, y = front()
    assert not estimator.init(kind=CUSTOM)
    assert estimator.init(kind=CUSTOM, custom=1, refresh_n=0, ceiling=100.0, warm_up_n=50, hold_off_n=10)
    alarms = estimator.run(u, y).alarms
    # Two samples gathered, 50 of warm-up; after an alarm two gathered and ten held.
    assert alarms.tolist() == [151, 263, 375, 487, 599, 711]


def test_own_trigger_is_told_the_variance_that_the_innovation_should_have(estimator: Estimator) -> None:
    """In codes^2, so that the squared innovation is as large on average. 2 LSB of noise, and rounding."""
    u, y = suspension([(0, FRONT)], np.arange(10.0, 4000.0, 50.0), 4000, 2.0, 5)
    assert estimator.init(kind=CUSTOM, custom=2, ceiling=1e6, noise_variance=4.0 + 1.0 / 12.0, edge_instants=LOCKED)
    assert estimator.run(u, y).statistic[800:].mean() == pytest.approx(1.0, rel=0.1)


def test_own_trigger_is_told_the_variance_of_theta_too(estimator: Estimator) -> None:
    """Before anything is known of the plant, the innovation is thousands of codes, and its variance as large."""
    u, y = suspension([(0, FRONT)], np.arange(10.0, 400.0, 50.0), 400, 2.0, 5)
    assert estimator.init(kind=CUSTOM, custom=2, ceiling=1e6, warm_up_n=0, edge_instants=LOCKED)
    result = estimator.run(u, y)
    assert np.abs(result.innovation).max() > 100.0
    assert 0.0 < result.statistic.max() < 100.0


def test_variance_of_the_noise_is_followed(estimator: Estimator) -> None:
    """2 LSB of Gaussian noise and rounding: 4 + 1/12; what clipping at three sigma costs is made up for."""
    u, y = suspension([(0, FRONT)], np.arange(10.0, 20_000.0, 50.0), 20_000, 2.0, 5)
    assert estimator.init(noise_estimated=1, noise_variance=16.0)
    assert estimator.run(u, y).noise_variance == pytest.approx(4.0 + 1.0 / 12.0, rel=0.15)


def test_walking_parameters_are_followed_where_forgetting_nothing_is_stuck(estimator: Estimator) -> None:
    """The spring softens by a quarter; with a random walk theta comes to it, without (and without trigger) not."""
    changes = [(0, FRONT), (400, (115.0, 3021.0, 18000.0))]
    u, y = suspension(changes, np.arange(10.0, 1600.0, 50.0), 1600, 0.5, 1)
    gains = {}
    for walk in (0.0, 1e-7):
        assert estimator.init(kind=NONE, forgetting=1.0, random_walk=walk, refresh_n=0)
        theta = estimator.run(u, y).theta[-1].astype(float)
        gains[walk] = theta[2:5].sum() / (1.0 + theta[0] + theta[1])
    true = (1.0 / 18000.0) * (2940.0 / 4096) / (0.1996 / 4096)
    assert gains[1e-7] == pytest.approx(true, rel=0.04)
    assert gains[0.0] < true * 0.93


def test_variance_of_walking_parameters_grows_without_excitation_up_to_the_prior(estimator: Estimator) -> None:
    """By 1 / forgetting (thesis Equ 3.21) and the walk (3.23) an equation."""
    p0, walk = 1e4, 1.0
    settings = {"na": 1, "nb": 1, "offset": 0, "p0": p0, "forgetting": 0.5, "random_walk": walk, "kind": NONE}
    assert estimator.init(**settings, c=(0.0, 0.0), refresh_n=0, stuck_n=0)
    rng = np.random.default_rng(1)
    estimator.run(rng.normal(0.0, 1000.0, 50), rng.normal(0.0, 1000.0, 50))
    estimator.run(np.zeros(3), np.zeros(3))
    variances = np.array([estimator.run([0.0], [0.0]).variance for _ in range(20)])
    assert variances[0].max() < 100.0
    assert variances[1:] == pytest.approx(np.minimum(variances[:-1] / 0.5 + walk, p0), rel=1e-4)
    assert (variances[-1] == p0).all()


def test_excitation_is_never_lost_where_it_is_not_watched(estimator: Estimator) -> None:
    assert estimator.init(idle_n=0)
    assert not estimator.run(np.zeros(300), np.full(300, 410.0)).idle.any()


def test_counters_stay_at_their_limits(estimator: Estimator) -> None:
    u, y = front()
    y[300:330] = np.nan
    y[400:600] = y[399]
    y[610:650] = 5000.0
    valid = np.ones(N)
    valid[200:220] = 0
    assert estimator.init(code_high=4500.0, code_low=-10.0)
    estimator.age_counters()
    counters = estimator.run(u, y, valid).counters
    limits = {"updated": 2**32 - 1, "missing": 2**32 - 1, "refused": 2**16 - 1, "saturated": 2**16 - 1}
    limits |= {"stuck": 2**16 - 1, "restarts": 2**16 - 1}
    assert {name: counters[name] for name in limits} == limits


def test_variance_of_no_noise_at_all_stays_positive(estimator: Estimator) -> None:
    assert estimator.init(noise_estimated=1, kind=NONE)
    assert estimator.run(np.zeros(6000), np.zeros(6000)).noise_variance == pytest.approx(0.07 * 1.2)


def test_mean_between_faults_goes_on_beyond_the_range_of_its_counter(estimator: Estimator) -> None:
    assert estimator.init(kind=2, ceiling=1e6, absolute=1, refresh_n=0, stuck_n=0)
    y = np.tile([1.0, -1.0], 35_000)
    assert np.isfinite(estimator.run(np.zeros(70_000), y).statistic).all()


def test_damaged_state_is_noticed(estimator: Estimator) -> None:
    assert estimator.init()
    u, y = front()
    estimator.run(u, y)
    assert [estimator.invariants_hold_if_damaged(way) for way in range(11)] == [False] * 10 + [True]
