"""Checks of the self-test: each quantity with its standard error, its limits and advice.

The limits admit every machine of 1 % resistors, 5 % capacitors and amplifiers with 3 mV of offset, and nothing within
them affects a verdict. harness/docs/background/self-test.md gives the reasons.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from analogrig.hardware.self_test.square_wave import Uncertain, remove_quantisation
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2

State = Literal["well", "wrong", "not measured"]

SIGMAS = 3.0
"""Distance beyond a limit, in standard errors, from which a quantity is wrong. One exactly at its limit is called wrong
with a probability of 0.0013."""

RESOLUTION = 1.0 / 12.0
"""Largest standard error, as a part of the allowed range, of a quantity that counts as measured: a fault of twice the
limit is then found with a probability of at least 0.9987."""

LEAST_SHARPER = 0.3
MOST_CLIPPED = 1e-3
LEAST_CODES = 1000.0
MOST_FORCE_GAIN, MOST_GAIN = 0.01, 0.05
MOST_OFFSET_V = 0.06
MOST_NOISE = 2e-3
MOST_SKEW_N, MOST_SKEW_S = 0.1, 5e-6
"""The larger counts; both are the same at 20 kHz. The effect of skew on the displacement depends on time: 5 to 6 LSB of
12 bits per microsecond. At high rates a tenth of a sample would limit the delay of the amplifiers, which two channels
cannot separate from that of the card."""
MOST_CLOCK_PPM = 50.0
MOST_MASS, MOST_DAMPING = 0.3, 0.15
MOST_SHAPE, LEAST_SHAPE_LSB = 3e-4, 0.5

AMPLIFIERS_S = Uncertain(0.625e-6, 0.5e-6)
"""Delay of the displacement by the computer's amplifiers: 0.62 us with TL07x, 1.2 us with polyester capacitors too, 0
with ideal ones. The 9.5 us of a 741 are reported as skew."""


@dataclass(frozen=True)
class Check:
    """Measured quantity of one channel, or of both, with its limits."""

    name: str
    channel: str
    """Empty for a quantity of both channels."""
    value: float
    error: float
    """Standard error. NaN, as is the value, if the quantity could not be measured."""
    least: float
    most: float
    unit: str
    advice: str
    """Remedy if it is wrong, or reason why it could not be measured."""
    note: str = ""
    """Remark on the value."""

    @property
    def state(self) -> State:
        if math.isnan(self.value):
            return "not measured"
        if self.value - SIGMAS * self.error > self.most or self.value + SIGMAS * self.error < self.least:
            return "wrong"
        return "not measured" if self.error > self.most_error else "well"

    @property
    def most_error(self) -> float:
        """Largest standard error with which the quantity counts as measured."""
        return RESOLUTION * (self.most - self.least)

    @property
    def remedy(self) -> str:
        """Advice on a quantity that is not well."""
        if self.state == "not measured" and not math.isnan(self.value):
            return f"known too poorly: its standard error would have to be at most {self.most_error:.2g}"
        return self.advice

    @property
    def title(self) -> str:
        return f"{self.name} of {self.channel}" if self.channel else self.name

    @property
    def sentence(self) -> str:
        """Title, value, limits and remedy in one line."""
        if math.isnan(self.value):
            return f"{self.title}: not measured: {self.advice}"
        known = f"{self.title}: {self.value:.4g} +- {self.error:.2g} {self.unit}".rstrip()
        return f"{known}, allowed {self.least:.4g} to {self.most:.4g}: {self.remedy}"


@dataclass(frozen=True)
class Findings:
    """Result of one self-test."""

    rig: str
    program: str
    checks: tuple[Check, ...]

    def in_state(self, state: State) -> tuple[Check, ...]:
        """Checks that are in ``state``."""
        return tuple(check for check in self.checks if check.state == state)

    @property
    def well(self) -> bool:
        """True if every quantity was measured and is within its limits."""
        return len(self.in_state("well")) == len(self.checks)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons not to judge anything on this rig, one line each; empty if all is well."""
        return tuple(check.sentence for check in (*self.in_state("wrong"), *self.in_state("not measured")))


def identity(sharper: float) -> Check:
    """Check that the leads are not swapped.

    :param sharper: sharpness of the force less that of the displacement.
    """
    swapped = "the leads of force and displacement are swapped: exchange them"
    both = "both inputs see much the same signal: one of the leads is in the wrong jack"
    advice = swapped if sharper < -LEAST_SHARPER else both
    return Check("identity", "", sharper, 0.0, LEAST_SHARPER, 1.0, "of the swing", advice)


def polarity(channel: str, sign: float) -> Check:
    advice = f"the {channel} is inverted: exchange the wires of its lead, or check for an amplifier that inverts"
    return Check("polarity", channel, sign, 0.0, 0.0, 1.0, "", advice)


def clipping(channel: str, share: float, samples: int, end: str) -> Check:
    advice = f"the {channel} leaves its range at the {end} end: choose a wider range, or check for inversion and offset"
    error = math.sqrt(share * (1.0 - share) / samples)
    return Check("clipping", channel, share, error, 0.0, MOST_CLIPPED, "of the samples", advice)


def range_use(channel: str, swing_codes: float, codes: int) -> Check:
    note = f"{swing_codes:.0f} codes"
    advice = f"the {channel} uses {note}: choose a smaller range, or amplify it before the card"
    part = swing_codes / codes
    return Check("range use", channel, part, 0.0, LEAST_CODES / codes, 1.0, "of full scale", advice, note)


def gain(channel: str, deviation: Uncertain, most: float, hint: str) -> Check:
    """Check of a gain; ``hint``, on the place of an error, is appended to the advice."""
    word = "more" if deviation.value > 0.0 else "less"
    advice = f"the {channel} is {abs(deviation.value):.1%} {word} than it should be{hint}"
    return Check("gain", channel, *deviation, -most, most, "off nominal", advice)


def offset(channel: str, volts: Uncertain, hint: str) -> Check:
    """Check of an offset; ``hint``, on the place of an error, is appended to the advice."""
    advice = f"the {channel} has an offset of {1e3 * volts.value:+.0f} mV{hint}"
    return Check("offset", channel, *volts, -MOST_OFFSET_V, MOST_OFFSET_V, "V", advice)


def skew(samples: Uncertain, sample_period_s: float) -> Check:
    late, slow = ("later", "") if samples.value > 0.0 else ("earlier", ", and check the type of the amplifiers")
    by = f"{1e6 * abs(samples.value) * sample_period_s:.2g} us"
    advice = f"the displacement is taken {late} than the force by {by}: have the card sample both at one instant{slow}"
    most = max(MOST_SKEW_N, MOST_SKEW_S / sample_period_s)
    return Check("skew", "", *samples, -most, most, "samples", advice)


def noise_floor(channel: str, rms_lsb: Uncertain, swing_codes: float) -> Check:
    analogue, quantisation = remove_quantisation(rms_lsb.value), math.sqrt(QUANTISATION_VARIANCE_LSB2)
    note = f"{analogue:.2f} LSB of noise and {quantisation:.2f} of quantisation"
    advice = f"{note}, {rms_lsb.value / swing_codes:.2%} of the signal: check for a bad ground, mains, an open shield"
    return Check("noise", channel, *rms_lsb, 0.0, MOST_NOISE * swing_codes, "LSB", advice, note)


def clock_ratio(ppm: Uncertain) -> Check:
    word = "fast" if ppm.value > 0.0 else "slow"
    advice = (
        f"the generator is {abs(ppm.value):.0f} ppm {word} by the card's clock: give both one clock, or set the"
        f" frequency to {1.0 - 1e-6 * ppm.value:.6f} of the desired one"
    )
    return Check("clock ratio", "", *ppm, -MOST_CLOCK_PPM, MOST_CLOCK_PPM, "ppm", advice)


def mass(deviation: Uncertain) -> Check:
    advice = f"M is {deviation.value:+.0%} relative to K: set the pot of M again, and check C1 and C2"
    return Check("mass", "", *deviation, -MOST_MASS, MOST_MASS, "off nominal", advice)


def damping(deviation: Uncertain) -> Check:
    advice = f"B is {deviation.value:+.0%} relative to K: set the pot of B again, and check C2"
    return Check("damping", "", *deviation, -MOST_DAMPING, MOST_DAMPING, "off nominal", advice)


def shape(lsb: Uncertain, swing_codes: float) -> Check:
    """Check of ``lsb``, the rms of the residual that noise does not explain."""
    advice = "the displacement is not that of a mass, a damper and a spring: check for overload, stuck bits, program"
    most = max(MOST_SHAPE * swing_codes, LEAST_SHAPE_LSB)
    return Check("shape", "displacement", *lsb, 0.0, most, "LSB", advice)


def not_measured(name: str, channel: str, why: str) -> Check:
    return Check(name, channel, math.nan, math.nan, -math.inf, math.inf, "", why)
