"""Estimates, fit and spectrum of a run whose plant is unknown, for its page and its summary.

Nothing here is a verdict: the figures say how well the device's own model describes the samples.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.datasheet import ModelOrders
from analogrig.run import INPUT, OUTPUT, Run
from analogrig.wording import number_of

_MOST_FITS = 20
_SETTLING_N = 50
"""Samples in which a simulation forgets that it began with the measured values."""

_LEAST_N = 4 * _SETTLING_N
"""Fewest samples of a stretch whose fit is computed, from those of its second half after the settling time."""

_SEGMENT_N = 1024
_COHERENT = 0.8
"""Least coherence of a point of the measured frequency response."""

_EXCITED_DB = 40.0
"""Depth below the input's largest density at which a point is left out: noise and leakage, not excitation."""

_MOST_BRIDGED_N = 16
"""Longest gap that a spectrum bridges; a longer one ends its stretch."""

_LEFT, _RIGHT, _TOP, _HEIGHT = 64.0, 630.0, 12.0, 200.0
"""Axes of a plot, in pixels of the drawing in run.html."""


_Curves = dict[str, tuple[NDArray[np.float64], str]]
"""Values and style of each curve by its name."""


@dataclass(frozen=True)
class Oscillation:
    """Slowest pair of poles of an estimate, and its gain for a constant input."""

    resonance_hz: float
    """Undamped natural frequency, in the time of the plant."""
    damping: float
    """Damping ratio; 1 or more: two real poles."""
    gain: float
    """Units of the output per unit of the input."""


@dataclass(frozen=True)
class StretchFit:
    """Last estimate of a stretch of samples ``start`` <= k < ``end`` without an alarm, and its fit there."""

    start: int
    end: int
    mode: Oscillation | None
    """None: the estimate has no stable pair of poles."""
    innovation_codes: float
    """Root mean square of the device's prediction errors."""
    predicted: float
    """Share of the output's standard deviation that the predictions explain."""
    simulated: float | None
    """Share that a simulation from the input alone explains; None if it is unstable."""
    neighbours: float
    """Correlation of neighbouring prediction errors; 0 for a model that explains all but white noise."""


def mode_of(run: Run, theta: NDArray[np.float32]) -> Oscillation | None:
    """Slowest oscillation of an estimate, (p,); None if it has none."""
    model = run.datasheet.model
    if model is None or model.na < 2 or not np.isfinite(theta).all():
        return None
    denominator, numerator = _polynomials(theta, model)
    poles = np.roots(denominator)
    with np.errstate(all="ignore"):
        rates = np.log(poles.astype(complex)) / run.conditions.sample_period_problem_s
    slow = rates[np.argsort(np.abs(rates))][:2]
    squared = (slow[0] * slow[1]).real
    if not (np.isfinite(slow).all() and (slow.real < 0).all() and squared > 0):
        return None
    rate = math.sqrt(squared)
    scales = [run.conditions.channels[name].lsb for name in run.conditions.program.measured]
    gain = numerator.sum() / denominator.sum() * scales[1] / scales[0]
    return Oscillation(rate / (2.0 * math.pi), float(-(slow[0] + slow[1]).real / (2.0 * rate)), float(gain))


def _polynomials(theta: NDArray[np.float32], model: ModelOrders) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """1 + a1 z^-1 + ..., and z^-nk (b0 + b1 z^-1 + ...)."""
    values = theta.astype(np.float64)
    return np.append(1.0, values[: model.na]), np.append(np.zeros(model.nk), values[model.na : model.na + model.nb])


def fits(run: Run) -> tuple[StretchFit, ...]:
    """Fit of each stretch between alarms with enough samples; empty if the device reports no estimates of a model."""
    if run.datasheet.model is None or not run.theta.shape[1] or not run.samples:
        return ()
    starts = sorted({start for start, _ in run.records} | {index + 1 for index in run.alarm_index.tolist()})
    spans = [span for span in itertools.pairwise([*starts, run.samples]) if span[1] - span[0] >= _LEAST_N]
    spans = [span for span in spans if _scored(run, *span).sum() >= _SETTLING_N]
    return tuple(_fit(run, *span) for span in spans[-_MOST_FITS:])


def _first_scored(start: int, end: int) -> int:
    """First sample of a stretch in its fit: the estimate converges in the first half."""
    return start + (end - start) // 2


def _scored(run: Run, start: int, end: int) -> NDArray[np.bool_]:
    """Samples of the second half of a stretch in which input and output were measured."""
    return ~run.missing[_first_scored(start, end) : end]


def _fit(run: Run, start: int, end: int) -> StretchFit:
    first, seen = _first_scored(start, end), _scored(run, start, end)
    theta = run.theta[end - 1]
    y = run.codes[first:end, OUTPUT].astype(np.float64)
    errors = run.innovation[first:end].astype(np.float64)[seen]
    spread = float(y[seen].std()) or 1.0
    simulated, settled = _simulate(run, theta, first, end), seen.copy()
    settled[:_SETTLING_N] = False
    left = None if simulated is None else _rms((y - simulated)[settled])
    centred = errors - errors.mean()
    power = float(centred @ centred) or 1.0
    return StretchFit(
        start=start,
        end=end,
        mode=mode_of(run, theta),
        innovation_codes=_rms(errors),
        predicted=1.0 - _rms(errors) / spread,
        simulated=None if left is None or not math.isfinite(left) else 1.0 - left / spread,
        neighbours=float(centred[1:] @ centred[:-1]) / power,
    )


def _rms(values: NDArray[np.float64]) -> float:
    """Root mean square; NaN without a value."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def _bridged(values: NDArray[np.float64], missing: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Values with straight lines over the missing ones; held at the ends."""
    if missing.all():
        return values
    at = np.arange(len(values))
    return np.interp(at, at[~missing], values[~missing])


def _simulate(run: Run, theta: NDArray[np.float32], first: int, end: int) -> NDArray[np.float64] | None:
    """Output in codes of the model with this estimate, from the input and the first outputs; None if it is unstable.

    It runs on over missing outputs; missing inputs are bridged.
    """
    from scipy.signal import lfilter, lfiltic

    model = run.datasheet.model
    if model is None or not np.isfinite(theta).all():
        return None
    denominator, numerator = _polynomials(theta, model)
    if (np.abs(np.roots(denominator)) >= 1.0).any():
        return None
    u, y = (_bridged(run.codes[first:end, at].astype(np.float64), run.clipped[first:end, at]) for at in (INPUT, OUTPUT))
    offset = float(theta[-1]) if model.offset else 0.0
    level = (offset + numerator.sum() * u[0]) / denominator.sum()
    state = lfiltic(numerator, denominator, np.full(model.na, y[0] - level), np.zeros(len(numerator)))
    return np.asarray(lfilter(numerator, denominator, u - u[0], zi=state)[0] + level)


def lines(run: Run) -> list[str]:
    """Estimates and fits for the terminal."""
    found = fits(run)
    if not found:
        return ["  the device reports no estimates of a model"]
    head = f"  samples          resonance [Hz]  damping  gain [{_gain_unit(run)}]  predicted  simulated"
    return [head, *(_line(each) for each in found)]


def _line(fit: StretchFit) -> str:
    mode = (
        "         no oscillation"
        if fit.mode is None
        else (f"{fit.mode.resonance_hz:14.6g}  {fit.mode.damping:7.4f}  {fit.mode.gain:10.5g}")
    )
    simulated = "unstable" if fit.simulated is None else f"{fit.simulated:.1%}"
    return f"  {fit.start:7}-{fit.end - 1:<8} {mode}  {fit.predicted:9.1%}  {simulated:>9}"


def _gain_unit(run: Run) -> str:
    units = [run.conditions.channels[name].unit for name in run.conditions.program.measured]
    return f"{units[1]}/{units[0]}"


# ----------------------------------------------------------------------------------------------------------- spectrum


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Averaged spectra of samples ``start`` <= k < ``end``: frequencies (f,) in Hz of the plant, figures at each."""

    start: int
    end: int
    bridged_n: int
    """Missing samples among them, over which straight lines were drawn."""
    frequency_hz: NDArray[np.float64]
    input_density: NDArray[np.float64]
    """Units squared per Hz."""
    output_density: NDArray[np.float64]
    response: NDArray[np.complex128]
    """Output over input, in their units."""
    coherence: NDArray[np.float64]


def spectrum(run: Run) -> Spectrum | None:
    """Spectra of input and output by Welch's method in the longest stretch without a long gap; None if too short."""
    from scipy import signal

    start, end = _longest_stretch(run.missing)
    length = min(_SEGMENT_N, 1 << ((end - start) // 2).bit_length() - 1) if end - start >= 4 else 0
    if length < 32:
        return None
    program = run.conditions.program
    u, y = (
        _bridged(run.channel(name)[start:end], run.clipped[start:end, at])
        for name, at in zip(program.measured, (INPUT, OUTPUT), strict=True)
    )
    settings = {"fs": 1.0 / run.conditions.sample_period_problem_s, "nperseg": length}
    u, y = u - u.mean(), y - y.mean()
    frequency, uu = signal.welch(u, **settings)
    yy, uy = signal.welch(y, **settings)[1], signal.csd(u, y, **settings)[1]
    with np.errstate(all="ignore"):
        figures = (frequency, uu, yy, uy / uu, np.abs(uy) ** 2 / (uu * yy))
    return Spectrum(start, end, int(run.missing[start:end].sum()), *figures)


def _longest_stretch(missing: NDArray[np.bool_]) -> tuple[int, int]:
    """Longest stretch start <= k < end that begins and ends with a measured sample and has short gaps only."""
    seen = np.flatnonzero(~missing)
    if not len(seen):
        return 0, 0
    after = np.flatnonzero(np.diff(seen) > _MOST_BRIDGED_N + 1) + 1
    firsts, lasts = seen[np.append(0, after)], seen[np.append(after - 1, len(seen) - 1)]
    longest = int((lasts - firsts).argmax())
    return int(firsts[longest]), int(lasts[longest]) + 1


def measured_response(found: Spectrum) -> NDArray[np.float64]:
    """Magnitude (f,) of output over input; NaN where they are not coherent, or the input has hardly any power."""
    least = found.input_density[1:].max() * 10.0 ** (-_EXCITED_DB / 10.0)
    shown = (found.coherence >= _COHERENT) & (found.input_density >= least)
    return np.where(shown, np.abs(found.response), np.nan)


def _model_response(run: Run, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Magnitude of the last estimate's frequency response in units; None without a model."""
    model = run.datasheet.model
    if model is None or not run.theta.shape[1] or not np.isfinite(run.theta[-1]).all():
        return None
    denominator, numerator = _polynomials(run.theta[-1], model)
    delay = np.exp(-2j * np.pi * frequency_hz * run.conditions.sample_period_problem_s)
    scales = [run.conditions.channels[name].lsb for name in run.conditions.program.measured]
    value = np.polynomial.polynomial.polyval(delay, numerator) / np.polynomial.polynomial.polyval(delay, denominator)
    return np.asarray(np.abs(value) * scales[1] / scales[0])


# -------------------------------------------------------------------------------------------------------- for the page


@dataclass(frozen=True)
class Curve:
    """Curve of a plot."""

    name: str
    style: str
    """``line``, ``dashed`` or ``dots``."""
    points: list[tuple[float, float]]


@dataclass(frozen=True)
class Plot:
    """Curves over the frequency, in pixels of the drawing."""

    caption: str
    curves: list[Curve]
    levels: list[tuple[float, str]]
    """Places and labels of the levels."""
    ticks: list[tuple[float, str]]
    """Places and labels on the axis of the frequency, from its start to its end."""


@dataclass(frozen=True)
class Measured:
    """Figures of a run whose plant is unknown."""

    alarms: list[int]
    fits: tuple[StretchFit, ...]
    gain_unit: str
    gaps: list[str]
    """Sentences about the missing samples of the spectra."""
    plots: list[Plot] | None
    """None: the run is too short for a spectrum."""


def measured(run: Run) -> Measured | None:
    """Figures for the page; None if the plant is known, or there are no samples."""
    if run.conditions.segments or not run.samples:
        return None
    found = spectrum(run)
    gaps, plots = ([], None) if found is None else (_gaps(run, found), _plots(run, found))
    return Measured(run.alarm_index.tolist(), fits(run), _gain_unit(run), gaps, plots)


def _gaps(run: Run, found: Spectrum) -> list[str]:
    notes = []
    if found.end - found.start < run.samples:
        gap = f"more than {_MOST_BRIDGED_N} samples"
        notes.append(f"The spectra are those of samples {found.start} to {found.end - 1}, without a gap of {gap}.")
    if found.bridged_n:
        notes.append(f"Straight lines bridge {number_of(found.bridged_n, 'missing sample', form=',')} in the spectra.")
    return notes


def _plots(run: Run, found: Spectrum) -> list[Plot]:
    units = [run.conditions.channels[name].unit for name in run.conditions.program.measured]
    densities = {
        f"input [dB of {units[0]}²/Hz]": (_decibels(found.input_density, 10.0), "line"),
        f"output [dB of {units[1]}²/Hz]": (_decibels(found.output_density, 10.0), "dashed"),
    }
    responses = {"output over input": (_decibels(measured_response(found), 20.0), "dots")}
    model = _model_response(run, found.frequency_hz)
    if model is not None:
        responses["the device's last estimate"] = (_decibels(model, 20.0), "line")
    response = (
        f"Frequency response in dB of {_gain_unit(run)}, where the coherence is at least {_COHERENT:g} and the input"
        f" within {_EXCITED_DB:g} dB of its largest density"
    )
    captioned = {"Power spectral density": densities, response: responses}
    plots = (_plot(caption, found.frequency_hz[1:], curves) for caption, curves in captioned.items())
    return [plot for plot in plots if plot is not None]


def _decibels(values: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    """Values in decibels but the first, which is that at 0 Hz; NaN where there are none."""
    with np.errstate(all="ignore"):
        out = factor * np.log10(values[1:])
    return np.where(np.isfinite(out), out, np.nan)


def _plot(caption: str, frequency_hz: NDArray[np.float64], curves: _Curves) -> Plot | None:
    """Plot of some curves in decibels; None if they have no value."""
    seen = np.concatenate([values[np.isfinite(values)] for values, _ in curves.values()])
    if not len(seen):
        return None
    low = 10.0 * math.floor(float(seen.min()) / 10.0)
    high, most_hz = max(10.0 * math.ceil(float(seen.max()) / 10.0), low + 10.0), float(frequency_hz[-1])
    step = 10.0 * math.ceil((high - low) / 60.0)

    def place(values: Any) -> Any:
        return _TOP + _HEIGHT * (high - values) / (high - low)

    x = _LEFT + (_RIGHT - _LEFT) * frequency_hz / most_hz
    return Plot(
        caption,
        [
            Curve(name, style, [(a, b) for a, b in zip(x.tolist(), place(y).tolist(), strict=True) if math.isfinite(b)])
            for name, (y, style) in curves.items()
        ],
        levels=[(place(level), f"{level:g}") for level in np.arange(low, high + 1.0, step).tolist()],
        ticks=[(_LEFT + (_RIGHT - _LEFT) * i / 4, f"{most_hz * i / 4:.4g}") for i in range(5)],
    )
