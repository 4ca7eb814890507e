"""Tests of the estimator that make builds: `make && pytest`."""

import pytest


def test_healthy_plant_raises_no_alarm(hil_play):
    assert hil_play("healthy", seed=7).stays_quiet()


@pytest.mark.xfail(reason="one large innovation is too crude a trigger for the thesis's changes", strict=True)
def test_changes_are_detected(hil_play):
    assert hil_play("thesis", seed=7).detects(within=4.0)
