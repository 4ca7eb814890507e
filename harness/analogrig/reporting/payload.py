"""The signals of a run as the page carries them: columns, deflated, in base64.

Codes travel as the card gave them (uint16) and are scaled in the page; what was computed travels as float32. The page
has at most 5 MB: points, marks and steps of the truth are bounded in number, whatever the length of the run.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analogrig.judging.verdict import TweakVerdict, Verdict, trajectory
from analogrig.plant import PARAMETERS, Plant
from analogrig.reporting.points import MOST_POINTS, Piece, condense, condense_clipping, pieces, spread
from analogrig.run import CHANNELS, Run, missing_samples

_DISPLAY_UNITS = {"m": ("mm", 1000.0)}
"""Units that read better as others."""


_MOST_FALSE_ALARMS = 5_000
"""Marks in the plots."""
_MOST_STEPS = 4_000
"""Steps of the truth on all ramps together."""


@dataclass(frozen=True)
class PlotColumn:
    """One signal; the page shows ``offset + scale * values`` in ``unit``."""

    name: str
    values: NDArray[Any]
    """(p,) uint8, uint16 or float32, of the points of the plot."""
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""


def payload(run: Run, verdict: Verdict) -> dict[str, Any]:
    """All that the plots need, in plain JSON types without NaN."""
    shown = _pieces(run, verdict)
    columns = _columns(run, shown)
    noticed, false = _alarms(run, verdict)
    return {
        "samples": run.samples,
        "points": sum(piece.points for piece in shown),
        "pieces": shown,
        "columns": [
            {"name": c.name, "type": c.values.dtype.name, "scale": c.scale, "offset": c.offset, "unit": c.unit}
            for c in columns
        ],
        "deflated": deflate(column.values for column in columns),
        "tweaks": [{"sample": tweak.sample, "label": direction(tweak)} for tweak in verdict.tweaks],
        "alarms": [
            {"sample": index, "false": is_false}
            for index, is_false in sorted([*((each, False) for each in noticed), *((each, True) for each in false)])
        ],
        "overloads": [{"sample": sample, "label": name} for name, sample in sorted(verdict.overloads.items())],
        "segments": [
            {"start": start, "end": end, **_finite_values(plant.parameters())}
            for start, end, plant in _true_segments(run)
        ],
        "ceiling": finite_or_none(verdict.ceiling),
    }


def is_thinned(run: Run) -> bool:
    """True if the plots do not show every sample of the run."""
    return run.samples > MOST_POINTS


def marked_alarms(run: Run, verdict: Verdict) -> int:
    """Alarms with a mark in the plots."""
    return sum(map(len, _alarms(run, verdict)))


def _alarms(run: Run, verdict: Verdict) -> tuple[list[int], list[int]]:
    """Alarms to be marked: those that noticed a change, and false ones."""
    false = set(verdict.false_alarms)
    noticed = [index for index in run.alarm_index.tolist() if index not in false]
    return noticed, spread(
        [index for index in run.alarm_index.tolist() if index in false], run.samples, _MOST_FALSE_ALARMS
    )


def _pieces(run: Run, verdict: Verdict) -> tuple[Piece, ...]:
    """Every sample near the start, the changes, the lamps and the first alarms."""
    noticed, false = _alarms(run, verdict)
    changes = (tweak.sample for tweak in verdict.tweaks)
    return pieces(run.samples, (0, *changes, *noticed, *verdict.overloads.values(), *false))


def _true_segments(run: Run) -> Iterator[tuple[int, int, Plant]]:
    """The segments of the run. Every sample of a ramp is one, or a few samples where the ramps are long."""
    ramps_n = {segment.start: segment.ramp_n for segment in run.conditions.segments}
    step_n = max(1, -(-sum(ramps_n.values()) // _MOST_STEPS))
    before: Plant | None = None
    for start, end, plant in run.segments:
        there = min(start + ramps_n.get(start, 0), end) if before is not None else start
        for k in range(start, there, step_n):
            yield k, min(k + step_n, there), (before or plant).interpolate(plant, (k - start) / ramps_n[start])
        if there < end:
            yield there, end, plant
        before = plant


def as_script(data: Mapping[str, Any]) -> str:
    """``data`` as JSON that cannot end the script element it stands in."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def deflate(columns: Iterable[NDArray[Any]]) -> str:
    """The columns one after another, little-endian, as a zlib stream in base64."""
    raw = b"".join(np.ascontiguousarray(c, dtype=c.dtype.newbyteorder("<")).tobytes() for c in columns)
    return base64.b64encode(zlib.compress(raw, 9)).decode("ascii")


def finite_or_none(value: float | None) -> float | None:
    """``value``, or None when there is none, or JSON has no word for it."""
    return value if value is not None and math.isfinite(value) else None


def direction(tweak: TweakVerdict) -> str:
    """The change in a few characters, for a label in a plot: ``B ↓, K ↑``."""
    return ", ".join(f"{name} {'↑' if tweak.after[name] > old else '↓'}" for name, old in tweak.before.items())


def _columns(run: Run, shown: Sequence[Piece]) -> Sequence[PlotColumn]:
    measured = [i for i, name in enumerate(CHANNELS) if name in run.conditions.channels]
    none = _points(run, slice(0), 1, measured)
    parts = [none, *(_points(run, part, piece.size, measured) for piece in shown for part in piece.parts())]
    values = {name: np.concatenate([part[name] for part in parts]) for name in none}
    return [PlotColumn(name, points, **_units(run, name)) for name, points in values.items()]


def _points(run: Run, part: slice, size: int, measured: Sequence[int]) -> dict[str, NDArray[Any]]:
    """The signals of a part of a run in buckets of ``size`` samples, by name."""
    codes, clipped = run.codes[part][:, measured], run.clipped[part][:, measured]
    shown = condense(codes, size)
    bits = np.packbits(condense_clipping(codes, clipped, size), axis=1, bitorder="little")[:, 0]
    missing = missing_samples(run.clipped[part]).astype(np.uint8)
    estimates = condense(trajectory(run, part).astype(np.float32), size)
    return {
        **{CHANNELS[channel]: shown[:, i] for i, channel in enumerate(measured)},
        "clipped": bits,
        "missing": np.repeat(condense(missing, size)[1::2], 2) if size > 1 else missing,
        **{name: estimates[:, i] for i, name in enumerate(PARAMETERS)},
        "statistic": condense(run.statistic[part], size),
    }


def _units(run: Run, name: str) -> dict[str, Any]:
    """Scale, offset and unit of a column, if it is a channel."""
    if name not in run.conditions.channels:
        return {}
    channel = run.conditions.channels[name]
    unit, factor = _DISPLAY_UNITS.get(channel.unit, (channel.unit, 1.0))
    per_volt = channel.unit_per_v * factor
    return {"scale": channel.lsb_v * per_volt, "offset": channel.low_v * per_volt, "unit": unit}


def _finite_values(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: finite_or_none(value) for name, value in values.items()}
