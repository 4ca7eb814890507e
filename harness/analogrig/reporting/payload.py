"""Signals of a run for the plots of the page: columns, deflated, in base64.

Codes are embedded as uint16 and scaled in the page; computed signals as float32. The page has at most 5 MB, because
points, marks and steps of the truth are bounded in number.

A short run is shown sample by sample. A long run is divided into pieces: every sample near moments of interest, and
elsewhere the minimum and the maximum of each bucket of consecutive samples. Zoomed out, a bucket is narrower than a
pixel, so the plot looks the same as with all samples.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.estimates import trajectory
from analogrig.judging.verdict import ChangeVerdict, Verdict
from analogrig.plant import Plant, estimated_response
from analogrig.run import CHUNK_SAMPLES, IMPORTED, Run, missing_samples

MOST_POINTS = 100_000
"""Longest run that is shown sample by sample."""

_MOST_BUCKETS = 25_000
_MOST_NEAR_MOMENTS = 50_000
"""Samples shown near all moments together."""
_MOST_MOMENTS = 100
_LONGEST_REACH = 1_000
"""Samples on either side of a moment."""

_MODE = ("resonance", "damping", "gain")
"""Estimates of a plant of which nothing is known, by a model of the second order."""

_MODE_ORDER = 2

_DISPLAY_UNITS = {"m": ("mm", 1000.0)}
"""Units that the page displays as others, with the factor."""

_MOST_FALSE_ALARMS = 5_000
"""Largest number of false alarms marked in the plots."""
_MOST_STEPS = 4_000
"""Largest number of steps of the truth on all ramps together."""


class Piece(NamedTuple):
    """Samples ``start`` <= k < ``end``, in buckets of ``size`` samples; the last bucket may be shorter."""

    start: int
    end: int
    size: int
    """1: the points are the samples themselves. Otherwise each bucket has two points, at its start and its middle."""

    @property
    def points(self) -> int:
        """Number of points in the plot."""
        return self.end - self.start if self.size == 1 else 2 * -(-(self.end - self.start) // self.size)

    def parts(self) -> Iterator[slice]:
        """Slices of whole buckets, each of about CHUNK_SAMPLES samples."""
        step = max(1, CHUNK_SAMPLES // self.size) * self.size
        for first in range(self.start, self.end, step):
            yield slice(first, min(first + step, self.end))


def pieces(samples: int, moments: Iterable[int]) -> tuple[Piece, ...]:
    """Division of a run; ``moments`` are the samples of interest, the most important first."""
    if samples <= MOST_POINTS:
        return (Piece(0, samples, 1),)
    size = -(-samples // _MOST_BUCKETS)
    out: list[Piece] = []
    end = 0
    for begin, last in [*_spans_near(moments, samples), (samples, samples)]:
        first = begin - ((begin - end) % size == 1)  # a bucket of one sample has no two points
        if end < first:
            out.append(Piece(end, first, size))
        if first < last:
            out.append(Piece(first, last, 1))
        end = last
    return tuple(out)


def _spans_near(moments: Iterable[int], samples: int) -> list[tuple[int, int]]:
    """Spans (first, end) around the most important moments, in order and apart."""
    chosen = list(dict.fromkeys(moments))[:_MOST_MOMENTS]
    reach = min(_LONGEST_REACH, _MOST_NEAR_MOMENTS // (2 * len(chosen))) if chosen else 0
    out: list[tuple[int, int]] = []
    for moment in sorted(chosen):
        first, end = max(0, moment - reach), min(samples, moment + reach)
        if out and first <= out[-1][1] + 1:
            first = out.pop()[0]
        out.append((first, end))
    return out


def condense(values: NDArray[Any], size: int) -> NDArray[Any]:
    """(p, ...): minimum and maximum in turn of each bucket of (n, ...); NaN for a bucket without a finite value."""
    if size == 1:
        return values
    if values.dtype.kind == "f":
        values = np.where(np.isfinite(values), values, np.nan)
    starts = range(0, len(values), size)
    out = np.empty((2 * len(starts), *values.shape[1:]), values.dtype)
    out[0::2] = np.fmin.reduceat(values, starts, axis=0)
    out[1::2] = np.fmax.reduceat(values, starts, axis=0)
    return out


def condense_clipping(codes: NDArray[np.uint16], clipped: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    """(p, c): the points of ``condense(codes, size)`` that were clipped; a clipped code is an end of its range."""
    if size == 1:
        return clipped
    ends, bucket = condense(codes, size), np.arange(len(codes)) // size
    at_end = (clipped & (codes == ends[half::2][bucket]) for half in range(2))
    found = [np.logical_or.reduceat(each, range(0, len(codes), size), axis=0) for each in at_end]
    return np.stack(found, axis=1).reshape(ends.shape)


def thin_out(values: Sequence[int], samples: int, most: int) -> list[int]:
    """At most ``most`` of ``values`` (sample indices), in order: the first in each equal part of the run."""
    if len(values) <= most:
        return sorted(values)
    ordered = np.sort(np.asarray(values, np.int64))
    _, firsts = np.unique(ordered * most // samples, return_index=True)
    return [int(each) for each in ordered[firsts]]


def payload(run: Run, verdict: Verdict) -> dict[str, Any]:
    """Data of the plots in plain JSON types without NaN."""
    detections, false = _alarms(run, verdict)
    moments = (0, *(change.sample for change in verdict.changes), *detections, *verdict.overloads.values(), *false)
    shown = pieces(run.samples, moments)
    values = _signals(run, shown)
    program = run.conditions.program
    return {
        "samples": run.samples,
        "channels": [name for name in program.channels if name in run.conditions.channels],
        "estimates": [{"name": name, "unit": program.unit(name)} for name in program.estimates if name in values],
        "points": sum(piece.points for piece in shown),
        "pieces": shown,
        "columns": [{"name": name, "type": each.dtype.name, **_units(run, name)} for name, each in values.items()],
        "deflated": deflate(values.values()),
        "changes": [{"sample": change.sample, "label": _direction(change)} for change in verdict.changes],
        "alarms": [
            {"sample": index, "false": is_false}
            for index, is_false in sorted([*((each, False) for each in detections), *((each, True) for each in false)])
        ],
        "overloads": [{"sample": sample, "label": name} for name, sample in sorted(verdict.overloads.items())],
        "segments": [
            {"start": start, "end": end, **{key: _finite(value) for key, value in plant.parameters().items()}}
            for start, end, plant in _true_segments(run)
        ],
        "ceiling": _finite(verdict.ceiling),
        "period_s": run.conditions.sample_period_problem_s,
    }


def is_thinned(run: Run) -> bool:
    """True if the plots do not show every sample of the run."""
    return run.samples > MOST_POINTS


def marked_alarms(run: Run, verdict: Verdict) -> int:
    """Number of alarms with a mark in the plots."""
    return sum(map(len, _alarms(run, verdict)))


def _alarms(run: Run, verdict: Verdict) -> tuple[list[int], list[int]]:
    """Alarms to be marked: detections, and false alarms."""
    false = set(verdict.false_alarms)
    detections = [index for index in run.alarm_index.tolist() if index not in false]
    return detections, thin_out(
        [index for index in run.alarm_index.tolist() if index in false], run.samples, _MOST_FALSE_ALARMS
    )


def _true_segments(run: Run) -> Iterator[tuple[int, int, Plant]]:
    """True segments for the plots. A ramp is divided into steps of one sample, or of several if the ramps are long."""
    ramps_n = {segment.start: segment.ramp_n for segment in run.conditions.segments}
    step_n = max(1, -(-sum(ramps_n.values()) // _MOST_STEPS))
    before: Plant | None = None
    for start, end, plant in run.segments:
        ramp_end = min(start + ramps_n.get(start, 0), end) if before is not None else start
        for k in range(start, ramp_end, step_n):
            yield k, min(k + step_n, ramp_end), (before or plant).interpolate(plant, (k - start) / ramps_n[start])
        if ramp_end < end:
            yield ramp_end, end, plant
        before = plant


def as_script(data: Mapping[str, Any]) -> str:
    """``data`` as JSON, escaped for use inside a script element."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def deflate(columns: Iterable[NDArray[Any]]) -> str:
    """Columns one after another, little-endian, as a zlib stream in base64."""
    raw = b"".join(np.ascontiguousarray(c, dtype=c.dtype.newbyteorder("<")).tobytes() for c in columns)
    return base64.b64encode(zlib.compress(raw, 9)).decode("ascii")


def _finite(value: float | None) -> float | None:
    """``value``, or None if it is None or non-finite."""
    return value if value is not None and math.isfinite(value) else None


def _direction(change: ChangeVerdict) -> str:
    """Label of a change in a plot: ``B ↓, K ↑``."""
    return ", ".join(f"{name} {'↑' if change.after[name] > old else '↓'}" for name, old in change.before.items())


def _signals(run: Run, shown: Sequence[Piece]) -> dict[str, NDArray[Any]]:
    """Signals by name: (p,) uint8, uint16 or float32, of the points of the plot."""
    measured = [i for i, name in enumerate(run.conditions.program.channels) if name in run.conditions.channels]
    none = _points(run, slice(0), 1, measured)
    parts = [none, *(_points(run, part, piece.size, measured) for piece in shown for part in piece.parts())]
    return {name: np.concatenate([part[name] for part in parts]) for name in none}


def _points(run: Run, part: slice, size: int, measured: Sequence[int]) -> dict[str, NDArray[Any]]:
    """Signals of a part of a run in buckets of ``size`` samples, by name."""
    codes, clipped = run.codes[part][:, measured], run.clipped[part][:, measured]
    shown = condense(codes, size)
    bits = np.packbits(condense_clipping(codes, clipped, size), axis=1, bitorder="little")[:, 0]
    missing = missing_samples(run.clipped[part]).astype(np.uint8)
    reported: dict[str, NDArray[Any]] = {}
    if run.datasheet.model is not None:
        names, estimates = _estimates(run, part)
        shown_estimates = condense(estimates.astype(np.float32), size)
        reported |= {name: shown_estimates[:, i] for i, name in enumerate(names)}
    if run.datasheet.innovation:
        reported["innovation"] = condense(run.innovation[part], size)
    if run.datasheet.statistic:
        reported["statistic"] = condense(run.statistic[part], size)
    return {
        **{run.conditions.program.channels[channel]: shown[:, i] for i, channel in enumerate(measured)},
        "clipped": bits,
        "missing": np.repeat(condense(missing, size)[1::2], 2) if size > 1 else missing,
        **reported,
    }


def _estimates(run: Run, part: slice) -> tuple[Sequence[str], NDArray[np.float64]]:
    """Names and values (n, m) of the estimates; of an unknown plant its resonance, damping and gain."""
    conditions, model = run.conditions, run.datasheet.model
    if conditions.segments:
        return conditions.program.estimates, trajectory(run, part)
    if model is None or model.na != _MODE_ORDER or not run.theta.shape[1]:
        return (), np.empty((len(run.theta[part]), 0))
    scales = conditions.input.lsb, conditions.output.lsb
    found = estimated_response(run.theta[part], model, *scales, conditions.sample_period_s)
    with np.errstate(all="ignore"):
        rate = np.sqrt(found["s0"])
        return _MODE, np.stack([rate / (2.0 * np.pi), found["s1"] / (2.0 * rate), found["gain"]], axis=1)


def _units(run: Run, name: str) -> dict[str, Any]:
    """Scale, offset and unit of a signal; the page shows ``offset + scale * values``.

    Clipped codes of imported columns between 0 and ``last`` stand for no value.
    """
    conditions = run.conditions
    if name not in conditions.channels:
        return {"scale": 1.0, "offset": 0.0, "unit": ""}
    channel = conditions.channels[name]
    unit, factor = _DISPLAY_UNITS.get(channel.unit, (channel.unit, 1.0))
    per_volt = channel.unit_per_v * factor
    return {"scale": channel.lsb_v * per_volt, "offset": channel.low_v * per_volt, "unit": unit} | (
        {"last": channel.codes - 1} if conditions.source.kind == IMPORTED and "rig" not in conditions.rig else {}
    )
