"""Requirements of our estimator."""

from __future__ import annotations

from typing import Any


def test_every_change_of_the_thesis_is_found_in_time(hil_play: Any) -> None:
    assert hil_play("thesis", seed=3).detects(within=6.0)


def test_healthy_suspension_raises_no_alarm(hil_play: Any) -> None:
    assert hil_play("healthy", seed=3).stays_quiet()
