"""What is allowed of each quantity, and what to do when it is beyond that.

No machine of 1 % resistors, 5 % capacitors and amplifiers with 3 mV of offset is beyond a limit, and what is within
them does a verdict no harm; harness/README.md, section Self-test, says why of each.
"""

from __future__ import annotations

import math

from analogrig.hardware.self_test import noise
from analogrig.hardware.self_test.findings import Check
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2

LEAST_SHARPER = 0.3
MOST_CLIPPED = 1e-3
LEAST_CODES = 1000.0
MOST_FORCE_GAIN, MOST_GAIN = 0.01, 0.05
MOST_OFFSET_V = 0.06
MOST_NOISE = 2e-3
MOST_SKEW_N, MOST_SKEW_S = 0.1, 5e-6
"""Whichever is more: both are the same at 20 kHz. What skew does to the displacement goes by time, 5 to 6 LSB of 12
bits a microsecond; and where a sample is short, a tenth of one would be a limit for the amplifiers, whose delay two
channels do not tell from the card's."""
MOST_CLOCK_PPM = 50.0
MOST_MASS, MOST_DAMPING = 0.3, 0.15
MOST_SHAPE, LEAST_SHAPE_LSB = 3e-4, 0.5

AMPLIFIERS_S = (0.625e-6, 0.5e-6)
"""By how much the amplifiers of the computer delay the displacement, and its standard error: 0.62 us with TL07x, 1.2 us
with polyester capacitors too, none with ideal ones. (9.5 us with a 741, which is found as skew.)"""


def identity(sharper: float) -> Check:
    """``sharper``: steps of the force from one sample to the next, less those of the displacement."""
    swapped = "the leads of force and displacement are swapped: exchange them"
    both = "both inputs see much the same signal: one of the leads is in the wrong jack"
    advice = swapped if sharper < -LEAST_SHARPER else both
    return Check("identity", "", sharper, 0.0, LEAST_SHARPER, 1.0, "of the swing", advice)


def polarity(channel: str, sign: float) -> Check:
    advice = f"the {channel} is inverted: exchange the wires of its lead, or look for an amplifier that inverts"
    return Check("polarity", channel, sign, 0.0, 0.0, 1.0, "", advice)


def clipping(channel: str, share: float, samples: int, end: str) -> Check:
    advice = (
        f"the {channel} leaves its range at the {end} end: take a range that holds it, or see whether it is inverted"
        " or has an offset"
    )
    error = math.sqrt(share * (1.0 - share) / samples)
    return Check("clipping", channel, share, error, 0.0, MOST_CLIPPED, "of the samples", advice)


def range_use(channel: str, swing_codes: float, codes: int) -> Check:
    advice = f"the {channel} takes {swing_codes:.0f} codes: take a smaller range, or amplify it before the card"
    note = f"{swing_codes:.0f} codes"
    return Check(
        "range use", channel, swing_codes / codes, 0.0, LEAST_CODES / codes, 1.0, "of full scale", advice, note
    )


def gain(channel: str, deviation: float, error: float, most: float, followed: str) -> Check:
    """``followed``: what the other channel has to say of it."""
    word = "more" if deviation > 0.0 else "less"
    advice = f"the {channel} is {abs(deviation):.1%} {word} than it should be{followed}"
    return Check("gain", channel, deviation, error, -most, most, "off nominal", advice)


def offset(channel: str, volts: float, error: float, followed: str) -> Check:
    advice = f"the {channel} has {1e3 * volts:+.0f} mV too much{followed}"
    return Check("offset", channel, volts, error, -MOST_OFFSET_V, MOST_OFFSET_V, "V", advice)


def skew(samples: float, error: float, sample_period_s: float) -> Check:
    by = f"by {1e6 * abs(samples) * sample_period_s:.2g} us"
    if samples > 0.0:
        advice = f"the displacement is taken later than the force {by}: have the card sample both at one instant"
    else:
        advice = (
            f"the displacement is taken earlier than the force {by}, or the computer's amplifiers are so slow: have the"
            " card sample both at one instant, and look at the amplifiers' type"
        )
    most = max(MOST_SKEW_N, MOST_SKEW_S / sample_period_s)
    return Check("skew", "", samples, error, -most, most, "samples", advice)


def noise_floor(channel: str, rms_lsb: float, error: float, swing_codes: float) -> Check:
    own = noise.analogue(rms_lsb)
    note = f"{own:.2f} LSB of noise and {math.sqrt(QUANTISATION_VARIANCE_LSB2):.2f} of quantisation"
    advice = f"{note}, {rms_lsb / swing_codes:.2%} of the signal: look for a bad ground, mains, an open shield"
    return Check("noise", channel, rms_lsb, error, 0.0, MOST_NOISE * swing_codes, "LSB", advice, note)


def clock_ratio(ppm: float, error: float) -> Check:
    word = "fast" if ppm > 0.0 else "slow"
    advice = (
        f"the generator is {abs(ppm):.0f} ppm {word} by the card's clock: give both one clock, or set the frequency to"
        f" {1.0 - 1e-6 * ppm:.6f} of what is wanted"
    )
    return Check("clock ratio", "", ppm, error, -MOST_CLOCK_PPM, MOST_CLOCK_PPM, "ppm", advice)


def mass(deviation: float, error: float) -> Check:
    advice = f"M is {deviation:+.0%} by K: set the pot of M again, and look at C1 and C2"
    return Check("mass", "", deviation, error, -MOST_MASS, MOST_MASS, "off nominal", advice)


def damping(deviation: float, error: float) -> Check:
    advice = f"B is {deviation:+.0%} by K: set the pot of B again, and look at C2"
    return Check("damping", "", deviation, error, -MOST_DAMPING, MOST_DAMPING, "off nominal", advice)


def shape(lsb: float, error_lsb: float, swing_codes: float) -> Check:
    """``lsb``: rms of what neither the response nor the noise explains."""
    advice = (
        "the displacement is not that of a mass, a damper and a spring: look for overload, stuck bits, another program"
    )
    most = max(MOST_SHAPE * swing_codes, LEAST_SHAPE_LSB)
    return Check("shape", "displacement", lsb, error_lsb, 0.0, most, "LSB", advice)


def not_measured(name: str, channel: str, why: str) -> Check:
    return Check(name, channel, math.nan, math.nan, -math.inf, math.inf, "", why)
