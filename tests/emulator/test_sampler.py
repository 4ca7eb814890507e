"""The card."""

from __future__ import annotations

import math

import numpy as np
import pytest

from analogrig_emulator import Card, Sampler, SamplerError

UNIPOLAR = Card(ranges_v=((0.0, 10.0),) * 4)
LSB_V = 10.0 / 4096


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
    ],
)
def test_a_field_out_of_range_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(SamplerError, match=f"card: {field}"):
        Card(**{field: value})  # type: ignore[arg-type]
