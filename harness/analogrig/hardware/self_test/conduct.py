"""The self-test: one square wave is played, and all that can be known about the rig is read from its two channels.

    levels of the force           polarity, gain, offset, noise, range use, clipping
    edges of the force            between which samples each came
    answer of the displacement    polarity, gain, offset, mass, damping, noise, and the edges' instants and period
    both together                 identity, skew; with the frequency that was commanded: the clock ratio

What the displacement says is held against the force as it was measured and as it was commanded, and it is at fault only
when it is wrong against both: an error of the generator, or of the force's input, is not reported twice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import SelfTestError
from analogrig.hardware.self_test import checks, noise
from analogrig.hardware.self_test.findings import Check, Findings
from analogrig.hardware.self_test.record import HIGH_V, LOW_V, SelfTestRecord
from analogrig.hardware.self_test.response import Answer, Response, SecondOrder
from analogrig.hardware.self_test.timing import Levels, SeenEdges, averaged_n, lateness
from analogrig.rigs.rig import Rig
from analogrig.run import MEASURED

LEAST_SWING_V = 0.25
"""A channel that moves by less shows no signal."""


def self_test(rig: Rig, seed: int, program: str = "front") -> Findings:
    """Plays the self-test on a rig, and says what is wrong with it.

    :param program: what is wired on the computer: front or shock.
    :raises ConfigurationError: the rig cannot play it.
    :raises SelfTestError: it could not be made: no signal, a drop-out, another program.
    :raises RigError: the rig failed.
    """
    return Findings(str(rig.description().get("name", "")), program, examined(SelfTestRecord.taken(rig, seed, program)))


def examined(record: SelfTestRecord) -> tuple[Check, ...]:
    """What the record shows, as far as what is wrong leaves the rest a meaning.

    :raises SelfTestError: there is no signal in it, or a drop-out.
    """
    clipping = tuple(_clipping(record, channel) for channel in MEASURED)
    if off_scale := tuple(each for each in clipping if each.value > 0.5 and not _moves(record, each.channel)):
        return off_scale
    for channel in MEASURED:
        if not _moves(record, channel):
            raise SelfTestError(
                f"no signal on {channel}, which moves by {record.swing_v(channel):.2g} V: is the generator on, the"
                " computer in operation, the lead plugged in?"
            )
    identity = checks.identity(record.sharpness("force") - record.sharpness("displacement"))
    if identity.state == "wrong":
        return (identity,)
    seen = _Seen(record)
    leads = (identity, *seen.polarity())
    if any(each.state == "wrong" for each in leads):
        return leads
    range_use = (checks.range_use(name, record.swing_codes(name), record.channels[name].codes) for name in MEASURED)
    return (*leads, *clipping, *range_use, *seen.quantities())


def _moves(record: SelfTestRecord, channel: str) -> bool:
    return record.swing_v(channel) > LEAST_SWING_V


def _clipping(record: SelfTestRecord, channel: str) -> Check:
    clipped = record.clipped[channel]
    share, samples = float(clipped.mean()), len(clipped)
    at_top = clipped & (record.codes[channel] > record.channels[channel].codes / 2)
    return checks.clipping(channel, share, samples, "upper" if float(at_top.mean()) > 0.5 * share else "lower")


@dataclass(frozen=True)
class _Known:
    """A number and its standard error."""

    value: float
    error: float


class _Seen:
    """A record whose force is a square wave, and what is read from it."""

    def __init__(self, record: SelfTestRecord) -> None:
        """:raises SelfTestError: the square wave is broken."""
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
        """The force is inverted if its levels are more like those commanded with the other sign."""
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
        """All that has a size."""
        shape = self._shape()
        if shape.state == "wrong":
            return (*self._force(), self._force_noise(), self._clock_ratio(), shape, *_UNKNOWN)
        return (
            *self._force(),
            self._force_noise(),
            *self._displacement(),
            self._skew(),
            self._clock_ratio(),
            *self._machine(),
            shape,
        )

    def _skew(self) -> Check:
        record, response = self._record, self._response
        room_n = 3.0 * response.period_error_n * float(np.abs(self._edges.turn).max())
        late_n, late_error_n = lateness(self._codes, self._levels, self._edges, response.line, room_n)
        lag_n, lag_error_n = (lag_s / record.sample_period_s for lag_s in checks.AMPLIFIERS_S)
        error_n = math.hypot(late_error_n, response.instant_error_n, lag_error_n)
        return checks.skew(late_n + lag_n, error_n, record.sample_period_s)

    def _clock_ratio(self) -> Check:
        line, error_n = self._response.line, self._response.period_error_n
        commanded_n = 2.0 * self._record.half_period_n
        return checks.clock_ratio(1e6 * (commanded_n / line.period_n - 1.0), 1e6 * error_n / line.period_n)

    @cached_property
    def _used(self) -> NDArray[np.bool_]:
        """(n,): samples of the displacement that can be explained: not clipped, and not before the second edge."""
        used = ~self._record.clipped["displacement"]
        used[: self._edges.after[1]] = False
        return used

    @cached_property
    def _response(self) -> Response:
        """Of the displacement, in volts, to the force as measured, or as commanded where that was clipped."""
        levels = (LOW_V, HIGH_V) if self._clipped else (self._low_v, self._high_v)
        averaged = averaged_n(self._edges)
        answer = Answer(self._record.volts("displacement"), self._used, self._edges, levels, averaged)
        return answer.fitted(self._nominal)

    @property
    def _nominal(self) -> SecondOrder:
        plant, sample_s = self._record.plant, self._record.sample_period_s * self._record.time_scale
        return SecondOrder(
            plant.mass_kg / plant.stiffness_n_per_m / sample_s**2,
            plant.damping_n_s_per_m / plant.stiffness_n_per_m / sample_s,
        )

    # ---- noise, and what is not noise

    @property
    def _residual_lsb(self) -> NDArray[np.float64]:
        return self._response.residual / self._record.channels["displacement"].lsb_v

    @cached_property
    def _rms_of_force(self) -> _Known:
        """In LSB."""
        return _Known(*noise.of_levels(self._codes, self._levels, self._edges))

    @cached_property
    def _rms_of_displacement(self) -> _Known:
        """In LSB."""
        samples, line = np.flatnonzero(self._used), self._response.line
        return _Known(*noise.of_answer(self._residual_lsb, samples, line, self._record.half_period_n))

    def _force_noise(self) -> Check:
        rms = self._rms_of_force
        return checks.noise_floor("force", rms.value, rms.error, self._record.swing_codes("force"))

    def _shape(self) -> Check:
        samples, line, rms = np.flatnonzero(self._used), self._response.line, self._rms_of_displacement.value
        lsb, error = noise.unexplained(self._residual_lsb, samples, line, rms)
        return checks.shape(lsb, error, self._record.swing_codes("displacement"))

    # ---- gain and offset

    @cached_property
    def _force_gain(self) -> _Known:
        """Deviation from what was commanded."""
        deviation = (self._high_v - self._low_v) / (HIGH_V - LOW_V) - 1.0
        return _Known(deviation, math.sqrt(2.0) * self._level_error_v / (HIGH_V - LOW_V))

    @cached_property
    def _force_offset(self) -> _Known:
        """V, where no force was commanded."""
        return _Known(self._low_v - (1.0 + self._force_gain.value) * LOW_V, 1.1 * self._level_error_v)

    @property
    def _level_error_v(self) -> float:
        """Standard error of a level: by noise, and by quantisation as far as noise does not smooth it (Widrow)."""
        rms_lsb = self._rms_of_force.value
        smoothed = math.exp(-2.0 * (math.pi * noise.analogue(rms_lsb)) ** 2) / (math.sqrt(2.0) * math.pi)
        error_lsb = math.hypot(rms_lsb / math.sqrt(0.4 * len(self._codes)), smoothed)
        return error_lsb * self._record.channels["force"].lsb_v

    def _force(self) -> tuple[Check, Check]:
        if self._clipped:
            why = "the levels of the force are clipped"
            return checks.not_measured("gain", "force", why), checks.not_measured("offset", "force", why)
        gain, offset = self._force_gain, self._force_offset
        (by_force, by_command), (from_force, from_command) = self._gains(), self._offsets()
        return (
            checks.gain(
                "force",
                gain.value,
                gain.error,
                checks.MOST_FORCE_GAIN,
                _where(displacement_follows=abs(by_force) < abs(by_command)),
            ),
            checks.offset(
                "force", offset.value, offset.error, _where(displacement_follows=abs(from_force) < abs(from_command))
            ),
        )

    def _gains(self) -> tuple[float, float]:
        """Deviation of the displacement's static gain, by the force as measured and as commanded."""
        record, response = self._record, self._response
        force, displacement = (record.channels[name].unit_per_v for name in MEASURED)
        measured = response.gain * record.plant.stiffness_n_per_m * displacement / force - 1.0
        if self._clipped:
            return measured, measured
        return measured, (1.0 + measured) * (1.0 + self._force_gain.value) - 1.0

    def _offsets(self) -> tuple[float, float]:
        """V of displacement without force, by the force as measured and as commanded."""
        measured = self._response.offset
        return measured, measured + (0.0 if self._clipped else self._response.gain * self._force_offset.value)

    def _displacement(self) -> tuple[Check, ...]:
        response, rms = self._response, self._rms_of_displacement
        gain, offset = min(self._gains(), key=abs), min(self._offsets(), key=abs)
        gain_error = math.hypot(response.gain_error / abs(response.gain), self._force_gain.error)
        offset_error = math.hypot(response.offset_error, response.gain * self._force_offset.error)
        return (
            checks.gain("displacement", gain, gain_error, checks.MOST_GAIN, _ELSEWHERE),
            checks.offset("displacement", offset, offset_error, _ELSEWHERE),
            checks.noise_floor("displacement", rms.value, rms.error, self._record.swing_codes("displacement")),
        )

    # ---- the machine

    def _machine(self) -> tuple[Check, Check]:
        response, nominal = self._response, self._nominal
        own = response.second_order
        return (
            checks.mass(own.mass_n2 / nominal.mass_n2 - 1.0, response.mass_error_n2 / nominal.mass_n2),
            checks.damping(own.damping_n / nominal.damping_n - 1.0, response.damping_error_n / nominal.damping_n),
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

_ELSEWHERE = ": look at its input's range and amplifier, and set the pot of K again"


def _where(*, displacement_follows: bool) -> str:
    """Where an error of the force is to be looked for."""
    if displacement_follows:
        return ", and the displacement follows it: look at the generator and its amplifier"
    return ", and the displacement does not follow it: look at the range and the amplifier of the force's input"
