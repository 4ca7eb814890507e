"""Plants of the thesis, the estimators that it compares, and the quality of their estimates.

Plants are difference equations. Estimators, ours among them, are settings of the same C.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import freqz, lfilter, lfiltic

from analogrig import EstimatorConfig, Plant, Program, Run
from analogrig.devices import Estimator, ModelOrders
from analogrig.judging import trajectory
from analogrig.plant import SampledPlant, Segment, estimated_parameters
from analogrig_thesis.texts import Mark, Signal

PERIOD_S = 0.01
"""Section 4.2: "The system sample rate was 100Hz"."""


class Suspension(NamedTuple):
    """Mass, damper and spring of the thesis (Equ 2.3)."""

    mass_kg: float
    damping_n_s_per_m: float
    stiffness_n_per_m: float

    @property
    def plant(self) -> Plant:
        return Plant(PROGRAM, tuple(self))


PROGRAM = Program.load("front")
"""Program of the equation M x'' + B x' + K x = F."""

SHOCK = Suspension(2.0, 900.0, 12250.0)
"""Shock absorber of section 4.2."""
FRONT = Suspension(115.0, 3021.0, 24500.0)
"""Front suspension of section 4.4.1."""

PROFILE = (
    Segment(0, FRONT.plant),
    Segment(200, Suspension(115.0, 3021.0, 18000.0).plant),
    Segment(400, Suspension(115.0, 3453.0, 18000.0).plant),
    Segment(500, Suspension(115.0, 2123.0, 20000.0).plant),
    Segment(600, Suspension(30.0, 2123.0, 20000.0).plant),
)
"""Section 4.4.1. Printed with both ends: 0 <= t <= 200, 201 <= t <= 400, ..."""
PROFILE_N = 800
CHANGE_LABELS = ("K↓", "B↑", "B↓, K↑", "M↓")


REST = np.zeros(2)
"""Two samples at rest."""


class Arx(NamedTuple):
    """y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k-1) + b1 u(k-2) (thesis Equ 3.10 with na = nb = 2)."""

    a1: float
    a2: float
    b0: float
    b1: float

    @classmethod
    def of(cls, plant: Plant) -> Arx:
        """Return the zero-order hold of a plant at ``PERIOD_S``, in metres per newton.

        Trace and determinant of the transition matrix are -a1 and a2; b follows from the first two values of the step
        response.
        """
        sampled = SampledPlant.from_plant(plant, PERIOD_S)
        (xx, xv), (vx, vv) = sampled.transition
        first = sampled.next(sampled.at_rest, 1.0)
        second = sampled.next(first, 1.0)
        a1, a2 = -(xx + vv), xx * vv - xv * vx
        return cls(a1, a2, first[0], second[0] + a1 * first[0] - first[0])

    @classmethod
    def scaled(cls, theta: NDArray[np.floating], b_scale: float) -> Arx:
        """Return the first four elements of ``theta`` (p,) with the b's times ``b_scale``."""
        a1, a2, b0, b1 = (float(x) for x in theta[:4])
        return cls(a1, a2, b0 * b_scale, b1 * b_scale)

    @property
    def poles(self) -> list[float]:
        """Real parts of both poles, the larger pole first."""
        return [x.real for x in sorted(np.roots([1.0, self.a1, self.a2]).tolist(), key=abs, reverse=True)]

    @property
    def gain(self) -> float:
        """Static gain, metres per newton."""
        return (self.b0 + self.b1) / (1.0 + self.a1 + self.a2)

    def response(self, u: Signal, past_u: Signal = REST, past_y: Signal = REST) -> Signal:
        """Simulated output (n,) after two inputs and two outputs."""
        b, a = [0.0, self.b0, self.b1], [1.0, self.a1, self.a2]
        return np.asarray(lfilter(b, a, u, zi=lfiltic(b, a, past_y[::-1], past_u[::-1]))[0])

    def frequency_response(self, frequency_hz: Signal) -> NDArray[np.complex128]:
        """G(exp(j w T)) (n,)."""
        b, a = [0.0, self.b0, self.b1], [1.0, self.a1, self.a2]
        return np.asarray(freqz(b, a, 2.0 * math.pi * frequency_hz * PERIOD_S)[1])


def damping_ratio(plant: Plant) -> float:
    """B / (2 sqrt(K M))."""
    mass_kg, damping_n_s_per_m, stiffness_n_per_m = plant.values
    return damping_n_s_per_m / (2.0 * math.sqrt(stiffness_n_per_m * mass_kg))


def square(n: int, amplitude: float, period_n: int = 100) -> Signal:
    """Square wave (n,) between ``-amplitude`` and ``amplitude`` that begins high; 100 samples are the thesis's 1 Hz."""
    return np.where(np.arange(n) % period_n < period_n // 2, amplitude, -amplitude)


def stretches(segments: Sequence[Segment], n: int) -> list[tuple[int, int, Plant]]:
    """First sample of each segment, that of the next one or ``n``, and the plant."""
    ends = itertools.pairwise([*(segment.start for segment in segments), n])
    return [(start, end, segment.plant) for (start, end), segment in zip(ends, segments, strict=True)]


def time_varying(u: Signal, segments: Sequence[Segment] = PROFILE, period_s: float = PERIOD_S) -> Signal:
    """Displacement (n,) of a plant whose parameters jump; position and velocity are continuous."""
    y, state = np.empty(len(u)), SampledPlant.from_plant(segments[0].plant, period_s).at_rest
    for start, end, plant in stretches(segments, len(u)):
        sampled = SampledPlant.from_plant(plant, period_s)
        for k in range(start, end):
            y[k] = state[0]
            state = sampled.next(state, float(u[k]))
    return y


def jumps_in_the_coefficients(u: Signal) -> Signal:
    """Displacement (n,) over the profile if the coefficients of the difference equation jump instead of the plant."""
    inputs, y = np.append(REST, u), REST
    for start, end, plant in stretches(PROFILE, PROFILE_N):
        y = np.append(y, Arx.of(plant).response(u[start:end], inputs[start : start + 2], y[-2:]))
    return y[2:]


def coefficients(segments: Sequence[Segment], n: int) -> Signal:
    """True a1, a2, b0, b1 (n, 4) of each sample, in metres and newtons."""
    return np.concatenate([np.tile(Arx.of(plant), (end - start, 1)) for start, end, plant in stretches(segments, n)])


HOLD_N = 4
"""Section 4.4.3: "After four samples, calculate the mean as normal". The C counts four innovations: it restarts its
equations with the sample after an alarm, so two samples pass before the first innovation."""

WARM_UP_N = 50
"""Section 5.5: "the fault detection algorithm was switched off for the first 50 samples"."""

UNITS_PER_M = 1e7
"""Units of y for which the printed ceilings make sense: 0.1 um."""

ERROR_CEILING = 1500.0
"""Section 4.4.2, in units of 0.1 um."""

FORGETTING = 0.97

P0 = 10.0
"""Section 4.4.1: "a diagonal P matrix with the value 10 along the main diagonal"."""

PLAIN = EstimatorConfig(
    nb=2,
    nk=1,
    offset=False,
    forgetting=1.0,
    p0=P0,
    noise_variance=1.0,
    c=(),
    refresh_n=0,
    stuck_n=0,
    idle_n=0,
    isolation=False,
    edge_instants="locked",
    trigger="none",
    warm_up_n=0,
)
"""Plain recursive least squares (Equ 3.19, 3.20): no whitening, no forgetting, no trigger."""

ERROR, MEAN, OURS = "prediction-error", "mean-between-faults", "cusum"
"""Keys of the thesis's two triggers, and of the shipped default: whitened equations, cumulative sum of the normalised
innovation."""

NAMES: Mapping[str, str] = {
    "rls": "recursive least squares",
    "forgetting": f"forgetting factor {FORGETTING:g}",
    "random-walk": "random walk, R = I",
    ERROR: "prediction error",
    MEAN: "mean between faults",
    OURS: "our default trigger, armed after 150 samples",
}
"""Names of all schemes by key, in the order of the tables."""

DEFAULT = EstimatorConfig(warm_up_n=150)
"""Our default trigger, armed earlier than by default: the first change of the thesis comes after 200 samples."""

CONVERGED = 0.05
"""M, B and K have converged once each is, and stays, this close to the truth, relative to it."""

SPIKE = 0.5
"""An excursion of M, B or K farther than this from the truth, relative to it, is a spike."""

LARGEST_INPUT = 2.0**19
"""The device rejects readings above 1e6: larger data are divided by a power of two and P0 is multiplied by its square,
which gives the same estimator to the bit."""


def schemes(
    plain: EstimatorConfig, prediction_error: float, mean: float, warm_up_n: int = WARM_UP_N
) -> dict[str, EstimatorConfig]:
    """Settings of the thesis's five schemes by key: ``plain`` and its variants.

    :param prediction_error: ceiling of that trigger, in codes.
    :param mean: ceiling of the mean between faults, in codes.
    :param warm_up_n: samples at the start without a trigger.
    """
    held: dict[str, Any] = {"hold_off_n": HOLD_N, "warm_up_n": warm_up_n}
    variants: dict[str, dict[str, Any]] = {
        "rls": {},
        "forgetting": {"forgetting": FORGETTING},
        "random-walk": {"random_walk": 1.0},
        ERROR: {"trigger": ERROR, "ceiling": prediction_error, "reset": "all", **held},
        MEAN: {"trigger": MEAN, "ceiling": mean, **held},
    }
    return {key: dataclasses.replace(plain, **fields) for key, fields in variants.items()}


@dataclass(frozen=True, eq=False)
class Track:
    """Output of an estimator over n samples."""

    theta: Signal
    """(n, p) in the units of the data."""
    innovation: Signal
    """(n,)"""
    statistic: Signal
    """(n,) of the trigger."""
    alarms: NDArray[np.int64]
    """Sample indices."""
    parameters: Signal
    """(n, 3) M, B, K in kg, N s/m, N/m; NaN where theta describes no suspension."""

    @classmethod
    def of_run(cls, run: Run) -> Track:
        """Return the device's estimates of a run; theta in codes."""
        theta, innovation, statistic = (each.astype(np.float64) for each in (run.theta, run.innovation, run.statistic))
        return cls(theta, innovation, statistic, run.alarm_index, trajectory(run))


@dataclass(frozen=True, eq=False)
class SignalPair:
    """Force ``u`` and displacement ``y`` (n,), in codes of the card or in any other units."""

    u: Signal
    y: Signal
    m_per_unit: float = 1.0
    n_per_unit: float = 1.0

    @property
    def b_scale(self) -> float:
        """Factor from b's in these units to b's in metres per newton."""
        return self.m_per_unit / self.n_per_unit

    def track(self, config: EstimatorConfig) -> Track:
        """Run the C estimator in this process; its ceiling is in units of y."""
        largest = max(np.abs(self.u).max(), np.abs(self.y).max())
        shrunk = 2.0 ** -max(0.0, np.ceil(np.log2(largest / LARGEST_INPUT)))
        unit = 1.0 if config.trigger == OURS else shrunk
        ceiling = None if config.ceiling is None else config.ceiling * unit
        fitted = dataclasses.replace(config, p0=config.p0 / shrunk**2, ceiling=ceiling)
        steps = Estimator(fitted).run(self.u * shrunk, self.y * shrunk)
        theta, model = steps.theta.astype(np.float64), ModelOrders.of_estimator(config.as_table())
        parameters = estimated_parameters(PROGRAM, theta, model, self.n_per_unit, self.m_per_unit, PERIOD_S)
        return Track(theta, steps.innovation / shrunk, steps.statistic / unit, steps.alarms, parameters)


@dataclass(frozen=True)
class TrackQuality:
    """Detection and convergence of a track, judged by the true plants."""

    latency_n: tuple[int | None, ...]
    """Samples from each change to the first alarm before the next change."""
    missed: int
    extra_alarms: int
    """Alarms that are not the first after a change."""
    reconverged_n: tuple[int | None, ...]
    """Samples from each change until M, B and K stay within 5 % up to the next change; None: never."""
    spread: tuple[float | None, ...]
    """Standard deviation of M, B, K over the truth, in the second halves of the stretches; None if one is undefined."""
    undefined: float
    """Fraction of those samples at which theta describes no suspension."""
    spikes: int
    """Number of times that M, B or K leave the bound SPIKE, or become undefined, after a change."""


def assess(track: Track, segments: Sequence[Segment]) -> TrackQuality:
    """Judge a track by the true plants."""
    ranges = stretches(segments, len(track.theta))
    error = np.concatenate([relative_errors(track, plant, start, end) for start, end, plant in ranges])
    late = [error[(start + end) // 2 : end] for start, end, _ in ranges]
    spread = np.sqrt(np.mean([each.var(axis=0) for each in late], axis=0))
    latency = [_first_alarm(track.alarms, start, end) for start, end, _ in ranges[1:]]
    beyond = [~(np.abs(error[start + 1 : end]) <= SPIKE).all(axis=1) for start, end, _ in ranges[1:]]
    return TrackQuality(
        latency_n=tuple(latency),
        missed=latency.count(None),
        extra_alarms=len(track.alarms) - len(latency) + latency.count(None),
        reconverged_n=tuple(reconverged(error, segments)),
        spread=tuple(None if np.isnan(each) else float(each) for each in spread),
        undefined=float(np.concatenate([np.isnan(each).any(axis=1) for each in late]).mean()),
        spikes=sum(int((each[1:] & ~each[:-1]).sum()) for each in beyond),
    )


def relative_errors(track: Track, plant: Plant, start: int = 0, end: int | None = None) -> Signal:
    """Errors (n, 3) of M, B, K in samples ``start`` to ``end``, relative to the plant."""
    return np.asarray(track.parameters[start:end] / list(plant.parameters().values()) - 1.0)


def settling_n(error: Signal, within: float = CONVERGED) -> int | None:
    """Samples until all rows of (n, p) errors stay within a bound, counted from 1; None if the last row does not."""
    beyond = np.flatnonzero(~(np.abs(error) <= within).all(axis=1))
    if not len(beyond):
        return 1
    return None if beyond[-1] == len(error) - 1 else int(beyond[-1]) + 2


def reconverged(error: Signal, segments: Sequence[Segment]) -> list[int | None]:
    """Samples from each change until all columns of (n, p) errors stay within 5 % up to the next change."""
    return [settling_n(error[start + 1 : end]) for start, end, _ in stretches(segments, len(error))[1:]]


def marks(track: Track, segments: Sequence[Segment], *, with_alarms: bool = True) -> tuple[Mark, ...]:
    """Changes of the plant and, on request, alarms: the first after each change, and the others."""
    ranges = stretches(segments, len(track.theta))[1:]
    changes = [Mark(float(start), "change", label) for (start, *_), label in zip(ranges, CHANGE_LABELS, strict=True)]
    found = {start + n for start, end, _ in ranges if (n := _first_alarm(track.alarms, start, end)) is not None}
    alarms = [Mark(float(k), "alarm" if int(k) in found else "false") for k in track.alarms]
    return (*changes, *(alarms if with_alarms else ()))


def _first_alarm(alarms: NDArray[np.int64], start: int, end: int) -> int | None:
    """Latency of a change at ``start``, which acts on sample ``start + 1`` for the first time."""
    after = alarms[(alarms > start) & (alarms <= end)]
    return int(after[0]) - start if len(after) else None
