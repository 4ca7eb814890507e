"""Self-test: finds the faults of a rig before any device is judged on it.

It plays one square wave, and estimates all quantities of the rig from input and output of the plant:

    levels of the input         polarity, gain, offset, noise, range use, clipping
    edges of the input          bounds of each instant
    response of the output      polarity, gain, offset, mass, damping, noise, and timing of the edges
    both                        identity, skew; with the commanded frequency: clock ratio

The output is compared with the input as measured and as commanded; the closer match is used. So an error of the
generator, or of the channel of the input, is not reported twice. The response is that of a linear plant of second order
without zeros; on other programs it is not tested.

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

from analogrig import Plant, Program, Rig, Scenario
from analogrig.devices import Change
from analogrig.errors import SelfTestError
from analogrig.judging import QUANTISATION_VARIANCE_LSB2
from analogrig.run import Channel
from analogrig.scenario import DEFAULT_PROGRAM
from analogrig_emulator import Excitation
from analogrig_instruments.square_wave import Response, SquareWave, Uncertain

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
MOST_INPUT_GAIN, MOST_GAIN = 0.01, 0.05
MOST_OFFSET_V = 0.06
MOST_NOISE = 2e-3
MOST_SKEW_N, MOST_SKEW_S = 0.1, 5e-6
"""The larger counts; both are the same at 20 kHz. The effect of skew on the output depends on time: 5 to 6 LSB of
12 bits per microsecond. At high rates a tenth of a sample would limit the delay of the amplifiers, which two channels
cannot separate from that of the card."""
MOST_CLOCK_PPM = 50.0
MOST_MASS, MOST_DAMPING = 0.3, 0.15
MOST_SHAPE, LEAST_SHAPE_LSB = 3e-4, 0.5

_TERMS = {
    Change.MASS: "second-order term",
    Change.DAMPING: "first-order term",
    Change.STIFFNESS: "the term of order zero",
}
"""Names of the terms of the output's equation where diagnoses name no parameter, by their changes."""

AMPLIFIERS_S = Uncertain(0.625e-6, 0.5e-6)
"""Delay of the output by the computer's amplifiers: 0.62 us with TL07x, 1.2 us with polyester capacitors too, 0
with ideal ones. The 9.5 us of a 741 are reported as skew."""

LEAST_SWING_V = 0.25
"""Smallest swing of a channel that counts as a signal."""

SAMPLES = 16_384
"""Samples that an instrument of the class of a Red Pitaya takes without a gap."""

LEVEL_PARTS = 0.05, 0.95
"""Levels at the computer's input, as parts of the range of the program's trial play. No signal of a healthy computer
comes near its limits. Levels that are negatives of each other would hide an inversion: the lower is at most half the
upper."""

GENERATOR_HZ = 125e6 / 2**30
"""Resolution of a Red Pitaya's generator (30 bits)."""

FREQUENCY_HZ = 823 * GENERATOR_HZ
"""95.81 Hz: half periods of 104 samples. At 20 kHz the edges of 0.8 s sample all parts of a sample period, at most
0.017 apart."""

SETTLING_TIMES = 11.5
"""Least half period, in time constants of the slowest pole: after it a signal has settled to 1e-5."""

LEAST_PERIODS = 13
"""Fewest periods in the record that determine the timing of the edges and the noise."""

SLOWEST_HZ = LEAST_PERIODS * 20e3 / SAMPLES
"""Least frequency of the square wave at 20 kHz."""


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
    untested: str = ""
    """Reason why the response of the output is not tested; empty if it is."""

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


def self_test(rig: Rig, seed: int, name: str = DEFAULT_PROGRAM) -> Findings:
    """Play the self-test on a rig and return its findings.

    :param name: program wired on the computer: a shipped name or a .toml file.
    :raises ConfigurationError: the rig cannot play it.
    :raises SelfTestError: it is not possible: no signal, a drop-out, a rig too fast.
    :raises RigError: the rig failed.
    """
    program = Program.load(name)
    plant = Plant.of(program)
    untested = _why_untested(plant)
    frequency_hz = FREQUENCY_HZ if untested else _frequency_hz(plant)
    low_v, high_v = _levels_v(program)
    excitation = Excitation(low_v=low_v, high_v=high_v, frequency_hz=frequency_hz, clock="free")
    scenario = Scenario(SAMPLES, excitation, program, random_phase=True, name="self-test")
    performance = rig.perform(scenario, seed)
    if performance.sample_period_s * SAMPLES * frequency_hz < LEAST_PERIODS:
        most_hz = SAMPLES * frequency_hz / LEAST_PERIODS
        rate_hz = 1.0 / performance.sample_period_s
        raise SelfTestError(f"the self-test goes up to {most_hz:.0f} samples/s, and the rig takes {rate_hz:.0f}")
    blocks = list(performance.blocks)
    codes, clipped = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("codes", "clipped"))
    if len(codes) < SAMPLES:
        raise SelfTestError(f"the rig gave {len(codes)} of {SAMPLES} samples")
    if len({block.record for block in blocks}) > 1:
        raise SelfTestError(f"the rig does not take {SAMPLES} samples without a gap")
    half_period_n = 0.5 / (frequency_hz * performance.sample_period_s)
    driven, answer = (
        _Signal(name, performance.channels[name], codes[:, i], clipped[:, i], half_period_n)
        for i, name in enumerate(program.measured)
    )
    analysis = _Analysis(driven, answer, plant, (low_v, high_v), performance.sample_period_s, performance.time_scale)
    checks = analysis.checks_of_input() if untested else analysis.checks()
    return Findings(str(rig.description().get("name", "")), program.name, checks, untested)


def _levels_v(program: Program) -> tuple[float, float]:
    """Levels of the square wave at the computer's input."""
    driven = program.channels[0]
    volts = program.circuit.scales.volts(driven)
    low_v, high_v = (level * volts for level in program.equations.inputs[driven].trial)
    low_v, high_v = (low_v + part * (high_v - low_v) for part in LEVEL_PARTS)
    return max(low_v, -0.5 * high_v) if high_v > 0.0 else low_v, high_v


def _why_untested(plant: Plant) -> str:
    """Reason why the response of the plant cannot be tested; empty if it can."""
    program = plant.program
    if not program.is_linear or len(program.equations.states) != 2:
        return f"program {program.name} is not linear with two states"
    step = program.generators(np.array([plant.values]))[0]
    output, rates, driven = step[-1, :-1], step[:-1, :-1], step[:-1, -1]
    if abs(output @ driven) > 1e-9 * np.linalg.norm(output) * np.linalg.norm(driven):
        return f"the input of program {program.name} reaches the rate of its output at once"
    if not np.linalg.eigvals(rates).real.max() < 0.0:
        return f"program {program.name} does not come to rest"
    if _frequency_hz(plant) < SLOWEST_HZ:
        return f"program {program.name} settles too slowly"
    return ""


def _frequency_hz(plant: Plant) -> float:
    """Frequency of the square wave, in machine time, whose half periods the signals settle in."""
    slowest = -np.linalg.eigvals(plant.program.generators(np.array([plant.values]))[0][:-1, :-1]).real.max()
    most_hz = float(slowest) * plant.program.equations.speed / (2.0 * SETTLING_TIMES)
    return min(FREQUENCY_HZ, (most_hz // GENERATOR_HZ) * GENERATOR_HZ)


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

    driven: _Signal
    """Signal of the program's input."""
    answer: _Signal
    """Signal of its output."""
    plant: Plant
    commanded_v: tuple[float, float]
    """Levels of the square wave."""
    sample_period_s: float
    time_scale: float

    def checks(self) -> tuple[Check, ...]:
        """All checks; only the first fault if it makes the other quantities meaningless.

        :raises SelfTestError: the record has no signal, or a drop-out.
        """
        if off_scale := self._off_scale():
            return off_scale
        identity = self._identity()
        if identity.state == "wrong":
            return (identity,)
        leads = (identity, *self._polarity())
        if any(each.state == "wrong" for each in leads):
            return leads
        return (
            *leads,
            *self._range_checks(),
            *self._input_checks(self._gains, self._offsets),
            self.driven.noise(self._input_noise),
            *self._response_checks(),
        )

    def checks_of_input(self) -> tuple[Check, ...]:
        """Checks that need no model of the plant; only the first fault if it makes the others meaningless.

        :raises SelfTestError: as ``checks``.
        """
        if off_scale := self._off_scale():
            return off_scale
        polarity = self.driven.polarity(self._input_sign)
        if polarity.state == "wrong":
            return (polarity,)
        noise = self.driven.noise(self._input_noise)
        return (polarity, *self._range_checks(), *self._input_checks(None, None), noise)

    @property
    def _signals(self) -> tuple[_Signal, _Signal]:
        return self.driven, self.answer

    def _off_scale(self) -> tuple[Check, ...]:
        """Clipping of signals that stand at an end of the range.

        :raises SelfTestError: a signal stands within it.
        """
        still = [each for each in self._signals if each.swing_v <= LEAST_SWING_V]
        if off_scale := tuple(each.clipping() for each in still if each.clipped.mean() > 0.5):
            return off_scale
        if still:
            raise SelfTestError(
                f"no signal on {still[0].name}, which moves by {still[0].swing_v:.2g} V: check the generator, the"
                " computer's operation, and the lead"
            )
        return ()

    def _range_checks(self) -> Iterator[Check]:
        yield from (each.clipping() for each in self._signals)
        yield from (each.range_use() for each in self._signals)

    # ---- leads

    def _identity(self) -> Check:
        sharper = self.driven.sharpness - self.answer.sharpness
        swapped = f"the leads of {self.driven.name} and {self.answer.name} are swapped: exchange them"
        both = "both inputs see much the same signal: one of the leads is in the wrong jack"
        advice = swapped if sharper < -LEAST_SHARPER else both
        return Check("identity", "", sharper, 0.0, LEAST_SHARPER, 1.0, "of the swing", advice)

    def _polarity(self) -> tuple[Check, Check]:
        """Polarity of both channels; an inverting plant answers a high input with a low output."""
        state = self._wave.state
        settled = state == np.roll(state, int(0.5 * self.driven.half_period_n))
        high, low = (np.median(self.answer.volts[settled & (state == level)]) for level in (1, 0))
        answer = math.copysign(1.0, (high - low) * self.plant.response()["gain"])
        driven = self._input_sign
        return self.driven.polarity(driven), self.answer.polarity(max(answer, answer * driven))

    @property
    def _input_sign(self) -> float:
        """Sign of the input: -1 if its levels match the negated commands better."""
        (low_v, high_v), (low, high) = self._levels_v, self.commanded_v
        upright, inverted = abs(low_v - low) + abs(high_v - high), abs(low_v + high) + abs(high_v + low)
        return 1.0 if upright < inverted else -1.0

    # ---- input

    @cached_property
    def _wave(self) -> SquareWave:
        return SquareWave.of(self.driven.codes, self.driven.half_period_n)

    @cached_property
    def _levels_v(self) -> tuple[float, float]:
        low, high = (float(self.driven.volts[self._wave.state == level].mean()) for level in (0, 1))
        return low, high

    @cached_property
    def _is_clipped(self) -> bool:
        """True if the levels of the input are clipped."""
        return float(self.driven.clipped.mean()) > MOST_CLIPPED

    @cached_property
    def _input_noise(self) -> Uncertain:
        return self._wave.noise()

    @cached_property
    def _input_gain(self) -> Uncertain:
        """Deviation of the input's swing from the commanded one."""
        low_v, high_v = self._levels_v
        span_v = self.commanded_v[1] - self.commanded_v[0]
        return Uncertain((high_v - low_v) / span_v - 1.0, math.sqrt(2.0) * self._level_error_v / span_v)

    @cached_property
    def _input_offset(self) -> Uncertain:
        """Input at a command of 0, V."""
        return Uncertain(
            self._levels_v[0] - (1.0 + self._input_gain.value) * self.commanded_v[0], 1.1 * self._level_error_v
        )

    @property
    def _level_error_v(self) -> float:
        """Standard error of a level: noise, and quantisation as far as noise does not smooth it (Widrow)."""
        rms_lsb = self._input_noise.value
        smoothed = math.exp(-2.0 * (math.pi * _remove_quantisation(rms_lsb)) ** 2) / (math.sqrt(2.0) * math.pi)
        return math.hypot(rms_lsb / math.sqrt(0.4 * SAMPLES), smoothed) * self.driven.channel.lsb_v

    def _input_checks(
        self, gains: tuple[float, float] | None, offsets: tuple[float, float] | None
    ) -> tuple[Check, Check]:
        """Checks of gain and offset; both are those of the output's ``_gains`` and ``_offsets``, None if unknown."""
        name = self.driven.name
        if self._is_clipped:
            why = f"the levels of the {name} are clipped"
            return _not_measured("gain", name, why), _not_measured("offset", name, why)
        return (
            self.driven.gain(self._input_gain, MOST_INPUT_GAIN, self._input_hint(gains)),
            self.driven.offset(self._input_offset, self._input_hint(offsets)),
        )

    def _input_hint(self, deviations: tuple[float, float] | None) -> str:
        """Place of an error of the input, from the output's deviations by the measured and the commanded input."""
        driven, answer = self.driven.name, self.answer.name
        if deviations is None:
            return f": check the generator and its amplifier, and range and amplifier of the {driven}'s input"
        if abs(deviations[0]) < abs(deviations[1]):
            return f", and the {answer} follows it: check the generator and its amplifier"
        return f", and the {answer} does not follow it: check the range and the amplifier of the {driven}'s input"

    # ---- response of the output

    @cached_property
    def _nominal(self) -> tuple[float, float]:
        """Terms of second and first order over that of order zero, in samples."""
        sample_s = self.sample_period_s * self.time_scale
        response = self.plant.response()
        return 1.0 / response["s0"] / sample_s**2, response["s1"] / response["s0"] / sample_s

    @cached_property
    def _response(self) -> Response:
        """Response in volts after the second edge, to the input as measured, or as commanded if that was clipped."""
        used = ~self.answer.clipped
        used[: self._wave.after[1]] = False
        levels = self.commanded_v if self._is_clipped else self._levels_v
        return Response.fit(self.answer.volts, used, self._wave, levels, self._nominal)

    @cached_property
    def _gains(self) -> tuple[float, float]:
        """Deviation of the output's static gain, by the input as measured and as commanded."""
        unit_per_v = self.answer.channel.unit_per_v / self.driven.channel.unit_per_v
        measured = self._response.gain.value / self.plant.response()["gain"] * unit_per_v - 1.0
        return measured, measured if self._is_clipped else (1.0 + measured) * (1.0 + self._input_gain.value) - 1.0

    @cached_property
    def _offsets(self) -> tuple[float, float]:
        """Output without input, V, by the input as measured and as commanded."""
        measured = self._response.offset.value
        return measured, measured + (0.0 if self._is_clipped else self._response.gain.value * self._input_offset.value)

    def _response_checks(self) -> tuple[Check, ...]:
        """Checks that are read from the response; most are not measured if its shape is wrong."""
        response, lsb_v = self._response, self.answer.channel.lsb_v
        noise_v = response.noise(self.answer.half_period_n)
        shape = self._shape(Uncertain(*(each / lsb_v for each in response.unexplained(noise_v.value))))
        if shape.state == "wrong":
            why = f"it is read from the shape of the {self.answer.name}, which is wrong"
            names = [(name, self.answer.name) for name in ("gain", "offset", "noise")]
            names += [(name, "") for name in ("skew", self._name_of(Change.MASS), self._name_of(Change.DAMPING))]
            return (self._clock_ratio(), shape, *(_not_measured(name, channel, why) for name, channel in names))
        gain, offset = min(self._gains, key=abs), min(self._offsets, key=abs)
        gain_error = math.hypot(response.gain.error / abs(response.gain.value), self._input_gain.error)
        offset_error = math.hypot(response.offset.error, response.gain.value * self._input_offset.error)
        hint = f": check the range and amplifier of its input, and set {self._pot_of(Change.STIFFNESS)} again"
        return (
            self.answer.gain(Uncertain(gain, gain_error), MOST_GAIN, hint),
            self.answer.offset(Uncertain(offset, offset_error), hint),
            self.answer.noise(Uncertain(*(each / lsb_v for each in noise_v))),
            self._skew(),
            self._clock_ratio(),
            *self._machine(),
            shape,
        )

    def _shape(self, lsb: Uncertain) -> Check:
        """Check of ``lsb``, the rms of the residual that noise does not explain."""
        advice = f"the {self.answer.name} is not that of the program: check for overload, stuck bits, program"
        most = max(MOST_SHAPE * self.answer.swing_codes, LEAST_SHAPE_LSB)
        return Check("shape", self.answer.name, *lsb, 0.0, most, "LSB", advice)

    def _skew(self) -> Check:
        drift_n = 3.0 * self._response.period_error_n * float(np.abs(self._wave.turn).max())
        delay = self._wave.delay(self._response.times, drift_n)
        lag_n, lag_error_n = (lag_s / self.sample_period_s for lag_s in AMPLIFIERS_S)
        late_n, error_n = delay.value + lag_n, math.hypot(delay.error, self._response.instant_error_n, lag_error_n)
        late, slow = ("later", "") if late_n > 0.0 else ("earlier", ", and check the type of the amplifiers")
        by = f"{1e6 * abs(late_n) * self.sample_period_s:.2g} us"
        advice = (
            f"the {self.answer.name} is taken {late} than the {self.driven.name} by {by}: have the card sample both at"
            f" one instant{slow}"
        )
        most = max(MOST_SKEW_N, MOST_SKEW_S / self.sample_period_s)
        return Check("skew", "", late_n, error_n, -most, most, "samples", advice)

    def _clock_ratio(self) -> Check:
        period_n = self._response.times.period_n
        ppm = 1e6 * (2.0 * self.driven.half_period_n / period_n - 1.0)
        advice = (
            f"the generator is {abs(ppm):.0f} ppm {'fast' if ppm > 0.0 else 'slow'} by the card's clock: give both one"
            f" clock, or set the frequency to {1.0 - 1e-6 * ppm:.6f} of the desired one"
        )
        error = 1e6 * self._response.period_error_n / period_n
        return Check("clock ratio", "", ppm, error, -MOST_CLOCK_PPM, MOST_CLOCK_PPM, "ppm", advice)

    def _pot_of(self, change: Change) -> str:
        """Pot of the parameter that this diagnosis names, or all pots."""
        name = self.plant.program.diagnosed.get(change.name.lower())
        return f"the pot of {name}" if name else "the pots"

    def _name_of(self, change: Change) -> str:
        """Parameter that this diagnosis names, or its place in the equation of second order."""
        return self.plant.program.diagnosed.get(change.name.lower(), _TERMS[change])

    def _machine(self) -> Iterator[Check]:
        """Checks of the terms of second and first order, relative to that of order zero."""
        fitted = (self._response.mass_n2, self._response.damping_n)
        for change, found, nominal, most, parts in zip(
            (Change.MASS, Change.DAMPING),
            fitted,
            self._nominal,
            (MOST_MASS, MOST_DAMPING),
            ("the capacitors of both integrators", "that of the second one"),
            strict=True,
        ):
            off = found.value / nominal - 1.0
            advice = (
                f"it is {off:+.0%} relative to {self._name_of(Change.STIFFNESS)}: set {self._pot_of(change)} again,"
                f" and check {parts}"
            )
            yield Check(self._name_of(change), "", off, found.error / nominal, -most, most, "off nominal", advice)


def _remove_quantisation(rms_lsb: float) -> float:
    """Analogue part of a noise, LSB rms."""
    return math.sqrt(max(rms_lsb**2 - QUANTISATION_VARIANCE_LSB2, 0.0))


def _not_measured(name: str, channel: str, why: str) -> Check:
    return Check(name, channel, math.nan, math.nan, -math.inf, math.inf, "", why)
