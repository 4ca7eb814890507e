"""Pots and their load."""

from __future__ import annotations

import pytest

from analogrig_emulator import PotError
from analogrig_emulator.circuit.pot import coefficient_under_load, dial_for

DIALS = (0.0, 0.01, 0.25, 0.5, 0.8358, 0.99, 1.0)


@pytest.mark.parametrize("dial", DIALS)
@pytest.mark.parametrize("load_ohm", [10e3, 33.2e3, 100e3])
def test_coefficient_is_that_of_the_divider_solved_by_hand(dial: float, load_ohm: float) -> None:
    track_ohm = 10e3
    upper_ohm, lower_ohm = (1 - dial) * track_ohm, dial * track_ohm
    loaded_ohm = lower_ohm * load_ohm / (lower_ohm + load_ohm)
    assert coefficient_under_load(dial, track_ohm, load_ohm) == pytest.approx(loaded_ohm / (loaded_ohm + upper_ohm))


@pytest.mark.parametrize("dial", DIALS)
@pytest.mark.parametrize("load_ohm", [1e3, 10e3, 1e9])
def test_dial_for_undoes_the_load(dial: float, load_ohm: float) -> None:
    assert dial_for(coefficient_under_load(dial, 10e3, load_ohm), 10e3, load_ohm) == pytest.approx(dial, abs=1e-14)


@pytest.mark.parametrize(
    ("coefficient", "load_ohm", "dial"),
    [
        (0.7350, 10e3, 0.8358),
        (0.4065, 33.2e3, 0.4367),
        (0.8300, 49.9e3, 0.8511),
        (0.2557, 100e3, 0.2606),
        (0.9800, 100e3, 0.9818),
    ],
)
def test_dials_are_those_of_the_set_up_sheet(coefficient: float, load_ohm: float, dial: float) -> None:
    assert dial_for(coefficient, 10e3, load_ohm) == pytest.approx(dial, abs=1e-4)


@pytest.mark.parametrize("coefficient", [-1e-9, 1.000001, float("nan")])
def test_coefficient_beyond_the_track_is_refused_naming_the_pot(coefficient: float) -> None:
    with pytest.raises(PotError, match="pot M: coefficient .* is beyond the track"):
        dial_for(coefficient, 10e3, 100e3, name="M")
