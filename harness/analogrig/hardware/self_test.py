"""Self-test: finds the faults of a rig before any device is judged on it.

It plays one square wave, and estimates all quantities of the rig from force and displacement:

    levels of the force              polarity, gain, offset, noise, range use, clipping
    edges of the force               bounds of each instant
    response of the displacement     polarity, gain, offset, mass, damping, noise, and timing of the edges
    both                             identity, skew; with the commanded frequency: clock ratio

The displacement is compared with the force as measured and as commanded; the closer match is used. So an error of the
generator, or of the force's input, is not reported twice.

The limits admit every machine of 1 % resistors, 5 % capacitors and amplifiers with 3 mV of offset, and nothing within
them affects a verdict. harness/docs/background/self-test.md gives the reasons.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import SelfTestError
from analogrig.hardware.instrument import MEASURED
from analogrig.hardware.square_wave import Response, SquareWave, Uncertain
from analogrig.judging.information import QUANTISATION_VARIANCE_LSB2
from analogrig.plant import Plant
from analogrig.program import Program
from analogrig.rigs.rig import Rig
from analogrig.run import Channel
from analogrig.scenario import Scenario
from analogrig_emulator import Excitation

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

LEAST_SWING_V = 0.25
"""Smallest swing of a channel that counts as a signal."""

SAMPLES = 16_384
"""Samples that an instrument of the class of a Red Pitaya takes without a gap."""

LOW_V, HIGH_V = 0.5, 9.5
"""Levels at the computer's input. No signal of a healthy computer comes near its limits, or falls below 0 V."""

FREQUENCY_HZ = 823 * 125e6 / 2**30
"""95.81 Hz: half periods of 104 samples, after which all signals have settled. It is a multiple of the resolution of a
Red Pitaya's generator (30 bits). At 20 kHz the edges of 0.8 s sample all parts of a sample period, at most 0.017
apart."""

LEAST_PERIODS = 13
"""Fewest periods in the record that determine the timing of the edges and the noise."""

PROGRAMS = ("front", "shock")


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


def self_test(rig: Rig, seed: int, program: str = "front") -> Findings:
    """Play the self-test on a rig and return its findings.

    :param program: program wired on the computer: front or shock.
    :raises ConfigurationError: the rig cannot play it.
    :raises SelfTestError: it is not possible: no signal, a drop-out, a rig too fast, an unsupported program.
    :raises RigError: the rig failed.
    """
    if program not in PROGRAMS:
        raise SelfTestError(f"the self-test supports the programs {', '.join(PROGRAMS)}, not {program}")
    excitation = Excitation(low_v=LOW_V, high_v=HIGH_V, frequency_hz=FREQUENCY_HZ, clock="free")
    scenario = Scenario(SAMPLES, excitation, Program.load(program), random_phase=True, name="self-test")
    performance = rig.perform(scenario, seed)
    if performance.sample_period_s * SAMPLES * FREQUENCY_HZ < LEAST_PERIODS:
        most_hz = SAMPLES * FREQUENCY_HZ / LEAST_PERIODS
        rate_hz = 1.0 / performance.sample_period_s
        raise SelfTestError(f"the self-test goes up to {most_hz:.0f} samples/s, and the rig takes {rate_hz:.0f}")
    blocks = list(performance.blocks)
    codes, clipped = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("codes", "clipped"))
    if len(codes) < SAMPLES:
        raise SelfTestError(f"the rig gave {len(codes)} of {SAMPLES} samples")
    if len({block.record for block in blocks}) > 1:
        raise SelfTestError(f"the rig does not take {SAMPLES} samples without a gap")
    half_period_n = 0.5 / (FREQUENCY_HZ * performance.sample_period_s)
    force, displacement = (
        _Signal(name, performance.channels[name], codes[:, i], clipped[:, i], half_period_n)
        for i, name in enumerate(MEASURED)
    )
    analysis = _Analysis(force, displacement, scenario.plant, performance.sample_period_s, performance.time_scale)
    return Findings(str(rig.description().get("name", "")), program, analysis.checks())


@dataclass(frozen=True, eq=False)
class _Signal:
    """One channel of the record."""

    name: str
    channel: Channel
    codes: NDArray[np.uint16]  # (n,)
    clipped: NDArray[np.bool_]  # (n,)
    half_period_n: float

    @cached_property
    def volts(self) -> NDArray[np.float64]:
        """(n,) voltage at the computer."""
        return self.channel.volts(self.codes)

    @cached_property
    def swing_v(self) -> float:
        """Range of the voltage between its 1 % and 99 % quantiles."""
        low, high = np.quantile(self.volts, (0.01, 0.99))
        return float(high - low)

    @property
    def swing_codes(self) -> float:
        return self.swing_v / self.channel.lsb_v

    @property
    def sharpness(self) -> float:
        """Step between neighbouring samples that is exceeded once in two half periods, in parts of the swing.

        It is about 1 for a square wave; a drop-out or a spike in another signal does not affect it.
        """
        steps = np.sort(np.abs(np.diff(self.volts)))
        return float(steps[-int(0.5 * len(steps) / self.half_period_n)] / self.swing_v)

    def clipping(self) -> Check:
        share = float(self.clipped.mean())
        at_top = float((self.clipped & (self.codes > self.channel.codes / 2)).mean())
        end = f"at the {'upper' if at_top > 0.5 * share else 'lower'} end"
        advice = f"the {self.name} leaves its range {end}: choose a wider range, or check for inversion and offset"
        error = math.sqrt(share * (1.0 - share) / len(self.clipped))
        return Check("clipping", self.name, share, error, 0.0, MOST_CLIPPED, "of the samples", advice)

    def range_use(self) -> Check:
        note, codes = f"{self.swing_codes:.0f} codes", self.channel.codes
        advice = f"the {self.name} uses {note}: choose a smaller range, or amplify it before the card"
        part, least = self.swing_codes / codes, LEAST_CODES / codes
        return Check("range use", self.name, part, 0.0, least, 1.0, "of full scale", advice, note)

    def polarity(self, sign: float) -> Check:
        advice = f"the {self.name} is inverted: exchange the wires of its lead, or check for an amplifier that inverts"
        return Check("polarity", self.name, sign, 0.0, 0.0, 1.0, "", advice)

    def gain(self, deviation: Uncertain, most: float, hint: str) -> Check:
        word = "more" if deviation.value > 0.0 else "less"
        advice = f"the {self.name} is {abs(deviation.value):.1%} {word} than it should be{hint}"
        return Check("gain", self.name, *deviation, -most, most, "off nominal", advice)

    def offset(self, volts: Uncertain, hint: str) -> Check:
        advice = f"the {self.name} has an offset of {1e3 * volts.value:+.0f} mV{hint}"
        return Check("offset", self.name, *volts, -MOST_OFFSET_V, MOST_OFFSET_V, "V", advice)

    def noise(self, rms_lsb: Uncertain) -> Check:
        analogue, quantisation = _remove_quantisation(rms_lsb.value), math.sqrt(QUANTISATION_VARIANCE_LSB2)
        note = f"{analogue:.2f} LSB of noise and {quantisation:.2f} of quantisation"
        part = rms_lsb.value / self.swing_codes
        advice = f"{note}, {part:.2%} of the signal: check for a bad ground, mains, an open shield"
        return Check("noise", self.name, *rms_lsb, 0.0, MOST_NOISE * self.swing_codes, "LSB", advice, note)


@dataclass(frozen=True, eq=False)
class _Analysis:
    """Checks of a record."""

    force: _Signal
    displacement: _Signal
    plant: Plant
    sample_period_s: float
    time_scale: float

    def checks(self) -> tuple[Check, ...]:
        """All checks; only the first fault if it makes the other quantities meaningless.

        :raises SelfTestError: the record has no signal, or a drop-out.
        """
        signals = (self.force, self.displacement)
        still = [each for each in signals if each.swing_v <= LEAST_SWING_V]
        if off_scale := tuple(each.clipping() for each in still if each.clipped.mean() > 0.5):
            return off_scale
        if still:
            raise SelfTestError(
                f"no signal on {still[0].name}, which moves by {still[0].swing_v:.2g} V: check the generator, the"
                " computer's operation, and the lead"
            )
        identity = self._identity()
        if identity.state == "wrong":
            return (identity,)
        leads = (identity, *self._polarity())
        if any(each.state == "wrong" for each in leads):
            return leads
        return (
            *leads,
            *(each.clipping() for each in signals),
            *(each.range_use() for each in signals),
            *self._force(),
            self.force.noise(self._force_noise),
            *self._response_checks(),
        )

    # ---- leads

    def _identity(self) -> Check:
        sharper = self.force.sharpness - self.displacement.sharpness
        swapped = "the leads of force and displacement are swapped: exchange them"
        both = "both inputs see much the same signal: one of the leads is in the wrong jack"
        advice = swapped if sharper < -LEAST_SHARPER else both
        return Check("identity", "", sharper, 0.0, LEAST_SHARPER, 1.0, "of the swing", advice)

    def _polarity(self) -> tuple[Check, Check]:
        """Polarity of both channels; the force is inverted if its levels match the negated commands better."""
        low_v, high_v = self._levels_v
        upright, inverted = abs(low_v - LOW_V) + abs(high_v - HIGH_V), abs(low_v + HIGH_V) + abs(high_v + LOW_V)
        state = self._wave.state
        settled = state == np.roll(state, int(0.5 * self.force.half_period_n))
        high, low = (np.median(self.displacement.volts[settled & (state == level)]) for level in (1, 0))
        answer, force = 1.0 if high > low else -1.0, 1.0 if upright < inverted else -1.0
        return self.force.polarity(force), self.displacement.polarity(max(answer, answer * force))

    # ---- force

    @cached_property
    def _wave(self) -> SquareWave:
        return SquareWave.of(self.force.codes, self.force.half_period_n)

    @cached_property
    def _levels_v(self) -> tuple[float, float]:
        low, high = (float(self.force.volts[self._wave.state == level].mean()) for level in (0, 1))
        return low, high

    @cached_property
    def _is_clipped(self) -> bool:
        """True if the levels of the force are clipped."""
        return float(self.force.clipped.mean()) > MOST_CLIPPED

    @cached_property
    def _force_noise(self) -> Uncertain:
        return self._wave.noise()

    @cached_property
    def _force_gain(self) -> Uncertain:
        """Deviation of the force's swing from the commanded one."""
        low_v, high_v = self._levels_v
        span_v = HIGH_V - LOW_V
        return Uncertain((high_v - low_v) / span_v - 1.0, math.sqrt(2.0) * self._level_error_v / span_v)

    @cached_property
    def _force_offset(self) -> Uncertain:
        """Force at a command of 0, V."""
        return Uncertain(self._levels_v[0] - (1.0 + self._force_gain.value) * LOW_V, 1.1 * self._level_error_v)

    @property
    def _level_error_v(self) -> float:
        """Standard error of a level: noise, and quantisation as far as noise does not smooth it (Widrow)."""
        rms_lsb = self._force_noise.value
        smoothed = math.exp(-2.0 * (math.pi * _remove_quantisation(rms_lsb)) ** 2) / (math.sqrt(2.0) * math.pi)
        return math.hypot(rms_lsb / math.sqrt(0.4 * SAMPLES), smoothed) * self.force.channel.lsb_v

    def _force(self) -> tuple[Check, Check]:
        if self._is_clipped:
            why = "the levels of the force are clipped"
            return _not_measured("gain", "force", why), _not_measured("offset", "force", why)
        return (
            self.force.gain(self._force_gain, MOST_FORCE_GAIN, _force_hint(*self._gains)),
            self.force.offset(self._force_offset, _force_hint(*self._offsets)),
        )

    # ---- response of the displacement

    @cached_property
    def _nominal(self) -> tuple[float, float]:
        """Mass and damping per unit of the spring, in samples."""
        sample_s = self.sample_period_s * self.time_scale
        response = self.plant.response()
        return 1.0 / response["s0"] / sample_s**2, response["s1"] / response["s0"] / sample_s

    @cached_property
    def _response(self) -> Response:
        """Response in volts after the second edge, to the force as measured, or as commanded if that was clipped."""
        used = ~self.displacement.clipped
        used[: self._wave.after[1]] = False
        levels = (LOW_V, HIGH_V) if self._is_clipped else self._levels_v
        return Response.fit(self.displacement.volts, used, self._wave, levels, self._nominal)

    @cached_property
    def _gains(self) -> tuple[float, float]:
        """Deviation of the displacement's static gain, by the force as measured and as commanded."""
        unit_per_v = self.displacement.channel.unit_per_v / self.force.channel.unit_per_v
        measured = self._response.gain.value / self.plant.response()["gain"] * unit_per_v - 1.0
        return measured, measured if self._is_clipped else (1.0 + measured) * (1.0 + self._force_gain.value) - 1.0

    @cached_property
    def _offsets(self) -> tuple[float, float]:
        """Displacement without force, V, by the force as measured and as commanded."""
        measured = self._response.offset.value
        return measured, measured + (0.0 if self._is_clipped else self._response.gain.value * self._force_offset.value)

    def _response_checks(self) -> tuple[Check, ...]:
        """Checks that are read from the response; most are not measured if its shape is wrong."""
        response, lsb_v = self._response, self.displacement.channel.lsb_v
        noise_v = response.noise(self.displacement.half_period_n)
        shape = self._shape(Uncertain(*(each / lsb_v for each in response.unexplained(noise_v.value))))
        if shape.state == "wrong":
            why = "it is read from the shape of the displacement, which is wrong"
            names = [(name, "displacement") for name in ("gain", "offset", "noise")]
            names += [(name, "") for name in ("skew", "mass", "damping")]
            return (self._clock_ratio(), shape, *(_not_measured(name, channel, why) for name, channel in names))
        gain, offset = min(self._gains, key=abs), min(self._offsets, key=abs)
        gain_error = math.hypot(response.gain.error / abs(response.gain.value), self._force_gain.error)
        offset_error = math.hypot(response.offset.error, response.gain.value * self._force_offset.error)
        hint = ": check the range and amplifier of its input, and set the pot of K again"
        return (
            self.displacement.gain(Uncertain(gain, gain_error), MOST_GAIN, hint),
            self.displacement.offset(Uncertain(offset, offset_error), hint),
            self.displacement.noise(Uncertain(*(each / lsb_v for each in noise_v))),
            self._skew(),
            self._clock_ratio(),
            *self._machine(),
            shape,
        )

    def _shape(self, lsb: Uncertain) -> Check:
        """Check of ``lsb``, the rms of the residual that noise does not explain."""
        advice = (
            "the displacement is not that of a mass, a damper and a spring: check for overload, stuck bits, program"
        )
        most = max(MOST_SHAPE * self.displacement.swing_codes, LEAST_SHAPE_LSB)
        return Check("shape", "displacement", *lsb, 0.0, most, "LSB", advice)

    def _skew(self) -> Check:
        drift_n = 3.0 * self._response.period_error_n * float(np.abs(self._wave.turn).max())
        delay = self._wave.delay(self._response.times, drift_n)
        lag_n, lag_error_n = (lag_s / self.sample_period_s for lag_s in AMPLIFIERS_S)
        late_n, error_n = delay.value + lag_n, math.hypot(delay.error, self._response.instant_error_n, lag_error_n)
        late, slow = ("later", "") if late_n > 0.0 else ("earlier", ", and check the type of the amplifiers")
        by = f"{1e6 * abs(late_n) * self.sample_period_s:.2g} us"
        advice = (
            f"the displacement is taken {late} than the force by {by}: have the card sample both at one instant{slow}"
        )
        most = max(MOST_SKEW_N, MOST_SKEW_S / self.sample_period_s)
        return Check("skew", "", late_n, error_n, -most, most, "samples", advice)

    def _clock_ratio(self) -> Check:
        period_n = self._response.times.period_n
        ppm = 1e6 * (2.0 * self.force.half_period_n / period_n - 1.0)
        advice = (
            f"the generator is {abs(ppm):.0f} ppm {'fast' if ppm > 0.0 else 'slow'} by the card's clock: give both one"
            f" clock, or set the frequency to {1.0 - 1e-6 * ppm:.6f} of the desired one"
        )
        error = 1e6 * self._response.period_error_n / period_n
        return Check("clock ratio", "", ppm, error, -MOST_CLOCK_PPM, MOST_CLOCK_PPM, "ppm", advice)

    def _machine(self) -> Iterator[Check]:
        """Checks of mass and damping."""
        fitted = (self._response.mass_n2, self._response.damping_n)
        for name, found, nominal, most, pot, parts in zip(
            ("mass", "damping"),
            fitted,
            self._nominal,
            (MOST_MASS, MOST_DAMPING),
            "MB",
            ("C1 and C2", "C2"),
            strict=True,
        ):
            off = found.value / nominal - 1.0
            advice = f"{pot} is {off:+.0%} relative to K: set the pot of {pot} again, and check {parts}"
            yield Check(name, "", off, found.error / nominal, -most, most, "off nominal", advice)


def _remove_quantisation(rms_lsb: float) -> float:
    """Analogue part of a noise, LSB rms."""
    return math.sqrt(max(rms_lsb**2 - QUANTISATION_VARIANCE_LSB2, 0.0))


def _not_measured(name: str, channel: str, why: str) -> Check:
    return Check(name, channel, math.nan, math.nan, -math.inf, math.inf, "", why)


def _force_hint(by_measured: float, by_commanded: float) -> str:
    """Place of an error of the force, from the displacement's deviations by the measured and the commanded force."""
    if abs(by_measured) < abs(by_commanded):
        return ", and the displacement follows it: check the generator and its amplifier"
    return ", and the displacement does not follow it: check the range and the amplifier of the force's input"
