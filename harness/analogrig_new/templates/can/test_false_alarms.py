"""False-alarm rate of the estimator on the suspension, of which nothing changes."""

import dataclasses

from analogrig import Scenario, rate_below

SHORT = dataclasses.replace(Scenario.load("healthy"), samples=1000)  # each sample takes four messages on the bus


def test_false_alarm_rate_is_below_1_in_200_samples(hil_play):
    plays = [hil_play(SHORT, seed=seed) for seed in range(8)]
    assert rate_below(5e-3, plays, confidence=0.95, burst=5)  # assumes bursts of at most five alarms on average
