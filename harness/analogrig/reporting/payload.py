"""The signals of a run as the page carries them: columns, deflated, in base64.

Codes travel as the card gave them (uint16) and are scaled in the page; what was computed travels as float32.
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
from analogrig.run import CHANNELS, Run

_SHOWN = {"m": ("mm", 1000.0)}
"""Units that read better as others."""


@dataclass(frozen=True)
class Column:
    """One signal; the page shows ``offset + scale * values`` in ``unit``."""

    name: str
    values: NDArray[Any]
    """(n,) uint8, uint16 or float32."""
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""


def payload(run: Run, verdict: Verdict) -> dict[str, Any]:
    """All that the plots need, in plain JSON types without NaN."""
    columns = _columns(run)
    false_alarms = set(verdict.false_alarms)
    return {
        "samples": run.samples,
        "columns": [
            {"name": c.name, "type": c.values.dtype.name, "scale": c.scale, "offset": c.offset, "unit": c.unit}
            for c in columns
        ],
        "deflated": deflated(column.values for column in columns),
        "tweaks": [{"sample": tweak.sample, "label": direction(tweak)} for tweak in verdict.tweaks],
        "alarms": [{"sample": index, "false": index in false_alarms} for index in run.alarm_index.tolist()],
        "overloads": [{"sample": sample, "label": name} for name, sample in sorted(verdict.overloads.items())],
        "segments": [
            {"start": start, "end": end, **_finite_only(plant.parameters())} for start, end, plant in _truth(run)
        ],
        "ceiling": finite(verdict.ceiling),
    }


def _truth(run: Run) -> Iterator[tuple[int, int, Plant]]:
    """The segments of the run, every sample of a ramp being one."""
    ramps_n = {segment.start: segment.ramp_n for segment in run.conditions.segments}
    before: Plant | None = None
    for start, end, plant in run.segments:
        there = min(start + ramps_n.get(start, 0), end) if before is not None else start
        for k in range(start, there):
            yield k, k + 1, (before or plant).on_the_way(plant, (k - start) / ramps_n[start])
        if there < end:
            yield there, end, plant
        before = plant


def as_script(data: Mapping[str, Any]) -> str:
    """``data`` as JSON that cannot end the script element it stands in."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def deflated(columns: Iterable[NDArray[Any]]) -> str:
    """The columns one after another, little-endian, as a zlib stream in base64."""
    raw = b"".join(np.ascontiguousarray(c, dtype=c.dtype.newbyteorder("<")).tobytes() for c in columns)
    return base64.b64encode(zlib.compress(raw, 9)).decode("ascii")


def finite(value: float | None) -> float | None:
    """``value``, or None when there is none, or JSON has no word for it."""
    return value if value is not None and math.isfinite(value) else None


def direction(tweak: TweakVerdict) -> str:
    """The change in a few characters, for a label in a plot: ``B ↓, K ↑``."""
    return ", ".join(f"{name} {'↑' if tweak.after[name] > old else '↓'}" for name, old in tweak.before.items())


def _columns(run: Run) -> Sequence[Column]:
    estimates = trajectory(run).astype(np.float32)
    measured = [i for i, name in enumerate(CHANNELS) if name in run.conditions.channels]
    return [
        *(_channel(run, CHANNELS[i]) for i in measured),
        Column("clipped", np.packbits(run.clipped[:, measured], axis=1, bitorder="little")[:, 0]),
        Column("missing", run.missing.astype(np.uint8)),
        *(Column(name, estimates[:, i]) for i, name in enumerate(PARAMETERS)),
        Column("statistic", run.statistic),
    ]


def _channel(run: Run, name: str) -> Column:
    channel = run.conditions.channels[name]
    unit, factor = _SHOWN.get(channel.unit, (channel.unit, 1.0))
    per_volt = channel.unit_per_v * factor
    codes = run.codes[:, CHANNELS.index(name)]
    return Column(name, codes, scale=channel.lsb_v * per_volt, offset=channel.low_v * per_volt, unit=unit)


def _finite_only(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: finite(value) for name, value in values.items()}
