"""Thesis profile over 50 seeds: no missed change, at most one false alarm, latencies near the information bound.

The seeds are fixed, so the code alone decides these tests. 600 seeds, these among them, gave 4 false alarms in 750,000
samples after the warm-up (ARL0 = 1e5 promises at most 7.5), no missed change, and no ratio above 1.3.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.thesis.detection import Detection, detect

pytestmark = pytest.mark.heavy

SEEDS = range(50)
CLIPPED_SEEDS = range(30)


@pytest.fixture(scope="module", params=["thesis", "thesis-free-running"])
def on_wide_range(request: pytest.FixtureRequest) -> Detection:
    return detect(request.param, "emulator", SEEDS)


@pytest.mark.xdist_group("detection")
def test_no_change_is_missed_and_at_most_one_alarm_is_false(on_wide_range: Detection) -> None:
    assert on_wide_range.inconclusive == 0
    assert on_wide_range.missed == 0
    assert on_wide_range.false_alarms <= 1


@pytest.mark.xdist_group("detection")
def test_mean_latency_is_at_most_one_and_a_half_times_the_mean_bound(on_wide_range: Detection) -> None:
    assert (on_wide_range.ratios() <= 1.5).all(), on_wide_range.ratios()


def test_estimates_at_the_end_of_each_stretch_are_those_of_the_plant(on_wide_range: Detection) -> None:
    rms = np.sqrt((on_wide_range.errors**2).mean(axis=0))
    assert (rms <= [0.01, 0.0015, 0.001]).all(), rms


@pytest.mark.parametrize("scenario", ["thesis", "thesis-free-running"])
def test_clipped_undershoot_raises_at_most_one_false_alarm_in_ten_runs(scenario: str) -> None:
    detection = detect(scenario, "emulator-0-10v", CLIPPED_SEEDS)
    assert detection.inconclusive == 0
    assert detection.missed == 0
    assert detection.false_alarms <= 0.1 * detection.runs
