"""Every scheme on the same data: what section 5.6 asks."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from analogrig.judging.verdict import judge
from analogrig_thesis.chapter4 import THESIS_SCHEMES, Simulation
from analogrig_thesis.chapter5 import Circuit
from analogrig_thesis.circuit import (
    CUTOFFS_HZ,
    NOISY,
    TRACKING,
    circuit_schemes,
    codes,
    conditioned_tracks,
    track_codes,
)
from analogrig_thesis.model import PROFILE
from analogrig_thesis.schemes import OURS
from analogrig_thesis.tracking import Performance, performance, track

SEEDS = range(20)

CODES_PER_M = 4096 / 0.1996
"""Of the card: 10 V are 0.1996 m."""

_COST = Path(__file__).parent / "cost.json"


@dataclass(frozen=True)
class Data:
    """What the schemes are compared on, and what came of each, by its key."""

    name: str
    rows: Mapping[str, Performance]
    bound_n: tuple[float | None, ...] = ()
    """Of each change: what no detector with a false alarm in 100,000 samples can beat on average."""


@dataclass(frozen=True)
class Seeds:
    """What came of one scheme over many seeds."""

    missed: int
    changes: int
    extra_alarms: int
    samples: int
    latency_n: float | None
    """Mean of those that were noticed."""
    reconverged_n: float | None
    """Median; None if half of them never did."""


@dataclass(frozen=True)
class Comparison:
    """The whole of it."""

    names: Mapping[str, str]
    """Of the schemes, by their keys, in order."""
    data: tuple[Data, ...]
    seeds: Mapping[str, Seeds]
    cost: Mapping[str, float]
    """Instructions a sample of the C on x86-64, as last measured by tests/thesis/cost.py."""


def compare(simulation: Simulation, circuit: Circuit) -> Comparison:
    """Judge all tracks by the truth; deterministic."""
    ours = track(OURS.config, simulation.u, simulation.y * CODES_PER_M, CODES_PER_M)
    simulated = {**simulation.performances, OURS.key: performance(ours, PROFILE)}
    recorded = (("circuit, 12 bits, no noise", circuit.quantised), ("circuit, 12 bits, 1 LSB of noise", circuit.noisy))
    played = [
        Data(
            name,
            {key: performance(each, recording.segments) for key, each in recording.tracks.items()},
            tuple(tweak.bound_n for tweak in judge(recording.run).tweaks),
        )
        for name, recording in recorded
    ]
    return Comparison(
        names={scheme.key: scheme.name for scheme in (*THESIS_SCHEMES, OURS)},
        data=(Data("simulation, no noise", simulated), *played, _conditioned(circuit)),
        seeds=_over_seeds(circuit),
        cost={
            key: float(value) for key, value in json.loads(_COST.read_text(encoding="utf-8"))["instructions"].items()
        },
    )


def _conditioned(circuit: Circuit) -> Data:
    run = circuit.noisy.run
    rows = {key: performance(each, circuit.noisy.segments) for key, each in conditioned_tracks(run).items()}
    del rows["mean-of-magnitudes"]
    return Data(
        f"the same, filtered off line at {CUTOFFS_HZ[0]:g} Hz and detrended as in section 4.3, which only the thesis"
        " needs",
        rows,
    )


def _over_seeds(circuit: Circuit) -> dict[str, Seeds]:
    segments = circuit.noisy.segments
    m_per_code = circuit.noisy.run.conditions.channels["displacement"].lsb
    judged: dict[str, list[Performance]] = {}
    for seed in SEEDS:
        samples = codes(NOISY, TRACKING, seed)
        for scheme in circuit_schemes(m_per_code):
            judged.setdefault(scheme.key, []).append(performance(track_codes(scheme.config, samples), segments))
    return {key: _gathered(each) for key, each in judged.items()}


def _gathered(each: Sequence[Performance]) -> Seeds:
    latencies = [n for one in each for n in one.latency_n if n is not None]
    settled = [np.inf if n is None else float(n) for one in each for n in one.reconverged_n]
    median = float(np.median(settled))
    return Seeds(
        missed=sum(one.missed for one in each),
        changes=len(settled),
        extra_alarms=sum(one.extra_alarms for one in each),
        samples=len(each) * TRACKING.samples,
        latency_n=float(np.mean(latencies)) if latencies else None,
        reconverged_n=median if np.isfinite(median) else None,
    )


def as_json(comparison: Comparison) -> dict[str, Any]:
    """In plain values."""
    return {
        "data": [
            {"name": each.name, "bound_n": list(each.bound_n), "schemes": {k: vars(v) for k, v in each.rows.items()}}
            for each in comparison.data
        ],
        "seeds": {key: vars(each) for key, each in comparison.seeds.items()},
        "instructions": dict(comparison.cost),
    }
