"""Twin of measured data: the parameters of a program, linear or not, fitted to a recording by playing its input.

The machine is played with the recorded input, and its output is compared with the recorded one in a simulation that
never sees the measured output. Between the samples the input is band-limited or held, whichever fits better.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig import ConfigurationError, Run
from analogrig.judging import QUANTISATION_VARIANCE_LSB2
from analogrig.recordings import in_units
from analogrig.rigs import ComputerDescription
from analogrig_emulator import (
    MULTIPLIERS,
    EngineError,
    PatchedProgram,
    RecordedExcitation,
    SuspensionComputer,
)
from analogrig_emulator.machine.patched_program import MACHINE_V
from analogrig_instruments.calibration.averages import noise_variance

SETTLING_N = 200
"""Samples at the beginning of a span that are played and not compared, by default: the machine starts from rest."""
_LEAST_N = 100
"""Usable samples of the output in a span."""

MOST_FITS = 50
"""Largest number of steps of the fit."""

Reconstruction = Literal["band-limited", "held"]
RECONSTRUCTIONS: tuple[Reconstruction, ...] = ("band-limited", "held")
"""Courses of the input between its samples: that before an anti-alias filter, and that after a converter."""

_INSIDE = 0.1
"""Part of a range by which a start is away from its ends: beside a bound scipy's reflecting steps hardly move."""

_STEP = 1e-3
"""Relative step of the numerical derivatives."""
_LEAST_SINGULAR = 5e-5
"""Least singular value of the sensitivities, as part of the largest, that is no numerical error (1.5e-5)."""
_UNKNOWN = 5.0
"""Standard error of a logarithm in a direction below that."""
_MOST_ERROR = 0.5
"""Largest standard error of a direction of logarithms that the samples determine."""
_LEAST_ERROR = 0.1
"""Least standard error that a direction beyond that gives a parameter which the samples leave open."""
_JUMP = 0.5
"""Least step of the input from one sample to the next, as part of its range, that is a jump."""
_ALIKE_RMS = 1.5
"""Largest ratio of the rms of two courses of the input, without the noise, that explain the output alike."""
_NOISE_ALONE = 1.1
"""Largest rms of a residual, in that of the noise, that may be noise alone."""
_MOST_COLOURED = 3.0
"""Largest rms, in that of the noise, of a residual that the noise of the output explains."""
_MOST_BEYOND_FIT = 3.0
"""Largest rms of samples that were not fitted, in that of the fitted ones, of a twin that holds for both."""
_BEGINNING = 0.1
"""Part of the compared samples that is their beginning."""
_MOST_AT_BEGINNING = 3.0
"""Largest rms there, in that of the others, of a machine that has settled."""

Progress = Callable[[int], None]
"""Callback after each play, with the number of plays so far."""


@dataclass(frozen=True, eq=False)
class Span:
    """Samples ``first`` <= k < ``end`` of a recording: values of the input and the output in the program's units."""

    first: int
    end: int
    before: NDArray[np.float64]
    """Input that is played before ``first``."""
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    valid: NDArray[np.bool_]
    """(n,): samples to compare: measured, and after the settling time."""

    def residual(self, played: NDArray[np.float64]) -> Residual:
        """Difference between an output (n,) and the recorded one."""
        steps = np.diff(np.unique(self.y[self.valid]))
        return Residual.of((played - self.y)[self.valid], float(steps.min()) if len(steps) else 0.0)


@dataclass(frozen=True)
class Residual:
    """Difference between a twin and a span of a recording, in the unit of the output."""

    rms: float
    largest: float
    beginning: float
    """Rms of the first tenth of the samples that are compared, over that of the others."""
    noise: float
    """Rms of the white noise in the difference, at least that of the rounding of the output."""

    @classmethod
    def of(cls, left: NDArray[np.float64], lsb: float) -> Residual:
        """Summary of differences (n,).

        :param lsb: resolution of the recorded output.
        """
        begins = math.ceil(_BEGINNING * len(left))
        first, others = (float(np.sqrt(np.mean(part**2))) for part in (left[:begins], left[begins:]))
        return cls(
            rms=float(np.sqrt(np.mean(left**2))),
            largest=float(np.abs(left).max()),
            beginning=first / others if others else 1.0,
            noise=math.sqrt(max(noise_variance(left), lsb**2 * QUANTISATION_VARIANCE_LSB2)),
        )

    @property
    def is_settled(self) -> bool:
        """True if the beginning fits like the rest."""
        return self.beginning <= _MOST_AT_BEGINNING

    @property
    def is_noise(self) -> bool:
        """True if the noise of the output explains it, for the greater part."""
        return self.rms <= _MOST_COLOURED * self.noise

    def beyond(self, fit: Residual) -> float | None:
        """Rms in that of a fit to other samples, or in the noise if it is more; None if the twin holds for both."""
        least = max(fit.rms, self.noise)
        return self.rms / least if self.rms > _MOST_BEYOND_FIT * least > 0.0 else None

    def excess(self, rms: float) -> float:
        """Rms beyond the noise, of this or another difference from the same samples."""
        return math.sqrt(max(0.0, rms**2 - (_NOISE_ALONE * self.noise) ** 2))


@dataclass(frozen=True)
class FittedParameter:
    """Parameter of a program, as fitted."""

    name: str
    value: float
    standard_error: float | None
    """None: the samples do not determine the value."""
    unit: str
    """Empty if the program states none."""
    place: str
    """Place of the value in its range, in words."""


@dataclass(frozen=True)
class ProgramTwin:
    """Program fitted to a span."""

    values: Mapping[str, float]
    """All parameters, fitted or not."""
    estimates: tuple[FittedParameter, ...]
    """Fitted parameters. The standard errors hold for residuals like white noise; others deserve larger ones."""
    fit: Residual
    output_rms: float
    """Rms of the recorded output about its mean, which a machine of the right program undercuts by far."""
    plays: int
    reconstruction: Reconstruction
    """Course of the input between its samples with which the machine was played."""
    other_rms: float | None
    """Rms of the other course; None if the caller chose."""
    other_is_fitted: bool = False
    """True if the parameters were fitted for the other course too; False: its rms is that after one step."""
    may_jump_between_samples: bool = False
    """True if the input jumps, and neither course explains the output much better than the other."""
    unseen: tuple[str, ...] = ()
    """Parameters that hardly act on the output in these samples."""
    inseparable: tuple[str, ...] = ()
    """Parameters whose effects on the output are alike."""
    surplus: int = 0
    """Number of ``inseparable`` that must be known for the others to follow."""


class RecordedPlant:
    """Program on the machine, and how the two channels of a recording belong to its quantities."""

    def __init__(self, program: PatchedProgram, run: Run, computer: ComputerDescription, seed: int = 0) -> None:
        """Set up the machine.

        :param computer: components of the machine; its pots are continuous.
        :param seed: draws the components.
        :raises ConfigurationError: the units differ, the program has several inputs, or no output.
        """
        equations = program.equations
        outputs = [name for name in equations.channels if name not in equations.inputs]
        if len(equations.inputs) != 1 or not outputs:
            raise ConfigurationError(f"program {program.name}: a twin needs one input, and an output on a channel")
        self.program, self._measured = program, run.conditions.program.measured
        self.input, self.output = next(iter(equations.inputs)), outputs[0]
        conditions = in_units(run.conditions, equations, (self.input, self.output))
        self.run = dataclasses.replace(run, conditions=conditions)
        stock = computer.components_for(seed)
        components = dataclasses.replace(stock, pots=dataclasses.replace(stock.pots, windings=0))
        period_s = run.conditions.sample_period_problem_s
        rate_hz = equations.speed / period_s
        self._computer = SuspensionComputer(
            program,
            opamp=computer.op_amp,
            multiplier=MULTIPLIERS[computer.multiplier_name],
            components=components,
            sample_rate_hz=rate_hz,
            offset_v=0.0,
        )
        self._at = equations.channels.index(self.output)
        self.output_unit = conditions.channels[self._measured[1]].unit
        self.plays = 0

    def span(self, first: int, end: int, settling_n: int = SETTLING_N, *, is_led_in: bool = False) -> Span:
        """Span of the recording.

        :param settling_n: samples at its beginning that are played and not compared.
        :param is_led_in: the machine plays the samples before it, too, since the last change of the plant and the last
            missing sample of the input.
        :raises ConfigurationError: it lies outside, is too short, or lacks a sample of the input.
        """
        if not 0 <= first < end <= self.run.samples:
            raise ConfigurationError(f"samples {first} to {end} are not within the {self.run.samples} of the recording")
        if end - first < 2 * max(settling_n, 1):
            raise ConfigurationError(
                f"samples {first} to {end}: a span needs {2 * max(settling_n, 1)}: {settling_n} settle the machine"
            )
        if changes := [start for start, _, _ in self.run.segments if first < start < end]:
            raise ConfigurationError(
                f"sample {changes[0]}: the plant changes in the recording; pass a span that ends there, such as"
                f" {first}:{changes[0]}"
            )
        rows, every = slice(first, end), self.run.conditions.program.channels
        (u, u_clipped), (y, y_clipped) = (
            (self.run.channel(name)[rows], self.run.clipped[rows, every.index(name)]) for name in self._measured
        )
        if u_clipped.any():
            missing = first + int(u_clipped.argmax())
            raise ConfigurationError(f"sample {missing}: the input is missing or clipped, and cannot be played")
        valid = ~y_clipped & (np.arange(end - first) >= settling_n)
        if (count := np.count_nonzero(valid)) < _LEAST_N:
            raise ConfigurationError(
                f"samples {first} to {end}: {count} of the output are neither missing nor clipped after settling;"
                f" a span needs {_LEAST_N}"
            )
        before = self.run.channel(self._measured[0])[self._lead(first) : first] if is_led_in else u[:0]
        return Span(first, end, before, u, y, valid)

    def _lead(self, first: int) -> int:
        """First of the samples before ``first`` in which the input is known and the plant does not change."""
        changes = [start for start, _, _ in self.run.segments if start <= first]
        at = self.run.conditions.program.channels.index(self._measured[0])
        missing = np.flatnonzero(self.run.clipped[:first, at]) + 1
        return max([0, *changes, *(int(each) for each in missing[-1:])])

    def simulate(
        self, values: Mapping[str, float], span: Span, reconstruction: Reconstruction = "band-limited"
    ) -> NDArray[np.float64]:
        """Output of the machine in its unit, (n,), played from rest with the input of a span and that before it.

        :param values: by parameter; those without a pot keep theirs.
        :raises PotError, EngineError: the machine cannot be set so, or is unstable.
        """
        self.plays += 1
        scales = self.program.scales
        self._computer.set(**{name: value for name, value in values.items() if name in self.program.values})
        u = np.concatenate([span.before, span.u])
        played = RecordedExcitation(u * MACHINE_V / scales.full(self.input), reconstruction == "held")
        volts = np.concatenate([block[:, self._at] for block in self._computer.play(played, len(u))])
        return np.asarray(volts[len(span.before) :] * scales.full(self.output) / MACHINE_V)

    def difference(
        self, values: Mapping[str, float], span: Span, reconstruction: Reconstruction = "band-limited"
    ) -> Residual:
        """Difference between the machine and a span."""
        return span.residual(self.simulate(values, span, reconstruction))


def fit_program(
    plant: RecordedPlant,
    span: Span,
    progress: Progress | None = None,
    *,
    reconstruction: Reconstruction | None = None,
    fixed: Mapping[str, float] = MappingProxyType({}),
) -> ProgramTwin:
    """Fit every parameter that has a range, within it, to a span.

    :param reconstruction: course of the input between its samples; None: the one that fits better.
    :param fixed: values of parameters that are not fitted.
    :raises ConfigurationError: no parameter is left to fit, a fixed one is unknown or beyond its range, or the machine
        is unstable with the program's values.
    """
    fit = _ProgramFit(plant, span, fixed, progress)
    found, other = fit.minimum(fit.start, reconstruction or "band-limited"), None
    chosen = reconstruction or "band-limited"
    if reconstruction is None:
        other = fit.after_a_step(found, "held")
        if other.rms < fit.rms(found):
            held = fit.minimum(found.x, "held")
            other = other._replace(rms=fit.rms(held), is_fitted=True)
            if held.cost < found.cost:
                found, other, chosen = held, other._replace(rms=fit.rms(found)), "held"
    slopes = fit.slopes(found.x, chosen)
    return fit.twin(found, slopes, chosen, other)


class _OtherCourse(NamedTuple):
    """Fit with the other course of the input between its samples, in the unit of the output."""

    rms: float
    is_fitted: bool
    apart: float
    """Rms difference between the outputs with the two courses, for the same parameters."""


class _ProgramFit:
    """Least squares in the logarithms of the parameters, and residuals in standard deviations of the output."""

    def __init__(self, plant: RecordedPlant, span: Span, fixed: Mapping[str, float], progress: Progress | None) -> None:
        program = plant.program
        rows = program.equations.parameters
        _check_fixed(program, fixed)
        names = [name for name in program.values if rows[name].low < rows[name].high and name not in fixed]
        if not names and fixed:
            raise ConfigurationError(f"program {program.name}: every parameter with a range is fixed; leave one to fit")
        if not names:
            raise ConfigurationError(f"program {program.name}: no parameter has a range to fit it in")
        self._plant, self._span, self._fixed, self._progress = plant, span, dict(fixed), progress
        self._names, self._rows = names, rows
        self._origin = np.array([rows[name].value for name in names])
        self._bounds = [
            np.log(np.array([getattr(rows[name], side) for name in names]) / self._origin) for side in ("low", "high")
        ]
        self._y = span.y[span.valid]
        self._scale = float(self._y.std()) or 1.0
        low, high = self._bounds
        inside = _INSIDE * (high - low)
        self.start = np.clip(np.zeros(len(names)), low + inside, high - inside)

    def minimum(self, start: NDArray[np.float64], reconstruction: Reconstruction) -> Any:
        """Result of scipy's least_squares."""
        from scipy.optimize import least_squares

        return least_squares(
            lambda logs: self._residuals(logs, reconstruction),
            start,
            bounds=self._bounds,
            diff_step=_STEP,
            xtol=1e-6,
            ftol=1e-8,
            x_scale="jac",
            max_nfev=MOST_FITS,
        )

    def rms(self, found: Any) -> float:
        """Rms difference at a minimum, in the unit of the output."""
        return self._scale * math.sqrt(2.0 * found.cost / len(self._y))

    def after_a_step(self, found: Any, reconstruction: Reconstruction) -> _OtherCourse:
        """Another reconstruction as one step of Gauss and Newton from a minimum predicts it."""
        left = self._residuals(found.x, reconstruction)
        step, *_ = np.linalg.lstsq(found.jac, left)
        rms, apart = (
            self._scale * float(np.sqrt(np.mean(each**2))) for each in (left - found.jac @ step, left - found.fun)
        )
        return _OtherCourse(rms, is_fitted=False, apart=apart)

    def slopes(self, logs: NDArray[np.float64], reconstruction: Reconstruction) -> NDArray[np.float64]:
        """Derivatives (n, parameters) of the residuals by central differences."""
        low, high = self._bounds
        columns = []
        for at in range(len(logs)):
            ends = []
            for side in (-_STEP, _STEP):
                moved = logs.copy()
                moved[at] = np.clip(moved[at] + side, low[at], high[at])
                ends.append((moved[at], self._residuals(moved, reconstruction)))
            (before, less), (after, more) = ends
            columns.append((more - less) / (after - before))
        return np.stack(columns, axis=1)

    def twin(
        self, found: Any, slopes: NDArray[np.float64], reconstruction: Reconstruction, other: _OtherCourse | None
    ) -> ProgramTwin:
        """Values at a minimum with their standard errors, as far as the samples determine them."""
        plant, values = self._plant, self._values_at(found.x)
        deviation = math.sqrt(2.0 * found.cost / max(1, len(self._y) - len(values)))
        errors, is_unseen, is_alike, surplus = _determined(slopes, deviation)
        names = np.array(self._names)
        estimates = tuple(
            FittedParameter(
                name,
                values[name],
                float(error * values[name]) if is_known else None,
                unit.text if (unit := self._rows[name].unit) is not None else "",
                _place(values[name], self._rows[name].low, self._rows[name].high),
            )
            for name, error, is_known in zip(self._names, errors, ~(is_unseen | is_alike), strict=True)
        )
        every = dict(plant.program.equations.values) | self._fixed | values
        fit = plant.difference(every, self._span, reconstruction)
        jumps = float(np.abs(np.diff(self._span.u)).max()) > _JUMP * float(np.ptp(self._span.u))
        return ProgramTwin(
            values=every,
            estimates=estimates,
            fit=fit,
            output_rms=float(self._y.std()),
            plays=plant.plays,
            reconstruction=reconstruction,
            other_rms=other and other.rms,
            other_is_fitted=other is not None and other.is_fitted,
            may_jump_between_samples=(
                other is not None
                and jumps
                and fit.excess(other.rms) < _ALIKE_RMS * fit.excess(fit.rms)
                and fit.rms <= other.apart  # edges between the samples explain no more
            ),
            unseen=tuple(names[is_unseen].tolist()),
            inseparable=tuple(names[is_alike].tolist()),
            surplus=surplus,
        )

    def _values_at(self, logs: NDArray[np.float64]) -> dict[str, float]:
        return dict(zip(self._names, (self._origin * np.exp(logs)).tolist(), strict=True))

    def _residuals(self, logs: NDArray[np.float64], reconstruction: Reconstruction) -> NDArray[np.float64]:
        plant, span = self._plant, self._span
        try:
            played = plant.simulate(self._fixed | self._values_at(logs), span, reconstruction)
            left = (played[span.valid] - self._y) / self._scale
        except EngineError as error:
            if not logs.any():
                raise ConfigurationError(f"program {plant.program.name}: {error}") from error
            left = np.full(len(self._y), 1e3)
        if self._progress is not None:
            self._progress(plant.plays)
        return np.asarray(left)


def _check_fixed(program: PatchedProgram, fixed: Mapping[str, float]) -> None:
    """:raises ConfigurationError: a name is no parameter of a pot, or a value lies beyond its range."""
    for name, value in fixed.items():
        if name not in program.values:
            raise ConfigurationError(
                f"program {program.name} has no parameter {name[:40]!r} on a pot; there are {', '.join(program.values)}"
            )
        row = program.equations.parameters[name]
        if not row.low <= value <= row.high:
            raise ConfigurationError(f"{name} = {value:g}: must be within its range, {row.low:g} to {row.high:g}")


class _Determined(NamedTuple):
    """Standard errors of logarithms (p,), and the parameters that the samples leave open."""

    errors: NDArray[np.float64]
    is_unseen: NDArray[np.bool_]
    is_alike: NDArray[np.bool_]
    surplus: int
    """Number of directions in which those that are alike hardly act."""


def _determined(slopes: NDArray[np.float64], deviation: float) -> _Determined:
    """Singular values of the sensitivities to logarithms, for which an error of 0.5 is one of 50 %."""
    norms = np.sqrt((slopes**2).sum(axis=0))
    resolved = _LEAST_SINGULAR * norms.max()
    is_unseen = norms <= max(resolved, deviation / _MOST_ERROR)
    _, singular, rows = np.linalg.svd(slopes[:, ~is_unseen], full_matrices=False)
    by_direction = np.where(
        singular < resolved, _UNKNOWN, np.minimum(deviation / np.maximum(singular, resolved), _UNKNOWN)
    )
    is_open = by_direction > _MOST_ERROR
    parts = (rows * by_direction[:, None]) ** 2
    errors, is_alike = np.zeros(len(norms)), np.zeros(len(norms), np.bool_)
    errors[~is_unseen] = np.sqrt(parts.sum(axis=0))
    is_alike[~is_unseen] = np.sqrt(parts[is_open].sum(axis=0)) >= _LEAST_ERROR
    if np.count_nonzero(is_alike) == 1:  # it is like no other
        return _Determined(errors, is_unseen | is_alike, np.zeros_like(is_alike), 0)
    return _Determined(errors, is_unseen, is_alike, int(np.count_nonzero(is_open)))


def _place(value: float, low: float, high: float) -> str:
    """Place of a value in its range, in words."""
    at = math.log(value / low) / math.log(high / low)
    return f"{at:.0%} of its range" if 0.001 < at < 0.999 else "at the end of its range: widen it"


def span_of(text: str) -> tuple[int, int]:
    """First and end of a span written FIRST:END.

    :raises ValueError: it is none.
    """
    first, colon, end = text.partition(":")
    if not (colon and first.isdecimal() and end.isdecimal() and len(text) <= 20 and text.isascii()):
        raise ValueError(f"{text[:40]!r} is no span: write FIRST:END, such as 0:1000")
    return int(first), int(end)
