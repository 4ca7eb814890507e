"""The card."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from analogrig_emulator import (
    CARDS,
    TICKS_PER_SAMPLE,
    Card,
    Excitation,
    PotTurn,
    Sampler,
    SamplerError,
    SuspensionComputer,
    acquired,
    drawn_levels,
    probes_per_sample,
    sample_plays,
)
from tests.emulator.plays import LSB_V, Volts

UNIPOLAR = Card(ranges_v=((0.0, 10.0),) * 4)


def sampler(card: Card, seed: int = 1) -> Sampler:
    return Sampler(card, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("lsbs", "code", "clipped"),
    [
        (-0.51, 0, True),
        (-0.49, 0, False),
        (0.0, 0, False),
        (0.49, 0, False),
        (0.51, 1, False),
        (2048.0, 2048, False),
        (4095.49, 4095, False),
        (4095.51, 4095, True),
        (4096.0, 4095, True),
        (1e9, 4095, True),
        (-1e300, 0, True),
    ],
)
def test_a_voltage_has_the_nearest_code_and_is_clipped_iff_there_is_none(lsbs: float, code: int, clipped: bool) -> None:  # noqa: FBT001
    codes, clips = sampler(UNIPOLAR).sample(np.full((1, 4), lsbs * LSB_V))
    assert codes.dtype == np.uint16
    assert codes.tolist() == [[code] * 4]
    assert clips.tolist() == [[clipped] * 4]


def test_each_channel_has_its_own_range() -> None:
    card = Card(bits=10, ranges_v=((0.0, 10.0), (-10.0, 10.0), (-1.0, 9.0), (0.0, 5.0)))
    codes, _ = sampler(card).sample(np.array([[2.5, 2.5, 2.5, 2.5]]))
    assert codes.tolist() == [[256, 640, 358, 512]]
    np.testing.assert_allclose(card.lsb_v * 1024, [10, 20, 10, 5])


def test_codes_come_back_as_volts_within_half_an_lsb() -> None:
    card = Card()
    volts = np.random.default_rng(2).uniform(-9.9, 9.9, (1000, 4))
    codes, clipped = sampler(card).sample(volts)
    assert not clipped.any()
    assert np.abs(card.volts(codes) - volts).max() <= 0.5 * 20.0 / 4096 * (1 + 1e-9)


def test_noise_has_its_rms_on_each_channel() -> None:
    """Standard error of an rms over 40,000 samples is 0.35 %, and quantisation adds 1/12; the bound is 5 sigma."""
    card = Card(noise_lsb=(0.0, 1.0, 2.0, 5.0))
    codes, _ = sampler(card).sample(np.zeros((40_000, 4)))
    spread = codes.astype(float).std(axis=0)
    assert spread[0] == 0.0
    expected = np.sqrt(np.array([1.0, 2.0, 5.0]) ** 2 + 1 / 12)
    np.testing.assert_allclose(spread[1:], expected, rtol=0.018)


def test_blocks_and_other_channels_noise_change_no_code() -> None:
    volts = np.random.default_rng(3).uniform(-5, 5, (500, 4))
    card = Card(noise_lsb=(1.0, 1.0, 1.0, 1.0))
    whole, _ = sampler(card).sample(volts)
    cutter = sampler(card)
    parts = [cutter.sample(part)[0] for part in np.split(volts, [1, 7, 300])]
    assert np.array_equal(np.concatenate(parts), whole)
    quiet, _ = sampler(Card(noise_lsb=(0.0, 1.0, 0.0, 0.0))).sample(volts)
    assert np.array_equal(quiet[:, 1], whole[:, 1])
    other, _ = sampler(card, seed=2).sample(volts)
    assert not np.array_equal(other, whole)


@pytest.mark.parametrize("volt", [math.nan, math.inf, -math.inf])
def test_what_is_no_voltage_is_refused_with_its_place_and_leaves_the_card_as_it_was(volt: float) -> None:
    volts = np.zeros((5, 4))
    volts[3, 2] = volt
    slow = sampler(Card(acquisition=2.0))
    with pytest.raises(SamplerError, match="sample 3 of the block, channel 2: the voltage must be finite"):
        slow.sample(volts)
    assert np.isfinite(slow.seen_lsb(np.zeros((5, 4)))).all()
    with pytest.raises(SamplerError, match="4 channels, got volts of shape"):
        sampler(Card()).sample(np.zeros((5, 3)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("bits", 0),
        ("bits", 17),
        ("bits", 12.5),
        ("missing_codes", (3.5,)),
        ("stuck_high", 1.0),
        ("rate_hz", 0.0),
        ("ranges_v", ((0.0, 10.0), (5.0, 5.0), (0.0, 1.0), (0.0, 1.0))),
        ("ranges_v", ((0.0, math.inf),) * 4),
        ("noise_lsb", (0.0, 0.0)),
        ("noise_lsb", (0.0, 0.0, -1.0, 0.0)),
        ("throughput_hz", 0.0),
        ("skew_s", (0.0, 1e-6)),
        ("skew_s", (0.0, 0.0, -1e-6, 0.0)),
        ("skew_s", (0.0, 50e-6, 0.0, 0.0)),
        ("clock_drift_ppm", math.nan),
        ("aperture_jitter_s", 1.0),
        ("acquisition", 0.0),
        ("droop_v_per_s", 1.0),
        ("gain_error", (0.0, 0.0, 0.0, math.inf)),
        ("offset_lsb", (math.nan,) * 4),
        ("levels_lsb", (0.5, 1.5)),
        ("missing_codes", (4095,)),
        ("stuck_high", 4096),
    ],
)
def test_a_field_out_of_range_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(SamplerError, match=f"card: {field}"):
        Card(**{field: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"stuck_high": 3, "stuck_low": 2}, "stuck_high has a bit that stuck_low has too"),
        ({"throughput_hz": 70e3}, r"throughput_hz 70000 does not carry 4 channels at 20000 Hz \(80000"),
        ({"skew_s": (0.0, 1e-6 * math.pi, 0.0, 0.0)}, "no grid"),
    ],
)
def test_fields_that_exclude_each_other_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(SamplerError, match=message):
        probes_per_sample(Card(**fields))


# ---- the faults of a card, each by itself, and its clipping flags with all of them


ONE = Card(bits=8, ranges_v=((0.0, 256.0),), noise_lsb=(0.0,))
"""One channel at one volt per code, so that volts are codes."""


def codes(card: Card, volts: Sequence[float] | Volts, seed: int = 1) -> list[int]:
    column = np.asarray(volts, np.float64)[:, None]
    return [int(code) for code in Sampler(card, np.random.default_rng(seed)).sample(column)[0][:, 0]]


class Wave:
    """A machine whose every voltage is the time in microseconds, at the rate it was made for."""

    def __init__(self, rate_hz: float, channels: int = 4) -> None:
        self.sample_rate_hz = rate_hz
        self.channels = channels

    def play(
        self,
        excitation: Excitation,
        samples: int,
        changes: Sequence[PotTurn] = (),
        block_samples: int = 256,
        ahead_ticks: int = 0,
    ) -> Iterator[Volts]:
        del excitation, changes
        instants = [0, ahead_ticks] if ahead_ticks else [0]
        ticks = np.arange(samples)[:, None] * TICKS_PER_SAMPLE + np.repeat(instants, self.channels)
        times = ticks / TICKS_PER_SAMPLE / self.sample_rate_hz * 1e6
        for first in range(0, samples, block_samples):
            yield times[first : first + block_samples]


def times_us(card: Card, samples: int, block_samples: int = 7, seed: int = 1) -> Volts:
    """Delay of each channel after the nominal instant: (samples, channels), us."""
    wave = Wave(card.true_rate_hz * probes_per_sample(card), card.channels)
    rng = np.random.default_rng(seed)
    blocks = list(acquired(wave, card, Excitation(), samples, rng=rng, block_samples=block_samples))
    nominal = np.arange(samples)[:, None] / card.true_rate_hz * 1e6
    return np.asarray(np.concatenate(blocks) - nominal)


# ---- timing


def test_throughput_is_what_all_channels_need_together() -> None:
    assert Card(throughput_hz=80e3).channels == 4


def test_each_channel_is_taken_at_its_own_instant() -> None:
    np.testing.assert_allclose(times_us(CARDS["skewed"], 20), np.tile([0.0, 10.0, 20.0, 30.0], (20, 1)), atol=1e-9)


@pytest.mark.parametrize("skew_us", [10.0, 25.0])
def test_skewed_displacement_is_that_of_a_machine_sampled_faster(skew_us: float) -> None:
    """The same machine at five, or two, times the rate: its own samples at that instant, change included."""
    count = round(50.0 / skew_us)
    card = Card(skew_s=(0.0, skew_us * 1e-6, 0.0, 0.0))
    assert probes_per_sample(card) == count
    excitation, change = Excitation(clock="free", phase=0.3), {"K": 18000.0}
    machine = SuspensionComputer("front", sample_rate_hz=20e3 * count)
    rng = np.random.default_rng(1)
    volts = np.concatenate(list(acquired(machine, card, excitation, 150, [PotTurn(60, change)], rng=rng)))
    fast = SuspensionComputer("front", sample_rate_hz=20e3 * count)
    every = np.concatenate(list(fast.play(excitation, 150 * count, [PotTurn(60 * count, change)])))
    np.testing.assert_allclose(volts[:, 0], every[::count, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(volts[:, 1], every[1::count, 1], rtol=0, atol=1e-9)


def test_edges_stay_on_the_cards_clock_however_often_it_is_probed() -> None:
    excitation = Excitation(phase=0.237)
    plain = np.concatenate(list(SuspensionComputer("front").play(excitation, 200)))
    card = CARDS["skewed"]
    machine = SuspensionComputer("front", sample_rate_hz=card.rate_hz * probes_per_sample(card))
    rng = np.random.default_rng(1)
    skewed = np.concatenate(list(acquired(machine, card, excitation, 200, rng=rng)))
    assert np.array_equal(skewed[:, 0], plain[:, 0])


def test_without_timing_faults_the_machine_is_played_as_it_is() -> None:
    rng = np.random.default_rng(1)
    volts = np.concatenate(list(acquired(SuspensionComputer("front"), Card(), Excitation(), 50, rng=rng)))
    assert volts.tobytes() == np.concatenate(list(SuspensionComputer("front").play(Excitation(), 50))).tobytes()


@pytest.mark.parametrize("card", [CARDS["skewed"], Card(clock_drift_ppm=1000.0), Card(rate_hz=1e4)])
def test_a_machine_made_for_another_rate_is_refused_naming_both(card: Card) -> None:
    machine, wanted_hz = SuspensionComputer("front"), card.true_rate_hz * probes_per_sample(card)
    with pytest.raises(SamplerError, match=f"sample_rate_hz 20000, and this card needs {wanted_hz:g}"):
        acquired(machine, card, Excitation(), 10, rng=np.random.default_rng(1))


def test_aperture_delay_shifts_every_channel() -> None:
    np.testing.assert_allclose(times_us(Card(aperture_delay_s=50e-9), 30), 0.05, atol=1e-9)


def test_aperture_jitter_has_its_rms_and_does_not_depend_on_blocks() -> None:
    """8000 draws: the standard error of their rms is 0.8 %; the bound is 4 sigma."""
    card = replace(CARDS["skewed"], aperture_jitter_s=5e-9)
    late_us = times_us(card, 2000, block_samples=256)
    assert np.std(late_us - [0.0, 10.0, 20.0, 30.0]) == pytest.approx(5e-3, rel=0.032)
    assert np.array_equal(times_us(card, 2000, block_samples=33), late_us)


def test_the_cards_clock_drifts_against_a_free_generator_and_not_against_its_own() -> None:
    """A card 1000 ppm fast takes 2002 samples while the generator makes 20 periods of 100."""
    card = Card(clock_drift_ppm=1000.0)

    def rises(clock: str) -> NDArray[np.intp]:
        machine = SuspensionComputer("front", sample_rate_hz=card.true_rate_hz)
        rng = np.random.default_rng(1)
        blocks = acquired(machine, card, Excitation(clock=clock), 2100, rng=rng)
        return np.flatnonzero(np.diff(np.concatenate(list(blocks))[:, 0]) > 5) + 1

    assert rises("card").tolist() == list(range(100, 2100, 100))
    assert rises("free")[-1] == math.ceil(2000 * 1.001)


# ---- holding


def test_acquisition_leaves_its_part_of_each_step() -> None:
    """After ln 10 time constants a tenth of the step from the sample before is missing."""
    card = replace(ONE, acquisition=math.log(10.0))
    assert codes(card, [100.0, 100.0, 200.0, 200.0]) == [100, 100, 190, 199]
    volts = np.random.default_rng(1).uniform(0, 255, (50, 1))
    whole, cut = Sampler(card, np.random.default_rng(1)), Sampler(card, np.random.default_rng(1))
    parts = [cut.sample(part)[0] for part in np.split(volts, [0, 1, 20])]
    assert np.array_equal(np.concatenate(parts), whole.sample(volts)[0])


@pytest.mark.parametrize("monotonic", [True, False])
def test_many_inputs_have_the_codes_of_each_alone(*, monotonic: bool) -> None:
    """Many inputs to a converter with rising levels are found from a guess, a single one bit by bit."""
    levels_lsb = drawn_levels(8, np.random.default_rng(4), inl_lsb=2.0, monotonic=monotonic)
    card = replace(ONE, levels_lsb=levels_lsb, missing_codes=(7, 8, 200))
    seen = np.concatenate((np.random.default_rng(5).uniform(-3.0, 258.0, 700), levels_lsb))[:, None]
    together, clipped = Sampler(card, np.random.default_rng(1)).sample(seen, np.zeros(seen.shape))
    alone = [Sampler(card, np.random.default_rng(1)).sample(each[None], np.zeros((1, 1))) for each in seen]
    assert together.tolist() == [code.tolist()[0] for code, _ in alone]
    assert clipped.tolist() == [flag.tolist()[0] for _, flag in alone]


@pytest.mark.parametrize("card", [replace(ONE, acquisition=2.0, noise_lsb=(0.7,)), ONE], ids=["slow", "whole"])
def test_plays_taken_together_are_those_of_a_card_each(card: Card) -> None:
    rng = np.random.default_rng(3)
    volts, normals = rng.uniform(-5, 260, (4, 30, 1)), rng.standard_normal((4, 30, 1))
    codes_of_all, clipped_of_all = sample_plays(card, volts, normals)
    for i in range(4):
        own_codes, own_clipped = Sampler(card, rng).sample(volts[i], normals[i])
        assert np.array_equal(codes_of_all[i], own_codes) and np.array_equal(clipped_of_all[i], own_clipped)


def test_a_held_voltage_droops_while_it_waits() -> None:
    """Two conversions of 10 us wait before channel 2: at 1e5 V/s it has lost 2 V, 3 V on channel 3."""
    card = Card(8, 20e3, ((0.0, 256.0),) * 4, throughput_hz=100e3, droop_v_per_s=1e5)
    taken, _ = Sampler(card, np.random.default_rng(1)).sample(np.full((1, 4), 100.0))
    assert taken.tolist() == [[100, 99, 98, 97]]


# ---- amplifier and converter


def test_gain_and_offset_errors_are_each_channels_own() -> None:
    card = Card(8, 20e3, ((0.0, 256.0),) * 4, gain_error=(0.0, 0.05, 0.0, -0.05), offset_lsb=(0.0, 0.0, 3.0, 3.0))
    taken, _ = Sampler(card, np.random.default_rng(1)).sample(np.full((1, 4), 100.0))
    assert taken.tolist() == [[100, 105, 103, 98]]


def test_a_given_level_moves_one_transition_alone() -> None:
    levels = [c - 0.5 for c in range(1, 256)]
    levels[99] += 0.4  # 99 to 100
    assert codes(replace(ONE, levels_lsb=tuple(levels)), [99.6, 99.8, 99.95, 100.4, 100.6]) == [99, 99, 100, 100, 101]


def test_ideal_levels_are_the_rounding_converter() -> None:
    volts = np.random.default_rng(1).uniform(-5, 260, 2000)
    levels = tuple(c - 0.5 for c in range(1, 256))
    assert codes(replace(ONE, levels_lsb=levels), volts) == codes(ONE, volts)


@given(st.integers(4, 12), st.integers(0, 2**32), st.floats(0.1, 2.0))
@settings(max_examples=30, deadline=None)
def test_drawn_levels_keep_their_inl_and_their_order(bits: int, seed: int, inl_lsb: float) -> None:
    ideal = np.arange(1, 1 << bits) - 0.5
    free = np.array(drawn_levels(bits, np.random.default_rng(seed), inl_lsb, monotonic=False))
    held = np.array(drawn_levels(bits, np.random.default_rng(seed), inl_lsb))
    assert np.abs(free - ideal).max() == pytest.approx(inl_lsb)
    assert free[0] == 0.5 and free[-1] == pytest.approx((1 << bits) - 1.5)
    assert np.all(np.diff(held) >= 0)
    card = Card(bits, 20e3, ((0.0, float(1 << bits)),), (0.0,), levels_lsb=tuple(held))
    rising = codes(card, np.linspace(-1.0, (1 << bits) + 1.0, 3000))
    assert rising == sorted(rising)


def test_a_missing_code_is_never_given() -> None:
    card = replace(ONE, missing_codes=(77, 78))
    assert codes(card, [76.4, 76.6, 77.0, 78.0, 78.4, 78.6]) == [76, 76, 76, 76, 76, 79]
    assert set(codes(card, np.arange(256.0))) == set(range(256)) - {77, 78}


def test_stuck_bits_read_what_they_are_stuck_at() -> None:
    assert codes(replace(ONE, stuck_high=0b100), [0.0, 4.0, 255.0]) == [4, 4, 255]
    assert codes(replace(ONE, stuck_low=0b100), [0.0, 5.0, 255.0]) == [0, 1, 251]


# ---- clipping

CARD = st.builds(
    Card,
    bits=st.integers(2, 12),
    ranges_v=st.just(((0.0, 10.0), (-10.0, 10.0), (-1.0, 9.0), (0.0, 5.0))),
    noise_lsb=st.tuples(*[st.floats(0, 50)] * 4),
    gain_error=st.tuples(*[st.floats(-0.1, 0.1)] * 4),
    offset_lsb=st.tuples(*[st.floats(-20, 20)] * 4),
    stuck_high=st.sampled_from([0, 1]),
    missing_codes=st.sampled_from([(), (1,), (2, 1)]),
)


@given(CARD, st.integers(0, 2**32))
@settings(max_examples=100, deadline=None)
def test_every_clipped_sample_is_flagged_and_no_other(card: Card, seed: int) -> None:
    """The converter input is computed here in volts: clipped is what lies outside half an LSB about the codes."""
    volts = np.random.default_rng(seed).uniform(-15.0, 15.0, (50, 4))
    _, clipped = Sampler(card, np.random.default_rng(seed)).sample(volts)
    low_v, high_v = np.array(card.ranges_v).T
    lsb_v = (high_v - low_v) / 2**card.bits
    noise_lsb = np.random.default_rng(seed).standard_normal((50, 4)) * card.noise_lsb
    seen_v = volts * (1 + np.array(card.gain_error)) + (noise_lsb + card.offset_lsb) * lsb_v
    beyond_v = np.maximum(low_v - lsb_v / 2 - seen_v, seen_v - (high_v - lsb_v / 2))
    certain = np.abs(beyond_v) > 1e-9
    assert np.array_equal(clipped[certain], beyond_v[certain] > 0)


def test_noise_that_leaves_the_range_is_flagged() -> None:
    card = replace(ONE, noise_lsb=(1.0,))
    taken, clipped = Sampler(card, np.random.default_rng(1)).sample(np.full((10_000, 1), 254.5))
    assert set(taken[clipped].tolist()) == {255}
    # P(noise >= 1) = 0.159, standard error 0.0037
    assert clipped.mean() == pytest.approx(0.1587, abs=0.015)


# ---- presets and errors


def test_the_ideal_preset_has_no_fault_and_the_others_sample_four_channels_at_20_khz() -> None:
    assert CARDS["ideal"] == Card()
    for card in CARDS.values():
        assert (card.channels, card.rate_hz, card.bits) == (4, 20e3, 12)
