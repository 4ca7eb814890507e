"""Estimates of parameters: their values from theta, and findings on those that the samples contradict.

A finding takes witnesses: least squares on the same samples and on each half of them, with the orders of the device's
model, plain and after a low-pass filter. All of them must come near the truth. Where the samples hold too little on a
parameter, or the plant was not that of the scenario, one of them is wrong, and the parameter is not judged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from analogrig.datasheet import ModelOrders
from analogrig.plant import Plant, estimated_parameters
from analogrig.run import INPUT, LOST, OUTPUT, UNREPORTED, Run

LEAST_SPAN_N = 160
"""Samples since the start, a change or an alarm from which on an estimate is judged."""

_LAST_N = 20
"""Estimates at the end of a segment whose median error is judged."""

_WITNESSED_N = 400
"""Samples at the end of a segment that the witnesses use: a device may forget older ones."""

_WITNESS_SHARE, _MOST_LIMITS = 0.4, 2.0
"""Largest error of a witness, as a share of that of the device, and the number of limits up to which the latter
counts."""

_ROWS_PER_UNKNOWN = 7
"""Fewest equations for each unknown of a witness."""

_PLAIN, _LOW_PASS = np.ones(1), np.array([(k + 1) * 0.8**k for k in range(24)])
"""Impulse responses of the filters of the witnesses; the second is close to the prefilter of the default device."""


def trajectory(run: Run, samples: Sequence[int] | NDArray[np.int64] | slice = slice(None)) -> NDArray[np.float64]:
    """Estimated parameters after each of ``samples``, (n, m) float64; NaN if theta does not describe them.

    The columns are those of ``Program.estimates``.
    """
    return parameters_of(run, run.theta[samples])


def parameters_of(run: Run, theta: NDArray[np.floating]) -> NDArray[np.float64]:
    """Parameters, as of ``trajectory``, of estimates (n, p) of a device as in ``run``."""
    conditions, model = run.conditions, run.datasheet.model
    if model is None or not theta.shape[1]:
        return np.full((len(theta), len(conditions.program.estimates)), np.nan)
    return estimated_parameters(
        conditions.program,
        theta,
        model,
        input_per_code=conditions.input.lsb,
        output_per_code=conditions.output.lsb,
        period_s=conditions.sample_period_problem_s,
    )


def estimate_findings(run: Run, limit: float) -> Iterator[str]:
    """One sentence for each segment in which an estimate of a parameter is off by more than the share ``limit``."""
    model, names = run.datasheet.model, run.conditions.program.estimates
    if not names or model is None or not run.theta.shape[1] or model.na != len(run.conditions.program.equations.states):
        return
    for start, end, plant in _judged_segments(run):
        middle = (start + end) // 2
        is_reported = (run.flags[middle:end] & np.uint8(UNREPORTED | LOST)) == 0
        rows = middle + np.flatnonzero(is_reported)[-_LAST_N:]
        if not len(rows):
            continue
        truth = np.array([plant.parameters()[name] for name in names])
        found = trajectory(run, rows)
        ordered = np.argsort(np.nan_to_num(np.abs(found / truth - 1.0), nan=np.inf), axis=0, kind="stable")
        median = np.take_along_axis(found, ordered[len(rows) // 2][None], axis=0)[0]
        errors = np.nan_to_num(np.abs(median / truth - 1.0), nan=np.inf)
        if not (errors > limit).any():
            continue
        most = _WITNESS_SHARE * np.clip(errors, limit, _MOST_LIMITS * limit)
        known = (np.abs(_witnesses(run, model, start, end) / truth - 1.0) <= most).all(axis=0)
        off = [
            f"{name} is {f'{median[i]:.5g}' if np.isfinite(median[i]) else 'no number'} instead of {truth[i]:.5g}"
            for i, name in enumerate(names)
            if errors[i] > limit and known[i]
        ]
        if off:
            yield (
                f"the estimate at the end of samples {start}-{end - 1} is off by more than {limit:.0%} ([expect]"
                f" estimate_error): {', '.join(off)}, as least squares finds in the same samples"
            )


def _judged_segments(run: Run) -> Iterator[tuple[int, int, Plant]]:
    """Segments (start, end, plant) in which the device has had time to learn the plant, from where it began to.

    It learns from the start of a record, and anew after an alarm. Segments of a change without an alarm are left out.
    """
    sheet, known = run.datasheet, {segment.start: segment for segment in run.conditions.segments}
    for start, end, plant in run.segments:
        segment = known.get(start)
        if segment is not None and segment.unseen:
            continue
        is_first = start in run.conditions.records
        learns_from = start if is_first or segment is None else start + segment.ramp_n
        alarms = [alarm for alarm in run.alarm_index.tolist() if start < alarm < end]
        if not (is_first or alarms):
            continue
        if sheet.latches and any(alarm < end for alarm in run.alarm_index.tolist()):
            continue
        learns_from = max([learns_from, *alarms])
        least_n = max(LEAST_SPAN_N, sheet.warm_up_n if is_first else 0)
        if end - learns_from >= least_n and not _has_misfit(run, end - 1):
            yield learns_from, end, plant


def _has_misfit(run: Run, sample: int) -> bool:
    """True if the device reported a misfit that had not ended at a sample."""
    record = max(start for start, _ in run.records if start <= sample)
    reported = np.flatnonzero((run.misfit_index >= record) & (run.misfit_index <= sample))
    return bool(len(reported)) and bool(run.misfit_cause[reported[-1]])


def _witnesses(run: Run, model: ModelOrders, start: int, end: int) -> NDArray[np.float64]:
    """Parameters (w, m) by least squares on the last samples of a segment and on their halves, plain and filtered.

    A witness with too few equations is NaN.
    """
    first = max(start, end - _WITNESSED_N)
    middle = (first + end) // 2
    spans = ((first, end), (first, middle), (middle, end))
    thetas = np.stack([_least_squares(run, model, *span, each) for span in spans for each in (_PLAIN, _LOW_PASS)])
    return parameters_of(run, thetas)


def _least_squares(
    run: Run, model: ModelOrders, start: int, end: int, response: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Theta (p,) by least squares on samples filtered by an impulse response; NaN if there are too few equations."""
    driven, output = (np.convolve(run.codes[start:end, i].astype(np.float64), response) for i in (INPUT, OUTPUT))
    is_missing = np.convolve((run.missing | run.lost)[start:end], np.ones(len(response)))
    terms = [(output, -1.0, 1 + i) for i in range(model.na)] + [(driven, 1.0, model.nk + i) for i in range(model.nb)]
    oldest = max(delay for _, _, delay in terms)
    rows = np.arange(len(response) - 1 + oldest, end - start)
    rows = rows[~np.any([is_missing[rows - delay] for delay in range(oldest + 1)], axis=0)]
    theta = np.zeros(model.parameters)
    if len(rows) < _ROWS_PER_UNKNOWN * (len(terms) + 1):
        return theta * np.nan
    regressors = np.stack([*(sign * signal[rows - delay] for signal, sign, delay in terms), np.ones(len(rows))], axis=1)
    theta[: len(terms)] = np.linalg.lstsq(regressors, output[rows], rcond=None)[0][:-1]
    return theta
