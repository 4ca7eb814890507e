"""Wired computer of the simulator against the emulator played directly: time, generator, pots and leads."""

from __future__ import annotations

import numpy as np
import pytest

from analogrig_emulator import EmulatorError, Excitation, PotTurn
from analogrig_instruments.instrument import DialChange
from analogrig_instruments.simulator.computer import CHUNK_N, Amplifier, Booster, WiredComputer, Wiring
from tests.served.talk import front

RATE_HZ = 20e3
SQUARE = Excitation("square", 0.01, 0.99, 100.0, clock="free")
AMPLIFIED = Excitation("square", 0.1, 9.9, 100.0, clock="free")
ROUNDING_V = 1e-9


def played(samples: int, changes: tuple[PotTurn, ...] = (), rate_hz: float = RATE_HZ) -> np.ndarray:
    """Force and displacement of the emulator itself."""
    return np.concatenate(list(front(rate_hz).play(AMPLIFIED, samples, changes)))[:, :2]


def wired(wiring: Wiring | None = None) -> WiredComputer:
    return WiredComputer(front, wiring or Wiring(), RATE_HZ)


def test_signals_are_those_of_the_emulator_for_any_division_into_runs() -> None:
    computer = wired()
    computer.generate(SQUARE)
    parts = [computer.run(count) for count in (1, 0, 7, 199, 1000, 793)]
    assert np.array_equal(np.concatenate(parts), played(2000))


def test_long_run_is_played_in_chunks_without_seams() -> None:
    computer = wired()
    computer.generate(SQUARE)
    assert np.array_equal(computer.run(CHUNK_N + 1000), played(CHUNK_N + 1000))


def test_scheduled_changes_are_made_in_order_of_time_after_the_point_at_or_before_each() -> None:
    computer = wired()
    computer.generate(SQUARE)
    computer.schedule(
        [DialChange(900 / RATE_HZ, "B", 0.8), DialChange(300 / RATE_HZ, "K", 0.6), DialChange(1e3, "M", 0.1)]
    )
    changes = (PotTurn(300, {"K_dial": 0.6}), PotTurn(900, {"B_dial": 0.8}))
    assert np.abs(computer.run(1500) - played(1500, changes)).max() < ROUNDING_V


def test_silenced_generator_gives_0_v_and_the_computer_comes_to_rest() -> None:
    computer = wired()
    computer.generate(SQUARE)
    computer.run(100)
    computer.silence()
    volts = computer.run(2000)
    assert not volts[:, 0].any()
    assert abs(volts[0, 1]) > 1.0
    assert np.abs(volts[-1]).max() < 0.01


def test_leads_have_gain_offset_and_limits_and_can_be_swapped() -> None:
    force, displacement = Amplifier(gain=-0.5, offset_v=0.25), Amplifier(offset_v=-1.0, limits_v=(-0.5, 3.0))
    computer = wired(Wiring(force=force, displacement=displacement, swapped=True))
    computer.generate(SQUARE)
    emulated = played(1000)
    expected = np.stack((np.clip(emulated[:, 1] - 1.0, -0.5, 3.0), -0.5 * emulated[:, 0] + 0.25), axis=1)
    seen = computer.run(1000)
    assert np.abs(seen - expected).max() < ROUNDING_V
    assert seen[:, 0].max() == 3.0 and seen[:, 0].min() == -0.5
    boosted = wired(Wiring(generator=Booster(gain=8.0, offset_v=0.5, limits_v=(-1.0, 7.0))))
    boosted.generate(SQUARE)
    assert sorted(set(np.round(boosted.run(1000)[:, 0], 9))) == [0.58, 7.0]


def test_another_rate_keeps_generator_pots_and_schedule() -> None:
    """The computer starts from rest; its transient is over after 15 ms."""
    computer = wired()
    computer.generate(SQUARE)
    computer.turn("B", 0.8)
    computer.schedule([DialChange(0.04, "K", 0.6)])
    computer.run(250)  # into the second period
    computer.set_rate(2 * RATE_HZ)
    changes = (PotTurn(0, {"B_dial": 0.8}), PotTurn(1600, {"K_dial": 0.6}))
    expected = played(4500, changes, 2 * RATE_HZ)[500:]
    seen = computer.run(4000)
    assert np.array_equal(seen[:, 0], expected[:, 0])
    assert np.abs(seen - expected)[600:].max() < 1e-6
    assert computer.dials["K"] == pytest.approx(0.6, abs=1e-3)


def test_points_to_the_next_period_are_counted() -> None:
    computer = wired()
    assert computer.points_to_period() is None
    computer.generate(SQUARE)
    assert computer.points_to_period() == 0
    computer.run(1)
    assert computer.points_to_period() == 199
    computer.run(199)
    assert computer.points_to_period() == 0


def test_waveform_too_fast_for_the_rate_is_refused_and_the_generator_continues() -> None:
    computer = wired()
    computer.generate(SQUARE)
    with pytest.raises(EmulatorError, match="half the sample rate"):
        computer.generate(Excitation("square", 0.0, 1.0, 0.6 * RATE_HZ, clock="free"))
    with pytest.raises(EmulatorError, match="half the sample rate"):
        computer.set_rate(150.0)
    assert np.array_equal(computer.run(1000), played(1000))


@pytest.mark.parametrize(
    ("field", "value"),
    [("gain", 1e4), ("gain", float("nan")), ("offset_v", 2e3), ("limits_v", (1.0, 1.0)), ("limits_v", (0.0, 1e4))],
)
def test_stage_out_of_range_is_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=field):
        Amplifier(**{field: value})  # type: ignore[arg-type]
