"""Tests of the estimator on the emulated suspension."""

import pytest


@pytest.mark.parametrize("seed", range(10))
def test_every_change_of_20_percent_is_detected_and_learned(hil_play, seed):
    played = hil_play("scenarios/first.toml", seed=seed)
    assert played.detects()  # each change before its deadline, which the verdict computes
    assert played.stays_quiet()
    assert played.estimates(within=0.05)  # M, B, K before each change and at the end
