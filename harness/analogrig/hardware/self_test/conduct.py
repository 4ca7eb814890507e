"""Self-test: plays one square wave, and estimates all quantities of the rig from force and displacement.

    levels of the force              polarity, gain, offset, noise, range use, clipping
    edges of the force               bounds of each instant
    response of the displacement     polarity, gain, offset, mass, damping, noise, and timing of the edges
    both                             identity, skew; with the commanded frequency: clock ratio

The displacement is compared with the force as measured and as commanded; the closer match is used. So an error of the
generator, or of the force's input, is not reported twice.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from analogrig.errors import SelfTestError
from analogrig.hardware.self_test import checks
from analogrig.hardware.self_test.checks import Check, Findings
from analogrig.hardware.self_test.record import HIGH_V, LOW_V, SelfTestRecord
from analogrig.hardware.self_test.response import FittedResponse, ObservedResponse, SecondOrder
from analogrig.hardware.self_test.square_wave import (
    Levels,
    Residual,
    SeenEdges,
    Uncertain,
    delay,
    level_noise,
    remove_quantisation,
)
from analogrig.rigs.rig import Rig
from analogrig.run import MEASURED

LEAST_SWING_V = 0.25
"""Smallest swing of a channel that counts as a signal."""


def self_test(rig: Rig, seed: int, program: str = "front") -> Findings:
    """Play the self-test on a rig and return its findings.

    :param program: program wired on the computer: front or shock.
    :raises ConfigurationError: the rig cannot play it.
    :raises SelfTestError: it is not possible: no signal, a drop-out, an unsupported program.
    :raises RigError: the rig failed.
    """
    return Findings(str(rig.description().get("name", "")), program, examine(SelfTestRecord.take(rig, seed, program)))


def examine(record: SelfTestRecord) -> tuple[Check, ...]:
    """Checks of a record; only the first fault if it makes the other quantities meaningless.

    :raises SelfTestError: the record has no signal, or a drop-out.
    """
    clipping = tuple(_clipping(record, channel) for channel in MEASURED)
    still = [channel for channel in MEASURED if record.swing_v(channel) <= LEAST_SWING_V]
    if off_scale := tuple(each for each in clipping if each.value > 0.5 and each.channel in still):
        return off_scale
    if still:
        raise SelfTestError(
            f"no signal on {still[0]}, which moves by {record.swing_v(still[0]):.2g} V: check the generator, the"
            " computer's operation, and the lead"
        )
    identity = checks.identity(record.sharpness("force") - record.sharpness("displacement"))
    if identity.state == "wrong":
        return (identity,)
    analysis = _Analysis(record)
    leads = (identity, *analysis.polarity())
    if any(each.state == "wrong" for each in leads):
        return leads
    range_use = (checks.range_use(name, record.swing_codes(name), record.channels[name].codes) for name in MEASURED)
    return (*leads, *clipping, *range_use, *analysis.quantities())


def _clipping(record: SelfTestRecord, channel: str) -> Check:
    clipped = record.clipped[channel]
    share, samples = float(clipped.mean()), len(clipped)
    at_top = clipped & (record.codes[channel] > record.channels[channel].codes / 2)
    return checks.clipping(channel, share, samples, "upper" if float(at_top.mean()) > 0.5 * share else "lower")


class _Analysis:
    """Quantities of a record whose force is a square wave.

    :raises SelfTestError: the square wave is broken.
    """

    def __init__(self, record: SelfTestRecord) -> None:
        self._record = record
        self._codes = record.codes["force"]
        self._levels = Levels.of(self._codes)
        self._edges = SeenEdges.of(self._levels.state, record.half_period_n)
        channel = record.channels["force"]
        self._low_v, self._high_v = (
            channel.low_v + channel.lsb_v * float(self._codes[self._levels.state == level].mean()) for level in (0, 1)
        )
        self._clipped = float(record.clipped["force"].mean()) > checks.MOST_CLIPPED

    def polarity(self) -> tuple[Check, Check]:
        """Polarity of both channels; the force is inverted if its levels match the negated commands better."""
        upright = abs(self._low_v - LOW_V) + abs(self._high_v - HIGH_V)
        inverted = abs(self._low_v + HIGH_V) + abs(self._high_v + LOW_V)
        volts = self._record.volts("displacement")
        state = self._levels.state
        settled = state == np.roll(state, int(0.5 * self._record.half_period_n))
        high, low = (np.median(volts[settled & (state == level)]) for level in (1, 0))
        answer = 1.0 if high > low else -1.0
        force = 1.0 if upright < inverted else -1.0
        return checks.polarity("force", force), checks.polarity("displacement", max(answer, answer * force))

    def quantities(self) -> tuple[Check, ...]:
        """All further checks; those read from the response are not measured if its shape is wrong."""
        force_noise = checks.noise_floor("force", self._force_noise, self._record.swing_codes("force"))
        swing_codes = self._record.swing_codes("displacement")
        shape = checks.shape(self._residual.unexplained(self._displacement_noise.value), swing_codes)
        if shape.state == "wrong":
            return (*self._force(), force_noise, self._clock_ratio(), shape, *_UNKNOWN)
        return (
            *self._force(),
            force_noise,
            *self._displacement(),
            checks.noise_floor("displacement", self._displacement_noise, swing_codes),
            self._skew(),
            self._clock_ratio(),
            *self._machine(),
            shape,
        )

    def _skew(self) -> Check:
        record, response = self._record, self._response
        drift_n = 3.0 * response.period_error_n * float(np.abs(self._edges.turn).max())
        late = delay(self._codes, self._levels, self._edges, response.times, drift_n)
        lag_n, lag_error_n = (lag_s / record.sample_period_s for lag_s in checks.AMPLIFIERS_S)
        error_n = math.hypot(late.error, response.instant_error_n, lag_error_n)
        return checks.skew(Uncertain(late.value + lag_n, error_n), record.sample_period_s)

    def _clock_ratio(self) -> Check:
        period_n, error_n = self._response.times.period_n, self._response.period_error_n
        commanded_n = 2.0 * self._record.half_period_n
        return checks.clock_ratio(Uncertain(1e6 * (commanded_n / period_n - 1.0), 1e6 * error_n / period_n))

    def _machine(self) -> tuple[Check, Check]:
        nominal = self._nominal
        mass, damping = self._response.mass_n2, self._response.damping_n
        return (
            checks.mass(Uncertain(mass.value / nominal.mass_n2 - 1.0, mass.error / nominal.mass_n2)),
            checks.damping(Uncertain(damping.value / nominal.damping_n - 1.0, damping.error / nominal.damping_n)),
        )

    @property
    def _nominal(self) -> SecondOrder:
        plant, sample_s = self._record.plant, self._record.sample_period_s * self._record.time_scale
        return SecondOrder(
            plant.mass_kg / plant.stiffness_n_per_m / sample_s**2,
            plant.damping_n_s_per_m / plant.stiffness_n_per_m / sample_s,
        )

    @cached_property
    def _observed(self) -> ObservedResponse:
        """Displacement, V, after the second edge, and the force as measured, or as commanded if that was clipped."""
        used = ~self._record.clipped["displacement"]
        used[: self._edges.after[1]] = False
        levels = (LOW_V, HIGH_V) if self._clipped else (self._low_v, self._high_v)
        volts = self._record.volts("displacement")
        return ObservedResponse(volts, used, self._edges, levels, self._edges.averaging_n())

    @cached_property
    def _response(self) -> FittedResponse:
        return self._observed.fit(self._nominal)

    # ---- noise, in LSB

    @cached_property
    def _residual(self) -> Residual:
        residual = self._response.residual / self._record.channels["displacement"].lsb_v
        return Residual.of(residual, np.flatnonzero(self._observed.used), self._response.times)

    @cached_property
    def _displacement_noise(self) -> Uncertain:
        return self._residual.noise(self._record.half_period_n)

    @cached_property
    def _force_noise(self) -> Uncertain:
        return level_noise(self._codes, self._levels, self._edges)

    # ---- gain and offset

    @cached_property
    def _force_gain(self) -> Uncertain:
        """Deviation of the force's swing from the commanded one."""
        deviation = (self._high_v - self._low_v) / (HIGH_V - LOW_V) - 1.0
        return Uncertain(deviation, math.sqrt(2.0) * self._level_error_v / (HIGH_V - LOW_V))

    @cached_property
    def _force_offset(self) -> Uncertain:
        """Force at a command of 0, V."""
        return Uncertain(self._low_v - (1.0 + self._force_gain.value) * LOW_V, 1.1 * self._level_error_v)

    @property
    def _level_error_v(self) -> float:
        """Standard error of a level: noise, and quantisation as far as noise does not smooth it (Widrow)."""
        rms_lsb = self._force_noise.value
        smoothed = math.exp(-2.0 * (math.pi * remove_quantisation(rms_lsb)) ** 2) / (math.sqrt(2.0) * math.pi)
        error_lsb = math.hypot(rms_lsb / math.sqrt(0.4 * len(self._codes)), smoothed)
        return error_lsb * self._record.channels["force"].lsb_v

    def _gains(self) -> tuple[float, float]:
        """Deviation of the displacement's static gain, by the force as measured and as commanded."""
        record = self._record
        force, displacement = (record.channels[name].unit_per_v for name in MEASURED)
        measured = self._response.gain.value * record.plant.stiffness_n_per_m * displacement / force - 1.0
        commanded = measured if self._clipped else (1.0 + measured) * (1.0 + self._force_gain.value) - 1.0
        return measured, commanded

    def _offsets(self) -> tuple[float, float]:
        """Displacement without force, V, by the force as measured and as commanded."""
        measured = self._response.offset.value
        return measured, measured + (0.0 if self._clipped else self._response.gain.value * self._force_offset.value)

    def _force(self) -> tuple[Check, Check]:
        if self._clipped:
            why = "the levels of the force are clipped"
            return checks.not_measured("gain", "force", why), checks.not_measured("offset", "force", why)
        return (
            checks.gain("force", self._force_gain, checks.MOST_FORCE_GAIN, _force_hint(*self._gains())),
            checks.offset("force", self._force_offset, _force_hint(*self._offsets())),
        )

    def _displacement(self) -> tuple[Check, Check]:
        response = self._response
        gain, offset = min(self._gains(), key=abs), min(self._offsets(), key=abs)
        gain_error = math.hypot(response.gain.error / abs(response.gain.value), self._force_gain.error)
        offset_error = math.hypot(response.offset.error, response.gain.value * self._force_offset.error)
        hint = ": check the range and amplifier of its input, and set the pot of K again"
        return (
            checks.gain("displacement", Uncertain(gain, gain_error), checks.MOST_GAIN, hint),
            checks.offset("displacement", Uncertain(offset, offset_error), hint),
        )


_UNKNOWN = tuple(
    checks.not_measured(name, channel, "it is read from the shape of the displacement, which is wrong")
    for name, channel in (
        ("gain", "displacement"),
        ("offset", "displacement"),
        ("noise", "displacement"),
        ("skew", ""),
        ("mass", ""),
        ("damping", ""),
    )
)


def _force_hint(by_measured: float, by_commanded: float) -> str:
    """Place of an error of the force, from the displacement's deviations by the measured and the commanded force."""
    if abs(by_measured) < abs(by_commanded):
        return ", and the displacement follows it: check the generator and its amplifier"
    return ", and the displacement does not follow it: check the range and the amplifier of the force's input"
