"""False-alarm rate of the estimator on the suspension, of which nothing changes."""

from analogrig import rate_below


def test_false_alarm_rate_is_below_1_in_10_000_samples(hil_play):
    plays = [hil_play("healthy", seed=seed) for seed in range(8)]  # 160,000 samples
    assert rate_below(1e-4, plays, confidence=0.95, burst=5)  # assumes bursts of at most five alarms on average
