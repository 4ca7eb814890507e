"""Twin of measured data: the parameters of a program, linear or not, fitted to a recording by playing its input.

The machine is played with the recorded input, band-limited between the samples, and its output is compared with the
recorded one in a simulation that never sees the measured output.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analogrig.errors import ConfigurationError
from analogrig.rigs.emulator import ComputerDescription
from analogrig.run import Run
from analogrig_emulator import (
    CHANNELS,
    MULTIPLIER_GRADES,
    EngineError,
    PatchedProgram,
    RecordedExcitation,
    SuspensionComputer,
)

SETTLING_N = 200
"""Samples at the beginning of a span that are played and not compared, by default: the machine starts from rest."""
_LEAST_N = 100
"""Usable samples of the output in a span."""

MOST_FITS = 50
"""Largest number of steps of the fit."""

_MACHINE_V = 10.0
_STEP = 1e-3
"""Relative step of the numerical derivatives."""

Progress = Callable[[int], None]
"""Callback after each play, with the number of plays so far."""


@dataclass(frozen=True, eq=False)
class Span:
    """Samples ``first`` <= k < ``end`` of a recording: values of the input and the output in the program's units."""

    first: int
    end: int
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    valid: NDArray[np.bool_]
    """(n,): samples to compare: measured, and after the settling time."""


@dataclass(frozen=True)
class Residual:
    """Difference between a twin and a span of a recording, in the unit of the output."""

    rms: float
    largest: float


@dataclass(frozen=True)
class FittedParameter:
    """Parameter of a program, as fitted."""

    name: str
    value: float
    standard_error: float
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
    plays: int


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
        self.program, self.run = program, run
        self.input, self.output = next(iter(equations.inputs)), outputs[0]
        for name, quantity in zip(CHANNELS, (self.input, self.output), strict=False):
            unit, measured = equations.quantities[quantity].unit, run.conditions.channels[name].unit
            if unit is not None and unit.text != measured:
                raise ConfigurationError(
                    f"{quantity} of program {program.name} is in {unit.text}, {name} of the recording in {measured}:"
                    f" import it in {unit.text}"
                )
        stock = computer.components_for(seed)
        components = dataclasses.replace(stock, pots=dataclasses.replace(stock.pots, windings=0))
        if computer.components != "nominal":
            components = dataclasses.replace(components, multipliers=MULTIPLIER_GRADES["ad633"])
        period_s = run.conditions.sample_period_problem_s
        rate_hz = equations.speed / period_s
        self._computer = SuspensionComputer(
            program, opamp=computer.op_amp, components=components, sample_rate_hz=rate_hz, offset_v=0.0
        )
        self._at = equations.channels.index(self.output)
        self.plays = 0

    def span(self, first: int, end: int, settling_n: int = SETTLING_N) -> Span:
        """Span of the recording.

        :param settling_n: samples at its beginning that are played and not compared.
        :raises ConfigurationError: it lies outside, is too short, or lacks a sample of the input.
        """
        if not 0 <= first < end <= self.run.samples:
            raise ConfigurationError(f"samples {first} to {end} are not within the {self.run.samples} of the recording")
        if end - first < 2 * max(settling_n, 1):
            raise ConfigurationError(
                f"samples {first} to {end}: a span needs {2 * max(settling_n, 1)}: {settling_n} settle the machine"
            )
        rows = slice(first, end)
        (u, u_clipped), (y, y_clipped) = (
            (self.run.channel(name)[rows], self.run.clipped[rows, CHANNELS.index(name)]) for name in CHANNELS[:2]
        )
        if u_clipped.any():
            lacking = first + int(u_clipped.argmax())
            raise ConfigurationError(f"sample {lacking}: the input is missing or clipped, and cannot be played")
        valid = ~y_clipped & (np.arange(end - first) >= settling_n)
        if (count := np.count_nonzero(valid)) < _LEAST_N:
            raise ConfigurationError(
                f"samples {first} to {end}: {count} of the output are neither missing nor clipped after settling;"
                f" a span needs {_LEAST_N}"
            )
        return Span(first, end, u, y, valid)

    def simulate(self, values: Mapping[str, float], span: Span) -> NDArray[np.float64]:
        """Output of the machine in its unit, (n,), played from rest with the input of a span.

        :raises PotError, EngineError: the machine cannot be set so, or is unstable.
        """
        self.plays += 1
        scales = self.program.scales
        self._computer.set(**values)
        played = RecordedExcitation(span.u * _MACHINE_V / scales.full(self.input))
        volts = np.concatenate([block[:, self._at] for block in self._computer.play(played, span.end - span.first)])
        return np.asarray(volts * scales.full(self.output) / _MACHINE_V)

    def difference(self, values: Mapping[str, float], span: Span) -> Residual:
        """Difference between the machine and a span."""
        left = (self.simulate(values, span) - span.y)[span.valid]
        return Residual(float(np.sqrt(np.mean(left**2))), float(np.abs(left).max(initial=0.0)))


def fit_program(plant: RecordedPlant, span: Span, progress: Progress | None = None) -> ProgramTwin:
    """Fit every parameter that has a range, within it, to a span.

    :raises ConfigurationError: no parameter has a range, or the machine is unstable with the program's values.
    """
    from scipy.optimize import least_squares

    rows = plant.program.equations.parameters
    names = [name for name in plant.program.values if rows[name].low < rows[name].high]
    if not names:
        raise ConfigurationError(f"program {plant.program.name}: no parameter has a range to fit it in")
    start = np.array([rows[name].value for name in names])
    low, high = (np.log(np.array([getattr(rows[name], side) for name in names]) / start) for side in ("low", "high"))
    valid_y = span.y[span.valid]
    scale = float(valid_y.std()) or 1.0

    def values_at(logs: NDArray[np.float64]) -> dict[str, float]:
        return dict(zip(names, (start * np.exp(logs)).tolist(), strict=True))

    def residuals(logs: NDArray[np.float64]) -> NDArray[np.float64]:
        try:
            left = (plant.simulate(values_at(logs), span)[span.valid] - valid_y) / scale
        except EngineError as error:
            if not logs.any():
                raise ConfigurationError(f"program {plant.program.name}: {error}") from error
            left = np.full(len(valid_y), 1e3)
        if progress is not None:
            progress(plant.plays)
        return np.asarray(left)

    outside = 1e-9  # least_squares wants the start strictly within
    found = least_squares(
        residuals,
        np.clip(np.zeros(len(names)), low + outside, high - outside),
        bounds=(low, high),
        diff_step=_STEP,
        xtol=1e-6,
        ftol=1e-8,
        x_scale="jac",
        max_nfev=MOST_FITS,
    )
    values = values_at(found.x)
    information = found.jac.T @ found.jac
    variance = 2.0 * found.cost / max(1, len(valid_y) - len(names))
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(information)) * variance, 0.0)) * np.array(list(values.values()))
    units = [unit.text if (unit := rows[name].unit) is not None else "" for name in names]
    estimates = tuple(
        FittedParameter(name, values[name], float(error), unit, _place(values[name], rows[name].low, rows[name].high))
        for name, error, unit in zip(names, errors, units, strict=True)
    )
    return ProgramTwin(
        values=dict(plant.program.equations.values) | values,
        estimates=estimates,
        fit=plant.difference(values, span),
        plays=plant.plays,
    )


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
