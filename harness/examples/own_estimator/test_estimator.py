"""Tests of the estimator that make builds: `make && pytest`."""

import pytest


def test_healthy_plant_raises_no_alarm(hil_play):
    assert hil_play("healthy", seed=7).stays_quiet()


@pytest.mark.xfail(reason="one warm-up after each alarm is too long for the thesis's changes", strict=True)
def test_changes_are_detected(hil_play):
    assert hil_play("thesis", seed=7).detects(within=4.0)
