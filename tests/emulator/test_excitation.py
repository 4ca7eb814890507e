"""The generator's edges."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest

from analogrig_emulator import TICKS_PER_SAMPLE, Edges, Excitation, ExcitationError

RATE_HZ = 20e3


def edges_of(excitation: Excitation, samples: int) -> Edges:
    return excitation.edges(0, samples * TICKS_PER_SAMPLE, RATE_HZ)


def instants(edges: Edges) -> list[float]:
    """In samples."""
    return [float(tick) / TICKS_PER_SAMPLE for tick in edges.ticks]


def test_a_square_wave_rises_at_once_and_then_switches_every_half_period() -> None:
    edges = edges_of(Excitation(frequency_hz=200.0, low_v=1.0, high_v=9.0), 210)
    assert instants(edges) == [0, 50, 100, 150, 200]
    assert edges.levels_v.tolist() == [9, 1, 9, 1, 9]


@pytest.mark.parametrize(("phase", "first"), [(0.3, [0, 20, 70]), (0.5, [0, 50, 100]), (0.9, [0, 10, 60])])
def test_phase_is_how_far_into_the_period_it_starts(phase: float, first: list[float]) -> None:
    edges = edges_of(Excitation(frequency_hz=200.0, phase=phase), 105)
    assert instants(edges)[:3] == first
    assert edges.levels_v[0] == (10.0 if phase < 0.5 else 0.0)


def test_a_pulse_is_high_for_its_duty() -> None:
    edges = edges_of(Excitation(shape="pulse", frequency_hz=200.0, duty=0.1), 210)
    assert instants(edges) == [0, 10, 100, 110, 200]
    assert edges.levels_v.tolist() == [10, 0, 10, 0, 10]


def test_on_the_cards_clock_an_edge_waits_for_the_next_sample() -> None:
    # A half period of 20000 / 600 = 33.33 samples.
    assert instants(edges_of(Excitation(frequency_hz=300.0), 201)) == [0, 34, 67, 100, 134, 167, 200]


def test_a_free_generator_drifts_by_its_ppm() -> None:
    excitation = Excitation(clock="free", frequency_hz=200.0, phase=0.137, drift_ppm=20.0)
    edges = edges_of(excitation, 1_000_000)
    half_period = Fraction(50) / (1 + Fraction(20, 1_000_000))
    for k in (1, 2, 777, 20_000):
        exact = (k * half_period - Fraction(137, 1000) * 2 * half_period) * TICKS_PER_SAMPLE
        assert abs(int(edges.ticks[k]) - exact) <= 1
    # 20 ppm of a million samples is 20 samples: one half period more would need 50.
    assert edges.ticks.size == 20_001


def test_a_slow_clock_drifts_the_other_way() -> None:
    fast, slow = (edges_of(Excitation(clock="free", drift_ppm=ppm), 10_000).ticks[199] for ppm in (50.0, -50.0))
    assert slow - fast == pytest.approx(2 * 50e-6 * 9950 * TICKS_PER_SAMPLE, rel=1e-4)


@pytest.mark.parametrize("length", range(2, 17))
def test_a_pseudo_random_sequence_has_maximal_length(length: int) -> None:
    period = 2**length - 1
    edges = edges_of(Excitation(shape="prbs", frequency_hz=RATE_HZ / 2, register_length=length), 4 * period)
    levels = levels_at(edges, 2 * period, 2.0) > 5.0
    assert np.array_equal(levels[:period], levels[period:])
    assert levels[:period].sum() == 2 ** (length - 1)
    weights = 1 << np.arange(length)
    windows = {int(levels[i : i + length] @ weights) for i in range(period)}
    assert windows == set(range(1, 2**length))


def levels_at(edges: Edges, count: int, every: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Levels at instants 0, every, 2 every ... samples."""
    ticks = (np.arange(count) * every * TICKS_PER_SAMPLE).astype(np.int64)
    return edges.levels_v[np.searchsorted(edges.ticks, ticks, side="right") - 1]


def test_the_seed_shifts_the_sequence() -> None:
    plain, shifted = (
        levels_at(edges_of(Excitation(shape="prbs", frequency_hz=1e3, seed=seed), 2000), 100, 20.0) for seed in (0, 7)
    )
    assert np.array_equal(plain[7:], shifted[:-7])
    assert not np.array_equal(plain, shifted)


@pytest.mark.parametrize(
    "excitation",
    [
        Excitation(frequency_hz=300.0, phase=0.123),
        Excitation(shape="pulse", duty=0.003, frequency_hz=777.0),
        Excitation(shape="pulse", duty=0.997, frequency_hz=777.0),
        Excitation(shape="prbs", frequency_hz=9.9e3, phase=0.5),
        Excitation(clock="free", drift_ppm=-35.0, frequency_hz=1234.5, phase=0.999),
        Excitation(shape="prbs", clock="free", frequency_hz=3333.0, drift_ppm=500.0),
    ],
)
def test_cutting_the_range_changes_no_edge(excitation: Excitation) -> None:
    whole = edges_of(excitation, 500)
    rng = np.random.default_rng(4)
    cuts = [0, *sorted(rng.integers(1, 500 * TICKS_PER_SAMPLE, 2000).tolist()), 500 * TICKS_PER_SAMPLE]
    parts = [excitation.edges(start, stop, RATE_HZ) for start, stop in itertools.pairwise(cuts)]
    assert np.array_equal(np.concatenate([part.ticks for part in parts]), whole.ticks)
    assert np.array_equal(np.concatenate([part.levels_v for part in parts]), whole.levels_v)
    assert whole.ticks[0] == 0
    assert (np.diff(whole.ticks) > 0).all()
    assert (np.diff(whole.levels_v) != 0).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("shape", "triangle"),
        ("clock", "gps"),
        ("low_v", math.nan),
        ("high_v", -1.0),
        ("frequency_hz", 0.0),
        ("frequency_hz", math.inf),
        ("phase", 1.0),
        ("phase", -0.1),
        ("duty", 0.2),
        ("drift_ppm", 3.0),
        ("drift_ppm", math.nan),
        ("register_length", 21),
        ("seed", 0.5),
    ],
)
def test_a_field_out_of_range_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(ExcitationError, match=f"excitation: {field}"):
        Excitation(**{field: value})  # type: ignore[arg-type]


def test_a_frequency_that_the_card_cannot_follow_is_refused() -> None:
    with pytest.raises(ExcitationError, match="frequency_hz 10001.0 exceeds half the sample rate"):
        Excitation(frequency_hz=10001.0).edges(0, 1, RATE_HZ)


def test_a_period_of_more_ticks_than_can_be_counted_is_refused() -> None:
    with pytest.raises(ExcitationError, match=r"frequency_hz 0.1 is too low .* more than 2\^53 ticks"):
        Excitation(frequency_hz=0.1).edges(0, 1, 1e15)
