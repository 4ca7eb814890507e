"""All schemes on the same data: the question of section 5.6."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analogrig.estimator_config import EstimatorConfig
from analogrig.judging.verdict import judge
from analogrig_thesis.chapter4 import Simulation
from analogrig_thesis.circuit_runs import (
    NOISY,
    TRACKING,
    CircuitRuns,
    ScaledSamples,
    TrackedRun,
    circuit_schemes,
    filtered_schemes,
)
from analogrig_thesis.plants import PROFILE
from analogrig_thesis.schemes import OURS
from analogrig_thesis.tracking import TrackQuality, assess, track

SEEDS = range(20)

CODES_PER_M = 4096 / 0.1996
"""Scale of the card: 10 V are 0.1996 m."""


@dataclass(frozen=True)
class ComparedData:
    """Quality of each scheme on the same data."""

    name: str
    schemes: Mapping[str, TrackQuality]
    """Quality by key of the scheme."""
    bound_n: tuple[float | None, ...] = ()
    """Least mean latency of any detector with a false alarm in 100,000 samples, by change."""


@dataclass(frozen=True)
class SeedSummary:
    """Quality of one scheme over many seeds."""

    missed: int
    changes: int
    extra_alarms: int
    samples: int
    latency_n: float | None
    """Mean over the detected changes."""
    reconverged_n: float | None
    """Median; None if at least half of the changes have no convergence."""


@dataclass(frozen=True)
class SchemeComparison:
    """Tables of all schemes."""

    data: tuple[ComparedData, ...]
    seeds: Mapping[str, SeedSummary]
    instructions: Mapping[str, int]
    """Instructions a sample of the C on x86-64, counted by tests/thesis/cost.py."""


def compare(simulation: Simulation, circuit: CircuitRuns) -> SchemeComparison:
    """Judge all tracks by the true plants; deterministic."""
    ours = track(EstimatorConfig(), simulation.u, simulation.y * CODES_PER_M, 1.0 / CODES_PER_M)
    filtered = {key: assess(each, circuit.noisy.segments) for key, each in filtered_schemes(circuit.noisy.run).items()}
    del filtered["mean-of-magnitudes"]
    return SchemeComparison(
        data=(
            ComparedData("simulation, no noise", {**simulation.qualities, OURS: assess(ours, PROFILE)}),
            _compare_on("circuit, 12 bits, no noise", circuit.quantised),
            _compare_on("circuit, 12 bits, 1 LSB of noise", circuit.noisy),
            ComparedData(
                "the same, filtered off line at 5 Hz and detrended as in section 4.3, which only the thesis needs",
                filtered,
            ),
        ),
        seeds=_over_seeds(circuit.noisy),
        instructions=json.loads((Path(__file__).parent / "cost.json").read_text(encoding="utf-8"))["instructions"],
    )


def _compare_on(name: str, tracked: TrackedRun) -> ComparedData:
    return ComparedData(name, tracked.qualities, tuple(tweak.bound_n for tweak in judge(tracked.run).tweaks))


def _over_seeds(tracked: TrackedRun) -> dict[str, SeedSummary]:
    judged: dict[str, list[TrackQuality]] = {}
    for seed in SEEDS:
        codes = ScaledSamples.play(NOISY, TRACKING, seed)
        for key, config in circuit_schemes(tracked.codes.m_per_unit).items():
            judged.setdefault(key, []).append(assess(codes.track(config), tracked.segments))
    return {key: _summarise(each) for key, each in judged.items()}


def _summarise(qualities: Sequence[TrackQuality]) -> SeedSummary:
    latencies = [n for each in qualities for n in each.latency_n if n is not None]
    settled = [np.inf if n is None else float(n) for each in qualities for n in each.reconverged_n]
    median = float(np.median(settled))
    return SeedSummary(
        missed=sum(each.missed for each in qualities),
        changes=len(settled),
        extra_alarms=sum(each.extra_alarms for each in qualities),
        samples=len(qualities) * TRACKING.samples,
        latency_n=float(np.mean(latencies)) if latencies else None,
        reconverged_n=median if np.isfinite(median) else None,
    )
